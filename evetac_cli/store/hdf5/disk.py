"""New files, all or nothing, also where the disk is full or the process is killed; HDF5 files among them.

A file is written beside its place, under the name of this machine and process, and renamed when it is complete. What a
process that was killed left behind is removed by the next that writes the same file. A part of that name is random:
in a folder that others may write to, one that can be guessed may be a link to any file of this user's.

Why HDF5 has a file object: where it cannot write, it cannot close the file either, and takes the whole process down at
its end. So it writes through a file object that never fails: that keeps the first error, which is raised once HDF5 has
closed. For the same reason Ctrl-C waits until then; it would otherwise come up inside that object.
"""

import errno
import hashlib
import io
import os
import platform
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import IO, Any, BinaryIO

import h5py
import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.interrupts import interrupts_wait, leave_if_interrupted
from evetac_cli.text_files import as_utf8

# HDF5 1.14 and everything since opens this; `latest` would need HDF5 2.0, which h5py bundles and others do not have.
LIBVER = ("earliest", "v114")


class _Disk(io.FileIO):
    """A file that takes everything: after the first error, bytes are dropped."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all of `data`, or remember why not."""
        left = memoryview(data).cast("B")
        try:
            while left and self.error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return len(data)


def existing_folder(folder: Path) -> Path:
    """The folder, or the nearest folder above that exists; InputError if it cannot be made or written in."""
    while not os.path.exists(folder):
        folder = folder.parent
    if not os.path.isdir(folder):
        raise InputError("the output folder is a file", where=str(folder))
    if not os.access(folder, os.W_OK | os.X_OK, effective_ids=True):
        raise InputError("the output folder cannot be written to", where=str(folder))
    return folder


def missing_folders(folder: Path) -> list[Path]:
    """The folder and those above it, as far as they do not exist, the innermost first."""
    return [one for one in (folder, *folder.parents) if not os.path.lexists(one)]


def remove_empty(folders: list[Path]) -> None:
    """Remove folders that were made for nothing, the innermost first; one that holds something stays."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def require_room(path: Path, needed_bytes: float, hint: str) -> None:
    """Refuse to begin what the disk of the folder `path` has no room for; InputError with figures.

    The folder need not exist yet, but has to be one that can be made.
    """
    folder = existing_folder(path)
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < needed_bytes:
        raise InputError(
            "not enough room on this disk",
            where=str(folder),
            expected=f"{needed_bytes / 1e6:,.0f} MB",
            found=f"{free_bytes / 1e6:,.0f} MB free",
            hint=hint,
        )


@contextmanager
def taking_the_place_of(path: Path, ending: str = "") -> Iterator[Path]:
    """A path to write to, which takes the place of `path` when the block ends well, and leaves no trace otherwise.

    ending: what the name has to end in, for libraries that go by it. InputError if the disk does not take the file, or
    where `path` is neither a file nor a link, which is replaced and not followed: a device, a pipe, a folder.
    """
    with suppress(OSError):
        kind = os.lstat(path).st_mode
        if not stat.S_ISREG(kind) and not stat.S_ISLNK(kind):
            what = "a folder" if stat.S_ISDIR(kind) else "a device, a pipe or a socket"
            raise InputError(f"cannot be written: it is {what}, and is not replaced", where=str(path))
    temporary = temporary_name(path, ending)
    made = missing_folders(path.parent)
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise InputError("the output folder is a file", where=str(path.parent)) from None
        yield temporary
        temporary.replace(path)
    except KeyboardInterrupt:  # only now: after an error, another job may be about to write there
        with suppress(OSError):
            temporary.unlink()
        remove_empty(made)
        raise
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", where=str(path)) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def remove_with_contents(path: Path) -> None:
    """Remove a file, or a folder with all that is in it, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def temporary_name(path: Path, ending: str = "") -> Path:
    """The name beside `path` under which this process writes; those of processes that no longer live are removed."""
    remove_unfinished(path, ending)
    process = os.getpid()
    return path.with_name(f"{_start(path)}{process}-{_started(process)}.{secrets.token_hex(8)}.tmp{ending}")


