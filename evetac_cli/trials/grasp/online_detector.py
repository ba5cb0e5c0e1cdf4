"""The slip detector of a grasp: tracker, features and network, one slice after the other.

It uses the start/step kernels of `track` and `featurize`. The controller gets a `SlipSignal`: a few numbers that fit
into shared memory, so that the detector may run in another process.

A closed gel has one more column of dots than a cut one, where the window would be. All dots are tracked, because they
stabilise each other. A network for a cut gel only gets the dots that a cut gel has.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli import resources
from evetac_cli.errors import MAKE_MODEL, InputError
from evetac_cli.events import FRAME_PX, Events
from evetac_cli.kernels.calibration.grid import in_words
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.kernels.slip import alarms
from evetac_cli.kernels.slip.alarms import AlarmState
from evetac_cli.kernels.slip.architectures import UNKNOWN_SENSITIVITY, Sensitivity, sensitivity_of
from evetac_cli.kernels.slip.detector import LiveDetector
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.stages.model_files import chosen_threshold
from evetac_cli.stages.slip_detectors import load_detector
from evetac_cli.stages.touch.touch_fold import StickingShare
from evetac_cli.store.files import StageFile


def known_dots(dot_xy_px: NDArray[np.float64], rows: int, columns: int) -> NDArray[np.bool_]:
    """Return the mask (dots,) of the dots (rows, columns, 2) that a network for a rows x columns grid uses.

    For a grid of that size, all dots. For a grid with one more column, all columns except one: the one without known
    dots, otherwise the rightmost. ValueError for another grid.
    """
    grid = int(dot_xy_px.shape[0]), int(dot_xy_px.shape[1])
    mask = np.ones(grid, np.bool_)
    if grid == (rows, columns + 1):
        x_px = dot_xy_px[..., 0]
        unknown = np.isnan(x_px).all(axis=0)
        mask[:, np.argmax(unknown if unknown.any() else np.nanmean(x_px, axis=0))] = False
    elif grid != (rows, columns):
        wanted = f"{rows} rows x {columns} columns of dots, or one more column"
        raise ValueError(f"expected {wanted}, found {in_words(*grid)}")
    return mask.reshape(-1)


def dots_for(model: StageFile, dot_xy_px: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the mask (dots,) of the dots, at rest at (rows, columns, 2), that a model uses.

    InputError for another grid.
    """
    rows, columns = (int(size) for size in model.read("dot_shape"))
    try:
        return known_dots(dot_xy_px, rows, columns)
    except ValueError as error:
        raise InputError(
            f"the model is for another dot grid: {error}", where=str(model.path), hint=MAKE_MODEL
        ) from None


