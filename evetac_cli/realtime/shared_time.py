"""The time by which devices and control loops run: the host's, or one that several processes share and that can wait.

With real devices it is `HOST_TIME`, time.monotonic. A virtual world has a `SharedTime` that stands still while the
world has not simulated what is due, or the reader of the camera's slices lags behind. So a busy machine makes such a
trial slower, and changes nothing in it. Beside a real gripper it does not stand still.

Why so: a world that is late on the host's clock misses the end of its own trial, and a controller that goes by the
host's clock takes a late detector for a dead one. Both say something about the machine, not about the program.
"""

import math
import mmap
import time
from pathlib import Path
from typing import Protocol

from evetac_cli.realtime.bell import Bell
from evetac_cli.realtime.shared_row import SharedRow

PATIENCE_S = 2.0  # time stands still for no longer than this: then who is late may as well be dead
CREEP = 0.01  # how fast it goes while it waits: two steps of a control loop never happen at the same time
SHORTEST_SLEEP_S = 2e-4
READER_S = 0.02  # how far it may be ahead of who reads the slices; a driver on a machine with time is behind by 5 ms


class TimeSource(Protocol):
    """A clock in seconds that never goes back, and what waits by it."""

    def now_s(self) -> float:
        """Time now, in s."""

    def sleep(self, seconds: float, bell: Bell | None = None) -> bool:
        """Wait until so much of this time has passed, or until the bell rings; whether it did."""

    def slices_read_until(self, now_s: float) -> None:
        """For the reader of a camera's slices: all that ended before this time were read."""


class HostTime:
    """The host's monotonic clock, which does not wait."""

    def now_s(self) -> float:
        """Time now, in s, as time.monotonic."""
        return time.monotonic()

    def sleep(self, seconds: float, bell: Bell | None = None) -> bool:
        """Sleep for so many seconds, as time.sleep, or until the bell rings; whether it did."""
        if bell is not None:
            return bell.wait(seconds)
        time.sleep(seconds)
        return False

    def slices_read_until(self, now_s: float) -> None:
        """Without effect: the host's clock does not wait for readers."""


HOST_TIME = HostTime()


class SharedTime:
    """A clock in a file in shared memory, at `start` of it, where all is 0 before the first use; or without a file.

    It runs as the host's until `limit` says how far it may go. One process limits it (a virtual world), one or two say
    how far they have read (the drivers of the cameras), any may ask for the time. It may be pickled: the copy is the
    same clock. Without a file it is the clock of one process.
    """

    SIZE = 192
    _READERS_AT = (64, 128)

    def __init__(self, path: Path | None = None, start: int = 0, reader: int = 0) -> None:
        """reader: which of two cameras has its driver here, if any has."""
        self._path, self._start, self._number = path, start, reader
        memory: mmap.mmap | memoryview[int] = memoryview(bytearray(start + self.SIZE))
        if path is not None:
            with open(path, "r+b") as file:
                memory = mmap.mmap(file.fileno(), start + self.SIZE)
        self._limit = SharedRow(memory, start, "2d")  # how much later than the host's it is; how far it may go
        self._readers = [SharedRow(memory, start + at, "d") for at in self._READERS_AT]
        self._until_s = -math.inf  # the last limit that was set here

    def __reduce__(self) -> tuple[type["SharedTime"], tuple[Path, int, int]]:
        if self._path is None:
            raise TypeError("the clock of one process cannot be given to another: it has no file")
        return SharedTime, (self._path, self._start, self._number)

    def of_reader(self, number: int) -> "SharedTime":
        """The same clock for the driver of another camera."""
        return SharedTime(self._path, self._start, number)

    def now_s(self) -> float:
        """The host's time less what was waited so far; beyond the limit it all but stands still, for PATIENCE_S."""
        host_s = time.monotonic()
        return host_s - self._behind_s(host_s)

    def sleep(self, seconds: float, bell: Bell | None = None) -> bool:
        """Wait until so much of this time has passed, or until the bell rings; whether it did."""
        until_s = self.now_s() + seconds
        while (left_s := until_s - self.now_s()) > 0:
            if HOST_TIME.sleep(max(left_s, SHORTEST_SLEEP_S), bell):
                return True
        return False

    def limit(self, until_s: float) -> None:
        """Let it run until then, inf: for good. It never goes back, and what was waited is not made up for.

        A limit that is no later than the last one changes nothing: so PATIENCE_S count from when time stood still.
        """
        if until_s <= self._until_s:
            return
        host_s = time.monotonic()
        behind_s = self._behind_s(host_s)
        self._until_s = -math.inf if until_s == math.inf else max(until_s, host_s - behind_s)
        self._limit.write(behind_s, max(until_s, host_s - behind_s))

    def slices_read_until(self, now_s: float) -> None:
        """For the reader of a camera's slices: all that ended before this time were read; inf: there is no reader."""
        self._readers[self._number].write(now_s)

    @property
    def reader_s(self) -> float:
        """Time until which the slices were read, by whoever has read least; inf without a reader."""
        rows = [reader.read() for reader in self._readers]
        return min((row[1][0] for row in rows if row is not None), default=math.inf)

    def _behind_s(self, host_s: float) -> float:
        """How much later than the host's this clock is."""
        row = self._limit.read()
        if row is None:
            return 0.0
        behind_s, limit_s = row[1]
        waited_s = host_s - behind_s - limit_s
        return behind_s if waited_s <= 0.0 else behind_s + min((1.0 - CREEP) * waited_s, PATIENCE_S)
