"""An image of the gel at rest, from the events of its motion.

A dark dot brightens each pixel that it leaves and darkens each pixel that it covers. The number of events is the step
of log brightness over the threshold. So the first run of events of one polarity after a rest shows how much brighter or
darker a pixel can become. Inside a dot the pixel brightens by the whole contrast, outside it darkens, and on the
blurred rim the two shares measure its brightness at rest. Together they are an image of the gel at rest.

Reasons:
- Only the first run counts. The sum of all events would be simpler, but a camera merges the steps of a fast motion into
  one event. From then on the sum is wrong: with the simulated camera, by 20 events after one stroke.
- Events can be processed backwards in time from the rest after a stroke, with reversed polarity. This gives a second
  first run, from the other side. The maximum over all strokes counts, because a fast motion can only remove events.
- A single event of the other polarity within or before a run is noise and does not end the run.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit

Pixels = NDArray[np.uint8]

BIN_SLICES = 10  # slices per bin, for finding rests
SPELL_BINS = 5  # shortest rest
QUIET_PERCENTILE = 2.0  # of the running mean over SPELL_BINS: the level of the quietest time
QUIET_RATIO, QUIET_EVENTS = 1.5, 30  # a bin with more than ratio * the quietest + this many events is in motion
MOST_EVENTS = 200  # of a run; a dot's contrast is about 10 events
TURNED_EVENTS = 2  # a run ends when it has reversed by this many events


class RestImage(NamedTuple):
    """Events by which every pixel became brighter, and darker, in runs from rest: two arrays (height, width)."""

    brighter: Pixels
    darker: Pixels

    def joined(self, other: "RestImage") -> "RestImage":
        """Return the larger count of both, for every pixel."""
        return RestImage(np.maximum(self.brighter, other.brighter), np.maximum(self.darker, other.darker))


@dataclass(slots=True)
class RunState:
    """First runs of one stroke so far, each (height, width); `step` changes them in place."""

    level: NDArray[np.int16]
    highest: NDArray[np.int16]
    lowest: NDArray[np.int16]
    over: NDArray[np.bool_]


def quiet_spells(events_a_slice: NDArray[np.integer]) -> list[tuple[int, int]]:
    """Return the slices [first, stop) of rests, in order: at least 50 ms with hardly more events than the quietest.

    Empty if there are fewer than 50 slices. A gel that is never at rest also has such times: those of its slowest
    motion.
    """
    bins = len(events_a_slice) // BIN_SLICES
    if bins < SPELL_BINS:
        return []
    counts = np.asarray(events_a_slice[: bins * BIN_SLICES], np.int64).reshape(bins, BIN_SLICES).sum(axis=1)
    running = np.convolve(counts, np.ones(SPELL_BINS, np.int64), "valid") / SPELL_BINS
    quiet = counts <= QUIET_RATIO * np.percentile(running, QUIET_PERCENTILE) + QUIET_EVENTS
    edges = np.flatnonzero(np.diff(np.concatenate([[0], quiet.astype(np.int8), [0]]))).reshape(-1, 2)
    return [(int(a) * BIN_SLICES, int(b) * BIN_SLICES) for a, b in edges if b - a >= SPELL_BINS]


def start(frame_px: tuple[int, int]) -> RunState:
    """Return the state at the start of a stroke, at rest; frame_px is (width, height)."""
    shape = (frame_px[1], frame_px[0])
    return RunState(
        level=np.zeros(shape, np.int16),
        highest=np.zeros(shape, np.int16),
        lowest=np.zeros(shape, np.int16),
        over=np.zeros(shape, np.bool_),
    )


def step(
    state: RunState,
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    *,
    backwards: bool = False,
) -> None:
    """Add the next events of a stroke, in order of time; updates `state` in place.

    backwards: the stroke is processed back from the rest after it, packet by packet; each packet is still in order of
    time. Events outside the frame are ignored.
    """
    assert len(x) == len(y) == len(p)
    _step(x, y, p, backwards, state.level, state.highest, state.lowest, state.over)


def image(state: RunState) -> RestImage:
    """Return the image after a stroke; a median over 3 x 3 removes hot and stray pixels."""
    up, down = state.highest, -state.lowest
    sides = (np.where(up >= down, up, 0), np.where(down > up, down, 0))
    return RestImage(*(cv2.medianBlur(side.astype(np.uint8), 3) for side in sides))


@njit(cache=True)
def _step(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    backwards: bool,
    level: NDArray[np.int16],
    highest: NDArray[np.int16],
    lowest: NDArray[np.int16],
    over: NDArray[np.bool_],
) -> None:
    height, width = level.shape
    count = len(x)
    for index in range(count):
        event = count - 1 - index if backwards else index
        row = y[event]
        column = x[event]
        if row >= height or column >= width or over[row, column]:
            continue
        brighter = (p[event] != 0) != backwards
        now = level[row, column] + (1 if brighter else -1)
        level[row, column] = now
        high = max(highest[row, column], now)
        low = min(lowest[row, column], now)
        highest[row, column] = high
        lowest[row, column] = low
        risen_and_turned = high >= TURNED_EVENTS and high - now >= TURNED_EVENTS
        sunk_and_turned = low <= -TURNED_EVENTS and now - low >= TURNED_EVENTS
        too_long = high >= MOST_EVENTS or low <= -MOST_EVENTS
        over[row, column] = risen_and_turned or sunk_and_turned or too_long
