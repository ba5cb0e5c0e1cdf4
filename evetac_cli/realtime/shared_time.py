"""The clock of devices and control loops: the host's, or one that several processes share and that can pause.

With real devices it is `HOST_TIME`, time.monotonic. A virtual world has a `SharedTime`, which pauses while the world is
behind with its simulation, or while the reader of the camera's slices lags behind. So a busy machine makes such a trial
slower but does not change its result. With a real gripper the clock does not pause.

Reason: on the host's clock, a late world misses the end of its own trial, and a controller mistakes a late detector for
a dead one. Both would be effects of the machine, not of the program.
"""

import contextlib
import math
import mmap
import multiprocessing
import os
import select
import time
from pathlib import Path
from typing import Protocol

from evetac_cli.realtime.shared_row import SharedRow


class WakeSignal:
    """A signal by which one process wakes another; sending never waits. May be passed to a spawned process.

    Why a pipe and not an eventfd or a futex: macOS has neither. Writing to a pipe also takes a microsecond, and a wait
    for a pipe can have a timeout that is not a whole number of milliseconds.
    """

    def __init__(self) -> None:
        self._reader, self._writer = multiprocessing.get_context("spawn").Pipe(duplex=False)

    def send(self) -> None:
        """Wake the process that waits, or the next that does; without effect if the pipe is full."""
        os.set_blocking(self._writer.fileno(), False)
        with contextlib.suppress(BlockingIOError):
            os.write(self._writer.fileno(), b"!")

    def wait(self, seconds: float) -> bool:
        """Sleep until it arrives, for at most `seconds`; return whether it did. Earlier ones count, and are cleared."""
        if not select.select([self._reader], [], [], seconds)[0]:
            return False
        os.read(self._reader.fileno(), _MANY)
        return True


PATIENCE_S = 2.0  # longest pause: a process that is later than this is considered dead
CREEP = 0.01  # speed of the clock during a pause, so that two steps of a control loop never have the same time
SHORTEST_SLEEP_S = 2e-4
_MANY = 1 << 12  # signals that one wait clears
READER_S = 0.02  # largest lead over the reader of the slices; a driver on an idle machine is 5 ms behind


class TimeSource(Protocol):
    """A clock in seconds that never goes back, with a sleep on this clock."""

    def now_s(self) -> float:
        """Return the current time, in s."""

    def sleep(self, seconds: float, wake: WakeSignal | None = None) -> bool:
        """Wait until this time has passed on the clock, or the signal arrives; return whether it did."""

    def slices_read_until(self, now_s: float) -> None:
        """For the reader of a camera's slices: report that all slices that ended before this time were read."""


class HostTime:
    """The host's monotonic clock, which never pauses."""

    def now_s(self) -> float:
        """Return the current time of time.monotonic, in s."""
        return time.monotonic()

    def sleep(self, seconds: float, wake: WakeSignal | None = None) -> bool:
        """Sleep like time.sleep, or until the signal arrives; return whether it did."""
        if wake is not None:
            return wake.wait(seconds)
        time.sleep(seconds)
        return False

    def slices_read_until(self, now_s: float) -> None:
        """Do nothing: the host's clock does not wait for readers."""


HOST_TIME = HostTime()


class SharedTime:
    """A clock in a shared-memory file, at the offset `start`, where all bytes are 0 before the first use.

    It runs like the host's clock up to the time set by `limit`. One process limits it (a virtual world), one or two
    report how far they have read (the drivers of the cameras), and any process may read the time. It may be pickled:
    the copy is the same clock. Without a file it is the clock of one process.
    """

    SIZE = 192
    _READERS_AT = (64, 128)

    def __init__(self, path: Path | None = None, start: int = 0, reader: int = 0) -> None:
        """reader: index of the camera whose driver runs in this process, if any."""
        self._path, self._start, self._number = path, start, reader
        memory: mmap.mmap | memoryview[int] = memoryview(bytearray(start + self.SIZE))
        if path is not None:
            with open(path, "r+b") as file:
                memory = mmap.mmap(file.fileno(), start + self.SIZE)
        self._limit = SharedRow(memory, start, "2d")  # delay relative to the host's clock; limit
        self._readers = [SharedRow(memory, start + at, "d") for at in self._READERS_AT]
        self._until_s = -math.inf  # the last limit that this process set

    def __reduce__(self) -> tuple[type["SharedTime"], tuple[Path, int, int]]:
        if self._path is None:
            raise TypeError("a clock without a file cannot be passed to another process")
        return SharedTime, (self._path, self._start, self._number)

    def of_reader(self, number: int) -> "SharedTime":
        """Return the same clock for the driver of another camera."""
        return SharedTime(self._path, self._start, number)

    def now_s(self) -> float:
        """Return the host's time minus all pauses; beyond the limit it almost stops, for at most PATIENCE_S."""
        host_s = time.monotonic()
        return host_s - self._behind_s(host_s)

    def sleep(self, seconds: float, wake: WakeSignal | None = None) -> bool:
        """Wait until this time has passed on the clock, or the signal arrives; return whether it did."""
        until_s = self.now_s() + seconds
        while (left_s := until_s - self.now_s()) > 0:
            if HOST_TIME.sleep(max(left_s, SHORTEST_SLEEP_S), wake):
                return True
        return False

    def limit(self, until_s: float) -> None:
        """Let the clock run until this time; inf: without limit. It never goes back, and pauses are not caught up.

        A limit that is not later than the last one has no effect: so PATIENCE_S counts from the begin of the pause.
        """
        if until_s <= self._until_s:
            return
        host_s = time.monotonic()
        behind_s = self._behind_s(host_s)
        self._until_s = -math.inf if until_s == math.inf else max(until_s, host_s - behind_s)
        self._limit.write(behind_s, max(until_s, host_s - behind_s))

    def slices_read_until(self, now_s: float) -> None:
        """For the reader of a camera's slices: report that all slices before this time were read; inf: no reader."""
        self._readers[self._number].write(now_s)

    @property
    def reader_s(self) -> float:
        """Time until which all readers have read the slices; inf without a reader."""
        rows = [reader.read() for reader in self._readers]
        return min((row[1][0] for row in rows if row is not None), default=math.inf)

    def _behind_s(self, host_s: float) -> float:
        """Return the delay of this clock relative to the host's."""
        row = self._limit.read()
        if row is None:
            return 0.0
        behind_s, limit_s = row[1]
        waited_s = host_s - behind_s - limit_s
        return behind_s if waited_s <= 0.0 else behind_s + min((1.0 - CREEP) * waited_s, PATIENCE_S)
