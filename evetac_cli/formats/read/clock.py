"""The clock of a camera as a file holds it, made continuous: the one rule for wraps, for every format.

A clock of few bits begins anew when it is full: 24 bits of microseconds in EVT3 (16.8 s), 31 or 32 bits in AEDAT, DAT,
libcaer and in columns that a program saved as int32 or uint32 (35.8 or 71.6 min), 34 bits in EVT2. A file may also hold
a clock that truly went back: the camera was restarted, files were joined, a packet was damaged. Size tells the two
apart: a fall of more than three quarters of the clock's range is a wrap and is followed. Any smaller step back stays in
the times, for time_order to judge.

After a jump ahead by more than three quarters of the range, a fall as large stays in the times too: the jump may have
been the fault, from which the clock only comes back. An event that is late by less than a millisecond over a wrap looks
like such a jump: it belongs to the turn before.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US

BITS_31, BITS_32 = 1 << 31, 1 << 32
NEVER = 1 << 62
WRAP_SHARE = 0.75  # of the range: a larger fall is a wrap
EDGE_SHARE = 1 / 64  # of the range: how near its two ends a fall has to lead where only the numbers suggest a range


class Clock:
    """Makes the times of a clock that wraps continuous, batch by batch."""

    def __init__(self, spans: Sequence[int], edges: Sequence[int] = (), tick_us: float = 1.0) -> None:
        """spans: ticks after which the clock begins anew, as the format says; of several the first that fits a fall.

        edges: ranges that the format does not say: a fall has to lead from their very end to their very beginning.
        tick_us: length of a tick.
        """
        self._spans, self._edges = tuple(spans), tuple(edges)
        self._large = WRAP_SHARE * min((*spans, *edges), default=NEVER)  # ticks; smaller steps are no wraps
        self._late = 1 + int(SLICE_US / tick_us)  # ticks that an event may be late over a wrap
        self._last: int | None = None  # the tick that was seen last
        self._turns: list[int] = []  # the range of each wrap that was followed
        self._jumped = False  # ahead by most of the range, since the last wrap
        self._wraps = 0
        self._first = ""

    def continuous(self, ticks: NDArray[np.int64], place: Callable[[int], str]) -> NDArray[np.int64]:
        """The ticks of the next batch, without wraps; place: where the user finds row i of it in the file."""
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
        """Ticks to add to all times from a large step on."""
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
            if len(self._turns) > self._wraps:  # not the way back from an event that was late over a wrap
                self._wraps += 1
                self._first = self._first or place()
        return span

    def _span(self, before: int, to: int) -> int:
        """The range that a fall is a wrap of; 0 for none."""
        for span in self._spans:
            if before - to > WRAP_SHARE * span and (to >= 0 or span == self._spans[0]):
                return span
        for span in self._edges:
            if span * (1 - EDGE_SHARE) <= before < span and 0 <= to < span * EDGE_SHARE:
                return span
        return 0

    @property
    def notes(self) -> list[str]:
        """What was followed, in words; none without a wrap."""
        if not self._wraps:
            return []
        times = f"{self._wraps:,} times, first" if self._wraps > 1 else "once,"
        return [f"the file's clock wrapped {times} {self._first}; the times are unwrapped"]
