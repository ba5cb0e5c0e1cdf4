"""The Python interface: what `import evetac_cli as evetac` offers; a test runs the example of every name.

The examples read files that the commands made: `a.recording.h5`, `a.labels.h5` and so on.
"""

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evetac_cli import resources
from evetac_cli.checks import check_range
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX, Events
from evetac_cli.kernels import event_drawing, event_representation
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.sensitivity import UNKNOWN, Sensitivity, sensitivity_of
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.touch import touch_map
from evetac_cli.kernels.touch.dot_modes import DotNoise
from evetac_cli.kernels.touch.dot_motion import ENDLESS_MM
from evetac_cli.kernels.touch.sticking import NO_TOUCH
from evetac_cli.kernels.touch.sticking import step as sticking_step
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.sim.setup.object_file import seed_of
from evetac_cli.sim.setup.plan import plans
from evetac_cli.stages.model_files import why_useless
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
    """Open a labels file: `label` (1 slip, 0 none, -1 not examined, a slice each) and `onset_slice` (-1 if none).

    InputError if it is anything else.

    >>> with evetac.open_labels("a.labels.h5") as labels:
    ...     slip, onset_ms = labels.read("label"), int(labels.read("onset_slice"))
    >>> bool(slip[onset_ms])
    True
    """
    return StageFile(Path(path), "labels")


def open_tracks(path: str | Path) -> StageFile:
    """Open a tracks file: `dot_xy_px` (slices, dots, 2), `events_per_dot` and `lost` (slices, dots).

    InputError if it is anything else.

    >>> with evetac.open_tracks("a.tracks.h5") as tracks:
    ...     moved_px = tracks.read("dot_xy_px") - tracks.read("sensor/dot_xy_px").reshape(-1, 2)
    >>> moved_px.shape[1:]
    (56, 2)
    """
    return StageFile(Path(path), "tracks")


def open_features(path: str | Path) -> StageFile:
    """Open a features file: `displacement_px`, `events_per_dot` (slices, dots), `displacement_xy_px`, labels if any.

    InputError if it is anything else.

    >>> with evetac.open_features("a.features.h5") as features:
    ...     features.read("displacement_px", 0, 10).shape      # the first 10 slices only
    (10, 56)
    """
    return StageFile(Path(path), "features")


def open_touch(path: str | Path) -> StageFile:
    """Open a touch file: `shear_n` (slices, 2), `normal_n`, `centre_mm` and more, their `_sd_`, by slice; and `map/`.

    InputError if it is anything else.

    >>> with evetac.open_touch("a.touch.h5") as touch:
    ...     touch.read("shear_n").shape[1], touch.read("map/pressure_pa").ndim
    (2, 3)
    """
    return StageFile(Path(path), "touch")


def open_model(path: str | Path) -> StageFile:
    """Open a slip detector's model file: weights as arrays, `onnx` graph, `threshold`, training curve.

    `shipped` is the package's. InputError if it is anything else. To run it on events see `SlipDetector`.

    >>> with evetac.open_model("slip.model.h5") as model:
    ...     model.read("architecture")
    'hist10'
    """
    return StageFile(resources.model_file(path, flag="path"), "model")


def open_force_model(path: str | Path) -> StageFile:
    """Open a force model: `regression/`, the network's weights and scales; or `adapted/`, the scale of touch maps.

    InputError if it is anything else.

    >>> with evetac.open_force_model("dots.force-model.h5") as model:
    ...     model.read("regression/offset_n").shape
    (2,)
    """
    return StageFile(Path(path), "force-model")


def open_report(path: str | Path) -> StageFile:
    """Open a report of `evaluate`: `rows` and `summary` are JSON texts, as `--json` prints them.

    InputError if it is anything else.

    >>> import json
    >>> with evetac.open_report("a.report.h5") as report:
    ...     row = json.loads(report.read("rows"))[0]
    >>> report.header["simulated"]
    True
    """
    return StageFile(Path(path), "report")


