"""A grasp on a recording: the decisions of detector and controller, slice by slice; nothing moves.

For a grasp with two fingers, both recordings are given, the first finger's first. The decisions are written together
with the events of the first finger.

The gripper has the positions in the recording, if any, and no command moves it. Time is the recording's: every slice is
evaluated and every step made, however long they take, so that the same recording gives the same decisions.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from evetac_cli.devices import EventCamera, GripperReading, Rig
from evetac_cli.devices.cameras import ReplayCamera
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX, Events
from evetac_cli.jobs import Outcome, Progress, outcome
from evetac_cli.sim.setup.plan import read_plan
from evetac_cli.stages import row_blocks
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import Recording, open_recording
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials.grasp.loop import TwoFingers, grasp_slices
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector
from evetac_cli.trials.grasp.settings import GraspSettings, ReplayGrasp
from evetac_cli.trials.trial import OUTPUT, DeviceTrial

METHOD = 3
OFFSET = "capture/clock_offset_us"


class RecordedGripper:
    """A gripper with the positions of a recording, at the time of the camera; commands have no effect."""

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
        """Return the last reading before now; zeros if there was none."""
        at = max(int(np.searchsorted(self._t_us, self._camera.now_us(), side="right")) - 1, 0)
        return GripperReading(float(self._current_ma[at]), int(self._ticks[at]))

    def write_current(self, current_ma: int) -> None:
        """Do nothing: the finger's positions are recorded."""

    def write_position(self, goal_ticks: int) -> None:
        """Do nothing: the finger's positions are recorded."""

    def emergency_open(self) -> None:
        """Do nothing: the finger's positions are recorded."""

    def close(self) -> None:
        """Do nothing: the caller closes the recording."""


def grasp_of(trial: DeviceTrial, files: tuple[Path, ...], settings: GraspSettings, touch_s: float) -> ReplayGrasp:
    """Return the grasp on the recordings of one or two fingers; InputError if one cannot be read.

    Its phases are those of the recording, if it is a grasp, otherwise those of the flags after a touch of `touch_s`.
    """
    with open_recording(files[0]) as recording:
        parameters = recording.header["parameters"]
        if len(files) > 1:
            _refuse_another_grasp(recording, files[1])
    timing = settings.timing(touch_s)
    if {"scene", "lift_s", "balance_s"} <= set(parameters):
        touch_s = read_plan(parameters, str(files[0])).scene.time.touch_s
        timing = settings.timing(touch_s, parameters["lift_s"], parameters["balance_s"])
    return ReplayGrasp(files, trial.output, trial.number, trial.seed, None, trial.cameras[0], settings, timing)


def _refuse_another_grasp(first: Recording, path: Path) -> None:
    """Raise InputError unless these are the first and the second finger of one grasp, according to their headers."""
    with open_recording(path) as second:
        both = first.header["parameters"].get("trajectory"), second.header["parameters"].get("trajectory")
        if both[0] != both[1]:
            expected = f"the trajectory of {first.path}, {both[0]}"
            raise InputError(
                "the recordings are of different grasps", where=str(path), expected=expected, found=str(both[1])
            )
        if first.has(OFFSET) or not second.has(OFFSET):
            expected = "replay:FIRST,replay:SECOND; SECOND stores the offset of its clock from FIRST"
            found = f"{OFFSET} in {first.path if first.has(OFFSET) else 'neither'}"
            raise InputError("the first finger cannot be identified", where="--camera", expected=expected, found=found)


def check(trial: ReplayGrasp, *, force: bool) -> None:
    """Raise InputError for everything that a run would refuse; only files are read."""
    with _opened(trial) as recordings:
        if not up_to_date(trial.output, _recipe(trial, recordings), force=force):
            for recording in recordings:
                _refuse_unknown_dots(trial, recording)


@contextmanager
def _opened(trial: ReplayGrasp) -> Iterator[list[Recording]]:
    """Yield the recordings of the fingers, open within the block."""
    with ExitStack() as opened:
        yield [opened.enter_context(open_recording(path)) for path in trial.inputs]


def _recipe(trial: ReplayGrasp, recordings: Sequence[Recording]) -> Recipe:
    timing = trial.timing
    parameters = {
        **trial.settings.parameters(trial),
        "replayed": True,
        "phases_ms": [timing.touch_ms, timing.lift_ms, timing.balance_ms],
    }
    frames_px = [list(recording.frame_px) for recording in recordings]
    if trial.settings.detector is not None and any(tuple(one) != FRAME_PX for one in frames_px):  # it depends on them
        parameters["frames_px"] = frames_px
    headers = (recording.header for recording in recordings)
    return Recipe(OUTPUT, METHOD, parameters, parents=(*trial.settings.parents(), *headers))


def _refuse_unknown_dots(trial: ReplayGrasp, recording: Recording) -> None:
    if trial.settings.detector is None:
        return
    if recording.dot_xy_px is None:
        raise InputError(
            "the recording has no dot grid", where=str(recording.path), hint=f"{MAKE_GRID} to evetac record"
        )
    trial.settings.detector.require_dots(recording.dot_xy_px)


def run(trial: ReplayGrasp, *, force: bool, progress: Progress) -> Outcome:
    """Detect slip and decide on a recording, and write events and decisions."""
    settings = trial.settings
    with _opened(trial) as recordings, ExitStack() as opened:
        recipe = _recipe(trial, recordings)
        if up_to_date(trial.output, recipe, force=force):
            return outcome(trial, made=False, simulated=recipe.simulated)
        for each in recordings:
            _refuse_unknown_dots(trial, each)
        recording, *others = recordings
        sensor = {**recording.sensor_datasets(), "t_offset": recording.read("t_offset")}
        first_detector = settings.open_detector(sensor)
        detector: OnlineSlipDetector | TwoFingers | None = first_detector
        slices = len(recording)
        if not slices:
            raise InputError("the recording has no slices", where=str(trial.inputs[0]))
        camera = ReplayCamera(trial.inputs[0])
        devices = Rig(camera, RecordedGripper(recording, camera))
        if others:
            second = ReplayCamera(trial.inputs[1])
            opened.callback(second.close)
            other = settings.open_detector(others[0].sensor_datasets())
            detector = TwoFingers(first_detector, other, second, clock_offset_us=float(others[0].read(OFFSET)))
        steps = steps_with_slip = 0

        def blocks() -> Iterator[dict[str, Any]]:
            """Yield the decisions in blocks of slices, so that an hour takes no more memory than a minute."""
            nonlocal steps, steps_with_slip
            happening = grasp_slices(devices, detector, settings.control(), trial.timing)
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
        lengths |= dict.fromkeys(("control/probability", *(["control/second_probability"] if others else [])), slices)
        try:
            arrays = {**sensor, "ms_to_idx": recording.starts}
            made = write_stage(trial.output, recipe, arrays, blocks(), lengths, force=force) is not None
        finally:
            devices.close()
    return outcome(
        trial,
        made=made,
        simulated=recipe.simulated,
        slices=slices,
        slices_with_slip=detector.count if detector is not None else 0,
        steps=steps,
        steps_with_slip=steps_with_slip,
    )
