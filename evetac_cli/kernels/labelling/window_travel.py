"""How far an object has gone by the events of the window that shows its texture.

A texture that moves makes a number of events per pixel of motion, which is measured in the recording itself while the
object still sticks to the gel, and the dots beside it go as far as it does. How far it went after that follows from
counting, at any speed.

Why so:
- At rest the window makes events of noise. They are told from the steps in which no dot moves, by their lower
  quartile, as the object may slide in half of them; counts of noise have it 0.67 standard deviations below their mean.
  The least of all steps would be less than noise makes, and would let an object at rest go on for pixels.
- The window's events per pixel fall with the distance travelled: the pixels start anywhere between two thresholds, but
  later every turn of the texture's slope costs as much brightness as a threshold before events come again. After a
  distance s it makes fresh / (1 + s / fading_px) events per pixel, so N events are a distance of
  fading_px (exp(N / (fresh fading_px)) - 1).
- `fresh` is the median over steps of 50 ms in which the dots that move most took the object along. Steps after a slice
  are not used, as they may contain the slip.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.events import SLICE_US, Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.labelling.flow import Region

STEP_MS = 50  # of the measurement of the window's events per pixel, and of its noise
LAG_MS = 30  # a slice uses only steps that ended so long before: later ones may hold the slip itself
LEAST_STEP_PX = 0.15  # the gel must have moved so far in a step for it to be used
LEAST_STEPS = 1
REST_STEP_PX = 0.03  # dots that moved less in a step were at rest
REST_STEPS = 4  # so many at least, for a quartile of the noise
QUARTILE_SD = 0.67  # standard deviations between quartile and mean of a normal distribution
HOT_BLOCK_US = 100_000
HOT_SHARE = 0.5  # a pixel with events in more of these blocks is hot; edges pass it only now and then
MOST_FADED = 6.0  # exponent beyond which the window is no measure: four hundred times fading_px


class EventRate(NamedTuple):
    """Events a pixel of motion of a window that has not moved, (slices,), and where the recording has told them."""

    per_px: Floats
    known: Flags


def block_counts(events: Events, window: Region, last: NDArray[np.int64], busy: NDArray[np.int64]) -> None:
    """Count in `busy` (height, width) of the window the blocks of time in which each pixel had events; `last` scratch.

    Events come in order of time; both arrays are kept from call to call, `last` begins at -1.
    """
    _count_blocks(events.t, events.x, events.y, window, last, busy)


def quiet_pixels(busy: NDArray[np.int64], slices: int) -> Flags:
    """Which pixels of the window count: those that are not hot."""
    quiet: Flags = busy <= max(HOT_SHARE * slices * SLICE_US / HOT_BLOCK_US, 2.0)
    return quiet


def slice_counts(events: Events, window: Region, quiet: Flags, first: int, stop: int) -> NDArray[np.int64]:
    """Events of the quiet pixels of the window in each of the slices [first, stop)."""
    x0, y0, x1, y1 = window
    inside = (events.x >= x0) & (events.x < x1) & (events.y >= y0) & (events.y < y1)
    seen = events.at(inside)
    counted = quiet[seen.y.astype(np.int64) - y0, seen.x.astype(np.int64) - x0]
    return np.bincount(seen.t[counted] // SLICE_US - first, minlength=stop - first)[: stop - first]


def noise_rate(window_events: NDArray[np.int64], leading: Floats) -> float:
    """Events a slice that the window makes at rest, of its events counted from the start (slices + 1,).

    leading: how far the leading dots are from rest, every STEP_MS slices. By the steps in which they rest, and where
    there are too few of these the least of all.
    """
    steps = np.diff(window_events[::STEP_MS])
    if not len(steps):
        return 0.0
    rest = np.abs(np.diff(leading)) < REST_STEP_PX
    if np.count_nonzero(rest) < REST_STEPS:
        return float(steps.min() / STEP_MS)
    quartile = np.quantile(steps[rest], 0.25)
    return float((quartile + QUARTILE_SD * np.sqrt(quartile)) / STEP_MS)


def events_per_px(moved: Floats, leading: Floats, assumed: float, fading_px: float) -> EventRate:
    """The events per pixel of motion that the window made before it moved, as known in every slice.

    `moved` (slices + 1,) counts events without noise, `leading` is how far the leading dots are from rest, every
    STEP_MS slices. Of all earlier steps the median, weighted by how far these dots went; `assumed` before.
    """
    gone = np.diff(leading)
    seen = np.diff(moved[::STEP_MS]) * (1.0 + 0.5 * (leading[1:] + leading[:-1]) / fading_px)
    used = gone > LEAST_STEP_PX
    used[:1] = False  # in the first step the dots jump from rest to where they are
    steps = np.cumsum(used)  # of use up to each
    medians = _medians(seen[used] / gone[used], gone[used])
    rate = np.full(len(moved) - 1, assumed)
    ended = (np.arange(len(rate)) - LAG_MS) // STEP_MS - 1  # step that a slice may use, with all before it
    of_use = steps[np.clip(ended, 0, None)] if len(steps) else np.zeros(len(rate), np.int64)
    tells = (ended >= 0) & (of_use >= LEAST_STEPS)
    rate[tells] = medians[of_use[tells] - 1]
    return EventRate(rate, tells)


def travel(moved: Floats, fresh: Floats, fading_px: float) -> Floats:
    """How far the object has gone by the window's events `moved` (slices + 1,) without noise, in px: (slices + 1,).

    `fresh` (slices,) is what `events_per_px` knows.
    """
    faded = np.exp(np.minimum(moved[:-1] / (fresh * fading_px), MOST_FADED))
    steps_px = np.diff(moved) / fresh * faded
    return np.concatenate([[0.0], np.cumsum(steps_px)])


@njit(cache=True)
def _medians(rates: Floats, weights: Floats) -> Floats:
    """Weighted median of the first value, the first two, and so on; sorted by insertion, so that an hour is quick."""
    medians, reached = np.empty(len(rates)), np.empty(len(rates))
    ordered, ordered_weights = np.empty(len(rates)), np.empty(len(rates))
    for count in range(len(rates)):
        at = count
        while at > 0 and (
            ordered[at - 1] > rates[count]
            or (ordered[at - 1] == rates[count] and ordered_weights[at - 1] > weights[count])
        ):
            ordered[at] = ordered[at - 1]
            ordered_weights[at] = ordered_weights[at - 1]
            at -= 1
        ordered[at] = rates[count]
        ordered_weights[at] = weights[count]
        for place in range(at, count + 1):
            reached[place] = ordered_weights[place] + (reached[place - 1] if place else 0.0)
        half = 0
        while reached[half] < 0.5 * reached[count]:
            half += 1
        medians[count] = ordered[half]
    return medians


@njit(cache=True)
def _count_blocks(
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    window: tuple[int, int, int, int],
    last: NDArray[np.int64],
    busy: NDArray[np.int64],
) -> None:
    """`block_counts`, compiled."""
    x0, y0, x1, y1 = window
    for event in range(len(t)):
        column = np.int64(x[event])
        row = np.int64(y[event])
        if column < x0 or column >= x1 or row < y0 or row >= y1:
            continue
        block = t[event] // HOT_BLOCK_US
        if last[row - y0, column - x0] != block:
            last[row - y0, column - x0] = block
            busy[row - y0, column - x0] += 1
