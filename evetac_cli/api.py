"""The Python interface: the names that `import evetac_cli as evetac` provides. A test runs the example of every name.

The examples read files made by the commands: `a.recording.h5`, `a.labels.h5` and so on.
"""

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evetac_cli import resources
from evetac_cli.errors import InputError, check_range
from evetac_cli.events import FRAME_PX, Events
from evetac_cli.kernels import event_drawing, event_representation
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, UNKNOWN_SENSITIVITY, Sensitivity, sensitivity_of
from evetac_cli.kernels.touch import touch_map
from evetac_cli.kernels.touch.dot_motion import ENDLESS_MM, DotNoise
from evetac_cli.kernels.touch.sticking import NO_TOUCH
from evetac_cli.kernels.touch.sticking import step as sticking_step
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.sim.setup.object_file import seed_of
from evetac_cli.sim.setup.plan import plans
from evetac_cli.stages.model_files import chosen_threshold, why_useless
from evetac_cli.stages.touch.known_gel import (
    DRIFT_PX,
    SHEAR_LOG_SD,
    SHEAR_MODULUS_PA,
    TRACKER_PX,
    GelShape,
    at_window,
)
from evetac_cli.stages.touch.touch_fold import sticking_of
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import RATE_HZ
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector
from evetac_cli.trials.record import SCENE_KINDS, simulated
from evetac_cli.trials.trial import SimulatedTrial


def open_labels(path: str | Path) -> StageFile:
    """Open a labels file, with `label` per slice (1 slip, 0 no slip, -1 not examined) and `onset_slice` (-1 if none).

    InputError if the file is of another kind.

    >>> with evetac.open_labels("a.labels.h5") as labels:
    ...     slip, onset_ms = labels.read("label"), int(labels.read("onset_slice"))
    >>> bool(slip[onset_ms])
    True
    """
    return StageFile(Path(path), "labels")


def open_tracks(path: str | Path) -> StageFile:
    """Open a tracks file, with `dot_xy_px` (slices, dots, 2), `events_per_dot` and `lost` (slices, dots).

    InputError if the file is of another kind.

    >>> with evetac.open_tracks("a.tracks.h5") as tracks:
    ...     moved_px = tracks.read("dot_xy_px") - tracks.read("sensor/dot_xy_px").reshape(-1, 2)
    >>> moved_px.shape[1:]
    (56, 2)
    """
    return StageFile(Path(path), "tracks")


def open_features(path: str | Path) -> StageFile:
    """Open a features file.

    It contains `displacement_px` and `events_per_dot` (slices, dots), `displacement_xy_px` (slices, dots, 2) and, if
    the recording was labelled, the labels. InputError if the file is of another kind.

    >>> with evetac.open_features("a.features.h5") as features:
    ...     features.read("displacement_px", 0, 10).shape      # the first 10 slices only
    (10, 56)
    """
    return StageFile(Path(path), "features")


def open_touch(path: str | Path) -> StageFile:
    """Open a touch file, with `shear_n` (slices, 2), `normal_n`, `centre_mm` and more per slice, and maps in `map/`.

    Datasets with `_sd_` in their name are standard deviations. InputError if the file is of another kind.

    >>> with evetac.open_touch("a.touch.h5") as touch:
    ...     touch.read("shear_n").shape[1], touch.read("map/pressure_pa").ndim
    (2, 3)
    """
    return StageFile(Path(path), "touch")


def open_model(path: str | Path) -> StageFile:
    """Open a slip detector's model file, with weights as arrays, the `onnx` graph, `threshold` and the training curve.

    `shipped` opens the pretrained model. To run a model on events, see `SlipDetector`. InputError if the file is of
    another kind.

    >>> with evetac.open_model("slip.model.h5") as model:
    ...     model.read("architecture")
    'hist10'
    """
    return StageFile(resources.model_file(path, flag="path"), "model")


def open_force_model(path: str | Path) -> StageFile:
    """Open a force model, with `regression/` and the network's weights and scales, or `adapted/`, the touch-map scale.

    InputError if the file is of another kind.

    >>> with evetac.open_force_model("dots.force-model.h5") as model:
    ...     model.read("regression/offset_n").shape
    (2,)
    """
    return StageFile(Path(path), "force-model")


