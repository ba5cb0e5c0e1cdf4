"""Whether an object slides over the gel, slice by slice, from the motion of object and dots; and when its slip began.

The evidence of a slice is two numbers: how far the dot that follows the object best moves per pixel of the object, and
how fast the object moves relative to the gel. Their weighted sum is the log odds that the object slides as one body.
Slides that begin in different slices and last are compared with each other: the score of a beginning in slice k is the
sum of all log odds starting at k. Slices of the slide thus count, and earlier slices do not.

Reasons:
- Only a slide that lasts is slip: a slide that ends before `lasting_px` is discarded.
- Time does not measure evidence. If the object moves slowly, a millisecond contains a dozen events; if dots snap back,
  the whole slip may take one. So following is measured over `seen_px` of motion of object or gel, half of it before the
  slice and half after, within at most HALF_MS slices either way.
- The object slides relative to the gel in contact. This gel snaps back when it is released, so an object may slide by 5
  px in a slice in which it hardly moves itself. The gel in contact is that of the dots that had moved farthest.
- Neighbouring slices share their motion and their errors, so their log odds are not independent. The posterior of the
  beginning is therefore raised to the power `trust`, which makes its intervals wide enough.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit

HALF_MS = 6  # following is measured over at most this many slices before a slice, and after it
LAG_MS = 12  # the dots in contact are determined this many slices earlier
IN_CONTACT = 0.3  # dots farther from rest than this share of the farthest are in contact, weighted by their distance
LEAST_PX = 1e-3  # smaller motion counts as this, to avoid division by zero
RATIOS = (-1.0, 2.0)  # bounds on a dot's motion over the object's; noise makes larger values
SLOW_PX_MS = 0.003  # added to speeds, so that much slower ones are treated alike


class Odds(NamedTuple):
    """Weights of the evidence: log odds = bias + follows * share that follows + speed * log(speed in px/ms).

    seen_px: motion over which the evidence is measured. most: bound on the log odds of a single slice, either sign.
    """

    bias: float
    follows: float
    speed: float
    seen_px: float
    most: float


class Evidence(NamedTuple):
    """Evidence of a number of slices, (slices,) each."""

    log_odds: Floats  # that the object slides as one body
    slide_px: Floats  # slide relative to the gel in contact; negative if the gel moves ahead


class LastingSlip(NamedTuple):
    """The onset of a slip that lasts, in slices, and the slide of the object between the earliest and the latest."""

    onset: int
    earliest: int
    latest: int
    width_px: float


def evidence(object_px: Floats, away_px: Floats, base: int, first: int, stop: int, odds: Odds) -> Evidence:
    """Return the evidence of the slices [first, stop); object_px (slices + 1,) is the distance travelled by the object.

    away_px: distances of the dots from rest, with rows starting at slice `base`. They must cover HALF_MS + LAG_MS
    slices before `first`, as far as these exist, to HALF_MS after `stop`.
    """
    slices = len(object_px) - 1
    low, high = max(first - HALF_MS, 0), min(stop + HALF_MS, slices)
    rows = np.arange(low, high)
    contact = away_px[np.maximum(rows - LAG_MS, 0) - base]
    contact = np.where(contact > IN_CONTACT * contact.max(axis=1, keepdims=True), contact, 0.0)
    weight = contact.sum(axis=1)
    gel_px = (contact * (away_px[rows + 1 - base] - away_px[rows - base])).sum(axis=1) / np.where(weight > 0, weight, 1)
    own_px = object_px[low + 1 : high + 1] - object_px[low:high]
    motion_px = np.maximum(own_px, 0.0) + np.abs(gel_px)
    slice_ = np.arange(first, stop)
    begin, end, gel_sum_px = _windows(slice_, low, slices, motion_px, gel_px, 0.5 * odds.seen_px)
    went_px = np.maximum(object_px[end] - object_px[begin], LEAST_PX)
    best = (away_px[end - base] - away_px[begin - base]).max(axis=1) / went_px
    speed = np.maximum(went_px - np.minimum(gel_sum_px, 0.0), LEAST_PX) / (end - begin)
    log_odds = odds.bias + odds.follows * np.clip(best, *RATIOS) + odds.speed * np.log(speed + SLOW_PX_MS)
    here = slice(first - low, stop - low)
    return Evidence(np.clip(log_odds, -odds.most, odds.most), own_px[here] - gel_px[here])


def _windows(
    slice_: NDArray[np.int64], low: int, slices: int, motion_px: Floats, gel_px: Floats, half_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Return, per slice, the window [begin, end) with `half_px` of motion on either side, and the gel's motion in it.

    motion_px, gel_px: of slices starting at `low`. The slice itself counts as after, so a window is never empty.
    """

    def of(values: Floats, at: NDArray[np.int64]) -> Floats:
        return values[np.clip(at - low, 0, len(values) - 1)]

    begin, end = slice_.copy(), slice_ + 1
    gel_sum_px, after_px, before_px = of(gel_px, slice_), of(motion_px, slice_), np.zeros(len(slice_))
    for _ in range(1, HALF_MS):
        goes_on = (after_px < half_px) & (end < slices)
        gel_sum_px = gel_sum_px + np.where(goes_on, of(gel_px, end), 0.0)
        after_px = after_px + np.where(goes_on, of(motion_px, end), 0.0)
        end = end + goes_on
        goes_on = (before_px < half_px) & (begin > 0)
        begin = begin - goes_on
        gel_sum_px = gel_sum_px + np.where(goes_on, of(gel_px, begin), 0.0)
        before_px = before_px + np.where(goes_on, of(motion_px, begin), 0.0)
    return begin, end, gel_sum_px


