"""Standard output and error of the program. A result that cannot be written ends the program; a message does not.

SIGPIPE's usual effect is not used: it would also end a process that lost its gripper, camera or worker, before it could
release the gripper. So only a failed write to standard output ends the program, in the end as SIGPIPE would.
"""

import io
import os
import select
import signal
import sys
from typing import Any, NoReturn

from evetac_cli.errors import EvetacError


class OutputClosed(BaseException):
    """The reader of the standard output is gone. This is not an error, and only the program's end catches it."""


class OutputError(EvetacError):
    """The result could not be written to the standard output (exit code 1)."""


class _Output(io.FileIO):
    """The standard output; after the first error, all bytes are dropped."""

    def write(self, data: Any) -> int:
        """Write some of the bytes; raise OutputClosed or OutputError on failure."""
        try:
            while (written := super().write(data)) is None:  # another process made it non-blocking
                select.select([], [self], [])
            return written
        except BrokenPipeError:
            self._drop_all()
            raise OutputClosed from None
        except OSError as error:
            self._drop_all()
            raise OutputError(f"cannot be written: {error.strerror or error}", where="the output") from None

    def _drop_all(self) -> None:
        """Discard what is still in buffers; otherwise the interpreter would try to write it again when it ends."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


class _Messages(io.FileIO):
    """The standard error. It never fails: messages that cannot be written are dropped."""

    def write(self, data: Any) -> int:
        """Write some of the bytes, or drop all of them silently."""
        try:
            written = super().write(data)
        except OSError:
            written = None
        return len(memoryview(data).cast("B")) if written is None else written


def open_streams() -> None:
    """Replace sys.stdout and sys.stderr; characters missing in their encoding are written as escapes."""
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except (
            OSError
        ):  # closed, e.g. by `>&-`: reserved, so that no other file gets this number and writing still fails
            os.set_inheritable(os.open(os.devnull, mode), True)
    # a copy of 1: the file of this number is another one while stdout is kept for JSON (console.stdout_for_json)
    output, messages = _Output(os.dup(1), "w"), _Messages(2, "w", closefd=False)
    sys.stdout = _text(output, sys.stdout, line_buffering=output.isatty())
    sys.stderr = _text(messages, sys.stderr, line_buffering=True)


def _text(raw: io.FileIO, before: Any, *, line_buffering: bool) -> io.TextIOWrapper:
    encoding = getattr(before, "encoding", None) or "utf-8"
    buffered = io.BufferedWriter(raw)
    return io.TextIOWrapper(buffered, encoding, errors="backslashreplace", line_buffering=line_buffering)


def end_as_by_sigpipe() -> NoReturn:
    """End this process like one that wrote to a closed pipe: shells report 141."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGPIPE})
    os.kill(os.getpid(), signal.SIGPIPE)
    os._exit(128 + signal.SIGPIPE)