@dataclass
class OnlineSlipDetector:
    """The state of the detector after the slices so far."""

    live: LiveDetector
    alarm: AlarmState
    probability: float = float("nan")
    sticking: StickingShare | None = None  # for a network or a law that needs it
    _gripper_state: tuple[float, float] = (float("nan"), float("nan"))  # position and goal of the gripper

    @classmethod
    def start(
        cls,
        model: StageFile,
        dot_xy_px: NDArray[np.float64],
        window_px: NDArray[np.int32] | tuple[int, int, int, int] | None,
        constants: presets.TrackerConstants,
        threshold: float,
        sensor: Sensitivity = UNKNOWN_SENSITIVITY,
        *,
        frame_px: Sequence[int] = FRAME_PX,
    ) -> "OnlineSlipDetector":
        """Load a model for a gel whose dots are at rest at (rows, columns, 2); InputError if it is for another grid.

        threshold: the probability that three consecutive slices must reach for an alarm, see `chosen_threshold`.

        sensor: the known sensitivity of the sensor; frame_px: width and height of its frame.
        """
        dots = dots_for(model, dot_xy_px)
        tracking = tracker.start(dot_xy_px.reshape(-1, 2), constants, frame_px=frame_px)
        detector = load_detector(model)
        live = LiveDetector(detector, tracking, window_px, sensor, dots)
        tracker.mean_displacement_px(tracking.record)  # compiles or loads it now instead of in the first slice
        started = cls(live, alarms.start(threshold))
        if detector.needs_sticking:
            started.measure_sticking()
        return started

    def measure_sticking(self) -> None:
        """Enable the sticking share of the contact for the signal and the network; call before the first slice."""
        tracking = self.tracking
        self.sticking, first = (StickingShare(tracking.rest_xy_px, tracking.record["frame_px"][0]) for _ in range(2))
        first.step(tracking.dot_xy_px, tracking.lost)  # compiles or loads it now instead of in the first slice
        tracker.turn_px(tracking.record)  # also compiles or loads it

    @property
    def threshold(self) -> float:
        """The probability that three consecutive slices must reach."""
        return self.alarm.threshold

    @property
    def count(self) -> int:
        """The number of slices with an alarm so far, which the controller reads."""
        return self.alarm.alarms

    @property
    def slip(self) -> bool:
        """Whether the last slice raises an alarm: at least the third in a row that reaches the threshold."""
        return self.alarm.alarming

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """Store the last position of the fingers and the goal set then, for a network with these inputs."""
        self._gripper_state = position_ticks, goal_ticks
        self._tell()

    @property
    def tracking(self) -> tracker.TrackerState:
        """The dots after the slices so far."""
        return self.live.tracking

    def step(self, events: Events) -> float:
        """Return the slip probability after one more slice; NaN while there is none (LiveDetector.step)."""
        self.probability = self.live.step(events.x, events.y, events.p, events.t)
        alarms.step(self.alarm, self.probability)
        if self.sticking is not None:
            self.sticking.step(self.tracking.dot_xy_px, self.tracking.lost)
            self._tell()
        return self.probability

    def _tell(self) -> None:
        """Pass to the network what is known before the next slice."""
        sticking = () if self.sticking is None else (self.sticking.share, self.sticking.begun)
        self.live.tell(*self._gripper_state, *sticking)

    @property
    def signal(self) -> SlipSignal:
        """The signal to the controller after the last slice, with the mean displacement of all dots."""
        record = self.live.tracking.record
        result = SlipSignal(self.count, self.probability, *tracker.mean_displacement_px(record))
        if self.sticking is None:
            return result
        return result._replace(turn_px=tracker.turn_px(record), sticking_share=self.sticking.share)


def open_detector(
    model: StageFile,
    sensor: Mapping[str, Any],
    constants: presets.TrackerConstants,
    threshold: float,
    *,
    sticking: bool = False,
) -> OnlineSlipDetector:
    """Return the detector of a model, for a sensor with these datasets `sensor/...`, set up for a controller.

    threshold: of its alarms. constants: of the tracker, for dots of the usual size;
    sticking: whether the signal includes the sticking share. InputError if the model is for another dot grid.
    """
    known = sensitivity_of(sensor)
    constants = constants.for_dots(float(sensor["sensor/dot_radius_px"]), known.contrast_over_threshold)
    detector = OnlineSlipDetector.start(
        model,
        sensor["sensor/dot_xy_px"],
        sensor.get("sensor/window_px"),
        constants,
        threshold,
        known,
        frame_px=sensor["sensor/frame_px"],
    )
    if sticking:
        detector.measure_sticking()
    return detector


def open_view_detector(
    path: Path | None, preset: str, threshold: float | None, sensor: Mapping[str, Any]
) -> OnlineSlipDetector:
    """Return the detector with which a live view follows a recording.

    path: of the model, None for the pretrained one; threshold: None for the model's own.
    """
    with StageFile(resources.model_file(path), "model") as model:
        own = chosen_threshold(model, threshold)
        detector = open_detector(model, sensor, presets.PRESETS[preset], own)
    if detector.live.needs_times:
        raise InputError(
            "this network needs the times of events, which the live view does not have",
            where=str(model.path),
            expected="a network over dots",
            found=detector.live.detector.architecture.name,
        )
    return detector
