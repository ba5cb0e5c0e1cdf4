"""The file through which a robot's program finds the door: address, port and token on one line.

Only this user can read the file. It is written under a temporary name and moved into place as a whole. The listening
process locks it for as long as it lives. So an unlocked file was left by a killed process, and is replaced.
"""

import errno
import fcntl
import os
import re
import secrets
import stat
from contextlib import suppress
from pathlib import Path

from evetac_cli.errors import InputError
from evetac_cli.trials.listen.door import ADDRESS, MOST_BYTES

LINE = re.compile(rb"127\.0\.0\.1 [0-9]{1,5} [A-Za-z0-9_-]{20,100}\n")
NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)  # errors of file systems without hard links
TRIES = 20  # attempts, if other processes create and remove the file at the same time


class AddressFile:
    """The address file of a listening process; `remove` deletes it."""

    def __init__(self, path: Path, port: int, token: str) -> None:
        """Write the file; InputError if another process listens in this folder, or another file has this name."""
        self.path = path
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
        try:
            self._file = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.write(self._file, f"{ADDRESS} {port} {token}\n".encode())
                self._put(temporary)
            except BaseException:
                os.close(self._file)
                raise
            finally:
                with suppress(FileNotFoundError):
                    temporary.unlink()
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", where=str(self.path)) from None

    def remove(self) -> None:
        """Delete the file, unless another has replaced it."""
        with suppress(OSError):
            if os.path.samestat(os.fstat(self._file), self.path.lstat()):
                self.path.unlink()
        with suppress(OSError):
            os.close(self._file)

    def _put(self, temporary: Path) -> None:
        """Move the file to its path, if nothing is there, or only the file of a killed process."""
        for _ in range(TRIES):
            try:
                os.link(temporary, self.path)
                return
            except FileExistsError:
                if self._replace(temporary):
                    return
            except OSError as error:
                if error.errno not in NO_LINKS:
                    raise
                if not os.path.lexists(self.path):
                    temporary.replace(self.path)
                    return
                if self._replace(temporary):
                    return
        raise InputError("another evetac is listening here", where=str(self.path), hint="-o FOLDER listens elsewhere")

    def _replace(self, temporary: Path) -> bool:
        """Replace an unlocked file; return whether that succeeded. InputError for a file that evetac did not write."""
        try:
            old = os.open(self.path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except FileNotFoundError:
            return False
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EACCES, errno.EISDIR, errno.ENXIO):
                raise
            raise self._strange() from None
        try:
            status = os.fstat(old)
            if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
                raise self._strange()
            if not LINE.fullmatch(os.read(old, MOST_BYTES)):
                raise self._strange()
            try:
                fcntl.flock(old, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                hint = "end it first, or -o FOLDER listens elsewhere"
                raise InputError("another evetac is listening here", where=str(self.path), hint=hint) from None
            if not os.path.samestat(status, self.path.lstat()):
                return False
            temporary.replace(self.path)
            return True
        except FileNotFoundError:
            return False
        finally:
            os.close(old)

    def _strange(self) -> InputError:
        return InputError(
            "this is not a file that evetac made", where=str(self.path), hint="-o FOLDER listens elsewhere"
        )
