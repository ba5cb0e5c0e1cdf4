"""Unwrap the camera clock of a file: the one rule for wraps, used for every format.

A clock with few bits wraps when it is full. EVT3 has 24 bits of microseconds (16.8 s), EVT2 has 34. AEDAT, DAT, libcaer
and columns that a program saved as int32 or uint32 have 31 or 32 (35.8 or 71.6 min). The clock of a file may also
really go back: the camera was restarted, files were joined, or a packet was damaged. The size of the step distinguishes
the two: a step back by more than three quarters of the clock's range is a wrap and is unwrapped. Any smaller step back
stays in the times, and time_order handles it.

After a jump ahead by more than three quarters of the range, an equally large step back stays in the times too: the jump
may have been the error, and the step back its end. An event that is less than a millisecond late after a wrap looks
like such a jump: it belongs to the turn before the wrap.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US

BITS_31, BITS_32 = 1 << 31, 1 << 32
NEVER = 1 << 62
WRAP_SHARE = 0.75  # of the range: a larger step back is a wrap
EDGE_SHARE = (
    1 / 64
)  # of the range: a wrap must begin and end this close to its ends if only the numbers suggest a range


class Clock:
    """Unwraps the times of a clock, batch by batch."""

    def __init__(self, spans: Sequence[int], edges: Sequence[int] = (), tick_us: float = 1.0) -> None:
        """spans: ticks after which the clock wraps, by the format; if there are several, the first that fits.

        edges: possible ranges that the format does not state: a wrap must lead from close to their end to close to 0.
        tick_us: length of a tick.
        """
        self._spans, self._edges = tuple(spans), tuple(edges)
        self._large = WRAP_SHARE * min((*spans, *edges), default=NEVER)  # ticks; smaller steps are not wraps
        self._late = 1 + int(SLICE_US / tick_us)  # ticks that an event may be late after a wrap
        self._last: int | None = None  # the last tick so far
        self._turns: list[int] = []  # the range of each wrap so far
        self._jumped = False  # ahead by most of the range, since the last wrap
        self._wraps = 0
        self._first = ""

    def continuous(self, ticks: NDArray[np.int64], place: Callable[[int], str]) -> NDArray[np.int64]:
        """Return the unwrapped ticks of the next batch; place(i): a text on where row i is in the file."""
        if not len(ticks):
            return ticks
        last = int(ticks[0]) if self._last is None else self._last
        self._last = int(ticks[-1])
        offset = sum(self._turns)
        if max(last, int(ticks.max())) - min(last, int(ticks.min())) <= self._large:
            return ticks + offset if offset else ticks
        offsets = np.zeros(len(ticks), np.int64)
        steps = np.diff(ticks, prepend=last)
        for row in np.flatnonzero(np.abs(steps) > self._large).tolist():
            to = int(ticks[row])
            offsets[row] = self._turn(to - int(steps[row]), to, partial(place, row))
        return ticks + offset + np.cumsum(offsets)

    def _turn(self, before: int, to: int, place: Callable[[], str]) -> int:
        """Return the ticks to add to all times after a large step."""
        if to > before:
            if self._turns and self._turns[-1] - (to - before) <= self._late:
                return -self._turns.pop()
            self._jumped = True
            return 0
        if self._jumped:
            self._jumped = False
            return 0
        span = self._span(before, to)
        if span:
            self._turns.append(span)
            if len(self._turns) > self._wraps:  # not the return from an event that was late after a wrap
                self._wraps += 1
                self._first = self._first or place()
        return span

    def _span(self, before: int, to: int) -> int:
        """Return the range whose wrap explains this jump back; 0 if none does."""
        for span in self._spans:
            if before - to > WRAP_SHARE * span and (to >= 0 or span == self._spans[0]):
                return span
        for span in self._edges:
            if span * (1 - EDGE_SHARE) <= before < span and 0 <= to < span * EDGE_SHARE:
                return span
        return 0

    @property
    def notes(self) -> list[str]:
        """A note on the wraps; none if there was no wrap."""
        if not self._wraps:
            return []
        times = f"{self._wraps:,} times, first" if self._wraps > 1 else "once,"
        return [f"the file's clock wrapped {times} {self._first}; the times are unwrapped"]