class Gel(NamedTuple):
    """What is known of a gel before it is touched; a recording and a simulation have these attributes too.

    dot_xy_px: centres of the dots at rest, (rows, columns, 2) in px, NaN for a missing dot; or (dots, 2) in any order,
    which a detector puts into rows, and a tracker follows in the order given. dot_radius_px: of the printed dots.
    window_px: x0, y0, x1, y1 of a cut gel's window, None for a closed gel. sensitivity: what `evetac identify` told of
    its contrast, threshold and stiffness, which slip detectors ask for.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     gel = evetac.Gel(recording.dot_xy_px, recording.dot_radius_px, recording.window_px)
    >>> gel.dot_xy_px.shape
    (7, 8, 2)
    """

    dot_xy_px: NDArray[np.float64] | None
    dot_radius_px: float | None
    window_px: tuple[int, int, int, int] | None = None
    sensitivity: Sensitivity = UNKNOWN


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


class DotTracker:
    """Follows the dots of a gel: a slice of events in, dot centres out, as the command `track` does.

    gel: a recording, a simulation or a `Gel`. preset: of `evetac.tracker_presets()`. InputError where the gel's dots or
    the preset are unknown; ValueError for dots that cannot be tracked.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     tracker = evetac.DotTracker(recording)
    ...     for events in recording:
    ...         dot_xy_px = tracker.step(events)
    >>> dot_xy_px.shape
    (56, 2)
    """

    def __init__(self, gel: _HasGel, preset: str = "stable") -> None:
        dot_xy_px, constants = _known_dots(gel, preset)
        self._state = tracker.start(dot_xy_px.reshape(-1, 2), constants)

    def step(self, events: Events) -> NDArray[np.float64]:
        """Dot centres after one more slice, (n, 2) in px: a view that the next step changes."""
        tracker.step(self._state, events.x, events.y, events.p)
        return self._state.dot_xy_px

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which dots are not to be trusted, (n,): a view that the next step changes."""
        return self._state.lost

    @property
    def events_per_dot(self) -> NDArray[np.int32]:
        """Events of the last slice near each dot, (n,): a view that the next step changes."""
        return self._state.events_per_dot


class SlipDetector:
    """Slip probability from events, slice by slice, and alarms: the tracker and the network that `grasp` runs.

    gel: a recording, a simulation or a `Gel`. model: a model file, or `shipped`, the package's, which is the default.
    InputError where the gel's dots are unknown, or the model is for another dot grid. A model that calls every slice
    slip, or none, is warned of.

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
                warnings.warn(f"{file.path} is no slip detector: {why}", stacklevel=2)
            try:
                self._detector = OnlineSlipDetector.start(file, dot_xy_px, gel.window_px, constants, gel.sensitivity)
            except InputError as error:
                error.hint = no_rows or error.hint
                raise

    @property
    def threshold(self) -> float:
        """Probability that three slices in a row have to reach, as chosen in training."""
        return self._detector.threshold

    @property
    def slip(self) -> bool:
        """Whether the last slice alarms: the third in a row, at least, that reaches the threshold."""
        return self._detector.slip

    def step(self, events: Events) -> float:
        """Slip probability after one more slice, NaN until the history of the network is full."""
        return self._detector.step(events)

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """Where the fingers are and are to go, in ticks, for a network that is told of them; others do not mind.

        NaN for what is not known; it holds until it is told anew.
        """
        self._detector.tell_gripper(position_ticks, goal_ticks)


