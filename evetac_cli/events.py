"""Events, and how a stream of events is cut into slices of one millisecond.

An event is (t_us, x, y, p): device time in microseconds, column, row, and polarity, 1 for brighter and 0 for darker.
Events are stored as columns of equal length, sorted by time. Slice k contains all events with k <= t / 1 ms < k + 1.
Empty slices exist too, because the slice index is the clock.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SLICE_US = 1000
SLICES_PER_S = 1_000_000 // SLICE_US
FRAME_PX = (640, 480)  # width, height of the DVXplorer Mini


class Events(NamedTuple):
    """Columns of events: t in us (int64), x and y in px (uint16), p 0 or 1 (uint8).

    >>> import numpy as np
    >>> events = evetac.Events(
    ...     t=np.array([100, 2500]),
    ...     x=np.array([3, 4], np.uint16),
    ...     y=np.array([5, 6], np.uint16),
    ...     p=np.array([1, 0], np.uint8),
    ... )
    >>> events.size, events.part(1, 2).t.tolist()
    (2, [2500])
    """

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]

    @property
    def size(self) -> int:
        """Number of events (len() of a named tuple counts its columns, and .count is a method of every tuple)."""
        return len(self.t)

    def part(self, start: int, stop: int) -> "Events":
        """Return views of the events [start, stop)."""
        return Events(self.t[start:stop], self.x[start:stop], self.y[start:stop], self.p[start:stop])

    def at(self, rows: NDArray[np.bool_ | np.intp]) -> "Events":
        """Return copies of the events at these rows, given as indices or a mask."""
        return Events(self.t[rows], self.x[rows], self.y[rows], self.p[rows])


class SliceBlock(NamedTuple):
    """A block of consecutive slices.

    first: index of the first slice.
    starts: index in `events` of each slice's first event, followed by the number of events, (slices + 1,).
    events: the events of all slices; their times are absolute.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     block = next(recording.blocks(ms=100))
    >>> block.first, block.stop, len(block.starts)
    (0, 100, 101)
    """

    first: int
    starts: NDArray[np.int64]
    events: Events

    @property
    def stop(self) -> int:
        """Index of the slice after the last one."""
        return self.first + len(self.starts) - 1

    def slices(self) -> Iterator[Events]:
        """Iterate over the slices, each as views."""
        return (self.events.part(start, stop) for start, stop in pairwise(self.starts.tolist()))


def empty() -> Events:
    """Return zero events, with the right dtypes."""
    return Events(np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8))


def concatenate(parts: list[Events]) -> Events:
    """Join consecutive parts of one stream."""
    if not parts:
        return empty()
    return Events(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def slice_starts(t_us: NDArray[np.int64], slices: int) -> NDArray[np.int64]:
    """Return the index of each slice's first event, then the total: shape (slices + 1,), `ms_to_idx` in files."""
    return np.searchsorted(t_us, np.arange(slices + 1, dtype=np.int64) * SLICE_US).astype(np.int64)


class SliceStarts:
    """Computes `slice_starts` for events that arrive in blocks, in order of time."""

    def __init__(self) -> None:
        self._known: list[NDArray[np.int64]] = []
        self._slices = self._events = 0  # slices with known starts; events received

    def add(self, t_us: NDArray[np.int64]) -> None:
        """Add the times of the next events."""
        if t_us.size:
            last = int(t_us[-1]) // SLICE_US
            edges = np.arange(self._slices, last + 1, dtype=np.int64) * SLICE_US
            self._known.append(self._events + np.searchsorted(t_us, edges))
            self._slices, self._events = last + 1, self._events + t_us.size

    def finish(self, slices: int) -> NDArray[np.int64]:
        """Return the index of each slice's first event, then the total: shape (slices + 1,)."""
        rest = np.full(slices + 1 - self._slices, self._events, np.int64)
        return np.concatenate([*self._known, rest])


class Slicer:
    """Cuts a stream that arrives in packets of any size into slices of 1 ms, including empty ones.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     packets = [recording.events(first, first + 700) for first in (0, 700, 1400)]
    >>> slicer = evetac.Slicer()
    >>> slices = [events for packet in packets for events in slicer.push(packet)]
    >>> all((events.t // 1000 == number).all() for number, events in enumerate(slices))
    True
    """

    def __init__(self) -> None:
        self._next = 0  # index of the slice that is open
        self._waiting: list[Events] = []
        self._latest_us = 0

    def push(self, packet: Events) -> list[Events]:
        """Add the next packet and return the slices that it completes. ValueError if time goes back."""
        if packet.size == 0:
            return []
        if packet.t[0] < self._latest_us or (np.diff(packet.t) < 0).any():
            raise ValueError(f"expected events in order of time, from {self._latest_us} us, found earlier ones")
        self._latest_us = int(packet.t[-1])
        self._waiting.append(packet)
        return self.close_until(self._latest_us // SLICE_US)

    def close_until(self, slices: int) -> list[Events]:
        """Close and return all slices below this index, because device time has passed them, with or without events."""
        if slices <= self._next:
            return []
        waiting = concatenate(self._waiting)
        edges = np.searchsorted(waiting.t, np.arange(self._next + 1, slices + 1, dtype=np.int64) * SLICE_US)
        starts = np.concatenate([[0], edges])
        closed = list(SliceBlock(self._next, starts, waiting).slices())
        self._waiting = [waiting.part(int(starts[-1]), waiting.size)]
        self._next = slices
        return closed
