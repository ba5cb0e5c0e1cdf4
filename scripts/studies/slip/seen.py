"""Run several slip detectors at once on a trial seen through the camera and the tracker `stable`.

The tracker runs once instead of once per detector. The probabilities equal those of `track`, `featurize` and a report.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from evetac_cli.arrays import Floats, Singles
from evetac_cli.evaluate.slip.models import Model
from evetac_cli.events import Events
from evetac_cli.kernels.slip import features, inputs
from evetac_cli.kernels.slip.architectures import Architecture, DotArchitecture, sensitivity_of
from evetac_cli.kernels.slip.detector import over_each
from evetac_cli.kernels.slip.inputs import DotsAndExtras
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.kernels.tracking.tracker import TrackerState
from evetac_cli.stages.touch.touch_fold import StickingShare
from scripts.studies import motions
from scripts.studies.motions import Planned, Trial
from scripts.studies.slip.trials import Scores

TRACKER = "stable"
UNKNOWN = float("nan")


class Seen:
    """Tracks, events, gripper and sticking share of a trial, slice by slice; pass `see` to `motions.played`."""

    def __init__(self, *, sticks: bool) -> None:
        """Start before the first slice; sticks: whether the sticking share is estimated."""
        self.sensor: Mapping[str, Any] = {}
        self.rest_px: Floats = np.empty((0, 2))
        self._dot_px: list[Singles] = []
        self._events: list[Any] = []
        self._gripper: list[tuple[float, float, float, float]] = []  # time in us, position, goal in ticks, goal in mA
        self._share: list[float] = []
        self._sticks = sticks
        self._tracking: TrackerState | None = None
        self._sticking: StickingShare | None = None

    def see(self, sensor: Mapping[str, Any], events: Events, row: Mapping[str, Any]) -> None:
        """Add one more slice."""
        if self._tracking is None:
            self.sensor = sensor
            self.rest_px = np.asarray(sensor["sensor/dot_xy_px"], np.float64).reshape(-1, 2)
            contrast = sensitivity_of(sensor).contrast_over_threshold
            constants = PRESETS[TRACKER].for_dots(float(sensor["sensor/dot_radius_px"]), contrast)
            self._tracking = tracker.start(self.rest_px, constants)
            self._sticking = StickingShare(self.rest_px, sensor["sensor/frame_px"]) if self._sticks else None
        state = self._tracking
        tracker.step(state, events.x, events.y, events.p)
        # a slice uses the sticking share of the slice before
        self._share.append(UNKNOWN if self._sticking is None else self._sticking.share)
        if self._sticking is not None:
            self._sticking.step(state.dot_xy_px, state.lost)
        self._dot_px.append(state.dot_xy_px.astype(np.float32))
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

    def extras(self) -> Singles:
        """The inputs that are not from dots, (slices, extras)."""
        slices = len(self._dot_px)
        share = np.array(self._share, np.float32)
        if not self._gripper:
            return inputs.extra_columns(slices, sticking_share=share)
        t_us, *values = (np.array(column) for column in zip(*self._gripper, strict=True))
        known = [inputs.known_at_start(t_us.astype(np.int64), column, slices) for column in values]
        return inputs.extra_columns(slices, *known, share)

    def probabilities(self, models: Mapping[str, Model]) -> dict[str, tuple[Singles, int]]:
        """Return the probabilities of each model by name, with its horizon in ms."""
        dot_px, events = self.dot_px, np.array(self._events)
        moved, moved_xy = features.displacement(dot_px, self.rest_px), features.displacement_xy(dot_px, self.rest_px)
        estimated, sensitivity = self.extras(), sensitivity_of(self.sensor)
        alike: dict[Architecture, list[str]] = {}  # models with the same inputs
        for name, model in models.items():
            alike.setdefault(model.architecture, []).append(name)
        said = {}
        for architecture, names in alike.items():
            if not isinstance(architecture, DotArchitecture):
                raise TypeError(f"{names[0]}: expected a network over dots, found {architecture.name}")
            series = features.series(moved, events, moved_xy, architecture.factors(sensitivity))
            detectors = [models[name].detector() for name in names]
            found = over_each(detectors, DotsAndExtras(series, estimated))
            said |= {name: (one, models[name].horizon_ms) for name, one in zip(names, found, strict=True)}
        return {name: said[name] for name in models}


def seen(planned: Planned, seed: int, models: Mapping[str, Model]) -> tuple[Trial, Scores]:
    """Simulate a trial with a camera; return it and each model's probabilities."""
    sticks = any(
        view.extra == "sticking"
        for model in models.values()
        if isinstance(model.architecture, DotArchitecture)
        for view in model.architecture.extras
    )
    eye = Seen(sticks=sticks)
    trial = motions.played(planned, seed, eye.see)
    return trial, eye.probabilities(models)
