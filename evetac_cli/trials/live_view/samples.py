"""What a live view knows of a recording: it follows the slices in shared memory, and tracks the dots by itself.

A sample is made for every picture, some 20 a second, whether or not anybody looks. Dots and slip are found by the
kernels of `track` and `grasp` on the slices that were seen; where the loop has a slip probability of its own, that one
is shown. The force comes from the model of `predict-force`, which was trained on simulated contacts.

Why so: the view runs behind all that records. Where it cannot keep up it goes on at the newest slice, counts what it
left out, and its dots catch up as after a silence of the camera.
"""

import functools
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evetac_cli import resources
from evetac_cli.commands.predict_force import PredictForce
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.touch.dot_field import lattice_field
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.stages.force import gel_model
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.store.files import StageFile
from evetac_cli.trials.live_view.shared_view import SeenSlices, SharedView

PERIOD_S = 0.05  # from one picture to the next
KEPT = 600  # samples, for a page that is opened later: 30 s
MOST_BEHIND = 400  # slices; farther behind, the view goes on at the newest
SHOWN_MS = 50  # events of the latest so many ms make a picture
MOST_COUNT = 15  # events of one polarity in a pixel of a picture


class ViewDetector(Protocol):
    """A slip detector with its tracker, as an `OnlineSlipDetector`."""

    threshold: float
    probability: float

    def step(self, events: Events) -> float:
        """Slip probability after one more slice."""

    @property
    def tracking(self) -> tracker.TrackerState:
        """The dots after the slices so far."""


OpenDetector = Callable[[Mapping[str, Any]], ViewDetector]  # for datasets `sensor/...`


class Force(NamedTuple):
    """Forces on the gel in N, and their standard deviations."""

    shear_x_n: float
    shear_y_n: float
    shear_sd_n: float
    normal_n: float
    normal_sd_n: float


