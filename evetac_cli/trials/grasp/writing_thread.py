"""The recorder's writing thread: it writes at lowest priority, while the recorder's main thread keeps supervising.

Packing and writing wait for a disk. On two cores shared with a detector, a controller and a servo, they also wait for a
core. A grasp must not end because of that, and code that can be so late must not be responsible for Ctrl-C and the
emergency key. So messages wait here, in memory of bounded size, and are written as time permits.

The two threads share an interpreter. HDF5 holds it while it packs, not while the disk takes the bytes, and a thread
that loses its core keeps the interpreter. This was measured on two cores with 18 processes that wanted one. With a
continuously writing thread at normal niceness, a loop of 5 ms at real-time priority came up to 50 ms late (21 to 29 ms
at p99). With niceness 15, which is for virtual devices, it came 0.7 s late. So a late sign of life alone ends no grasp
(controller_process.py).
"""

import contextlib
import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from evetac_cli.realtime.processes import set_niceness

MOST_BYTES = 192 << 20  # limit of waiting data: at 13 bytes per event, 15 s at a million events per s
WAIT_S = 0.1  # interval at which to check whether the main thread was interrupted


class WritingThread(threading.Thread):
    """Passes messages, in order, to a function that may be slow; used as a context manager."""

    def __init__(self, write: Callable[[Any], None], niceness: int, most_bytes: int = MOST_BYTES) -> None:
        """niceness: of this thread only, where permitted; most_bytes: above this, no more should be put."""
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
        """Wait until everything is written, or after a failure in the block until the current write is done."""
        try:
            self._end(drop=kind is not None)
        except BaseException:  # a second Ctrl-C: waiting messages are dropped
            self._end(drop=True)
            raise
        if kind is None:
            self.check()

    @property
    def is_full(self) -> bool:
        """Whether the limit of waiting data is reached; new data should then wait at their source."""
        return self.waiting_bytes >= self._most_bytes

    def put(self, message: Any, size: int = 0) -> None:
        """Queue a message with this number of bytes."""
        with self._changed:
            self._waiting.append((message, size))
            self.waiting_bytes += size
            self._changed.notify()

    def check(self) -> None:
        """Raise the error that writing failed with, for example a full disk."""
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
        if (
            sys.platform == "linux"
        ):  # on Linux both settings apply to this thread only; it may have inherited another priority
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            set_niceness(self._niceness)
        try:
            while (message := self._next()) is not None:
                self._write(message)
        except BaseException as error:  # raised in the thread that puts messages
            self._error = error

    def _next(self) -> Any:
        """Return the next message; None at the end."""
        with self._changed:
            while not self._waiting and not self._ends:
                self._changed.wait()
            if not self._waiting:
                return None
            message, size = self._waiting.popleft()
            self.waiting_bytes -= size
            return message
