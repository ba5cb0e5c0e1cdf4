"""Standard output and error of the program: a result that cannot be written ends it, a message that cannot does not.

Why not SIGPIPE's usual effect: it would also end a process whose gripper, camera or worker has gone, before it could
let go of the gripper. So only what is written to the standard output ends the program, as SIGPIPE would, at its end.
"""

import io
import os
import select
import signal
import sys
from typing import Any, NoReturn

from evetac_cli.errors import EvetacError


class OutputClosed(BaseException):
    """Whoever read the standard output has gone; no error, and nobody's to catch but the program's end."""


class OutputError(EvetacError):
    """The result could not be written to the standard output (exit code 1)."""


class _Output(io.FileIO):
    """The standard output; after the first error, bytes are dropped."""

    def write(self, data: Any) -> int:
        """Write some of the bytes; OutputClosed or OutputError where that fails."""
        try:
            while (written := super().write(data)) is None:  # somebody else made it non-blocking
                select.select([], [self], [])
            return written
        except BrokenPipeError:
            self._drop_all()
            raise OutputClosed from None
        except OSError as error:
            self._drop_all()
            raise OutputError(f"cannot be written: {error.strerror or error}", where="the output") from None

    def _drop_all(self) -> None:
        """What is still in buffers goes nowhere, or it would be tried again at the interpreter's end."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


class _Messages(io.FileIO):
    """The standard error, which never fails: messages that cannot be written are lost."""

    def write(self, data: Any) -> int:
        """Write some of the bytes, or none and say nothing."""
        try:
            written = super().write(data)
        except OSError:
            written = None
        return len(memoryview(data).cast("B")) if written is None else written


def open_streams() -> None:
    """Put ours in place of sys.stdout and sys.stderr; what their encoding has not got is written as escapes."""
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:  # closed, as by `>&-`: held, so that no file of ours is opened as it, and writing still fails
            os.set_inheritable(os.open(os.devnull, mode), True)
    output, messages = _Output(1, "w", closefd=False), _Messages(2, "w", closefd=False)
    sys.stdout = _text(output, sys.stdout, line_buffering=output.isatty())
    sys.stderr = _text(messages, sys.stderr, line_buffering=True)


def _text(raw: io.FileIO, before: Any, *, line_buffering: bool) -> io.TextIOWrapper:
    encoding = getattr(before, "encoding", None) or "utf-8"
    buffered = io.BufferedWriter(raw)
    return io.TextIOWrapper(buffered, encoding, errors="backslashreplace", line_buffering=line_buffering)


def end_as_by_sigpipe() -> NoReturn:
    """End this process as one that wrote to a closed pipe: shells say 141."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGPIPE})
    os.kill(os.getpid(), signal.SIGPIPE)
    os._exit(128 + signal.SIGPIPE)
