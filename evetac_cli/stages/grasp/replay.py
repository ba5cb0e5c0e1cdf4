"""A grasp on a recording: what detector and controller would have decided, slice by slice; nothing moves.

The gripper is where the recording says it was, if it says so, and no command moves it. Time is the recording's: every
slice is evaluated and every step made, however long they take, so that the same recording gives the same decisions.
"""

from collections.abc import Iterator, Mapping
from itertools import islice
from types import MappingProxyType
from typing import Any

import numpy as np

from evetac_cli.devices import EventCamera, GripperReading, Rig
from evetac_cli.devices.replay import ReplayCamera
from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.jobs import Outcome, Progress, outcome
from evetac_cli.kernels.grip.control import Control
from evetac_cli.params.grasp import Grasp
from evetac_cli.stages import row_blocks
from evetac_cli.stages.grasp import setup
from evetac_cli.stages.grasp.loop import Timing, grasp_slices
from evetac_cli.stages.grasp.online_detector import dots_for
from evetac_cli.stages.trials import OUTPUT, ReplayTrial
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.read import Recording, open_recording
from evetac_cli.store.trial_writer import TrialBuffer

METHOD = 2


class RecordedGripper:
    """A gripper that was where a recording says, at the time of the camera; commands have no effect."""

    counted: Mapping[str, int] = MappingProxyType({})
    release_words = ""

    def __init__(self, recording: Recording, camera: EventCamera) -> None:
        self._camera = camera
        self._t_us = np.zeros(1, np.int64)
        self._ticks, self._current_ma = np.zeros(1, np.int32), np.zeros(1, np.float32)
        if recording.has("gripper") and recording.length("gripper/t_us"):
            self._t_us = recording.read("gripper/t_us")
            self._ticks = recording.read("gripper/position_ticks")
            self._current_ma = recording.read("gripper/current_ma")

    def read(self) -> GripperReading:
        """The last reading before now; zeros if there was none."""
        at = max(int(np.searchsorted(self._t_us, self._camera.now_us(), side="right")) - 1, 0)
        return GripperReading(float(self._current_ma[at]), int(self._ticks[at]))

    def write_current(self, current_ma: int) -> None:
        """Without effect: the finger is where it was recorded."""

    def write_position(self, goal_ticks: int) -> None:
        """Without effect: the finger is where it was recorded."""

    def emergency_open(self) -> None:
        """Without effect: the finger is where it was recorded."""

    def close(self) -> None:
        """Without effect: the recording belongs to whoever opened it."""


def check(trial: ReplayTrial, params: Grasp, *, force: bool) -> None:
    """InputError for what a run would refuse; only files are read."""
    with open_recording(trial.inputs[0]) as recording:
        timing = setup.recorded_timing(params, recording)
        control = Control(setup.make_law(params), params.control_hz)
        if not up_to_date(trial.output, _recipe(trial, params, recording, timing, control), force=force):
            _refuse_unknown_dots(params, recording)


def _recipe(trial: ReplayTrial, params: Grasp, recording: Recording, timing: Timing, control: Control) -> Recipe:
    parameters = {
        **setup.grasp_parameters(trial, params, control),
        "replayed": True,
        "phases_ms": [timing.touch_ms, timing.lift_ms, timing.balance_ms],
    }
    parents = (*setup.model_headers(setup.model_path_for(params)), recording.header)
    return Recipe(OUTPUT, METHOD, parameters, parents=parents)


def _refuse_unknown_dots(params: Grasp, recording: Recording) -> None:
    model_path, dot_xy_px = setup.model_path_for(params), recording.dot_xy_px
    if model_path is None:
        return
    if dot_xy_px is None:
        raise InputError(
            "the recording has no dot grid", where=str(recording.path), hint=f"{MAKE_GRID} to evetac record"
        )
    with StageFile(model_path, "model") as model:
        dots_for(model, dot_xy_px)


def run(trial: ReplayTrial, params: Grasp, *, force: bool, progress: Progress) -> Outcome:
    """Detect slip and decide on a recording, and write events and decisions."""
    model_path, control = setup.model_path_for(params), Control(setup.make_law(params), params.control_hz)
    with open_recording(trial.inputs[0]) as recording:
        timing = setup.recorded_timing(params, recording)
        recipe = _recipe(trial, params, recording, timing, control)
        if up_to_date(trial.output, recipe, force=force):
            return outcome(trial, made=False, simulated=recipe.simulated)
        _refuse_unknown_dots(params, recording)
        sensor = {**recording.sensor_datasets(), "t_offset": recording.read("t_offset")}
        detector = None
        if model_path is not None:
            with StageFile(model_path, "model") as model:
                detector = setup.open_detector(model, sensor, params.tracker, params.slip_threshold)
        slices = len(recording)
        if not slices:
            raise InputError("there is not a single slice", where=str(trial.inputs[0]))
        camera = ReplayCamera(trial.inputs[0])
        devices = Rig(camera, RecordedGripper(recording, camera))
        steps = steps_with_slip = 0

        def blocks() -> Iterator[dict[str, Any]]:
            """What happened, in blocks of slices: an hour takes no more memory than a minute."""
            nonlocal steps, steps_with_slip
            happening = grasp_slices(devices, detector, control, timing)
            for first, stop in row_blocks(slices):
                buffer = TrialBuffer()
                for index, (events, rows) in enumerate(islice(happening, stop - first), first):
                    buffer.append(events, rows)
                    if index % 100 == 0:
                        progress(index, slices)
                block = buffer.columns()
                slips = block.get("control/slip", np.empty(0, np.uint8))
                steps, steps_with_slip = steps + len(slips), steps_with_slip + int(slips.sum())
                yield block

        lengths = dict.fromkeys((f"events/{column}" for column in Events._fields), recording.event_count)
        lengths["control/probability"] = slices
        try:
            write_stage(trial.output, recipe, {**sensor, "ms_to_idx": recording.starts}, blocks(), lengths)
        finally:
            devices.close()
    return outcome(
        trial,
        made=True,
        simulated=recipe.simulated,
        slices=slices,
        slices_with_slip=detector.count if detector is not None else 0,
        steps=steps,
        steps_with_slip=steps_with_slip,
    )
