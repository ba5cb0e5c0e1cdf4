"""Atomic writing of new files, including HDF5 files, even if the disk is full or the process is killed.

A file is written next to its target, under a name with this machine, this process and random digits, and renamed when
it is complete. Leftovers of a killed process are removed by the next process that writes the same file.

Two runs may write the same target at once. So whether the target may be replaced is checked before the work, and again
just before the file is renamed, under a lock that is held only for this. The lock file `.NAME.lock` is next to the
target, the only place that all machines of a shared folder see, and its holder removes it.

If HDF5 cannot write, it cannot close the file either, and crashes the process at its end. So HDF5 writes through a
file object that never fails: it keeps the first error, which is raised once HDF5 has closed the file. For the same
reason Ctrl-C is delayed until then; it would otherwise be raised inside that object.
"""

import hashlib
import io
import os
import platform
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.interrupts import interrupts_wait, leave_if_interrupted
from evetac_cli.text_files import as_utf8

# HDF5 1.14 and newer open this; `latest` would need HDF5 2.0, which h5py bundles but other programs do not have.
LIBVER = ("earliest", "v114")
LOCK_WAIT_S = 120  # a lock is held while an existing file is checked, which takes seconds for the largest


class _Disk(io.FileIO):
    """A file that accepts all bytes: after the first error, they are dropped."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all of `data`, or keep the error."""
        left = memoryview(data).cast("B")
        try:
            while left and self.error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return len(data)


def existing_folder(folder: Path) -> Path:
    """Return the folder, or its nearest existing parent; InputError if it cannot be created or written to."""
    while not os.path.exists(folder):
        folder = folder.parent
    if not os.path.isdir(folder):
        raise InputError("the output folder is a file", where=str(folder))
    if not os.access(folder, os.W_OK | os.X_OK, effective_ids=True):
        raise InputError("the output folder cannot be written to", where=str(folder))
    return folder


def missing_folders(folder: Path) -> list[Path]:
    """Return the folder and its parents that do not exist, the innermost first."""
    return [one for one in (folder, *folder.parents) if not os.path.lexists(one)]


def remove_empty(folders: list[Path]) -> None:
    """Remove folders, the innermost first, unless they contain something."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def require_room(path: Path, needed_bytes: float, hint: str) -> None:
    """Raise InputError, with figures, if the disk of the folder `path` does not have enough space.

    The folder need not exist yet, but it must be possible to create it.
    """
    folder = existing_folder(path)
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < needed_bytes:
        expected, found = f"{needed_bytes / 1e6:,.0f} MB", f"{free_bytes / 1e6:,.0f} MB free"
        raise InputError("not enough space on this disk", where=str(folder), expected=expected, found=found, hint=hint)


def check_free(path: Path, *, force: bool) -> None:
    """Raise InputError if a file without a recipe cannot be written to this path, or exists there, unless `force`."""
    if os.path.isdir(path):
        raise InputError("the output is a folder", where=str(path))
    if os.path.lexists(path) and not force:
        hint = "--force replaces it, -o NAME writes to another file"
        raise InputError("the output exists", where=str(path), hint=hint)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other runs from checking and replacing `path` within the block; InputError if another does not end."""
    import filelock  # here, as most commands that load this module write nothing

    place = path.with_name(f".{path.name}.lock")
    lock = filelock.FileLock(place, LOCK_WAIT_S, 0o666)
    try:
        lock.acquire()
    except filelock.Timeout:
        hint = "wait for it or end it; if there is none, remove this file"
        raise InputError("another run is writing this output", where=str(place), hint=hint) from None
    try:
        yield
    finally:
        # Before it is unlocked: a process waiting for the removed file sees that it is gone, and locks a new one.
        with suppress(OSError):
            place.unlink()
        lock.release()


class Recheck:
    """Asks again, just before a file is put in place, whether it is there; `made` is False if another run made it."""

    def __init__(self, is_made: Callable[[], bool]) -> None:
        self._is_made, self.made = is_made, False

    def __call__(self) -> bool:
        """Return whether the file is there."""
        self.made = not self._is_made()
        return not self.made