class TouchMap:
    """Where a gel is touched, how hard and in which direction, in mm, Pa and N, from dots slice by slice.

    gel: a recording, a simulation or a `Gel`. mm_per_px: scale of the image, x_mm and y_mm are from its middle.
    shear_modulus_pa, which forces are proportional to, is the gel's unless given; where it is unknown, 121e3 as in
    `predict-touch`, and then forces are as unsure. stiffness_error: its relative sd. print_depth_mm: of the dots below
    the surface. lens_mm: from the lens to the dots. edges_mm: where the gel ends, x0, y0, x1, y1; a cut one ends at its
    window anyway. leave_out_wrong: dots that moved otherwise than the others allow. InputError where the gel's dots
    are unknown; ValueError for numbers that cannot be.
    On a busy computer set OPENBLAS_NUM_THREADS=1 before Python starts: the matrices are small, and threads that wait
    for a core make a new patch take ten times as long.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     tracker, touch = evetac.DotTracker(recording), evetac.TouchMap(recording, mm_per_px=0.0329)
    ...     for events in recording:
    ...         reading = touch.step(tracker.step(events), tracker.lost)
    >>> reading.pressure_pa.shape == (len(touch.y_mm), len(touch.x_mm)) == reading.patch.shape
    True
    >>> touch.sticking.alarm in (True, False)      # beside sticking_share, its sd and slip_direction_rad
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
        frame_px = getattr(gel, "frame_px", FRAME_PX)
        self._scale, self._middle_px = mm_per_px, np.array(frame_px) / 2
        self.rest_xy_px = dot_xy_px.reshape(-1, 2)  # the dots at rest, (n, 2)
        rest_mm = (self.rest_xy_px - self._middle_px) * mm_per_px
        noise = DotNoise(TRACKER_PX * mm_per_px, DRIFT_PX * mm_per_px)
        shape = GelShape(height_mm, print_depth_mm, lens_mm, edges_mm)
        shape = at_window(shape, gel.window_px, frame_px, mm_per_px, rest_mm)
        layer = shape.layer(modulus or SHEAR_MODULUS_PA)
        self._state = touch_map.start(rest_mm, layer, noise, stiffness_error, compares=leave_out_wrong)
        self.x_mm, self.y_mm = self._state.cells  # middles of the columns and rows of cells
        self._sticking = sticking_of(self._state)
        self.sticking = NO_TOUCH  # of the last slice: share that sticks, its sd, direction of slip, and an alarm

    def step(self, dot_xy_px: NDArray[np.float64], lost: NDArray[np.bool_] | None = None) -> touch_map.TouchReading:
        """What one more slice tells: dots (n, 2) in px as of `DotTracker`, and which of them are lost."""
        dot_mm = (dot_xy_px - self._middle_px) * self._scale
        reading = touch_map.step(self._state, dot_mm, lost)
        if self._sticking is not None:
            none_lost = np.zeros(len(dot_mm), np.bool_)
            self.sticking = sticking_step(self._sticking, dot_mm, none_lost if lost is None else lost, reading.touches)
        return reading

    def hold(self) -> None:
        """Count what is `since` in readings from now on: when a grip has closed and shear is to come."""
        touch_map.hold(self._state)


class EventImager:
    """Images of events at a fixed rate, in a loop of your own: the same bits as `frames` and the like of a recording.

    kind: frames, histogram, voxels or surface. frame_px: width and height of the sensor's frame; size_px: of the
    images, the frame's unless given. window_ms: what an image looks back on, from one image to the next unless given;
    of a surface the last event of each pixel counts, however long ago. bins, polarity, decay_ms: as in
    `Recording.histogram`, `Recording.frames` and `Recording.time_surface`. ValueError for numbers that cannot be.

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
        """Take one more slice; the image that ends with it, a new array, or None."""
        return event_drawing.step(self._state, events)


