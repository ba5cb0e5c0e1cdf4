"""The cache of compiled kernels: folders that no other user can write to, because numba runs the code in them.

Kernels are kept next to their source if that is writable, as in a clone or the user's own environment. If several users
share an installation, each has a folder below XDG_CACHE_HOME or ~/.cache, or, without a home folder, below the folder
for temporary files. The folder must belong to the user, with mode 0700. Every folder above it must belong to the user
or root, and no other user may be able to replace it. Otherwise kernels go to a new folder for this program only. A
folder given by NUMBA_CACHE_DIR is the user's own choice and is used as it is.

The reason: the name of a folder in /tmp can be guessed, and another user who creates it first could put code into it.
"""

import atexit
import hashlib
import os
import shutil
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from evetac_cli.errors import InputError

PACKAGE = Path(os.path.abspath(__file__)).parent  # links are kept, as in numba's paths
SETTINGS = ".numba_config.yaml"  # numba reads this file from the working folder, no matter who created it
OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH
NOT_KEPT = "compiled kernels are not kept: found no folder that only you can access; set NUMBA_CACHE_DIR to one"


def own_folder(candidates: Iterable[Path] | None = None) -> Path | None:
    """Return the first candidate that can be private to this user, creating it if needed; None if there is none."""
    for folder in _candidates() if candidates is None else candidates:
        with suppress(OSError):
            if (private_folder := _made_private(folder)) is not None:
                return private_folder
    return None


def _candidates() -> Iterator[Path]:
    for cache in (os.environ.get("XDG_CACHE_HOME", ""), os.path.expanduser("~/.cache")):
        if os.path.isabs(cache) and os.path.isdir(os.path.dirname(cache)):
            yield Path(cache) / "evetac" / "numba"
    with suppress(OSError):  # there is no folder for temporary files
        yield Path(tempfile.gettempdir()) / f"evetac-numba-{os.geteuid()}"


def _made_private(folder: Path) -> Path | None:
    """Return the folder's path without links, created with mode 0700 if needed; None if it is not private.

    Parents are checked from the root down: if no other user can replace a parent, the result of a check stays valid.
    """
    above = Path(os.path.realpath(folder.parent))
    for part in (*reversed(above.parents), above):
        with suppress(FileExistsError):
            if not os.path.lexists(part):
                part.mkdir(0o700)
        if not is_out_of_reach(part):
            return None
    own = above / folder.name
    with suppress(FileExistsError):
        own.mkdir(0o700)
    status = own.lstat()
    is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid()
    return own if is_own and not status.st_mode & (stat.S_IRWXG | stat.S_IRWXO) else None


def is_out_of_reach(folder: Path) -> bool:
    """Whether this is a folder, not a link, of this user or root, in which no other user can replace their files."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid not in (0, os.geteuid()):
        return False
    return not status.st_mode & OTHERS_MAY_WRITE or bool(status.st_mode & stat.S_ISVTX)


def folder_for_kernels() -> Path | None:
    """Return the private folder for this user's kernels, with the kernels of the package; None if there is none."""
    folder = own_folder()
    if folder is not None:
        _take_over(folder)
    return folder


def _take_over(folder: Path) -> None:
    """Copy the kernels that were compiled next to the source at installation, so that they are not compiled again.

    Anyone who can write them can also write the source. Each user still needs a copy, because numba does not load from
    a folder that it cannot write to. Kernels that cannot be copied are compiled.
    """
    with suppress(OSError):
        _copy_kernels(folder)


def _copy_kernels(folder: Path) -> None:
    for beside in filter(_is_the_installers, PACKAGE.rglob("__pycache__")):
        place = folder / numba_name(beside.parent)
        for source in filter(_is_the_installers, sorted(beside.glob("*.nb[ci]"))):  # *.nbi refers to *.nbc: that first
            target = place / source.name
            if target.exists() and target.stat().st_mtime >= source.stat().st_mtime:
                continue
            place.mkdir(exist_ok=True)
            unfinished = place / f"{source.name}.{os.getpid()}"
            shutil.copy2(source, unfinished)
            unfinished.replace(target)  # atomic: another process of this user may be reading it


def _is_the_installers(path: Path) -> bool:
    """Whether this file can only have been written by this user or a user who can write the package's source."""
    status = path.lstat()
    return status.st_uid in (0, os.geteuid(), PACKAGE.stat().st_uid) and not status.st_mode & OTHERS_MAY_WRITE


