"""Where compiled kernels are kept: in folders that no other user can write to, because numba runs what it finds there.

They are kept beside their source where that can be written to: in a clone, or an environment of one's own. Where one
installation serves several users, each has a folder of their own below XDG_CACHE_HOME or ~/.cache, or, where there is
no home folder, below the one for temporary files. It has to belong to the user, with mode 0700, and every folder above
it to the user or root, and nobody else may be able to exchange it. Otherwise kernels are kept in a new folder for this
program alone. What NUMBA_CACHE_DIR names is the user's own choice and is taken as it is.

Why so: the name of a folder in /tmp can be guessed, and whoever makes it first can put into it what others then run.
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

PACKAGE = Path(os.path.abspath(__file__)).parent  # with its links, as numba writes paths
SETTINGS = ".numba_config.yaml"  # numba obeys the one in the working folder, whoever put it there
OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH
NOT_KEPT = "compiled kernels are not kept: no folder for them is yours alone; set NUMBA_CACHE_DIR to one that is"


def own_folder(candidates: Iterable[Path] | None = None) -> Path | None:
    """The first of some folders that can be made this user's alone, made if need be; None if there is none."""
    for folder in _candidates() if candidates is None else candidates:
        with suppress(OSError):
            if (made := _made_private(folder)) is not None:
                return made
    return None


def _candidates() -> Iterator[Path]:
    for cache in (os.environ.get("XDG_CACHE_HOME", ""), os.path.expanduser("~/.cache")):
        if os.path.isabs(cache) and os.path.isdir(os.path.dirname(cache)):
            yield Path(cache) / "evetac" / "numba"
    with suppress(OSError):  # there is no folder for temporary files
        yield Path(tempfile.gettempdir()) / f"evetac-numba-{os.geteuid()}"


def _made_private(folder: Path) -> Path | None:
    """The folder by its path without links, made with mode 0700 if need be; None unless it is this user's alone.

    From the root down: where nobody else can exchange what is above, what was looked at stays what it is.
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
    """Whether this is a folder of this user or root in which nobody else can replace what is theirs; no link is."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid not in (0, os.geteuid()):
        return False
    return not status.st_mode & OTHERS_MAY_WRITE or bool(status.st_mode & stat.S_ISVTX)


def folder_for_kernels() -> Path | None:
    """The folder for this user's kernels, with those that came with the package; None if there is none of their own."""
    folder = own_folder()
    if folder is not None:
        _take_over(folder)
    return folder


def _take_over(folder: Path) -> None:
    """Copy kernels that whoever installed the package compiled beside the source, so that nobody waits for them again.

    Whoever can write there can write the source too. Each user still needs a copy, because numba loads nothing from a
    folder that it cannot write to. What cannot be copied is compiled.
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
            unfinished.replace(target)  # another process of this user may be reading it


def _is_the_installers(path: Path) -> bool:
    """Whether only those can have written this who can write the package's source, or this user."""
    status = path.lstat()
    return status.st_uid in (0, os.geteuid(), PACKAGE.stat().st_uid) and not status.st_mode & OTHERS_MAY_WRITE


def numba_name(folder: Path) -> str:
    """The name that numba gives, in a folder for all kernels, to those whose source lies in this folder."""
    return f"{folder.name}_{hashlib.sha1(str(folder).encode()).hexdigest()}"


def drop_unreadable() -> None:
    """Remove compiled kernels that numba could not read, because a class that they name has gone; once per source.

    Why so: numba reads what it kept of a kernel before it looks whether the source is still the same, and an error ends
    the program.
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
        below[:] = sorted(set(below) - {"__pycache__"})  # which holds thousands of kernels
        for name in sorted(names):
            if name.endswith(".py"):
                digest.update(f"{folder}/{name} {os.stat(os.path.join(folder, name)).st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _is_readable(index: Path) -> bool:
    """Whether numba could read an index of its cache, as it will."""
    import pickle  # `evetac --help` needs none of it

    try:
        with index.open("rb") as file:
            pickle.load(file)  # the version of numba
            pickle.loads(file.read())
    except Exception:  # whatever a class that is gone leads to
        return False
    return True


def is_beside_source() -> bool:
    """Whether kernels are kept beside their source."""
    return os.access(PACKAGE, os.W_OK)


def refuse_settings_in_the_working_folder() -> None:
    """InputError where numba would find settings in the folder in which the program was started.

    They are no part of the command, and may come with somebody else's data; they change numbers and load code.
    """
    if os.path.lexists(SETTINGS):
        raise InputError(
            "this file in the working folder would change how numba compiles, so evetac does not start beside it",
            where=os.path.abspath(SETTINGS),
            hint="move it away, or start evetac in another folder; settings of your own: variables NUMBA_...",
        )


@contextmanager
def settled_by_environment() -> Iterator[str]:
    """Settle for this program, and for all processes that it starts, what they load code from; what to tell the user.

    Also their modules: Python looks for those of a program that it is told to run by name in the working folder first,
    where anybody may have put a `json.py`.
    """
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", "")  # that it is set bars what SETTINGS might say
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
    if not os.access(os.path.expanduser("~"), os.W_OK):  # else matplotlib makes another one, with a warning each time
        os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))


def settle_for_this_process() -> None:
    """As above where somebody else's program imports evetac: kernels alone, and no variable of the environment."""
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


_waiting: list[Callable[[], None]] = []  # for the first kernel


def before_the_first_kernel(act: Callable[[], None]) -> None:
    """Call this when numba is loaded and before a kernel is: at once where numba is there, or never without kernels."""
    if "numba" in sys.modules:
        act()
    elif act not in _waiting:
        _waiting.append(act)


def forget(act: Callable[[], None]) -> None:
    """Call this no longer before the first kernel."""
    with suppress(ValueError):
        _waiting.remove(act)


def first_kernel_comes() -> None:
    """Call what waits for the first kernel, once; for kernels/compiled.py."""
    while _waiting:
        _waiting.pop(0)()
