"""The data of a live view: it follows the slices in shared memory, and tracks the dots itself.

A sample is made for every picture, some 20 per second, whether or not anyone is looking. The kernels of `track` and
`grasp` find dots and slip on the slices seen. If the recording loop has a slip probability, that one is shown. The
touch data come from the touch maps of `predict-touch`. The patch of a map is updated in parts, one per sample: each
takes some milliseconds of the sample's 50 ms, so it is at most 0.2 s old. A first touch gets its patch at once.

The view has lower priority than all recording processes. If it cannot keep up, it continues at the newest slice and
counts the skipped slices. Its dots then recover as after a silence of the camera.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.force.gel_forces import CreepMemory
from evetac_cli.kernels.slip.architectures import sensitivity_of
from evetac_cli.kernels.touch import touch_map
from evetac_cli.kernels.touch.dot_motion import CELL_MM
from evetac_cli.kernels.touch.touch_map import TouchReading
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.kernels.tracking.tracker import TrackerState
from evetac_cli.stages.touch import touch_fold
from evetac_cli.stages.touch.known_gel import KnownGel, gel_of
from evetac_cli.stages.touch.touch_fold import Factor, Slices, forces_of, normal_factor, shear_factor
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.trials.live_view.shared_view import SeenSlices, SharedView

if TYPE_CHECKING:
    from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector

PERIOD_S = 0.05  # time from one picture to the next
KEPT = 600  # samples kept for a page that is opened later: 30 s
MOST_BEHIND = 400  # slices; if farther behind, the view continues at the newest
SHOWN_MS = 50  # a picture shows the events of the latest 50 ms
MOST_COUNT = 15  # most events of one polarity in a pixel of a picture
DIGITS = 3  # digits after the decimal point in a map


OpenDetector = Callable[[Mapping[str, Any]], "OnlineSlipDetector"]  # called with datasets `sensor/...`


class LiveTouch:
    """Touch maps from the dots of a tracker, with the same assumptions on the gel as predict-touch."""

    def __init__(self, sensor: Mapping[str, Any], tracking: TrackerState, period_s: float) -> None:
        """sensor: datasets `sensor/...` of a camera; period_s: time between samples.

        ValueError if the dots cannot be used.
        """
        width, height = (int(side) for side in sensor["sensor/frame_px"])
        if (width, height) != FRAME_PX:  # the size of its pixels on the gel is unknown
            raise ValueError("the frame is not {} x {} px".format(*FRAME_PX))
        self._tracking, self._middle_px = tracking, np.array(FRAME_PX) / 2
        modulus = sensor.get("sensor/shear_modulus_pa")
        known_gel = KnownGel(shear_modulus_pa=None if modulus is None else float(modulus))
        gel = gel_of(known_gel, PredictTouch().stiffness_error)
        self._gel, self._mm_per_px, self._period_s = gel, gel.mm_per_px, period_s
        self._creep = CreepMemory()
        self._shear, self._normal = shear_factor(gel), normal_factor(gel)
        sd = float(np.hypot(self._shear.relative_sd.mean(), gel.mm_log_sd))  # a lever has one more power of the scale
        self._torsion = Factor(self._shear.value.mean(), np.asarray(sd), self._shear.times)
        window = sensor.get("sensor/window_px")
        window_px = None if window is None else [int(side) for side in window]
        self._state = touch_fold.start(gel, tracking.rest_xy_px, FRAME_PX, window_px, renews=False)
        self._reading: TouchReading | None = None

    def _mm(self, dot_xy_px: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.asarray((dot_xy_px - self._middle_px) * self._mm_per_px)

    def now(self) -> dict[str, float]:
        """Return the present forces, torsion and area, with standard deviations; NaN if too few dots are tracked."""
        state, dots_mm, lost = self._state, self._mm(self._tracking.dot_xy_px), self._tracking.lost
        reading = touch_map.step(state, dots_mm, lost)
        if reading.touches:
            touch_map.renew_part(state)
        elif reading.known and state.touches:  # a touch has begun
            touch_map.renew(state)
            reading = touch_map.step(state, dots_mm, lost)
        self._reading = reading
        mpa = self._gel.modulus_pa * 1e-6
        over = Slices(
            reading.shear_n[None] / mpa,
            reading.shear_sd_n[None] / mpa,
            np.array([reading.normal_n]) / mpa,
            np.array([reading.normal_sd_n]) / mpa,
            np.array([reading.touches]),
        )
        forces = forces_of(self._gel, over, self._creep, self._period_s)
        torsion, torsion_sd = self._torsion.applied(
            np.asarray(reading.torsion_n_mm), np.asarray(reading.torsion_sd_n_mm)
        )
        return {
            "shear_x_n": float(forces.shear_n[0, 0]),
            "shear_y_n": float(forces.shear_n[0, 1]),
            "shear_sd_n": float(forces.shear_sd_n.max()),
            "normal_n": float(forces.normal_n[0]),
            "normal_sd_n": float(forces.normal_sd_n[0]),
            "torsion_n_mm": float(torsion),
            "torsion_sd_n_mm": float(torsion_sd),
            "area_mm2": reading.area_mm2,
        }

    def map(self) -> dict[str, Any] | None:
        """Return the map of the latest reading; None before the first.

        It has the grid in mm, and index, pressure and shear in kPa of each touched cell.
        """
        reading, (x_mm, y_mm) = self._reading, self._state.cells
        if reading is None:
            return None
        cells = np.flatnonzero(reading.patch)
        pa = np.stack(
            [reading.pressure_pa * self._normal.value, *(reading.shear_pa * self._shear.value[:, None, None])]
        )
        kpa = pa.reshape(3, -1)[:, cells] * 1e-3
        has_centre = reading.touches and bool(np.isfinite(reading.centre_mm).all())
        return {
            "known": reading.known,
            "x_mm": float(x_mm[0]),
            "y_mm": float(y_mm[0]),
            "cell_mm": CELL_MM,
            "columns": len(x_mm),
            "rows": len(y_mm),
            "area_mm2": round(reading.area_mm2, DIGITS) if reading.touches else None,
            "centre_mm": _rounded(reading.centre_mm) if has_centre else None,
            "centre_sd_mm": _rounded(reading.centre_sd_mm) if has_centre else None,
            "cells": [[cell, *_rounded(values)] for cell, values in zip(cells.tolist(), kpa.T, strict=True)],
        }


def _rounded(values: np.ndarray[Any, Any]) -> list[float]:
    return [round(value, DIGITS) for value in values.tolist()]


class Follower:
    """Follows the slices of a recording as they arrive."""

    def __init__(self, shared: SharedView) -> None:
        self._shared = shared
        self._next = 0
        self._latest: deque[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]] = deque()  # events of the slices shown
        self._detector: OnlineSlipDetector | None = None
        self._tracking: TrackerState | None = None
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
            contrast = sensitivity_of(sensor).contrast_over_threshold
            constants = presets.PRESETS["stable"].for_dots(float(sensor["sensor/dot_radius_px"]), contrast)
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