class Simulation:
    """A simulated trial: iterate over its slices. Everything it gives is simulated.

    `truth` holds what only the simulation knows of the last slice, and every 2 ms a row of `gripper/...`.

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
        self.window_px: tuple[int, int, int, int] | None = None  # of a cut gel: x0, y0, x1, y1, ends excluded
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
    readout: str = "dvxplorer",
    solver: Mapping[str, Any] = MappingProxyType({}),
    seed: int = 0,
) -> Simulation:
    """Simulate one trial of a scene and iterate over its slices; the same events as `record` with these flags.

    scene_name: of `evetac.scenes()` but those of kind lift, or a TOML file. object_number: of the paper's table, or a
    TOML file as of `--object`. gel: cut or closed, default: the scene's.
    readout: dvxplorer (scanned) or ideal. solver: settings of the simulation, as in {"tolerance_um": 0.05}; see the
    table `[solver]` of scenes. InputError for an unknown name.

    >>> trial = evetac.simulate("slip", object_number=8, seed=3)
    >>> for milliseconds, events in enumerate(trial):
    ...     if milliseconds == 500:
    ...         break
    >>> trial.dot_xy_px.shape, int(trial.truth["truth/slip"])
    ((7, 8, 2), 0)
    """
    first = plans(scene_name, str(object_number), sensor, SCENE_KINDS, gel, readout, solver=solver)[0]
    plan = first.of_trial((seed, seed_of(first.called), 0))
    return Simulation(SimulatedTrial((), Path(), 0, seed, plan))


def objects() -> dict[int, dict[str, Any]]:
    """The paper's objects by number: material, width, height, mass and what the simulation needs of them.

    >>> evetac.objects()[11]["mass_g"] > 0
    True
    """
    return {int(number): dict(row) for number, row in resources.table("objects").items()}


def sensors() -> list[str]:
    """Names of the built sensors that can be simulated; `randomized` is another one for every trial.

    >>> "evetac" in evetac.sensors()
    True
    """
    return list(resources.table("sensors"))


def scenes() -> list[str]:
    """Names of the scenes that come with the package; those of kind lift are for the command `grasp`.

    >>> "slip" in evetac.scenes()
    True
    """
    return sorted(path.stem for path in resources.SCENES.glob("*.toml"))


def tracker_presets() -> list[str]:
    """Names of the presets of the dot tracker.

    >>> "stable" in evetac.tracker_presets()
    True
    """
    return list(presets.PRESETS)


def architectures() -> list[str]:
    """Names of the architectures of slip detectors, as in the paper's table and ours.

    >>> "fast-slow" in evetac.architectures()
    True
    """
    return list(ARCHITECTURES)


def _known_dots(gel: _HasGel, preset: str) -> tuple[NDArray[np.float64], presets.TrackerConstants]:
    """The dots of a gel at rest and the tracker's constants for them; InputError where they are unknown or no dots."""
    if preset not in presets.PRESETS:
        raise InputError("unknown preset of the tracker", expected=", ".join(presets.PRESETS), found=preset)
    where = str(getattr(gel, "path", "gel"))
    if gel.dot_xy_px is None or gel.dot_radius_px is None:
        raise InputError(
            "where the dots of this gel are is unknown",
            where=where,
            expected="dot_xy_px and dot_radius_px",
            hint="evetac calibrate finds them; evetac record --calibration stores them with a recording",
        )
    try:
        dots = np.asarray(gel.dot_xy_px, np.float64)
    except (TypeError, ValueError):
        dots = np.empty(0)
    if dots.ndim not in (2, 3) or dots.shape[-1] != 2 or dots.size == 0:
        shape = f"shape {np.shape(dots)}" if dots.size else "no array of numbers"
        expected = "(rows, columns, 2), or (dots, 2): x and y of each dot"
        raise InputError("not dot positions", where=f"{where}: dot_xy_px", expected=expected, found=shape)
    return dots, presets.PRESETS[preset].for_dots(gel.dot_radius_px)


def _in_rows(dot_xy_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """Dots in rows, those of a list as sensor files put them: in the rows of their grid, or in one row if it has none.

    And what to try where they have no rows.
    """
    if dot_xy_px.ndim == 3:
        return dot_xy_px, ""
    try:
        return grid.arrange(dot_xy_px), ""
    except ValueError as error:
        return dot_xy_px[None], f"give dot_xy_px as (rows, columns, 2): a list of dots finds no rows, {error}"
