"""Slip labels from counted events: motion of dots and window to a fraction of a pixel, without images.

The tracker, preset `stable`, follows the dots. The events of the window, through which the object's texture is visible,
give the motion of the object (window_travel.py). Both together show slice by slice whether the object slides. An
optical flow of images needs enough events to recognise a pattern, which slow motion does not make.

The onset is the slice in which the object has slid `slip_distance_px` since its slip began. It has an interval in which
it may be. Labels abstain, with a reason, in three cases: the object slides far within that interval, the slide stopped,
or the recording did not determine the motion per event of the window. Slices of such an interval have the label -1.

Constants are fitted to simulated slips of the digital twin (dots of 9 px, one-threshold friction). The seeds are listed
in scripts/reproduce/seeds.json, group `labels`; scripts/studies/labels/judge.py evaluates them on other seeds.

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

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.labelling import window_travel
from evetac_cli.kernels.labelling.flow import Between, Labels, Region, apart
from evetac_cli.kernels.labelling.window_travel import STEP_MS
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import TrackerConstants

HALF_MS = 6  # following is measured over at most this many slices before a slice, and after it
LAG_MS = 12  # the dots in contact are determined this many slices earlier
IN_CONTACT = 0.3  # dots farther from rest than this share of the farthest are in contact, weighted by their distance
LEAST_PX = 1e-3  # smaller motion counts as this, to avoid division by zero
RATIOS = (-1.0, 2.0)  # bounds on a dot's motion over the object's; noise makes larger values
SLOW_PX_MS = 0.003  # added to speeds, so that much slower ones are treated alike


@dataclass(frozen=True)
class EventFlowConstants:
    """Constants of slip labels from counted events."""

    slip_distance_px: float = 0.3  # counted slide at the onset; 0.5 px in truth
    lasting_px: float = 1.5  # a slide that continues this far is slip
    pause_ms: int = 3  # longest pause within a slide, in slices
    search_ms: int = 200  # longest time from the beginning of a slip to lasting_px
    seen_px: float = 0.6  # motion over which it is measured whether a dot follows
    bias: float = 4.2  # log odds of a slide: constant,
    follows: float = -3.1  # ... plus this for each px that a dot moves per px of the object,
    speed: float = 1.35  # ... plus this for each e-fold of the speed relative to the gel in px/ms
    most: float = 3.0  # bound on the log odds of a single slice, either sign
    trust: float = 0.45  # power of the posterior, below 1 because slices share their errors
    doubtful_trust: float = 0.1  # ... smaller if the interval is wide, which widens it further
    outside: float = 0.03  # posterior probability on either side of the interval
    widest_px: float = 1.2  # the label abstains if the object slides farther within the interval,
    least_confidence: float = 0.5  # ... or if a smaller share of the slices after the onset slips
    look_ahead_ms: int = 4  # slices over which relative flow is summed
    seen_slide_px: float = 10.0  # after a longer slide, the window's events measure nothing and relative flow is NaN
    events_per_px: float = 500.0  # of the window before it has moved, until the recording determines it
    fading_px: float = 30.0  # travel after which the window has half the events per px
    least_events_per_px: float = 20.0  # of the window: with fewer it shows no texture
    after_ms: int = 60  # slices labelled after the onset


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


def evidence(
    object_px: Floats, away_px: Floats, base: int, first: int, stop: int, constants: EventFlowConstants
) -> Evidence:
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
    begin, end, gel_sum_px = _windows(slice_, low, slices, motion_px, gel_px, 0.5 * constants.seen_px)
    went_px = np.maximum(object_px[end] - object_px[begin], LEAST_PX)
    best = (away_px[end - base] - away_px[begin - base]).max(axis=1) / went_px
    speed = np.maximum(went_px - np.minimum(gel_sum_px, 0.0), LEAST_PX) / (end - begin)
    log_odds = constants.bias + constants.follows * np.clip(best, *RATIOS)
    log_odds = log_odds + constants.speed * np.log(speed + SLOW_PX_MS)
    here = slice(first - low, stop - low)
    return Evidence(np.clip(log_odds, -constants.most, constants.most), own_px[here] - gel_px[here])


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


def find(observed: Evidence, start: int, constants: EventFlowConstants, trust: float) -> LastingSlip | None:
    """Return the first slip that lasts, starting at slice `start`, with an interval for this trust in the evidence.

    None without one.
    """
    slid_px = np.maximum(observed.slide_px, 0.0)
    sure = int(_lasting(observed.log_odds, slid_px, start, constants.lasting_px, constants.pause_ms))
    if sure < 0:
        return None
    low = max(sure - constants.search_ms, start)
    score = np.cumsum(observed.log_odds[low : sure + 1][::-1])[::-1]
    posterior = np.exp(trust * (score - score.max()))
    reached = np.cumsum(posterior / posterior.sum())
    so_far_px = np.concatenate([[0.0], np.cumsum(slid_px[low:])])
    begun_px = so_far_px[: len(score)]
    # For a slide that began in each slice: the onset is the first slice at whose end slip_distance_px is exceeded.
    onset = np.minimum(
        np.searchsorted(so_far_px, begun_px + constants.slip_distance_px, side="right") - 1, len(so_far_px) - 2
    )
    earliest = int(onset[np.searchsorted(reached, constants.outside)])
    latest = int(onset[min(int(np.searchsorted(reached, 1.0 - constants.outside)), len(onset) - 1)])
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


BLOCK_SLICES = 1000  # events are read in blocks of this many slices
LEADING_DOTS = 3  # the dots that move farthest are taken to move with the object
TRAVEL_PX = 1.5  # once the gel was dragged this far, a texture must have been seen


def label(
    between: Between,
    slices: int,
    window: Region,
    frame_px: tuple[int, int],
    dot_xy_px: Floats,
    tracking: TrackerConstants,
    constants: EventFlowConstants,
    start: int = 0,
) -> Labels:
    """Label every slice, searching for the onset from slice `start`; `dot_xy_px` (dots, 2) at rest, NaN if missing.

    Slices before `start`, and more than `after_ms` after the onset, are not examined. `relative_flow_px` is the motion
    of the object relative to the gel in contact over the look-ahead, NaN once the window cannot measure it.
    `confidence` is the share of sliding slices among those labelled after the onset. ValueError if the gel was
    dragged along but the window showed nothing, or if the dots cannot be followed.
    """
    dots = np.ascontiguousarray(dot_xy_px[np.isfinite(dot_xy_px).all(axis=1)], np.float64)
    assert len(dots)
    quiet = _quiet_pixels(between, slices, window)
    window_events = np.zeros(slices + 1, np.int64)
    leading = [0.0]
    dragged = 0.0
    arguments = between, slices, frame_px, dots, tracking
    for first, events, away_px in follow(*arguments):
        stop = first + len(away_px) - 1
        window_events[first + 1 : stop + 1] = window_travel.slice_counts(events, window, quiet, first, stop)
        led = np.sort(away_px, axis=1)[:, -LEADING_DOTS:].mean(axis=1)
        leading += led[1:][(first + 1 + np.arange(len(led) - 1)) % STEP_MS == 0].tolist()
        dragged = max(dragged, float(led.max()))
    window_events = np.cumsum(window_events)
    noise = window_travel.noise_rate(window_events, np.array(leading))
    moved = np.maximum.accumulate(window_events - noise * np.arange(slices + 1))
    rate = window_travel.events_per_px(moved, np.array(leading), constants.events_per_px, constants.fading_px)
    if dragged > TRAVEL_PX and rate.per_px[-1] < constants.least_events_per_px:
        raise ValueError(
            f"texture: expected at least {constants.least_events_per_px:g} window events per pixel of motion, "
            f"found {rate.per_px[-1]:.1f} while the gel was dragged by {dragged:.1f} px"
        )
    per_px = np.maximum(rate.per_px, constants.least_events_per_px)
    evidence = _evidence(window_travel.travel(moved, per_px, constants.fading_px), follow(*arguments), constants)
    return _labels(evidence, rate.is_known, start, constants)


def follow(
    between: Between, slices: int, frame_px: tuple[int, int], dots: Floats, tracking: TrackerConstants
) -> Iterator[tuple[int, Events, Floats]]:
    """Track the dots: yield blocks of first slice, events, and distances of the dots from rest (slices + 1, dots).

    The distances are those at the start of every slice, and after the last.
    """
    state = tracker.start(dots, tracking, frame_px=frame_px)
    before = np.zeros((1, len(dots)))
    for first in range(0, slices, BLOCK_SLICES):
        stop = min(first + BLOCK_SLICES, slices)
        events = between(first, stop)
        starts = np.searchsorted(events.t, np.arange(first, stop + 1) * 1000)
        tracks = tracker.fold(state, events.x, events.y, events.p, starts)
        away_px = np.concatenate([before, np.hypot(*np.moveaxis(tracks.dot_xy_px - dots, 2, 0))])
        before = away_px[-1:]
        yield first, events, away_px


def _quiet_pixels(between: Between, slices: int, window: Region) -> NDArray[np.bool_]:
    """Return which pixels of the window are not hot."""
    shape = window[3] - window[1], window[2] - window[0]
    last, busy = np.full(shape, -1, np.int64), np.zeros(shape, np.int64)
    for first in range(0, slices, BLOCK_SLICES):
        window_travel.block_counts(between(first, min(first + BLOCK_SLICES, slices)), window, last, busy)
    return window_travel.quiet_pixels(busy, slices)


def _evidence(
    object_px: Floats, blocks: Iterator[tuple[int, Events, Floats]], constants: EventFlowConstants
) -> Evidence:
    """Return the evidence of all slices; the motion of the dots comes in blocks."""
    slices = len(object_px) - 1
    parts: list[Evidence] = []
    away_px = np.zeros((1, 0))
    base = done = 0  # away_px begins at row `base`; slices before `done` are finished
    for first, _, more_px in blocks:
        away_px = more_px if first == 0 else np.concatenate([away_px, more_px[1:]])
        known_slices = first + len(more_px) - 1
        until = slices if known_slices == slices else max(known_slices - HALF_MS, done)
        if until > done:
            parts.append(evidence(object_px, away_px, base, done, until, constants))
        done = until
        keep = max(done - HALF_MS - LAG_MS, 0)
        away_px, base = away_px[max(keep - base, 0) :], max(keep, base)
    return Evidence(*(np.concatenate(columns) for columns in zip(*parts, strict=True))) if parts else _NOTHING


_NOTHING = Evidence(np.zeros(0), np.zeros(0))


def _labels(evidence: Evidence, rate_known: NDArray[np.bool_], start: int, constants: EventFlowConstants) -> Labels:
    """Return labels from the evidence of all slices."""
    slices = len(evidence.log_odds)
    gone_px = np.concatenate([[0.0], np.cumsum(evidence.slide_px)])
    ends = np.minimum(np.arange(slices) + constants.look_ahead_ms, slices)
    relative_px = (gone_px[ends] - gone_px[:-1]).astype(np.float32)
    labels = np.zeros(slices, np.int8)
    labels[:start] = -1
    found = find(evidence, start, constants, constants.trust)
    if found is None:
        return Labels(labels, relative_px, -1, float("nan"), 0)
    stop = min(found.onset + max(constants.after_ms, 1), slices)
    slides = evidence.log_odds[found.onset : stop] > 0.0
    labels[found.onset : stop] = slides
    labels[found.onset] = 1
    labels[stop:] = -1
    far = gone_px[1:] - gone_px[found.onset] > constants.seen_slide_px
    relative_px[found.onset :][np.logical_or.accumulate(far[found.onset :])] = np.nan
    confidence = float(slides.mean())
    if found.width_px > constants.widest_px:
        wider = find(evidence, start, constants, constants.doubtful_trust)
        found = found if wider is None else wider._replace(onset=found.onset)
    doubt = _doubt(found, confidence, bool(rate_known[found.onset]), constants)
    result = Labels(labels, relative_px, found.onset, confidence, 0, found.earliest, found.latest, doubt)
    return apart(result) if doubt else result


def _doubt(found: LastingSlip, confidence: float, rate_known: bool, constants: EventFlowConstants) -> str:
    """Return the reason why the onset cannot be determined; empty if it can."""
    if not rate_known:
        return "the object did not drag the gel along before slip, so the motion per window event is unknown"
    if confidence < constants.least_confidence:
        return f"the slide stopped: only {confidence:.0%} of the slices after the onset slide"
    if found.width_px > constants.widest_px:
        span_ms = found.latest - found.earliest
        return f"the onset is uncertain within {span_ms} ms, in which the object slid {found.width_px:.1f} px"
    return ""