def remove_unfinished(path: Path, ending: str = "") -> None:
    """Remove what processes that no longer live left beside `path` while they wrote it."""
    for left in path.parent.glob(f"{escape(_start(path))}*.tmp{escape(ending)}"):
        if not _lives(left.name.removeprefix(_start(path)).partition(".")[0]):
            remove_with_contents(left)


def _start(path: Path) -> str:
    name = path.name
    if as_utf8(name) != name:  # libraries that write there may know no other names
        name = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    return f".{name}.{platform.node()}."  # a folder may be shared: other machines' processes cannot be seen


@contextmanager
def utf8_path(path: Path) -> Iterator[Path]:
    """A name of UTF-8 for a file that is there, or is to be made, for libraries that take no other.

    On Linux by way of the file, or its folder, held open meanwhile; elsewhere the path as it is.
    """
    if as_utf8(str(path)) == str(path) or not os.path.isdir("/proc/self/fd"):
        yield path
        return
    is_there = path.exists()
    held = os.open(path if is_there else path.parent, os.O_PATH | os.O_CLOEXEC)
    try:
        place = Path(f"/proc/self/fd/{held}")
        yield place if is_there else place / path.name
    finally:
        os.close(held)


def _started(process: int | str) -> str:
    """When a process started, in the words of Linux, as numbers are given away again; empty where that is unknown."""
    try:
        state, *more = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "dead" if state in "ZX" else more[18]  # one whose parent has not waited for it still has its number


def _lives(name: str) -> bool:
    """Whether the process of a temporary file, its number and when it started, still runs."""
    process, _, started = name.partition("-")
    if (now := _started(process)) and (now == "dead" or started not in ("", now)):
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OverflowError, PermissionError):  # no number: not ours to remove; or somebody else's process
        return True
    return True


def joined_on_disk(folder: Path | None, parts: Iterable[tuple[NDArray[Any], ...]]) -> tuple[NDArray[Any], ...]:
    """Columns of arrays, each put end to end: in files of `folder`, from where they are read as they are used.

    parts: of each column the next rows. Without a folder, that of the system for temporary files, which TMPDIR names.
    The files have no name and are gone with the arrays. Memory is needed for one part; what is read lies in memory that
    the system takes back when it needs it. Without any part there is no column. InputError if the disk does not take
    them.
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
    """What a file holds, as an array of rows like these."""
    file.flush()
    row_bytes = like.dtype.itemsize * int(np.prod(like.shape[1:]))
    shape = (os.fstat(file.fileno()).st_size // row_bytes, *like.shape[1:])
    if not shape[0]:
        return np.empty(shape, like.dtype)
    return np.asarray(np.memmap(file, like.dtype, "r", shape=shape))


def make_own_folder(folder: Path) -> None:
    """Make a folder to write into; one that is there may stay if nobody else can exchange what is written there.

    InputError for one that another user made (root may), for a link, which could lead to any folder of the user's, and
    for a file.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        folder.mkdir()
    except FileExistsError:
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode):
            what = "a link" if stat.S_ISLNK(status.st_mode) else "a file"
            raise InputError(f"the output folder is {what}", where=str(folder)) from None
        if status.st_uid not in (0, os.geteuid()):
            raise InputError(
                "this folder was made by another user", where=str(folder), hint="-o NAME writes elsewhere"
            ) from None


def open_lock(path: Path) -> BinaryIO:
    """The lock file of a folder, made where there is none; OSError if it is a link, a pipe or anything but a file.

    A link could lead to any file of the user's, and opening a pipe waits for its other end.
    """
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(errno.EINVAL, "its lock is not a regular file")
    return os.fdopen(file, "wb")


@contextmanager
def new_file(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file, open for writing; OSError if something is there already, or the disk did not take all of it."""
    with interrupts_wait(), _Disk(path, "x+") as disk:
        try:
            with h5py.File(disk, "w", libver=LIBVER) as h5:
                yield h5
        finally:
            if disk.error is not None:
                raise disk.error
