"""The data of a live view: it follows the slices in shared memory, and tracks the dots itself.

A sample is made for every picture, some 20 per second, whether or not anyone is looking. The kernels of `track` and
`grasp` find dots and slip on the slices seen. If the recording loop has a slip probability, that one is shown. The
touch data come from the touch maps of `predict-touch` (touch.py).

The view has lower priority than all recording processes. If it cannot keep up, it continues at the newest slice and
counts the skipped slices. Its dots then recover as after a silence of the camera.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.trials.live_view.shared_view import SeenSlices, SharedView
from evetac_cli.trials.live_view.touch import LiveTouch

PERIOD_S = 0.05  # time from one picture to the next
KEPT = 600  # samples kept for a page that is opened later: 30 s
MOST_BEHIND = 400  # slices; if farther behind, the view continues at the newest
SHOWN_MS = 50  # a picture shows the events of the latest 50 ms
MOST_COUNT = 15  # most events of one polarity in a pixel of a picture


class ViewDetector(Protocol):
    """A slip detector with its tracker, for example an `OnlineSlipDetector`."""

    threshold: float
    probability: float

    def step(self, events: Events) -> float:
        """Return the slip probability after one more slice."""

    @property
    def tracking(self) -> tracker.TrackerState:
        """The dots after the slices so far."""


OpenDetector = Callable[[Mapping[str, Any]], ViewDetector]  # called with datasets `sensor/...`


class Follower:
    """Follows the slices of a recording as they arrive."""

    def __init__(self, shared: SharedView) -> None:
        self._shared = shared
        self._next = 0
        self._latest: deque[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]] = deque()  # events of the slices shown
        self._detector: ViewDetector | None = None
        self._tracking: tracker.TrackerState | None = None
        self._touch: LiveTouch | None = None
        self.left_out = 0  # slices that arrived too fast
        self.samples: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self.frame_px = (640, 480)
        self.window_px: list[int] | None = None  # x0, y0, x1, y1
        self.threshold: float | None = None
        self.notes: list[str] = []  # what cannot be shown, and how to fix that

    def begin(self, sensor: Mapping[str, Any], open_detector: OpenDetector) -> None:
        """Take the camera's datasets `sensor/...`, which contain the dot positions."""
        width, height = sensor["sensor/frame_px"]
        self.frame_px = int(width), int(height)
        if "sensor/window_px" in sensor:
            self.window_px = [int(edge) for edge in sensor["sensor/window_px"]]
        if not {"sensor/dot_xy_px", "sensor/dot_radius_px"} <= sensor.keys():
            self.notes = [f"no dots, slip or touch: the dot grid is unknown; {MAKE_GRID}"]
            return
        try:
            self._detector = open_detector(sensor)
            self.threshold = self._detector.threshold
            self._tracking = self._detector.tracking
        except InputError as error:
            self.notes = [f"no slip: {str(error).splitlines()[0]}"]
            constants = presets.PRESETS["stable"].for_dots(float(sensor["sensor/dot_radius_px"]))
            self._tracking = tracker.start(sensor["sensor/dot_xy_px"].reshape(-1, 2), constants, frame_px=self.frame_px)
        try:
            self._touch = LiveTouch(sensor, self._tracking, PERIOD_S)
        except ValueError as error:
            self.notes.append(f"no touch: {error}")
        self._next = max(0, self._shared.slices - SHOWN_MS)  # more slices arrived during loading

    def sample(self) -> dict[str, Any]:
        """Return the data since the previous sample, in the form for a page; NaN is None."""
        newest = self._shared.slices
        first = self._next if newest - self._next <= MOST_BEHIND else newest - SHOWN_MS
        seen = self._shared.since(first)
        self.left_out += seen.first - self._next
        own = self._take(seen)
        self._next = seen.first + seen.slices
        from_loop = seen.probability[~np.isnan(seen.probability)]
        probability = float(from_loop.max()) if len(from_loop) else own
        late_us = seen.late_us[~np.isnan(seen.late_us)]
        gripper = self._shared.gripper
        sample = {
            "t": self._next * SLICE_US * 1e-6,
            "slices": self._next,
            "events": len(seen.x),
            "events_per_s": len(seen.x) / (seen.slices * 1e-3) if seen.slices else None,
            "late_ms": float(np.median(late_us)) * 1e-3 if len(late_us) else None,
            "late_most_ms": float(late_us.max()) * 1e-3 if len(late_us) else None,
            "probability": probability,
            **({} if gripper is None else gripper._asdict()),
            **({} if self._touch is None else self._touch.now()),
        }
        sample = {name: _plain(value) for name, value in sample.items()}
        self.samples.append(sample)
        return sample

    def _take(self, seen: SeenSlices) -> float:
        """Track and detect on new slices; return the highest probability, NaN if there is none."""
        highest = math.nan
        for k in range(seen.slices):
            part = slice(int(seen.starts[k]), int(seen.starts[k + 1]))
            x, y, p = seen.x[part], seen.y[part], seen.p[part]
            self._latest.append((x, y, p))
            if self._detector is not None:
                highest = np.fmax(highest, self._detector.step(Events(np.empty(len(x), np.int64), x, y, p)))
            elif self._tracking is not None:
                tracker.step(self._tracking, x, y, p)
        while len(self._latest) > SHOWN_MS:
            self._latest.popleft()
        return float(highest)

    def dots(self) -> list[list[float]]:
        """Return x, y, displacement to the right and down in px, and 1 if lost, of every dot that is not missing."""
        if self._tracking is None:
            return []
        now, rest, lost = self._tracking.dot_xy_px, self._tracking.rest_xy_px, self._tracking.lost
        rows = np.column_stack([now, now - rest, lost])[~np.isnan(rest[:, 0])]
        return [[round(value, 2) for value in row] for row in rows.tolist()]

    def touch_map(self) -> dict[str, Any] | None:
        """Return the touch map of the latest sample, in the form for a page; None without one."""
        return None if self._touch is None else self._touch.map()

    def latest(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Return the columns x, y, p of the events of the latest SHOWN_MS slices."""
        if not self._latest:
            return np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8)
        x, y, p = (np.concatenate(column) for column in zip(*self._latest, strict=True))
        return x, y, p

    def image(self) -> bytes:
        """Return one byte per pixel, row by row.

        Brighter events are counted in the lower four bits, darker ones in the upper four.
        """
        width, height = self.frame_px
        counts = np.zeros((height, width), np.uint8)
        for x, y, p in self._latest:
            _count(x, y, p, counts)
        return counts.tobytes()


@njit(cache=True)
def _count(x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], counts: NDArray[np.uint8]) -> None:
    """Add events to a picture (height, width), except those outside it; no count exceeds MOST_COUNT."""
    height, width = counts.shape
    for k in range(x.shape[0]):
        if y[k] >= height or x[k] >= width:
            continue
        both = counts[y[k], x[k]]
        if p[k] == 1 and (both & 15) < MOST_COUNT:
            counts[y[k], x[k]] = both + 1
        elif p[k] != 1 and (both >> 4) < MOST_COUNT:
            counts[y[k], x[k]] = both + 16


def load(open_detector: OpenDetector) -> None:
    """Load models and compiled code by running a slice of noise on a grid of dots, so that it takes no time later."""
    grid = np.stack(np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0), axis=-1)
    sensor = {"sensor/frame_px": FRAME_PX, "sensor/dot_xy_px": grid, "sensor/dot_radius_px": 11.0}
    shared = SharedView()
    follower = Follower(shared)
    follower.begin(sensor, open_detector)
    t, x, y, p = (np.arange(100).astype(kind) for kind in ("i8", "u2", "u2", "u1"))
    shared.add_slice(Events(t, x, y, p))
    follower.sample()
    follower.image()


def _plain(value: Any) -> Any:
    """Return a number for JSON: None if it is not finite, rounded to five digits."""
    if isinstance(value, int):
        return value
    return None if value is None or not math.isfinite(value) else float(f"{value:.5g}")
