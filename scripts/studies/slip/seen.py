"""Keep trials as slip detectors see them, one file per trial: load path of tracked and of true dots, and the truth.

Simulating trials with a camera takes hours, evaluating detectors on the files minutes (judge.py). The tracker is
`stable`, and the load paths of tracked dots equal those of `track` and `featurize`, bit for bit. Networks over dots run
while a trial is simulated, because their inputs are too large to keep.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Floats, Singles
from evetac_cli.errors import SceneError
from evetac_cli.evaluate.slip.models import Model
from evetac_cli.events import Events
from evetac_cli.kernels.slip import features, load_path
from evetac_cli.kernels.slip.architectures import sensitivity_of
from evetac_cli.kernels.slip.detector import over_each
from evetac_cli.kernels.slip.inputs import known_at_start
from evetac_cli.kernels.slip.load_path import LoadPath
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.kernels.tracking.tracker import TrackerState
from evetac_cli.stages.touch.touch_fold import StickingShare
from evetac_cli.store.hdf5.disk import taking_the_place_of
from scripts.studies import motions
from scripts.studies.motions import Planned, Trial

TRACKER = "stable"
UNKNOWN = float("nan")
DOTS = ("tracked", "true")
TRUTH = ("slip_share", "slips", "normal_n", "shear_n", "closing_ticks")  # fields of `Trial` that are kept


class View(NamedTuple):
    """What a detector sees of a trial; share and begun are the sticking network's before each slice, (slices,)."""

    path: LoadPath
    sticking_share: Singles
    slip_begun: Singles


class SeenTrial(NamedTuple):
    """A trial of a motion: its truth without dots, its views by kind of dots, and scores of networks over dots.

    row: object, seed, sensor, and `refused`: why it was not simulated.
    """

    motion: str
    row: dict[str, Any]
    trial: Trial | None
    views: dict[str, View]
    scores: dict[str, tuple[Singles, int]]  # probability of each slice, and the horizon in ms


class Seen:
    """Tracks, events and gripper of a trial, slice by slice; pass `see` to `motions.played`."""

    def __init__(self) -> None:
        """Start before the first slice."""
        self.sensor: Mapping[str, Any] = {}
        self.rest_px: Floats = np.empty((0, 2))
        self._dot_px: list[Singles] = []
        self._lost: list[Any] = []
        self._events: list[Any] = []
        self._gripper: list[tuple[float, float, float, float]] = []  # time in us, position, goal in ticks, goal in mA
        self._tracking: TrackerState | None = None

    def see(self, sensor: Mapping[str, Any], events: Events, row: Mapping[str, Any]) -> None:
        """Add one more slice."""
        if self._tracking is None:
            self.sensor = sensor
            self.rest_px = np.asarray(sensor["sensor/dot_xy_px"], np.float64).reshape(-1, 2)
            contrast = sensitivity_of(sensor).contrast_over_threshold
            constants = PRESETS[TRACKER].for_dots(float(sensor["sensor/dot_radius_px"]), contrast)
            self._tracking = tracker.start(self.rest_px, constants)
        state = self._tracking
        tracker.step(state, events.x, events.y, events.p)
        self._dot_px.append(state.dot_xy_px.astype(np.float32))
        self._lost.append(np.array(state.lost))
        self._events.append(state.events_per_dot.copy())
        if "gripper/t_us" in row:
            in_current_mode = not np.isnan(row["gripper/current_target_ma"])
            goal_ma = float(row["gripper/current_written_ma"]) if in_current_mode else UNKNOWN
            goal_ticks = float(row.get("control/goal_ticks", UNKNOWN))
            self._gripper.append((row["gripper/t_us"], float(row["gripper/position_ticks"]), goal_ticks, goal_ma))

    @property
    def dot_px(self) -> Singles:
        """Tracked positions of the dots at the end of each slice, (slices, dots, 2), as tracks store them."""
        return np.array(self._dot_px)

    def gripper(self) -> list[Singles]:
        """Position and goal in ticks and goal in mA at the start of each slice, (slices,) each."""
        slices = len(self._dot_px)
        if not self._gripper:
            return [np.full(slices, np.nan, np.float32) for _ in range(3)]
        t_us, *values = (np.array(column) for column in zip(*self._gripper, strict=True))
        return [known_at_start(t_us.astype(np.int64), column, slices) for column in values]

    def view(self, dot_px: Singles, lost: Iterable[Any]) -> View:
        """Return what detectors see of these dots (slices, dots, 2), lost (dots,) in each slice, and of the rest."""
        sticks = StickingShare(self.rest_px, self.sensor["sensor/frame_px"])
        # a slice uses what the sticking network says after the slice before
        share, begun = np.full((2, len(dot_px) + 1), np.nan, np.float32)
        for number, (of_slice, gone) in enumerate(zip(dot_px, lost, strict=True), 1):
            share[number] = sticks.step(of_slice, gone)
            begun[number] = sticks.begun
        told = np.stack([*self.gripper(), share[:-1], begun[:-1]], axis=1)
        state = load_path.start(
            tuple(np.shape(self.sensor["sensor/dot_xy_px"])[:2]),
            sensitivity_of(self.sensor),
            self.sensor["sensor/frame_px"],
        )
        moved = features.displacement_xy(dot_px, self.rest_px)
        path = load_path.over(state, moved, np.array(self._events), told.astype(np.float32))
        return View(path, share[:-1], begun[:-1])

    def views(self, trial: Trial) -> dict[str, View]:
        """Return the views by kind of dots."""
        none_lost = np.zeros(trial.dot_px.shape[:2], np.bool_)
        return {"tracked": self.view(self.dot_px, self._lost), "true": self.view(trial.dot_px, none_lost)}

    def scores(self, models: Mapping[str, Model]) -> dict[str, tuple[Singles, int]]:
        """Return the probabilities by networks over dots, and their horizons."""
        series = features.series(features.displacement(self.dot_px, self.rest_px), np.array(self._events))
        return {name: (over_each([model.detector()], series)[0], model.horizon_ms) for name, model in models.items()}