def find(
    observed: Evidence,
    start: int,
    *,
    slip_distance_px: float,
    lasting_px: float,
    pause_ms: int,
    search_ms: int,
    trust: float,
    outside: float,
) -> LastingSlip | None:
    """Return the first slip that lasts, starting at slice `start`; None without one.

    `slip_distance_px`: slide of the object at the onset. `lasting_px`: a slide is slip if it continues this far, with
    pauses of up to pause_ms. `search_ms`: longest time from its beginning until then. `trust`: power of the posterior.
    `outside`: posterior probability before the interval, and after it.
    """
    slid_px = np.maximum(observed.slide_px, 0.0)
    sure = int(_lasting(observed.log_odds, slid_px, start, lasting_px, pause_ms))
    if sure < 0:
        return None
    low = max(sure - search_ms, start)
    score = np.cumsum(observed.log_odds[low : sure + 1][::-1])[::-1]
    posterior = np.exp(trust * (score - score.max()))
    reached = np.cumsum(posterior / posterior.sum())
    so_far_px = np.concatenate([[0.0], np.cumsum(slid_px[low:])])
    begun_px = so_far_px[: len(score)]
    # For a slide that began in each slice: the onset is the first slice at whose end slip_distance_px is exceeded.
    onset = np.minimum(np.searchsorted(so_far_px, begun_px + slip_distance_px, side="right") - 1, len(so_far_px) - 2)
    earliest = int(onset[np.searchsorted(reached, outside)])
    latest = int(onset[min(int(np.searchsorted(reached, 1.0 - outside)), len(onset) - 1)])
    best = int(np.clip(onset[np.argmax(score)], earliest, latest))
    width_px = float(so_far_px[latest + 1] - so_far_px[earliest + 1])
    return LastingSlip(low + best, low + earliest, low + latest, width_px)


@njit(cache=True)
def _lasting(log_odds: Floats, slid_px: Floats, start: int, lasting_px: float, pause_ms: int) -> int:
    """Return the slice by which a slide has continued for lasting_px; -1 without one."""
    gone_px = 0.0
    paused = 0
    for slice_ in range(start, len(log_odds)):
        if log_odds[slice_] > 0.0:
            gone_px += slid_px[slice_]
            paused = 0
        else:
            paused += 1
            if paused > pause_ms:
                gone_px = 0.0
        if gone_px > lasting_px:
            return slice_
    return -1
