"""When an object slips: optical flow of the window against the gel (paper, "Data Labelling - Slip Classifier").

Slices are drawn as images (grey, white where it got brighter, black where darker), the flow from the image at t to the
one `look_ahead_ms` later is Farneback's, in the window and in the marker region apart, and a slice is slip where the
two differ by more than a threshold. That is the paper's method, `farneback`. Its alternatives: `dis`, another flow, and
`event-count`, the paper's "simpler approach": many events in the window. What they miss, event_flow counts.

Why so, where the paper is silent:
- An image sums `accumulate_ms` slices. One slice at the onset of slip has a few dozen events in the window, and the
  next image shows others than those: in single slices nothing corresponds.
- The flow of a region is its mean over the pixels with events. Elsewhere the image is flat, and the flow is 0.
- Slip needs a window that moves by more than the threshold itself, too: gel that snaps back under an object at rest is
  no slip of the object. The flow of the gel, which costs five times as much, is left out where that already fails, and
  so are pairs of images whose window has hardly any events. `plain` computes them all, for the same answer.
- Once the object falls, the answer is far from the threshold, and the flow of smaller images, which costs a tenth, is
  enough: where window alone and window against gel both exceed the threshold by `clear_px`. In 47 slices
  without slip of five simulated trials the window alone reached 0.43 px. `plain` leaves that out.
- Slip holds for `confirm_ms` before it is an onset: a search in steps no longer than that cannot miss one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.checks import check_range
from evetac_cli.events import Events

METHODS = ("farneback", "dis", "event-count")
GREY = 128
LEAST_SIDE_PX = 32  # smaller images have no flow
SLIP_PX = 0.5  # of gross slip, which the interval is about
LEAST_CONFIDENCE = 0.5  # labels abstain where fewer of the slices after the onset slip: what slid came to rest
CLEAR_WINDOW, CLEAR_GEL = 2, 4  # times that images are shrunk for clear slip
GEL_MOVES = 20  # times as many events in the gel as a window needs at least: the gel moves

Region = tuple[int, int, int, int]  # x0, y0, x1, y1, ends excluded
Between = Callable[[int, int], Events]  # events of the slices [start, stop)


@dataclass(frozen=True)
class FlowConstants:
    """Constants of the slip labels; lengths in px over the look-ahead, times in slices of 1 ms."""

    threshold_px: float
    look_ahead_ms: int
    accumulate_ms: int
    min_events: int
    confirm_ms: int
    coarse_ms: int
    after_ms: int
    method: str = "farneback"  # one of METHODS
    threshold_events: int = 200  # of event-count: so many in the window over the look-ahead are slip
    shrink: int = 1  # flow is computed on images so many times smaller
    clear_px: float = 0.6  # so much above the threshold on smaller images is slip; infinity: compute no smaller ones
    plain: bool = False  # compute the flow of both regions even where it cannot change the answer

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, found {self.method}")
        for name in ("threshold_px", "clear_px", "after_ms"):
            check_range(name, getattr(self, name), 0, math.inf)
        for name in ("look_ahead_ms", "accumulate_ms", "confirm_ms", "coarse_ms", "shrink"):
            check_range(name, getattr(self, name), 1)


class Labels(NamedTuple):
    """The slip labels of a trajectory, and what they were derived from."""

    label: NDArray[np.int8]  # (slices,) 1 slip, 0 no slip, -1 not examined
    relative_flow_px: NDArray[np.float32]  # (slices,) NaN where not computed, of smaller images where these decide
    onset: int  # first slice of slip, -1 if there is none
    confidence: float  # share of the slices in the `after_ms` from the onset that are slip; NaN without onset
    flow_pairs: int  # pairs of images of which flow was computed
    earliest: int = -1  # first and last slice in which the onset may lie, -1 without onset
    latest: int = -1
    doubt: str = ""  # why the onset cannot be told, in words: the labels abstain; empty where it can


def apart(labels: Labels) -> Labels:
    """Labels that abstain: the slices of their interval are neither slip nor no slip."""
    label = labels.label.copy()
    label[labels.earliest : labels.latest + 1] = -1
    return labels._replace(label=label)


def event_picture(events: Events, region: Region) -> NDArray[np.uint8]:
    """Events of a region as an image: grey, lighter where more events were brighter, darker where more were darker."""
    x0, y0, x1, y1 = region
    inside = (events.x >= x0) & (events.x < x1) & (events.y >= y0) & (events.y < y1)
    place = (events.y[inside].astype(np.int64) - y0) * (x1 - x0) + (events.x[inside] - x0)
    sign = 2 * events.p[inside].astype(np.int64) - 1
    balance = np.bincount(place, weights=sign, minlength=(x1 - x0) * (y1 - y0))
    drawn = GREY + 127 * np.sign(balance)
    return drawn.reshape(y1 - y0, x1 - x0).astype(np.uint8)


def region_flow(
    now: NDArray[np.uint8], later: NDArray[np.uint8], method: str = "farneback", shrink: int = 1
) -> NDArray[np.float64]:
    """Mean flow (x, y) in px from one image to another, over the pixels with events in the first.

    By `farneback` or `dis`, on images `shrink` times smaller. Zero without events, and for images that are too small.
    """
    import cv2  # here, as event_flow.py, which shares the types of this module, does without

    if shrink > 1:
        size = (now.shape[1] // shrink, now.shape[0] // shrink)
        now, later = (cv2.resize(drawn, size, interpolation=cv2.INTER_AREA) for drawn in (now, later))
    lit = now != GREY
    if not lit.any() or min(now.shape) < LEAST_SIDE_PX:
        return np.zeros(2)
    if method == "dis":
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(now, later, None)
    else:
        flow = cv2.calcOpticalFlowFarneback(
            now, later, None, pyr_scale=0.5, levels=3, winsize=31, iterations=3, poly_n=5, poly_sigma=1.2, flags=0
        )
    return np.asarray(flow[lit].mean(axis=0) * shrink, np.float64)


def label(
    between: Between, slices: int, window: Region, gel: Region, constants: FlowConstants, start: int = 0
) -> Labels:
    """Find the onset coarse to fine from slice `start`, and label the slices after it.

    `between(start, stop)` gives events of slices. The search looks at every `coarse_ms`-th slice; where one is slip it
    goes back to the slice before and on one by one, up to the first slice from which slip holds for
    `confirm_ms`. Slices before the onset are no slip; those before `start`, or later than `after_ms` after the onset,
    are not examined. ValueError if the gel was seen to move and the window never showed enough: no texture.
    """
    search = _Search(between, slices, window, gel, constants)
    onset = search.onset(start)
    if search.gel_moved and not search.textured and constants.method != "event-count":
        raise ValueError(
            f"texture: expected {constants.min_events} events in an image of the window, found fewer in all"
        )
    labels = np.zeros(slices, np.int8)
    labels[:start] = -1
    if onset < 0:
        return Labels(labels, search.relative_px, -1, float("nan"), search.flow_pairs)
    stop = min(onset + max(constants.after_ms, 1), slices)
    labels[stop:] = -1
    for index in range(onset, stop):
        labels[index] = search.slips(index)
    confidence = float(labels[onset:stop].mean())
    earliest, latest = search.interval(onset, start)
    doubt = ""
    if confidence < LEAST_CONFIDENCE:
        doubt = f"what slid came to rest: only {confidence:.0%} of the slices after the onset slide"
    made = Labels(labels, search.relative_px, onset, confidence, search.flow_pairs, earliest, latest, doubt)
    return apart(made) if doubt else made


class _Search:
    """Flow of a trajectory, computed only for the slices that the search needs, each once."""

    def __init__(self, between: Between, slices: int, window: Region, gel: Region, constants: FlowConstants) -> None:
        self._between = between
        self._window, self._gel = window, gel
        self._constants = constants
        self.slices = slices
        self.relative_px = np.full(slices, np.nan, np.float32)
        self._known: dict[int, bool] = {}
        self.flow_pairs = 0
        self.textured = False  # an image of the window once had events enough
        self.gel_moved = False  # the gel had many more while the window had hardly any

    def onset(self, start: int) -> int:
        """First slice from which slip holds for `confirm_ms`, or -1."""
        checked = start - 1
        for coarse in range(start, self.slices, self._constants.coarse_ms):
            if not self.slips(coarse):
                continue
            first = max(checked + 1, coarse - self._constants.coarse_ms + 1)
            for index in range(first, coarse + 1):
                if self._confirmed(index):
                    return index
            checked = coarse
        return -1

    def interval(self, onset: int, start: int) -> tuple[int, int]:
        """The earliest and the latest slice of the onset, as far as threshold and look-ahead tell.

        A slide just below the threshold goes SLIP_PX unseen before. Images that differ are look_ahead_ms apart and sum
        accumulate_ms, and the motion may lie anywhere in them.
        """
        constants = self._constants
        unseen_ms = constants.look_ahead_ms
        if constants.method != "event-count":  # whose threshold is no distance
            unseen_ms = math.ceil(constants.look_ahead_ms * SLIP_PX / max(constants.threshold_px, 1e-3))
        later_ms = constants.look_ahead_ms + constants.accumulate_ms - 1
        return max(onset - unseen_ms, start), min(onset + later_ms, self.slices - 1)

    def _confirmed(self, index: int) -> bool:
        stop = min(index + self._constants.confirm_ms, self.slices)
        return all(self.slips(later) for later in range(index, stop))

    def slips(self, index: int) -> bool:
        """Whether the window moves against the gel between this slice and the one `look_ahead_ms` later."""
        if index not in self._known:
            self._known[index] = self._compute(index)
        return self._known[index]

    def _compute(self, index: int) -> bool:
        constants = self._constants
        later = index + constants.look_ahead_ms
        if later + constants.accumulate_ms > self.slices:
            return False
        if constants.method == "event-count":
            return self._count(self._between(index, later), self._window) > constants.threshold_events
        now_events = self._between(index, index + constants.accumulate_ms)
        later_events = self._between(later, later + constants.accumulate_ms)
        now, then = event_picture(now_events, self._window), event_picture(later_events, self._window)
        lit = np.count_nonzero(now != GREY), np.count_nonzero(then != GREY)
        few = bool(min(lit) < constants.min_events)
        self.textured |= bool(max(lit) >= constants.min_events)
        self.gel_moved |= few and self._count(now_events, self._gel) > GEL_MOVES * constants.min_events
        if few and not constants.plain:
            return False
        self.flow_pairs += 1
        drawn_gel = None
        if math.isfinite(constants.clear_px) and not constants.plain:
            least = constants.threshold_px + constants.clear_px
            rough = region_flow(now, then, constants.method, CLEAR_WINDOW * constants.shrink)
            if np.hypot(*rough) > least:
                drawn_gel = event_picture(now_events, self._gel), event_picture(later_events, self._gel)
                rough -= region_flow(*drawn_gel, constants.method, CLEAR_GEL * constants.shrink)
                relative = float(np.hypot(*rough))
                if relative > least:
                    self.relative_px[index] = relative
                    return True
        window_flow = region_flow(now, then, constants.method, constants.shrink)
        still = bool(np.hypot(*window_flow) <= constants.threshold_px)
        if still and not constants.plain:
            return False
        drawn_gel = drawn_gel or (event_picture(now_events, self._gel), event_picture(later_events, self._gel))
        gel_flow = region_flow(*drawn_gel, constants.method, constants.shrink)
        relative = float(np.hypot(*(window_flow - gel_flow)))
        self.relative_px[index] = relative
        return relative > constants.threshold_px and not (few or still)

    @staticmethod
    def _count(events: Events, region: Region) -> int:
        x0, y0, x1, y1 = region
        return int(np.count_nonzero((events.x >= x0) & (events.x < x1) & (events.y >= y0) & (events.y < y1)))
