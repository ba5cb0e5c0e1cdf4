"""Events of each pixel while dots are moved over it, ON and OFF apart, with those added that scans have merged.

An event says that brightness has changed by a threshold, and by what a scan lets it change further before the pixel is
looked at again. Where a pixel's events of one polarity follow each other m scans apart, that further change is 1 / (2
m) of the whole in the mean, so such an event stands for 1 / (1 - 1 / (2 m)) thresholds.

Why so: a gel that sticks and slips is drawn slowly one way and snaps back the other, so that scans merge more events of
one polarity than of the other.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

SCAN_US = 200.0  # of a DVXplorer
LONGEST_US = 20_000  # between two events that one passing rim makes
LONG_AGO_US = -(10**12)


@dataclass(slots=True)
class StrokeEvents:
    """Thresholds that each pixel has passed so far; `add` changes it in place.

    `events` as they came, `on` and `off` with those that were merged (halves of the strokes, height, width); `merged`
    sums 1 / (2 m) over `intervals` of both polarities; of each pixel the last event, and whether it began its run.
    """

    events: Ints
    on: Floats
    off: Floats
    merged: Floats
    intervals: Ints
    last_us: Ints
    last_p: NDArray[np.int8]
    first: NDArray[np.bool_]

    @property
    def kept_share(self) -> float:
        """Share of the events that scans leave; 1 where no events followed each other."""
        return float(1.0 - self.merged.sum() / max(1, self.intervals.sum()))


def start(frame_px: tuple[int, int]) -> StrokeEvents:
    """No events yet; frame_px is (width, height)."""
    shape = frame_px[1], frame_px[0]
    return StrokeEvents(
        events=np.zeros((2, *shape), np.int64),
        on=np.zeros((2, *shape)),
        off=np.zeros((2, *shape)),
        merged=np.zeros(1),
        intervals=np.zeros(1, np.int64),
        last_us=np.full(shape, LONG_AGO_US, np.int64),
        last_p=np.full(shape, -1, np.int8),
        first=np.zeros(shape, np.bool_),
    )


def add(
    state: StrokeEvents, t_us: Ints, x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], half: int
) -> None:
    """Take in the next events, in order of time, of one half of the strokes, 0 or 1; those outside the frame are not.

    ValueError if the columns differ in length.
    """
    if not len(t_us) == len(x) == len(y) == len(p):
        raise ValueError(f"expected columns of equal length, found {len(t_us)}, {len(x)}, {len(y)} and {len(p)}")
    counts = state.events[half], state.on[half], state.off[half], state.merged, state.intervals
    _add(t_us, x, y, p, *counts, state.last_us, state.last_p, state.first)


@njit(cache=True)
def _add(
    t_us: Ints,
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    events: Ints,
    on: Floats,
    off: Floats,
    merged: Floats,
    intervals: Ints,
    last_us: Ints,
    last_p: NDArray[np.int8],
    first: NDArray[np.bool_],
) -> None:
    height, width = on.shape
    for event in range(len(t_us)):
        row, column = y[event], x[event]
        if row >= height or column >= width:
            continue
        events[row, column] += 1
        polarity = np.int8(p[event] != 0)
        between_us = t_us[event] - last_us[row, column]
        thresholds = 1.0
        follows = last_p[row, column] == polarity and between_us < LONGEST_US
        if follows:
            share = 0.5 / max(1.0, np.round(between_us / SCAN_US))
            merged[0] += share
            intervals[0] += 1
            thresholds = 1.0 / (1.0 - share)
            if first[row, column]:  # it came as fast, but nothing before it told how fast
                thresholds += thresholds - 1.0
        first[row, column] = not follows
        if polarity:
            on[row, column] += thresholds
        else:
            off[row, column] += thresholds
        last_us[row, column] = t_us[event]
        last_p[row, column] = polarity
