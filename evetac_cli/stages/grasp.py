"""grasp: detect slip at 1000 Hz and control the gripper at 500 Hz (paper, section VII).

Light contact, lifting, balancing. The detector folds the same kernels over live slices that `track` and `featurize`
fold over a file (slip_sense.py). It counts slices with slip; the controller asks every 2 ms whether the count has risen
(grip_control.py, grasp_loop.py). What became of it is in the file and in the row (grasp_outcome.py).
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli import resources
from evetac_cli.devices import Rig
from evetac_cli.errors import InputError
from evetac_cli.kernels import grip_control, tracker
from evetac_cli.kernels.grip_control import Control
from evetac_cli.params import Grasp
from evetac_cli.sim import grasp_outcome
from evetac_cli.stages import Job, Outcome, Progress, outcome, silent
from evetac_cli.stages.grasp_loop import SLICES_S, Kept, Timing, hold
from evetac_cli.stages.record import dry_run, seeds, trials
from evetac_cli.stages.slip_sense import SlipSense
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Header, Recipe

INPUTS = ("model",)
OUTPUT = "recording"
METHOD = 4
__all__ = ["SlipSense", "dry_run", "jobs", "run"]  # a grasp shows its plan as a recording does


def jobs(files: list[Path], params: Grasp, out: Path | None) -> list[Job]:
    """One recording for every object and trial."""
    law = law_of(params)
    if not grip_control.feels(law) and params.model is not None:
        raise InputError(
            f"no detector is used with --controller {params.controller}", where="--model", found=str(params.model)
        )
    found = trials(("lift",), params, out)
    timing_of(params, found[0].choice["plan"]["scene"]).every_ms  # noqa: B018 - refuses a rate that cannot be kept
    return found


def law_of(params: Grasp) -> Any:
    """The controller's law; InputError if there is none of that name, or none with that gain."""
    try:
        return grip_control.law_of(params.controller, params.gain)
    except ValueError as error:
        where = "--controller" if params.gain == 1.0 else "--controller, --gain"
        raise InputError("unknown value", where=where, expected=str(error).removeprefix("expected ")) from None


def model_of(params: Grasp) -> Path | None:
    """The model file that a grasp feels with: the one named, else the package's; None without a detector."""
    if not grip_control.feels(law_of(params)):
        return None
    return params.model if params.model is not None else resources.MODEL


def timing_of(params: Grasp, scene: dict[str, Any]) -> Timing:
    """When the phases of a scene end, and how the controller is timed."""
    touch_ms, lift_ms, balance_ms = (
        round(SLICES_S * seconds) for seconds in (scene["time"]["touch_s"], params.lift_s, params.balance_s)
    )
    return Timing(touch_ms, lift_ms, balance_ms, params.control_hz, params.latency_ms)


def sense_of(model: StageFile, devices: Rig, preset: str) -> SlipSense:
    """The detector of a model, for the sensor of these devices."""
    sensor = devices.camera.sensor
    constants = tracker.PRESETS[preset].for_dots(float(sensor["sensor/dot_radius_px"]))
    return SlipSense.start(model, sensor["sensor/dot_xy_px"], sensor.get("sensor/window_px"), constants)


def run(job: Job, params: Grasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Grasp one object in simulation and record everything."""
    model_path, law = model_of(params), law_of(params)
    control = Control(law, params.control_hz)
    feeling = {"preset": params.tracker, "constants": asdict(tracker.PRESETS[params.tracker])}
    parameters: dict[str, Any] = {
        **job.choice["plan"],
        "trial": job.choice["trial"],
        "controller": params.controller,
        "gain": params.gain,
        "law": control.parameters(),
        "latency_ms": params.latency_ms,
        "control_hz": params.control_hz,
        "tracker": None if model_path is None else feeling,
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
    timing = timing_of(params, parameters["scene"])
    kept = Kept()
    try:
        sense = None
        if model_path is not None:
            with StageFile(model_path, "model") as model:
                sense = sense_of(model, devices, params.tracker)
        slices = hold(devices, sense, control, timing, kept.append, lambda done: progress(done, timing.end_ms))
    finally:
        devices.close()
    arrays = kept.arrays()
    figures = grasp_outcome.outcome(arrays, parameters["individual_row"]["mm_per_px"], timing.end_ms)
    told = {"control/outcome": json.dumps(figures), "truth/drawn": devices.drawn, "t_offset": np.int64(0)}
    write_stage(job.output, recipe, {**devices.camera.sensor, **arrays, **told})
    slipping = sense.count if sense else 0
    return outcome(job, made=True, simulated=True, slices=slices, slices_with_slip=slipping, **figures)
