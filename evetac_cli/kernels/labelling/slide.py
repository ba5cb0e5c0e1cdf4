"""Whether an object slides over the gel, slice by slice, from how far it and the dots went; and when its slip began.

The evidence of a slice are two numbers: how far the dot that follows the object best went for a pixel of the object,
and how fast the object moves against the gel. Their weighted sum is the logarithm of the odds that the object slides
as one body. The slides that begin in each slice and last are weighed against each other: a slide that begins in slice
k has the sum of these logarithms from k on, so that what belongs to it counts for it, and what came before does not.

Why so:
- Only a slide that lasts is slip: one that ends before it has gone `lasting_px` is forgotten, however far.
- Time is no measure of the evidence: where the object moves slowly a millisecond holds a dozen events, and where dots
  snap back the whole slip may be in one. So what follows is seen over `seen_px` of motion of object or gel, half of it
  before the slice and half after, and at most HALF_MS slices either way.
- What moves against the object is the gel in contact, which snaps back when it is let go, so that an object may slide
  by 5 px in a slice in which it hardly moves. The gel in contact is that of the dots which had gone farthest.
- The logarithms are of slices that share their motion and their mistakes, so the posterior of the beginning is taken
  to the power `trust`, which makes its intervals as wide as they have to be.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit

HALF_MS = 6  # what follows is seen over so many slices at most before a slice, and after
LAG_MS = 12  # which dots are in contact is asked of so many slices before
IN_CONTACT = 0.3  # dots farther from rest than this share of the farthest are in contact, the more the farther
LEAST_PX = 1e-3  # of motion: less is nothing
RATIOS = (-1.0, 2.0)  # of a dot's motion to the object's; noise makes larger ones
SLOW_PX_MS = 0.003  # speeds much below are alike


class Odds(NamedTuple):
    """How the evidence is weighed: log odds = bias + follows * share that follows + speed * log(speed in px/ms).

    seen_px: motion over which it is seen; most: log odds of a single slice, either way.
    """

    bias: float
    follows: float
    speed: float
    seen_px: float
    most: float


class Evidence(NamedTuple):
    """Of some slices, (slices,) each."""

    log_odds: Floats  # that the object slides as one body
    slide_px: Floats  # how far it goes against the gel in contact; below 0 where the gel goes ahead


class LastingSlip(NamedTuple):
    """The onset of a slip that lasts, slices, and how far the object slid between the earliest and the latest."""

    onset: int
    earliest: int
    latest: int
    width_px: float


def evidence(object_px: Floats, away_px: Floats, base: int, first: int, stop: int, odds: Odds) -> Evidence:
    """The evidence of the slices [first, stop); object_px (slices + 1,) is how far the object has gone.

    away_px: how far dots are from rest, rows from `base` on: from HALF_MS + LAG_MS before `first`, where there are
    such, to HALF_MS after `stop`.
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
    """For each slice the window [begin, end) around it in which `half_px` of motion lie either way, and the gel's sum.

    motion_px, gel_px: of slices from `low` on. The slice itself is after, so that a window has one slice at least.
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
    told: Evidence,
    start: int,
    *,
    slip_distance_px: float,
    lasting_px: float,
    pause_ms: int,
    search_ms: int,
    trust: float,
    outside: float,
) -> LastingSlip | None:
    """The first slip from slice `start` on that lasts; None without one.

    slip_distance_px: the object has slid so far: the onset; lasting_px: a slide is slip when it goes on so far, with
    pauses of up to pause_ms; search_ms: it began so long before that at most; trust: power of the posterior; outside:
    share of it that may lie before the interval, and after it.
    """
    slid_px = np.maximum(told.slide_px, 0.0)
    sure = int(_lasting(told.log_odds, slid_px, start, lasting_px, pause_ms))
    if sure < 0:
        return None
    low = max(sure - search_ms, start)
    score = np.cumsum(told.log_odds[low : sure + 1][::-1])[::-1]
    posterior = np.exp(trust * (score - score.max()))
    reached = np.cumsum(posterior / posterior.sum())
    so_far_px = np.concatenate([[0.0], np.cumsum(slid_px[low:])])
    begun_px = so_far_px[: len(score)]
    # the onset, if the slide began in each slice: the first slice at whose end slip_distance_px are exceeded
    onset = np.minimum(np.searchsorted(so_far_px, begun_px + slip_distance_px, side="right") - 1, len(so_far_px) - 2)
    earliest = int(onset[np.searchsorted(reached, outside)])
    latest = int(onset[min(int(np.searchsorted(reached, 1.0 - outside)), len(onset) - 1)])
    best = int(np.clip(onset[np.argmax(score)], earliest, latest))
    width_px = float(so_far_px[latest + 1] - so_far_px[earliest + 1])
    return LastingSlip(low + best, low + earliest, low + latest, width_px)


@njit(cache=True)
def _lasting(log_odds: Floats, slid_px: Floats, start: int, lasting_px: float, pause_ms: int) -> int:
    """The slice by which a slide has gone on for lasting_px; -1 without one."""
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