@contextmanager
def taking_the_place_of(path: Path, ending: str = "", check: Callable[[], bool | None] | None = None) -> Iterator[Path]:
    """Yield a path to write to, which replaces `path` if the block succeeds, and is removed if it fails.

    - ending: required end of the name, for libraries that depend on it.
    - check: called just before, while no other run can replace `path`. It raises InputError if an existing file must
      not be replaced, and returns True if that has this very result and stays.

    InputError if writing fails, or if `path` is a device, a pipe or a folder. A link at `path` is replaced and not
    followed.
    """
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.islink(path):
        raise InputError("cannot be written: it is a folder, a pipe or a device", where=str(path))
    temporary = temporary_name(path, ending)
    new_folders = missing_folders(path.parent)
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise InputError("the output folder is a file", where=str(path.parent)) from None
        yield temporary
        with locked(path):
            if check is None or not check():
                temporary.replace(path)
    except KeyboardInterrupt:  # folders are removed only here: after an error, another job may be about to write there
        with suppress(OSError):
            temporary.unlink()
        remove_empty(new_folders)
        raise
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", where=str(path)) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def remove_with_contents(path: Path) -> None:
    """Remove a file, or a folder with its contents, as far as possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def temporary_name(path: Path, ending: str = "") -> Path:
    """Return the name next to `path` under which this process writes; leftovers of dead processes are removed."""
    remove_unfinished(path, ending)
    return path.with_name(f"{_start(path)}{os.getpid()}.{secrets.token_hex(8)}.tmp{ending}")


def remove_unfinished(path: Path, ending: str = "") -> None:
    """Remove files that dead processes left next to `path` while they wrote it."""
    for left in path.parent.glob(f"{escape(_start(path))}*.tmp{escape(ending)}"):
        if not _lives(left.name.removeprefix(_start(path)).partition(".")[0]):
            remove_with_contents(left)


def _start(path: Path) -> str:
    name = path.name
    if as_utf8(name) != name:  # libraries that write there may support only UTF-8 names
        name = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    return f".{name}.{platform.node()}."  # a folder may be shared, and processes of other machines are not visible


def _lives(process: str) -> bool:
    """Whether the process of a temporary file, given by its number, still runs."""
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OverflowError, PermissionError):  # not a name by evetac, or another user's process
        return True
    return True


def joined_on_disk(folder: Path | None, parts: Iterable[tuple[NDArray[Any], ...]]) -> tuple[NDArray[Any], ...]:
    """Return columns of arrays, each concatenated in a file of `folder` and mapped into memory.

    parts: the next rows of each column. folder: None for the system's folder for temporary files (TMPDIR). The files
    have no name and disappear with the arrays. Memory is needed for one part; the system can reclaim the memory of
    mapped data. Without any part there is no column. InputError if writing fails.
    """
    with ExitStack() as stack:
        files: list[IO[bytes]] = []
        first: tuple[NDArray[Any], ...] = ()
        for part in parts:
            leave_if_interrupted()
            try:
                first = first or part
                files = files or [stack.enter_context(tempfile.TemporaryFile(dir=folder)) for _ in part]
                for file, rows in zip(files, part, strict=True):
                    file.write(np.ascontiguousarray(rows).data.cast("B") if rows.size else b"")
            except OSError as error:
                where = str(folder or tempfile.gettempdir())
                raise InputError(f"cannot be written: {error.strerror or error}", where=where) from error
        return tuple(_mapped(file, column) for file, column in zip(files, first, strict=True))


def _mapped(file: IO[bytes], like: NDArray[Any]) -> NDArray[Any]:
    """Return the contents of a file as an array of rows like these."""
    file.flush()
    row_bytes = like.dtype.itemsize * int(np.prod(like.shape[1:]))
    shape = (os.fstat(file.fileno()).st_size // row_bytes, *like.shape[1:])
    if not shape[0]:
        return np.empty(shape, like.dtype)
    return np.asarray(np.memmap(file, like.dtype, "r", shape=shape))


@contextmanager
def new_file(path: Path) -> Iterator[h5py.File]:
    """Yield a new HDF5 file, open for writing; OSError if the path exists, or if not everything could be written."""
    with interrupts_wait(), _Disk(path, "x+") as disk:
        try:
            with h5py.File(disk, "w", libver=LIBVER) as h5:
                yield h5
        finally:
            if disk.error is not None:
                raise disk.error
