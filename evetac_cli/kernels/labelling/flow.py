"""Slip labels from optical flow of the window relative to the gel (paper, "Data Labelling - Slip Classifier").

Slices are drawn as images: grey, white for brighter pixels, black for darker ones. The flow from the image at t to the
one `look_ahead_ms` later is Farneback's, computed separately in the window and in the region of the dots. A slice is
slip if the two flows differ by more than a threshold. This is the paper's method, `farneback`. Alternatives are `dis`,
another flow, and `event-count`, the paper's "simpler approach": many events in the window. event_flow.py finds slips
that they miss.

Choices where the paper gives no detail:
- An image sums `accumulate_ms` slices. A single slice at the onset of slip has a few dozen events in the window, and
  the next slice shows different ones, so single slices have no common pattern.
- The flow of a region is its mean over the pixels with events. Elsewhere the image is uniform, and the flow is 0.
- For slip, the window's own flow must exceed the threshold, too: if gel snaps back under an object at rest, the object
  does not slip. The flow of the gel costs five times as much. It is skipped if the window's own flow is too small, and
  if the window has hardly any events. With `plain`, all flows are computed; the result is the same.
- Once the object falls, the flow is far above the threshold, and the flow of smaller images is sufficient, at a tenth
  of the cost. It decides if the window alone, and relative to the gel, exceeds the threshold by `clear_px`. In 47
  slices without slip of five simulated trials, the window alone reached at most 0.43 px. `plain` does not use it.
- Slip must last for `confirm_ms` to be an onset, so a search in steps no longer than that cannot miss one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import Events

METHODS = ("farneback", "dis", "event-count")
GREY = 128  # of a pixel without events
LEAST_SIDE_PX = 32  # flow is not computed on smaller images
SLIP_PX = 0.5  # slide at the onset of gross slip, which the interval is about
LEAST_CONFIDENCE = 0.5  # labels abstain if a smaller share of the slices after the onset slips: the slide stopped
CLEAR_WINDOW, CLEAR_GEL = 2, 4  # factors by which images are shrunk to find clear slip
GEL_MOVES = 20  # the gel moves if it has this many times the events that the window needs

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
    threshold_events: int = 200  # of event-count: more window events than this over the look-ahead are slip
    clear_px: float = 0.6  # margin above the threshold for clear slip on smaller images; infinity: do not compute them
    plain: bool = False  # compute the flow of both regions even if it cannot change the result


class Labels(NamedTuple):
    """The slip labels of a trajectory, with the quantities that they were derived from."""

    label: NDArray[np.int8]  # (slices,) 1 slip, 0 no slip, -1 not examined
    relative_flow_px: NDArray[np.float32]  # (slices,) NaN if not computed; from smaller images if these decided
    onset: int  # first slice of slip, -1 for none
    confidence: float  # share of slip in the `after_ms` slices from the onset; NaN without onset
    flow_pairs: int  # number of image pairs for which flow was computed
    earliest: int = -1  # first and last slice in which the onset may be, -1 without onset
    latest: int = -1
    doubt: str = ""  # reason why the onset cannot be determined, so that the labels abstain; else empty


def apart(labels: Labels) -> Labels:
    """Return labels that abstain: the slices of their interval are labelled neither slip nor no slip."""
    label = labels.label.copy()
    label[labels.earliest : labels.latest + 1] = -1
    return labels._replace(label=label)


def event_picture(events: Events, region: Region) -> NDArray[np.uint8]:
    """Return the events of a region as an image: grey, white where brighter events prevail, black where darker do."""
    x0, y0, x1, y1 = region
    inside = (events.x >= x0) & (events.x < x1) & (events.y >= y0) & (events.y < y1)
    place = (events.y[inside].astype(np.int64) - y0) * (x1 - x0) + (events.x[inside] - x0)
    sign = 2 * events.p[inside].astype(np.int64) - 1
    balance = np.bincount(place, weights=sign, minlength=(x1 - x0) * (y1 - y0))
    picture = GREY + 127 * np.sign(balance)
    return picture.reshape(y1 - y0, x1 - x0).astype(np.uint8)


def region_flow(
    now: NDArray[np.uint8], later: NDArray[np.uint8], method: str = "farneback", shrink: int = 1
) -> NDArray[np.float64]:
    """Return the mean flow (x, y) in px from one image to another, over the pixels with events in the first.

    By `farneback` or `dis`, on images `shrink` times smaller. Zero without events, and for images that are too small.
    """
    import cv2  # here, because event_flow.py shares the types of this module but does not need cv2

    if shrink > 1:
        size = (now.shape[1] // shrink, now.shape[0] // shrink)
        now, later = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in (now, later))
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
    """Find the onset, coarse to fine from slice `start`, and label the slices after it.

    `between(start, stop)` returns the events of slices. The search tests every `coarse_ms`-th slice. If one is slip, it
    goes back to the previous one and tests all slices from there, up to the first from which slip lasts for
    `confirm_ms`. Slices before the onset are labelled no slip; those before `start`, or more than `after_ms` after the
    onset, are not examined. ValueError if the gel moved but the window never had enough events: no texture.
    """
    search = _Search(between, slices, window, gel, constants)
    onset = search.onset(start)
    if search.gel_moved and not search.textured and constants.method != "event-count":
        raise ValueError(
            f"texture: expected {constants.min_events} pixels with events in an image of the window, found fewer in all"
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
        doubt = f"the slide stopped: only {confidence:.0%} of the slices after the onset slide"
    result = Labels(labels, search.relative_px, onset, confidence, search.flow_pairs, earliest, latest, doubt)
    return apart(result) if doubt else result


class _Search:
    """Flow of a trajectory, computed only for the slices that the search needs, once for each."""

    def __init__(self, between: Between, slices: int, window: Region, gel: Region, constants: FlowConstants) -> None:
        self._between = between
        self._window, self._gel = window, gel
        self._constants = constants
        self.slices = slices
        self.relative_px = np.full(slices, np.nan, np.float32)
        self._slips: dict[int, bool] = {}
        self.flow_pairs = 0
        self.textured = False  # an image of the window had enough events at least once
        self.gel_moved = False  # the gel had many events while the window had hardly any

    def onset(self, start: int) -> int:
        """Return the first slice from which slip lasts for `confirm_ms`, or -1."""
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
        """Return the earliest and the latest slice of the onset that threshold and look-ahead allow.

        A slide just below the threshold can go on unseen for SLIP_PX. The compared images are look_ahead_ms apart and
        sum accumulate_ms, and the motion may be anywhere in them.
        """
        constants = self._constants
        unseen_ms = constants.look_ahead_ms
        if constants.method != "event-count":  # its threshold is not a distance
            unseen_ms = math.ceil(constants.look_ahead_ms * SLIP_PX / max(constants.threshold_px, 1e-3))
        later_ms = constants.look_ahead_ms + constants.accumulate_ms - 1
        return max(onset - unseen_ms, start), min(onset + later_ms, self.slices - 1)

    def _confirmed(self, index: int) -> bool:
        stop = min(index + self._constants.confirm_ms, self.slices)
        return all(self.slips(later) for later in range(index, stop))

    def slips(self, index: int) -> bool:
        """Whether the window moves relative to the gel between this slice and the one `look_ahead_ms` later."""
        if index not in self._slips:
            self._slips[index] = self._compute(index)
        return self._slips[index]

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
            rough = region_flow(now, then, constants.method, CLEAR_WINDOW)
            if np.hypot(*rough) > least:
                drawn_gel = event_picture(now_events, self._gel), event_picture(later_events, self._gel)
                rough -= region_flow(*drawn_gel, constants.method, CLEAR_GEL)
                relative = float(np.hypot(*rough))
                if relative > least:
                    self.relative_px[index] = relative
                    return True
        window_flow = region_flow(now, then, constants.method)
        still = bool(np.hypot(*window_flow) <= constants.threshold_px)
        if still and not constants.plain:
            return False
        drawn_gel = drawn_gel or (event_picture(now_events, self._gel), event_picture(later_events, self._gel))
        gel_flow = region_flow(*drawn_gel, constants.method)
        relative = float(np.hypot(*(window_flow - gel_flow)))
        self.relative_px[index] = relative
        return relative > constants.threshold_px and not (few or still)

    @staticmethod
    def _count(events: Events, region: Region) -> int:
        x0, y0, x1, y1 = region
        return int(np.count_nonzero((events.x >= x0) & (events.x < x1) & (events.y >= y0) & (events.y < y1)))
