"""Where compiled kernels are kept: in a folder for one state of their sources.

numba compares only the file of a kernel, and would keep using it after a function that it calls was edited elsewhere,
or fail to read it after a class is gone. So the folder is named by the version and a digest of all these sources.

It is next to the source if that is writable, as in a clone or the user's own environment. If several users share an
installation, each has a copy in a folder that only they can enter, because numba runs the code in it.
"""

import hashlib
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from evetac_cli.errors import InputError
from evetac_cli.names import __version__
from evetac_cli.resources import PACKAGE

# Files and folders of all kernels, and of the constants in them.
SOURCES = (
    *("kernels", "sim", "devices/dvxplorer", "formats/read/prophesee", "evaluate/cost", "trials/live_view"),
    *("arrays.py", "events.py"),
)
PREFIX = "evetac-kernels-"
KEPT_S = 30 * 86400.0  # unused folders are removed after this time
SETTINGS = ".numba_config.yaml"  # numba reads this file from the working folder, no matter who created it


def folder() -> Path:
    """Return the folder for the present kernels, created if needed; InputError if there can be none."""
    name = f"{PREFIX}{__version__}-{_digest()}"
    beside = PACKAGE / "__pycache__"
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        place = Path(chosen, name)
    elif os.access(PACKAGE, os.W_OK):
        place = beside / name
    else:
        place = _own_folder() / name
        if not place.exists() and (beside / name).is_dir():
            _copy(beside / name, place)
    place.mkdir(parents=True, exist_ok=True)
    with suppress(OSError):
        os.utime(place)
        for other in place.parent.glob(f"{PREFIX}*"):
            if time.time() - other.stat().st_mtime > KEPT_S:
                shutil.rmtree(other, ignore_errors=True)
    return place


def _digest() -> str:
    digest = hashlib.sha256()
    for source in SOURCES:
        path = PACKAGE / source
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(f"{file.relative_to(PACKAGE)}\n".encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def _own_folder() -> Path:
    """Return a folder that only this user can enter."""
    caches = [Path(os.environ.get("XDG_CACHE_HOME", "")), Path("~/.cache").expanduser()]
    places = [cache / "evetac" / "numba" for cache in caches if cache.is_absolute()]
    for place in (*places, Path(tempfile.gettempdir(), f"evetac-numba-{os.geteuid()}")):
        with suppress(OSError):
            place.mkdir(0o700, parents=True, exist_ok=True)
            status = place.lstat()
            if status.st_uid == os.geteuid() and stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o077:
                return place
    hint = "set NUMBA_CACHE_DIR to one"
    raise InputError("only you should be able to enter the folder for compiled kernels", where=str(place), hint=hint)


def _copy(beside: Path, place: Path) -> None:
    """Copy the installer's kernels, because numba does not load from a folder that it cannot write to."""
    unfinished = Path(tempfile.mkdtemp(dir=place.parent))
    shutil.copytree(beside, unfinished, dirs_exist_ok=True)
    try:
        unfinished.rename(place)
    except OSError:  # another process was faster
        shutil.rmtree(unfinished)


def refuse_settings_in_the_working_folder() -> None:
    """Raise InputError if numba would find settings in the folder in which the program was started.

    They are not part of the command and may come with somebody else's data; they change numbers and load code.
    """
    if os.path.lexists(SETTINGS):
        message = "this file would change how numba compiles: move it, or start evetac in another folder"
        raise InputError(message, where=os.path.abspath(SETTINGS))


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
