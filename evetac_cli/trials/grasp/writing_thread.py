"""The thread of a recorder that writes what came, behind everybody else, while the recorder itself goes on watching.

Why so: who packs and writes waits for a disk, and on two cores, behind a detector, a controller and a servo, for a core
as well. A grasp must not end for that, and nothing that can be late by so much may listen for Ctrl-C and for the
emergency key. So what came waits here, in memory of a bounded size, and is written as there is time.

The two threads share an interpreter: HDF5 holds it while it packs, not while the disk takes the bytes, and a thread
that has lost its core keeps it. On two cores with 18 processes that wanted one, a loop of 5 ms at real-time priority
came up to 50 ms late (21 to 29 at p99) beside a thread that wrote without a break at usual niceness, and 0.7 s beside
one of niceness 15, which is for virtual devices. So a late sign of life alone ends no grasp (controller_process.py).
"""

import contextlib
import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from evetac_cli.realtime.processes import set_niceness

MOST_BYTES = 192 << 20  # that may wait: at 13 bytes an event, 15 s of a million events a second
WAIT_S = 0.1  # between two looks at whether the main thread was interrupted


class WritingThread(threading.Thread):
    """Hands messages, in their order, to a function that may take long; used as the block in which they come."""

    def __init__(self, write: Callable[[Any], None], niceness: int, most_bytes: int = MOST_BYTES) -> None:
        """niceness: of this thread alone, where it is permitted; most_bytes: from which on no more should be put."""
        super().__init__(name="writes the recording", daemon=True)
        self._write = write
        self._niceness = niceness
        self._most_bytes = most_bytes
        self._waiting: deque[tuple[Any, int]] = deque()
        self._changed = threading.Condition()
        self._ends = False
        self._error: BaseException | None = None
        self.waiting_bytes = 0

    def __enter__(self) -> "WritingThread":
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait until all is written, or, where the block failed, until what is being written is."""
        try:
            self._end(drop=kind is not None)
        except BaseException:  # a second Ctrl-C: what waits is given up
            self._end(drop=True)
            raise
        if kind is None:
            self.check()

    @property
    def is_full(self) -> bool:
        """Whether as much waits as may; what comes then should wait where it is."""
        return self.waiting_bytes >= self._most_bytes

    def put(self, message: Any, size: int = 0) -> None:
        """Take a message of so many bytes."""
        with self._changed:
            self._waiting.append((message, size))
            self.waiting_bytes += size
            self._changed.notify()

    def check(self) -> None:
        """Raise what went wrong with writing, such as a full disk."""
        if self._error is not None:
            raise self._error

    def _end(self, *, drop: bool) -> None:
        with self._changed:
            self._ends = True
            if drop:
                self._waiting.clear()
            self._changed.notify()
        while self.is_alive():
            self.join(WAIT_S)

    def run(self) -> None:
        """Write until the block is over, or writing fails."""
        if sys.platform == "linux":  # where both are of this thread alone; it may have inherited another priority
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            set_niceness(self._niceness)
        try:
            while (message := self._next()) is not None:
                self._write(message)
        except BaseException as error:  # raised by whoever puts messages
            self._error = error

    def _next(self) -> Any:
        """The next message; None at the end."""
        with self._changed:
            while not self._waiting and not self._ends:
                self._changed.wait()
            if not self._waiting:
                return None
            message, size = self._waiting.popleft()
            self.waiting_bytes -= size
            return message