class Follower:
    """Follows the slices of a recording as they come."""

    def __init__(self, shared: SharedView) -> None:
        self._shared = shared
        self._next = 0
        self._latest: deque[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]] = deque()  # of the slices shown
        self._detector: ViewDetector | None = None
        self._tracking: tracker.TrackerState | None = None
        self._force: _ForceModel | None = None
        self.left_out = 0  # slices that came too fast
        self.samples: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self.frame_px = (640, 480)
        self.window_px: list[int] | None = None  # x0, y0, x1, y1
        self.threshold: float | None = None
        self.notes: list[str] = []  # what cannot be shown, and what to do about it

    def begin(self, sensor: Mapping[str, Any], open_detector: OpenDetector) -> None:
        """Take the datasets `sensor/...` of the camera: they say where the dots are."""
        width, height = sensor["sensor/frame_px"]
        self.frame_px = int(width), int(height)
        if "sensor/window_px" in sensor:
            self.window_px = [int(edge) for edge in sensor["sensor/window_px"]]
        if not {"sensor/dot_xy_px", "sensor/dot_radius_px"} <= sensor.keys():
            self.notes = [f"no dots, slip or force: the dot grid is not known; {MAKE_GRID}"]
            return
        try:
            self._detector = open_detector(sensor)
            self.threshold = self._detector.threshold
            self._tracking = self._detector.tracking
        except InputError as error:
            self.notes = [f"no slip: {str(error).splitlines()[0]}"]
            constants = presets.PRESETS["stable"].for_dots(float(sensor["sensor/dot_radius_px"]))
            self._tracking = tracker.start(sensor["sensor/dot_xy_px"].reshape(-1, 2), constants)
        if self.frame_px == FRAME_PX:
            self._force = _ForceModel(sensor, self._tracking)
        else:  # how large its pixels are on the gel is not known
            self.notes.append("no force: the frame is not {} x {} px".format(*FRAME_PX))
        self._next = max(0, self._shared.slices - SHOWN_MS)  # more came while this was loaded

    def sample(self) -> dict[str, Any]:
        """What came since the sample before, as it goes to a page; NaN is None."""
        newest = self._shared.slices
        first = self._next if newest - self._next <= MOST_BEHIND else newest - SHOWN_MS
        seen = self._shared.since(first)
        self.left_out += seen.first - self._next
        own = self._take(seen)
        self._next = seen.first + seen.slices
        known = seen.probability[~np.isnan(seen.probability)]
        probability = float(known.max()) if len(known) else own
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
            **({} if self._force is None else self._force.now()),
        }
        sample = {name: _plain(value) for name, value in sample.items()}
        self.samples.append(sample)
        return sample

    def _take(self, seen: SeenSlices) -> float:
        """Track and detect over new slices; the highest probability, NaN where there is none."""
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
        """x, y, displacement right and down in px, and 1 where it is lost, of every dot that is not missing."""
        if self._tracking is None:
            return []
        now, rest, lost = self._tracking.dot_xy_px, self._tracking.rest_xy_px, self._tracking.lost
        rows = np.column_stack([now, now - rest, lost])[~np.isnan(rest[:, 0])]
        return [[round(value, 2) for value in row] for row in rows.tolist()]

    def latest(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Columns x, y, p of the events of the latest SHOWN_MS slices."""
        if not self._latest:
            return np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8)
        x, y, p = (np.concatenate(column) for column in zip(*self._latest, strict=True))
        return x, y, p

    def image(self) -> bytes:
        """A byte for each pixel, row by row: brighter events in the lower four bits, darker ones in the upper four."""
        width, height = self.frame_px
        counts = np.zeros((height, width), np.uint8)
        for x, y, p in self._latest:
            _count(x, y, p, counts)
        return counts.tobytes()


@njit(cache=True)
def _count(x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], counts: NDArray[np.uint8]) -> None:
    """Add events to a picture (height, width), but for those beside it; no count goes beyond MOST_COUNT."""
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
    """Load models and compiled code, with a slice of noise on a grid of dots: later it takes no time."""
    grid = np.stack(np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0), axis=-1)
    sensor = {"sensor/frame_px": FRAME_PX, "sensor/dot_xy_px": grid, "sensor/dot_radius_px": 11.0}
    shared = SharedView()
    follower = Follower(shared)
    follower.begin(sensor, open_detector)
    t, x, y, p = (np.arange(100).astype(kind) for kind in ("i8", "u2", "u2", "u1"))
    shared.add_slice(Events(t, x, y, p))
    follower.sample()
    follower.image()


@functools.cache
def _force_model() -> gel_model.GelModel:
    with StageFile(resources.FORCE_MODEL, "force-model") as file:
        return gel_model.read_gel_model(file)


class _ForceModel:
    """The force on the gel from where the dots are, a sample at a time."""

    def __init__(self, sensor: Mapping[str, Any], tracking: tracker.TrackerState) -> None:
        self._model = _force_model()
        modulus = sensor.get("sensor/shear_modulus_pa")
        known = gel_model.KnownGel(shear_modulus_pa=None if modulus is None else float(modulus))
        self._gel = gel_model.gel_of(self._model, known, PredictForce().stiffness_error)
        self._tracking = tracking
        self._rest_mm = (tracking.rest_xy_px - np.asarray(sensor["sensor/frame_px"]) / 2) * self._gel.mm_per_px
        self._over_modulus: deque[NDArray[np.float64]] = deque(maxlen=KEPT)  # creep depends on what was before

    def now(self) -> dict[str, float]:
        """The force now; nothing where too few dots are tracked."""
        moved_mm = (self._tracking.dot_xy_px - self._tracking.rest_xy_px) * self._gel.mm_per_px
        field_mm = lattice_field(moved_mm[None], self._rest_mm, ~self._tracking.lost[None])
        self._over_modulus.append(gel_forces.over_modulus(self._model.network, field_mm)[0])
        over = np.array(self._over_modulus)
        shear = gel_forces.shear_terms(over[:, :2], self._gel.creep_time_s, PERIOD_S)[-1:]
        forces = gel_forces.predict(self._gel.scale, self._gel.errors, shear, gel_forces.normal_terms(over[-1:, 2]))
        (x_n, y_n), sd_n = forces.shear_n[0], float(forces.shear_sd_n[0].max())
        return Force(float(x_n), float(y_n), sd_n, float(forces.normal_n[0]), float(forces.normal_sd_n[0]))._asdict()


def _plain(value: Any) -> Any:
    """A number as JSON takes it: what is not finite is None, and five digits are enough."""
    if isinstance(value, int):
        return value
    return None if value is None or not math.isfinite(value) else float(f"{value:.5g}")
