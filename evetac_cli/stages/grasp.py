"""grasp: detect slip at 1000 Hz and control the gripper at 500 Hz (paper, section VII).

Light contact, lifting, balancing. The detector folds the same kernels over live slices that `track` and `featurize`
fold over a file. It counts slices with slip; the controller asks every 2 ms whether the count has risen.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli import resources
from evetac_cli.devices import Rig
from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.kernels import grip, tracker
from evetac_cli.kernels.detector import Live
from evetac_cli.params import Grasp
from evetac_cli.stages import Job, Outcome, Progress, outcome, silent
from evetac_cli.stages.record import COMMAND_MS, dry_run, seeds, trials
from evetac_cli.stages.train import detector_of
from evetac_cli.store.files import StageFile, up_to_date
from evetac_cli.store.provenance import Header, Recipe
from evetac_cli.store.segments import RecordingWriter

INPUTS = ("model",)
OUTPUT = "recording"
METHOD = 3
__all__ = ["dry_run", "jobs", "run"]  # a grasp shows its plan as a recording does


def jobs(files: list[Path], params: Grasp, out: Path | None) -> list[Job]:
    """One recording for every object and trial."""
    if params.controller == "none" and params.model is not None:
        raise InputError("no detector is used with --controller none", where="--model", found=str(params.model))
    return trials(("lift",), params, out)


def model_of(params: Grasp) -> Path | None:
    """The model file that a grasp feels with: the one named, else the package's; None without a detector."""
    if params.controller == "none":
        return None
    return params.model if params.model is not None else resources.MODEL


@dataclass
class SlipSense:
    """The detector: slices in, slip probability out; the same start/step kernels as in `track` and `featurize`."""

    tracking: tracker.TrackerState
    live: Live
    threshold: float
    count: int = 0  # slices with slip so far: what the controller reads

    @classmethod
    def start(
        cls,
        model: StageFile,
        dot_xy_px: NDArray[np.float64],
        window_px: NDArray[np.int32] | tuple[int, int, int, int] | None,
        constants: tracker.TrackerConstants,
    ) -> "SlipSense":
        """Load a model for a gel whose dots are at rest at (rows, columns, 2); InputError if it is for another grid."""
        if model.read("dot_shape").tolist() != list(dot_xy_px.shape[:2]):
            raise InputError(
                "the model is for another dot grid",
                where=str(model.path),
                expected=str(list(dot_xy_px.shape[:2])),
                found=str(model.read("dot_shape").tolist()),
            )
        rest = dot_xy_px.reshape(-1, 2)
        live = Live(detector_of(model), rest, window_px)
        return cls(tracker.start(rest, constants), live, float(model.read("threshold")))

    def step(self, events: Events) -> float:
        """Slip probability after one more slice; NaN until the history is full."""
        tracker.step(self.tracking, events.x, events.y, events.p)
        probability = self.live.step(
            self.tracking.dot_xy_px, self.tracking.events_per_dot, events.x, events.y, events.p
        )
        self.count += probability >= self.threshold
        return probability


def run(job: Job, params: Grasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Grasp one object in simulation and record everything."""
    model_path = model_of(params)
    sensing = model_path is not None
    parameters: dict[str, Any] = {
        **job.choice["plan"],
        "trial": job.choice["trial"],
        "controller": params.controller,
        "law": asdict(grip.PAPER),
        "tracker": {"preset": params.tracker, "constants": asdict(tracker.PRESETS[params.tracker])}
        if sensing
        else None,
        "lift_s": params.lift_s,
        "balance_s": params.balance_s,
    }
    parents: tuple[Header, ...] = ()
    if model_path is not None:
        with StageFile(model_path, "model") as model:
            parents = (model.header,)
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=parents, simulated_source=True)
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=True)
    from evetac_cli.devices.simulated import rig

    devices = rig(parameters, seeds(params, job), lift_s=params.lift_s, balance_s=params.balance_s)
    sense = None
    if model_path is not None:
        with StageFile(model_path, "model") as model:
            sensor = devices.camera.sensor
            constants = tracker.PRESETS[params.tracker].for_dots(float(sensor["sensor/dot_radius_px"]))
            sense = SlipSense.start(model, sensor["sensor/dot_xy_px"], sensor.get("sensor/window_px"), constants)
    touch_ms = round(1000 * parameters["scene"]["time"]["touch_s"])
    ends_ms = (
        touch_ms,
        touch_ms + round(1000 * params.lift_s),
        touch_ms + round(1000 * (params.lift_s + params.balance_s)),
    )
    writer = RecordingWriter(job.output, {**devices.camera.sensor, "t_offset": np.int64(0)}, discard_leftover=True)
    try:
        slices, slipping = _hold(devices, sense, writer, ends_ms, lambda done: progress(done, ends_ms[-1]))
        writer.finish(recipe, {"truth/drawn": devices.drawn})
    except BaseException:
        writer.discard()
        raise
    finally:
        devices.close()
    return outcome(job, made=True, simulated=True, slices=slices, slices_with_slip=slipping)


def _hold(
    devices: Rig, sense: SlipSense | None, writer: RecordingWriter, ends_ms: tuple[int, ...], progress: Any
) -> tuple[int, int]:
    """Read, sense, and every 2 ms control, until the scene has ended."""
    gripper = devices.gripper
    assert gripper is not None
    state = grip.start()
    seen = slices = 0
    while (events := devices.camera.read()) is not None:
        probability = sense.step(events) if sense else float("nan")
        rows: dict[str, Any] = dict(devices.truth()) if devices.truth else {}
        rows["control/probability"] = probability
        if slices % COMMAND_MS == 0:
            phase = grip.Phase(sum(slices >= end for end in ends_ms[:2]))
            count = sense.count if sense else 0
            reading = gripper.read()
            if sense or phase is grip.Phase.CONTACT:
                goal = grip.step(state, phase, count > seen, reading.position_ticks)
            else:
                goal = reading.position_ticks  # the paper's control experiment: contact alone
            gripper.write_position(goal)
            now_us = devices.clock.now_us()
            rows |= {
                "gripper/t_us": now_us,
                "gripper/current_target_ma": float("nan"),
                "gripper/current_written_ma": 0,
                "gripper/current_ma": reading.current_ma,
                "gripper/position_ticks": reading.position_ticks,
                "control/t_us": now_us,
                "control/u_ff_ticks": state.u_ff,
                "control/x_ref_ticks": state.x_ref,
                "control/goal_ticks": goal,
                "control/slip": count > seen,
                "control/phase": phase,
            }
            seen = count
        writer.append(events, rows)
        slices += 1
        if slices % 100 == 0:
            progress(slices)
    return slices, sense.count if sense else 0
