"""grasp: detect slip at 1000 Hz and control the gripper at 500 Hz (paper, section VII).

Light contact, lifting, balancing. The detector folds the same kernels over live slices that `track` and `featurize`
fold over a file (online_detector.py). It counts slices with slip; the controller asks every 2 ms whether the count has risen
(control.py, loop.py). What became of it is in the file and in the row (grasp_outcome.py).
"""

import json
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.kernels.grip import control as grip_control
from evetac_cli.kernels.grip.control import Control
from evetac_cli.params import Grasp
from evetac_cli.sim import grasp_outcome
from evetac_cli.stages import record
from evetac_cli.stages.grasp.loop import TrialBuffer, run_grasp
from evetac_cli.stages.grasp.setup import (
    grasp_parameters,
    make_law,
    make_timing,
    model_headers,
    model_path_for,
    open_detector,
)
from evetac_cli.stages.record import seeds, trials
from evetac_cli.stages.unused_options import refuse_unused_options
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe

OUTPUT = "recording"
METHOD = 4


def jobs(files: list[Path], params: Grasp, out: Path | None) -> list[Job]:
    """One recording for every object and trial."""
    refuse_unused_options(params)
    law = make_law(params)
    if not grip_control.uses_detector(law) and params.model is not None:
        raise InputError(
            f"no detector is used with --controller {params.controller}", where="--model", found=str(params.model)
        )
    if (params.camera, params.gripper) not in (("sim", None), ("sim", "sim")):
        from evetac_cli.stages.grasp import live  # with all that belongs to devices

        return live.jobs(params, out)
    found = trials(("lift",), params, out)
    make_timing(params, found[0].choice["plan"]["scene"])  # refuses a rate that cannot be kept
    return found


def dry_run(jobs: list[Job], params: Grasp, *, force: bool = False) -> Outcome:
    """What would be built or done, and what that costs; refused what a run refuses."""
    if params.camera != "sim":
        from evetac_cli.stages.grasp import live

        return live.dry_run(jobs, params, force=force)
    for job in jobs:
        up_to_date(job.output, _recipe(job, params), force=force)
    return record.what_is_built(jobs, params)


def _recipe(job: Job, params: Grasp) -> Recipe:
    parameters = grasp_parameters(job, params, Control(make_law(params), params.control_hz))
    parents = model_headers(model_path_for(params))
    return Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=parents, simulated_source=True)


def run(job: Job, params: Grasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Grasp one object and record everything: in simulation, or in real time (grasp_live)."""
    if params.camera != "sim":
        from evetac_cli.stages.grasp import live

        return live.run(job, params, seeds(params, job), force=force, progress=progress)
    model_path, control = model_path_for(params), Control(make_law(params), params.control_hz)
    recipe = _recipe(job, params)
    parameters = recipe.parameters
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=True)
    from evetac_cli.devices.simulated import rig

    devices = rig(parameters, seeds(params, job), lift_s=params.lift_s, balance_s=params.balance_s)
    timing = make_timing(params, parameters["scene"])
    kept = TrialBuffer()
    try:
        sense = None
        if model_path is not None:
            with StageFile(model_path, "model") as model:
                sense = open_detector(model, devices.camera.sensor, params.tracker)
        slices = run_grasp(devices, sense, control, timing, kept.append, lambda done: progress(done, timing.end_ms))
    finally:
        devices.close()
    arrays = kept.arrays()
    figures = grasp_outcome.outcome(arrays, parameters["sensor_row"]["mm_per_px"], timing.end_ms)
    told = {"control/outcome": json.dumps(figures), "truth/sampled_parameters": devices.drawn, "t_offset": np.int64(0)}
    write_stage(job.output, recipe, {**devices.camera.sensor, **arrays, **told})
    slipping = sense.count if sense else 0
    return outcome(job, made=True, simulated=True, slices=slices, slices_with_slip=slipping, **figures)