def open_report(path: str | Path) -> StageFile:
    """Open a report of `evaluate`, in which `rows` and `summary` are JSON texts as printed by `--json`.

    InputError if the file is of another kind.

    >>> import json
    >>> with evetac.open_report("a.report.h5") as report:
    ...     row = json.loads(report.read("rows"))[0]
    >>> report.header["simulated"]
    True
    """
    return StageFile(Path(path), "report")


class Gel(NamedTuple):
    """The properties of a gel at rest; a recording and a simulation have the same attributes.

    - dot_xy_px: centres of the dots at rest, (rows, columns, 2) in px, NaN for a missing dot; or (dots, 2) in any
      order. A detector sorts such a list into rows, a tracker keeps its order.
    - dot_radius_px: radius of the printed dots.
    - window_px: x0, y0, x1, y1 of a cut gel's window; None for a closed gel.
    - sensitivity: contrast, threshold and stiffness from `evetac identify`, which slip detectors use.
    - frame_px: width and height of the camera's frame.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     gel = evetac.Gel(recording.dot_xy_px, recording.dot_radius_px, recording.window_px)
    >>> gel.dot_xy_px.shape
    (7, 8, 2)
    """

    dot_xy_px: NDArray[np.float64] | None
    dot_radius_px: float | None
    window_px: tuple[int, int, int, int] | None = None
    sensitivity: Sensitivity = UNKNOWN_SENSITIVITY
    frame_px: tuple[int, int] = FRAME_PX


class _HasGel(Protocol):
    """A Gel, a Recording or a Simulation."""

    @property
    def dot_xy_px(self) -> NDArray[np.float64] | None: ...
    @property
    def dot_radius_px(self) -> float | None: ...
    @property
    def window_px(self) -> tuple[int, int, int, int] | None: ...
    @property
    def sensitivity(self) -> Sensitivity: ...
    @property
    def frame_px(self) -> tuple[int, int]: ...