def numba_name(folder: Path) -> str:
    """Return the name of numba's subfolder for kernels whose source is in this folder."""
    return f"{folder.name}_{hashlib.sha1(str(folder).encode()).hexdigest()}"


def drop_unreadable() -> None:
    """Remove compiled kernels that numba cannot read because they refer to a class that is gone; once per source.

    Numba reads a cached kernel before it checks whether the source is unchanged, and an error there ends the program.
    """
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or PACKAGE)
    stamp, sources = folder / "__pycache__" / "evetac-sources", _digest_of_sources()
    with suppress(OSError):
        if stamp.is_file() and stamp.read_text() == sources:
            return
        for index in folder.rglob("*.nbi"):
            if not _is_readable(index):
                index.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        unfinished = stamp.with_name(f"{stamp.name}.{os.getpid()}")
        unfinished.write_text(sources)
        unfinished.replace(stamp)


def _digest_of_sources() -> str:
    digest = hashlib.sha1()
    for folder, below, names in os.walk(PACKAGE):
        below[:] = sorted(set(below) - {"__pycache__"})  # it contains thousands of kernels
        for name in sorted(names):
            if name.endswith(".py"):
                digest.update(f"{folder}/{name} {os.stat(os.path.join(folder, name)).st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _is_readable(index: Path) -> bool:
    """Whether numba can read an index file of its cache; this reads it in the same manner."""
    import pickle  # `evetac --help` needs none of it

    try:
        with index.open("rb") as file:
            pickle.load(file)  # the version of numba
            pickle.loads(file.read())
    except Exception:  # any error that a missing class causes
        return False
    return True


def is_beside_source() -> bool:
    """Whether kernels are kept next to their source."""
    return os.access(PACKAGE, os.W_OK)


def refuse_settings_in_the_working_folder() -> None:
    """Raise InputError if numba would find settings in the folder in which the program was started.

    They are not part of the command and may come with somebody else's data; they change numbers and load code.
    """
    if os.path.lexists(SETTINGS):
        raise InputError(
            "this file in the working folder would change how numba compiles, so evetac does not start here",
            where=os.path.abspath(SETTINGS),
            hint="move the file or start evetac in another folder; use NUMBA_... variables for your own settings",
        )


@contextmanager
def settled_by_environment() -> Iterator[str]:
    """Set where this program and its child processes load compiled code from, and yield a note for the user.

    This includes modules: for a program run by name, Python first searches the working folder, where another person
    may have put a `json.py`.
    """
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", "")  # set, so that SETTINGS cannot define it
    if "NUMBA_CACHE_DIR" in os.environ:
        yield ""
        return
    if is_beside_source():
        os.environ["NUMBA_CACHE_DIR"] = ""
        yield ""
        return
    if (folder := folder_for_kernels()) is not None:
        _put_caches_into(folder)
        yield ""
        return
    with tempfile.TemporaryDirectory(prefix="evetac-numba-", ignore_cleanup_errors=True) as temporary:
        _take_over(Path(temporary))
        _put_caches_into(Path(temporary))
        yield NOT_KEPT


def _put_caches_into(folder: Path) -> None:
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if not os.access(os.path.expanduser("~"), os.W_OK):  # otherwise matplotlib makes a folder, with a warning each time
        os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))


def settle_for_this_process() -> None:
    """Set the kernel cache for a program that imports evetac, without changing environment variables."""
    if not is_beside_source():
        before_the_first_kernel(_settle_numba)


def _settle_numba() -> None:
    import numba

    if not numba.config.CACHE_DIR:
        folder = folder_for_kernels()
        if folder is None:
            warnings.warn(NOT_KEPT, RuntimeWarning, stacklevel=3)
            folder = Path(tempfile.mkdtemp(prefix="evetac-numba-"))
            _take_over(folder)
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
        numba.config.CACHE_DIR = str(folder)


_waiting: list[Callable[[], None]] = []  # functions to call before the first kernel


def before_the_first_kernel(act: Callable[[], None]) -> None:
    """Call `act` after numba is loaded and before the first kernel: now if numba is loaded, never without kernels."""
    if "numba" in sys.modules:
        act()
    elif act not in _waiting:
        _waiting.append(act)


def forget(act: Callable[[], None]) -> None:
    """Do not call `act` before the first kernel any more."""
    with suppress(ValueError):
        _waiting.remove(act)


def first_kernel_comes() -> None:
    """Call the functions that wait for the first kernel, once; used by kernels/compiled.py."""
    while _waiting:
        _waiting.pop(0)()
