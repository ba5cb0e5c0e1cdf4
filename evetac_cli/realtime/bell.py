"""A bell with which one process wakes another that sleeps; ringing never waits.

Why a pipe and not an eventfd or a futex: macOS has neither. Writing to a pipe also takes a microsecond, and a wait for
a pipe can have a timeout that is not a whole number of milliseconds.
"""

import contextlib
import multiprocessing
import os
import select

_MANY = 1 << 12  # rings that one wait clears


class Bell:
    """The bell; may be passed to a process when it is spawned."""

    def __init__(self) -> None:
        self._ear, self._rope = multiprocessing.get_context("spawn").Pipe(duplex=False)

    def ring(self) -> None:
        """Wake the process that waits, or the next that does; without effect if the pipe is full of rings."""
        os.set_blocking(self._rope.fileno(), False)
        with contextlib.suppress(BlockingIOError):
            os.write(self._rope.fileno(), b"!")

    def wait(self, seconds: float) -> bool:
        """Sleep until it rings, for at most `seconds`; return whether it rang. Earlier rings count, and are cleared."""
        if not select.select([self._ear], [], [], seconds)[0]:
            return False
        os.read(self._ear.fileno(), _MANY)
        return True
