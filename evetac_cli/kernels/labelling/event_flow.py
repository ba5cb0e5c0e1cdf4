"""Slip labels from counted events: motion of dots and window to a fraction of a pixel, without images.

The tracker, preset `stable`, follows the dots. The events of the window, through which the object's texture is visible,
give the motion of the object (window_travel.py). slide.py combines both slice by slice: whether the object slides, and
since when. An optical flow of images needs enough events to recognise a pattern, which slow motion does not make.

The onset is the slice in which the object has slid `slip_distance_px` since its slip began. It has an interval in which
it may be. Labels abstain, with a reason, in three cases: the object slides far within that interval, the slide stopped,
or the recording did not determine the motion per event of the window. Slices of such an interval have the label -1.

Constants are fitted to simulated slips of the digital twin (dots of 9 px, one-threshold friction). The seeds are listed
in scripts/seeds.json, group `labels`; scripts/judge_labels.py evaluates them on other seeds.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import Events
from evetac_cli.kernels.labelling import slide, window_travel
from evetac_cli.kernels.labelling.flow import Between, Labels, Region, apart
from evetac_cli.kernels.labelling.slide import Evidence, LastingSlip, Odds
from evetac_cli.kernels.labelling.window_travel import STEP_MS
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS

PRESET = "stable"  # of the tracker
BLOCK_SLICES = 1000  # events are read in blocks of this many slices
LEADING_DOTS = 3  # the dots that move farthest are taken to move with the object
TRAVEL_PX = 1.5  # once the gel was dragged this far, a texture must have been seen


@dataclass(frozen=True)
class EventFlowConstants:
    """Constants of slip labels from counted events; ValueError unless all are finite and in range."""

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

    @property
    def odds(self) -> Odds:
        """Weights of the evidence of a slide."""
        return Odds(self.bias, self.follows, self.speed, self.seen_px, self.most)


def label(
    between: Between,
    slices: int,
    window: Region,
    frame_px: tuple[int, int],
    dot_xy_px: Floats,
    dot_radius_px: float,
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
    if not len(dots) or not 0.0 < dot_radius_px < math.inf:
        raise ValueError(f"dots: expected some with a radius > 0, found {len(dots)} of radius {dot_radius_px}")
    quiet = _quiet_pixels(between, slices, window)
    window_events = np.zeros(slices + 1, np.int64)
    leading = [0.0]
    dragged = 0.0
    arguments = between, slices, frame_px, dots, dot_radius_px
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
    evidence = _evidence(window_travel.travel(moved, per_px, constants.fading_px), follow(*arguments), constants.odds)
    return _labels(evidence, rate.is_known, start, constants)


def follow(
    between: Between, slices: int, frame_px: tuple[int, int], dots: Floats, radius_px: float
) -> Iterator[tuple[int, Events, Floats]]:
    """Track the dots: yield blocks of first slice, events, and distances of the dots from rest (slices + 1, dots).

    The distances are those at the start of every slice, and after the last.
    """
    state = tracker.start(dots, PRESETS[PRESET].for_dots(radius_px), frame_px=frame_px)
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


def _evidence(object_px: Floats, blocks: Iterator[tuple[int, Events, Floats]], odds: Odds) -> Evidence:
    """Return the evidence of all slices; the motion of the dots comes in blocks."""
    slices = len(object_px) - 1
    parts: list[Evidence] = []
    away_px = np.zeros((1, 0))
    base = done = 0  # away_px begins at row `base`; slices before `done` are finished
    for first, _, more_px in blocks:
        away_px = more_px if first == 0 else np.concatenate([away_px, more_px[1:]])
        known_slices = first + len(more_px) - 1
        until = slices if known_slices == slices else max(known_slices - slide.HALF_MS, done)
        if until > done:
            parts.append(slide.evidence(object_px, away_px, base, done, until, odds))
        done = until
        keep = max(done - slide.HALF_MS - slide.LAG_MS, 0)
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
    found = _find(evidence, start, constants, constants.trust)
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
        wider = _find(evidence, start, constants, constants.doubtful_trust)
        found = found if wider is None else wider._replace(onset=found.onset)
    doubt = _doubt(found, confidence, bool(rate_known[found.onset]), constants)
    result = Labels(labels, relative_px, found.onset, confidence, 0, found.earliest, found.latest, doubt)
    return apart(result) if doubt else result


def _find(evidence: Evidence, start: int, constants: EventFlowConstants, trust: float) -> LastingSlip | None:
    """Return the first slip that lasts, with an interval for this trust in the evidence."""
    return slide.find(
        evidence,
        start,
        slip_distance_px=constants.slip_distance_px,
        lasting_px=constants.lasting_px,
        pause_ms=constants.pause_ms,
        search_ms=constants.search_ms,
        trust=trust,
        outside=constants.outside,
    )


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
