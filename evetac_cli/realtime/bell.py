"""A bell: what one process rings and another, that sleeps, is woken by; whoever rings never waits.

Why a pipe and not an eventfd or a futex: macOS has neither, to ring a pipe takes a microsecond as they do, and a pipe
can be waited for together with a time that is no whole number of milliseconds.
"""

import contextlib
import multiprocessing
import os
import select

_MANY = 1 << 12  # rings that are forgotten at once


class Bell:
    """The bell; may be given to a process that is being spawned."""

    def __init__(self) -> None:
        self._ear, self._rope = multiprocessing.get_context("spawn").Pipe(duplex=False)

    def ring(self) -> None:
        """Wake whoever waits, or does so next; without effect where so many rings wait that no more fit."""
        os.set_blocking(self._rope.fileno(), False)
        with contextlib.suppress(BlockingIOError):
            os.write(self._rope.fileno(), b"!")

    def wait(self, seconds: float) -> bool:
        """Sleep until it rings, at most so long; whether it rang. Rings that came before count, and are then over."""
        if not select.select([self._ear], [], [], seconds)[0]:
            return False
        os.read(self._ear.fileno(), _MANY)
        return True