class DotTracker:
    """Tracks the dots of a gel slice by slice, from events to dot centres, as the command `track` does.

    - gel: a recording, a simulation or a `Gel`.
    - preset: one of `evetac.tracker_presets()`.
    - InputError: the positions of the gel's dots or the preset are unknown. ValueError: the dots cannot be tracked.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     tracker = evetac.DotTracker(recording)
    ...     for events in recording:
    ...         dot_xy_px = tracker.step(events)
    >>> dot_xy_px.shape
    (56, 2)
    """

    def __init__(self, gel: _HasGel, preset: str = "stable") -> None:
        dot_xy_px, constants = _known_dots(gel, preset)
        self._state = tracker.start(dot_xy_px.reshape(-1, 2), constants, frame_px=gel.frame_px)

    def step(self, events: Events) -> NDArray[np.float64]:
        """Process one slice and return the dot centres, (n, 2) in px, as a view that the next step overwrites."""
        tracker.step(self._state, events.x, events.y, events.p)
        return self._state.dot_xy_px

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which dots are lost, so that their positions are unreliable, (n,): a view that the next step overwrites."""
        return self._state.lost

    @property
    def events_per_dot(self) -> NDArray[np.int32]:
        """Number of events near each dot in the last slice, (n,): a view that the next step overwrites."""
        return self._state.events_per_dot


class SlipDetector:
    """Estimates slip probability and raises slip alarms, slice by slice, with the tracker and network used by `grasp`.

    - gel: a recording, a simulation or a `Gel`.
    - model: a model file, or the pretrained `shipped`, which is the default. A model that calls every slice slip, or
      none, causes a warning.
    - InputError: the positions of the gel's dots are unknown, or the model is for another dot grid.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     detector = evetac.SlipDetector(recording)
    ...     slip = []
    ...     for events in recording:
    ...         probability = detector.step(events)
    ...         slip.append(detector.slip)
    >>> 0.0 <= probability <= 1.0, slip[0]
    (True, False)
    """

    def __init__(self, gel: _HasGel, model: str | Path | None = None, tracker_preset: str = "stable") -> None:
        dot_xy_px, constants = _known_dots(gel, tracker_preset)
        dot_xy_px, no_rows = _in_rows(dot_xy_px)
        with StageFile(resources.model_file(model, flag="model"), "model") as file:
            if why := why_useless(file):
                warnings.warn(f"{file.path} is not a slip detector: {why}", stacklevel=2)
            try:
                self._detector = OnlineSlipDetector.start(
                    file,
                    dot_xy_px,
                    gel.window_px,
                    constants,
                    chosen_threshold(file),
                    gel.sensitivity,
                    frame_px=gel.frame_px,
                )
            except InputError as error:
                error.hint = no_rows or error.hint
                raise

    @property
    def threshold(self) -> float:
        """Slip probability, chosen in training, that three consecutive slices must reach for an alarm."""
        return self._detector.threshold

    @property
    def slip(self) -> bool:
        """Whether there is an alarm: at least three consecutive slices, up to the last one, reached the threshold."""
        return self._detector.slip

    def step(self, events: Events) -> float:
        """Process one slice and return the slip probability.

        It is NaN until the history of the network is full; with a network that has memory, while nothing touches.
        """
        return self._detector.step(events)

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """Set the position of the fingers and their goal, in ticks; networks that do not use them ignore the call.

        Use NaN for an unknown value. The values apply until the next call.
        """
        self._detector.tell_gripper(position_ticks, goal_ticks)


class TouchMap:
    """Estimates where a gel is touched, how hard and in which direction, in mm, Pa and N, from the dots of each slice.

    - gel: a recording, a simulation or a `Gel`.
    - mm_per_px: scale of the image; x_mm and y_mm are measured from its middle.
    - height_mm: thickness of the gel.
    - shear_modulus_pa: forces are proportional to it. Default: the gel's; if that is unknown, 121e3 as in
      `predict-touch`, which makes forces less certain.
    - stiffness_error: relative standard deviation of the modulus.
    - print_depth_mm: depth of the dots below the surface.
    - lens_mm: distance from the lens to the dots.
    - edges_mm: edges of the gel, x0, y0, x1, y1; a cut gel also ends at its window.
    - leave_out_wrong: leave out dots whose motion is inconsistent with the others.
    - InputError: the positions of the gel's dots are unknown. ValueError: a number is out of range.

    On a busy computer set OPENBLAS_NUM_THREADS=1 before Python starts. The matrices are small, and threads that wait
    for a core make a new contact patch take ten times as long.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     tracker, touch = evetac.DotTracker(recording), evetac.TouchMap(recording, mm_per_px=0.0329)
    ...     for events in recording:
    ...         reading = touch.step(tracker.step(events), tracker.lost)
    >>> reading.pressure_pa.shape == (len(touch.y_mm), len(touch.x_mm)) == reading.patch.shape
    True
    >>> touch.sticking.alarm in (True, False)      # and sticking_share, its sd and slip_direction_rad
    True
    """

    def __init__(
        self,
        gel: _HasGel,
        *,
        mm_per_px: float,
        height_mm: float = 4.0,
        shear_modulus_pa: float | None = None,
        stiffness_error: float | None = None,
        print_depth_mm: float = 0.0,
        lens_mm: float = 25.0,
        edges_mm: tuple[float, float, float, float] = ENDLESS_MM,
        leave_out_wrong: bool = False,
    ) -> None:
        check_range("mm_per_px", mm_per_px, 0.0, 10.0, "mm", above=True)
        dot_xy_px, _ = _known_dots(gel, "stable")
        modulus = gel.sensitivity.shear_modulus_pa if shear_modulus_pa is None else shear_modulus_pa
        if stiffness_error is None:
            stiffness_error = SHEAR_LOG_SD if modulus is None else 0.0
        self._scale, self._middle_px = mm_per_px, np.array(gel.frame_px) / 2
        self.rest_xy_px = dot_xy_px.reshape(-1, 2)  # the dots at rest, (n, 2)
        rest_mm = (self.rest_xy_px - self._middle_px) * mm_per_px
        noise = DotNoise(TRACKER_PX * mm_per_px, DRIFT_PX * mm_per_px)
        shape = GelShape(height_mm, print_depth_mm, lens_mm, edges_mm)
        shape = at_window(shape, gel.window_px, gel.frame_px, mm_per_px, rest_mm)
        layer = shape.layer(modulus or SHEAR_MODULUS_PA)
        self._state = touch_map.start(rest_mm, layer, noise, stiffness_error, compares=leave_out_wrong)
        self.x_mm, self.y_mm = self._state.cells  # middles of the columns and rows of cells
        self._sticking = sticking_of(self._state)
        self.sticking = NO_TOUCH  # for the last slice: sticking share, its sd, direction of slip, and an alarm

    def step(self, dot_xy_px: NDArray[np.float64], lost: NDArray[np.bool_] | None = None) -> touch_map.TouchReading:
        """Process one slice and return its reading.

        dot_xy_px: dot centres, (n, 2) in px, from `DotTracker.step`. lost: which dots are lost, (n,).
        """
        dot_mm = (dot_xy_px - self._middle_px) * self._scale
        reading = touch_map.step(self._state, dot_mm, lost)
        if self._sticking is not None:
            none_lost = np.zeros(len(dot_mm), np.bool_)
            self.sticking = sticking_step(self._sticking, dot_mm, none_lost if lost is None else lost, reading.touches)
        return reading

    def hold(self) -> None:
        """Restart the quantities named `since` in readings; call it when the grip has closed, before shear begins."""
        touch_map.hold(self._state)


class EventImager:
    """Draws images of events at a fixed rate in your own loop, bit for bit as `Recording.frames` and similar methods.

    - kind: frames, histogram, voxels or surface.
    - frame_px: width and height of the sensor's frame.
    - size_px: width and height of the images; default: those of the frame.
    - window_ms: length of the time window that an image covers; default: from the end of the image before. In a
      surface the last event of each pixel counts, however long ago it was.
    - bins, polarity, decay_ms: as in `Recording.histogram`, `Recording.frames` and `Recording.time_surface`.
    - ValueError: a number is out of range.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     images = evetac.EventImager("frames", recording.frame_px, rate_hz=200, size_px=(160, 120))
    ...     found = [image for events in recording if (image := images.step(events)) is not None]
    >>> found[0].shape, len(found) == len(recording) // 5
    ((2, 120, 160), True)
    """

    def __init__(
        self,
        kind: event_representation.Kind,
        frame_px: tuple[int, int] = FRAME_PX,
        *,
        rate_hz: float = RATE_HZ,
        size_px: tuple[int, int] | None = None,
        window_ms: int | None = None,
        bins: int = 5,
        polarity: event_representation.Polarity = "split",
        decay_ms: float = 10.0,
    ) -> None:
        more = {"bins": bins, "polarity": polarity, "decay_ms": decay_ms}
        of = event_representation.representation(kind, frame_px, size_px, rate_hz, window_ms, **more)
        self._state = event_drawing.start(of)
        self.shape = of.shape  # of an image

    def step(self, events: Events) -> NDArray[Any] | None:
        """Process one slice and return the image that ends with it, as a new array, or None."""
        return event_drawing.step(self._state, events)


class Simulation:
    """A simulated trial: iterate over it to get its slices. All of its data are simulated.

    `truth` holds the ground truth of the last slice and, every 2 ms, a row of `gripper/...`.

    >>> trial = evetac.simulate("press", seed=1)
    >>> isinstance(trial, evetac.Simulation), trial.frame_px
    (True, (640, 480))
    """

    def __init__(self, trial: SimulatedTrial) -> None:
        self._devices, self._slices = simulated.play(trial)
        sensor = self._devices.camera.sensor
        self.dot_xy_px: NDArray[np.float64] = np.asarray(sensor["sensor/dot_xy_px"])  # at rest, (rows, columns, 2)
        width, height = sensor["sensor/frame_px"]
        self.frame_px = int(width), int(height)
        self.dot_radius_px = float(sensor["sensor/dot_radius_px"])
        self.sensitivity = sensitivity_of(sensor)
        self.window_px: tuple[int, int, int, int] | None = None  # for a cut gel: x0, y0, x1, y1, ends excluded
        if "sensor/window_px" in sensor:
            x0, y0, x1, y1 = (int(edge) for edge in sensor["sensor/window_px"])
            self.window_px = x0, y0, x1, y1
        self.truth: dict[str, Any] = {}

    def __iter__(self) -> Iterator[Events]:
        for events, rows in self._slices:
            self.truth = rows
            yield events


def simulate(
    scene_name: str = "slip",
    object_number: int | str | Path = 8,
    *,
    sensor: str = "evetac",
    gel: str | None = None,
    solver: Mapping[str, Any] = MappingProxyType({}),
    seed: int = 0,
) -> Simulation:
    """Return a simulated trial of a scene, to iterate over; its events are those of `record` with the same flags.

    - scene_name: one of `evetac.scenes()`, except those of kind lift, or a TOML file.
    - object_number: number in the paper's table, or a TOML file as for `--object`.
    - gel: cut or closed; default: the scene's.
    - solver: settings of the simulation, e.g. {"tolerance_um": 0.05}; see the table `[solver]` of scenes.
    - InputError: a name is unknown.

    >>> trial = evetac.simulate("slip", object_number=8, seed=3)
    >>> for milliseconds, events in enumerate(trial):
    ...     if milliseconds == 500:
    ...         break
    >>> trial.dot_xy_px.shape, int(trial.truth["truth/slip"])
    ((7, 8, 2), 0)
    """
    first = plans(scene_name, str(object_number), sensor, SCENE_KINDS, gel, solver=solver)[0]
    plan = first.of_trial((seed, seed_of(first.object_name), 0))
    return Simulation(SimulatedTrial((), Path(), 0, seed, plan))


def objects() -> dict[int, dict[str, Any]]:
    """Return the paper's objects by number: material, width, height, mass and parameters for the simulation.

    >>> evetac.objects()[11]["mass_g"] > 0
    True
    """
    return {int(number): dict(row) for number, row in resources.table("objects").items()}


def sensors() -> list[str]:
    """Return the names of the built-in sensors for simulation; `randomized` is a different sensor in every trial.

    >>> "evetac" in evetac.sensors()
    True
    """
    return list(resources.table("sensors"))


def scenes() -> list[str]:
    """Return the names of the built-in scenes; those of kind lift are for the command `grasp`.

    >>> "slip" in evetac.scenes()
    True
    """
    return sorted(path.stem for path in resources.SCENES.glob("*.toml"))


def tracker_presets() -> list[str]:
    """Return the names of the dot tracker's presets.

    >>> "stable" in evetac.tracker_presets()
    True
    """
    return list(presets.PRESETS)


def architectures() -> list[str]:
    """Return the names of the slip detectors' architectures: those of the paper's table, and evetac's own.

    >>> "fast-slow" in evetac.architectures()
    True
    """
    return list(ARCHITECTURES)


def _known_dots(gel: _HasGel, preset: str) -> tuple[NDArray[np.float64], presets.TrackerConstants]:
    """Return a gel's dots at rest and the tracker's constants for them; InputError if dots are unknown or invalid."""
    if preset not in presets.PRESETS:
        raise InputError("unknown preset of the tracker", expected=", ".join(presets.PRESETS), found=preset)
    where = str(getattr(gel, "path", "gel"))
    if gel.dot_xy_px is None or gel.dot_radius_px is None:
        hint = "evetac calibrate finds them; evetac record --calibration stores them with a recording"
        raise InputError("the positions of this gel's dots are unknown", where=where, hint=hint)
    dots = np.asarray(gel.dot_xy_px, np.float64)
    if dots.ndim not in (2, 3) or dots.shape[-1] != 2 or dots.size == 0:
        expected, found = "(rows, columns, 2), or (dots, 2): x and y of each dot", f"shape {dots.shape}"
        raise InputError("not dot positions", where=f"{where}: dot_xy_px", expected=expected, found=found)
    return dots, presets.PRESETS[preset].for_dots(gel.dot_radius_px, gel.sensitivity.contrast_over_threshold)


def _in_rows(dot_xy_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """Return the dots in rows, as in sensor files, and a hint if they form no rows.

    A list of dots is sorted into the rows of its grid, or kept as one row if there is no grid.
    """
    if dot_xy_px.ndim == 3:
        return dot_xy_px, ""
    try:
        return grid.arrange(dot_xy_px), ""
    except ValueError as error:
        return dot_xy_px[
            None
        ], f"pass dot_xy_px as (rows, columns, 2): no rows were found in this list of dots, {error}"
