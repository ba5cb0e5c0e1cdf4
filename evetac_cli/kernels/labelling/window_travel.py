"""Distance travelled by an object, from the events of the window through which its texture is visible.

A moving texture causes a certain number of events per pixel of motion. This number is measured in the recording itself,
while the object still sticks to the gel and the dots next to it move as far as it does. The later motion then follows
from counting events, at any speed.

Reasons:
- At rest the window has noise events. Their rate comes from the steps in which no dot moves. It is taken from the
  lower quartile, because the object may slide in half of these steps; noise counts have their lower quartile 0.67
  standard deviations below their mean. The minimum over all steps would be too low, and an object at rest would seem to
  move on for pixels.
- The window's events per pixel decrease with the distance travelled. The pixels start anywhere between two thresholds,
  but later every reversal of the texture's slope needs a full threshold of brightness before events come again. After a
  distance s there are fresh / (1 + s / fading_px) events per pixel, so N events mean a distance of
  fading_px (exp(N / (fresh fading_px)) - 1).
- `fresh` is the median over steps of 50 ms in which the dots that move most moved with the object. Only steps before a
  slice are used for it, because later ones may contain the slip.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.events import SLICE_US, Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.labelling.flow import Region

STEP_MS = 50  # duration of a step, for the window's events per pixel and its noise
LAG_MS = 30  # a slice only uses steps that ended this long before: later ones may contain the slip itself
LEAST_STEP_PX = 0.15  # a step is used if the gel moved at least this far
LEAST_STEPS = 1  # fewest used steps that determine the events per pixel
REST_STEP_PX = 0.03  # dots that moved less than this in a step were at rest
REST_STEPS = 4  # fewest steps at rest for a quartile of the noise
QUARTILE_SD = 0.67  # standard deviations between quartile and mean of a normal distribution
HOT_BLOCK_US = 100_000
HOT_SHARE = 0.5  # a pixel with events in more than this share of the blocks is hot; an edge passes less often
MOST_FADED = 6.0  # exponent beyond which the window cannot measure motion: four hundred times fading_px


class EventRate(NamedTuple):
    """Events per pixel of motion for a window that has not moved yet, (slices,), and whether they were measured."""

    per_px: Floats
    is_known: Flags


def block_counts(events: Events, window: Region, last: NDArray[np.int64], busy: NDArray[np.int64]) -> None:
    """Count in `busy` (height, width) of the window the blocks of time in which each pixel had events.

    Events must be in order of time. Both arrays are kept from call to call; `last` is workspace that begins at -1.
    """
    _count_blocks(events.t, events.x, events.y, window, last, busy)


def quiet_pixels(busy: NDArray[np.int64], slices: int) -> Flags:
    """Return which pixels of the window count: those that are not hot."""
    quiet: Flags = busy <= max(HOT_SHARE * slices * SLICE_US / HOT_BLOCK_US, 2.0)
    return quiet


def slice_counts(events: Events, window: Region, quiet: Flags, first: int, stop: int) -> NDArray[np.int64]:
    """Return the number of events of the window's quiet pixels in each of the slices [first, stop)."""
    x0, y0, x1, y1 = window
    inside = (events.x >= x0) & (events.x < x1) & (events.y >= y0) & (events.y < y1)
    seen = events.at(inside)
    counted = quiet[seen.y.astype(np.int64) - y0, seen.x.astype(np.int64) - x0]
    return np.bincount(seen.t[counted] // SLICE_US - first, minlength=stop - first)[: stop - first]


def noise_rate(window_events: NDArray[np.int64], leading: Floats) -> float:
    """Return the events per slice that the window makes at rest, from its cumulative events (slices + 1,).

    leading: distance of the leading dots from rest, every STEP_MS slices. The rate comes from the steps in which they
    rest or, if these are too few, from the step with the fewest events.
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
    """Return the events per pixel of motion that a fresh window makes, as known at every slice.

    `moved` (slices + 1,) counts events without noise; `leading` is the distance of the leading dots from rest, every
    STEP_MS slices. The result is the median over all earlier steps, weighted by the motion of these dots, and `assumed`
    before there are any.
    """
    gone = np.diff(leading)
    seen = np.diff(moved[::STEP_MS]) * (1.0 + 0.5 * (leading[1:] + leading[:-1]) / fading_px)
    used = gone > LEAST_STEP_PX
    used[:1] = False  # in the first step the dots jump from rest to their present position
    steps = np.cumsum(used)  # number of used steps up to each one
    medians = _medians(seen[used] / gone[used], gone[used])
    rate = np.full(len(moved) - 1, assumed)
    ended = (np.arange(len(rate)) - LAG_MS) // STEP_MS - 1  # last step that a slice may use
    of_use = steps[np.clip(ended, 0, None)] if len(steps) else np.zeros(len(rate), np.int64)
    tells = (ended >= 0) & (of_use >= LEAST_STEPS)
    rate[tells] = medians[of_use[tells] - 1]
    return EventRate(rate, tells)


def travel(moved: Floats, fresh: Floats, fading_px: float) -> Floats:
    """Return the distance travelled by the object in px, (slices + 1,), from the window's events without noise.

    moved: these events, cumulative (slices + 1,). fresh: (slices,) from `events_per_px`.
    """
    faded = np.exp(np.minimum(moved[:-1] / (fresh * fading_px), MOST_FADED))
    steps_px = np.diff(moved) / fresh * faded
    return np.concatenate([[0.0], np.cumsum(steps_px)])


@njit(cache=True)
def _medians(rates: Floats, weights: Floats) -> Floats:
    """Return the weighted median of the first value, the first two, and so on; insertion sort is fast for an hour."""
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
    """Do the work of `block_counts`, compiled."""
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