def seen(motion: str, row: dict[str, Any], planned: Planned, seed: int, models: Mapping[str, Model]) -> SeenTrial:
    """Simulate a trial with a camera; one that the simulator refuses has no truth and no views."""
    eye = Seen()
    try:
        trial = motions.played(planned, seed, eye.see)
    except SceneError as error:  # a heavy object would compress a soft gel beyond the layer's limit
        return SeenTrial(motion, row | {"refused": error.message}, None, {}, {})
    return SeenTrial(motion, row, trial, eye.views(trial), eye.scores(models))


def write(path: Path, one: SeenTrial) -> None:
    """Write a trial to a file."""
    arrays: dict[str, Any] = {"row": json.dumps(one.row)}
    if one.trial is not None:
        arrays |= {name: getattr(one.trial, name) for name in TRUTH}
    for dots, view in one.views.items():
        arrays |= {f"{dots}/numbers": view.path.numbers, f"{dots}/touches": view.path.touches}
        arrays |= {f"{dots}/sticking_share": view.sticking_share, f"{dots}/slip_begun": view.slip_begun}
    arrays |= {f"score/{name}/{horizon_ms}": score for name, (score, horizon_ms) in one.scores.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with taking_the_place_of(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read(path: Path) -> SeenTrial:
    """Read a trial from its file."""
    with np.load(path, allow_pickle=False) as arrays:
        row = json.loads(str(arrays["row"]))
        views: dict[str, View] = {}
        if "refused" in row:
            return SeenTrial(path.parent.name, row, None, views, {})
        nowhere = np.empty((len(arrays["slips"]), 0, 2), np.float32)
        truth = {name: arrays[name] for name in TRUTH}
        trial = Trial(dot_px=nowhere, rest_px=np.empty((0, 2)), mm_per_px=1.0, frame_px=(1, 1), **truth)
        for dots in DOTS:
            path_of = LoadPath(arrays[f"{dots}/numbers"], arrays[f"{dots}/touches"], len(trial.slips))
            views[dots] = View(path_of, arrays[f"{dots}/sticking_share"], arrays[f"{dots}/slip_begun"])
        kept = [(name.split("/"), arrays[name]) for name in arrays.files if name.startswith("score/")]
        scores = {name: (score, int(horizon_ms)) for (_, name, horizon_ms), score in kept}
        return SeenTrial(path.parent.name, row, trial, views, scores)


def trials_in(folder: Path, motion: str) -> Iterator[SeenTrial]:
    """Yield the trials of a motion that were simulated, in their order."""
    for path in sorted((folder / motion).glob("*.npz")):
        one = read(path)
        if one.trial is not None:
            yield one
