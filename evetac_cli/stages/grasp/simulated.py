"""A grasp in a simulated scene, whose time passes as its slices are read.

What became of it is in the file and in the row (sim/grasp_outcome.py).
"""

import json

import numpy as np

from evetac_cli.jobs import Outcome, Progress, outcome
from evetac_cli.kernels.grip.control import Control
from evetac_cli.params import Grasp
from evetac_cli.sim import grasp_outcome
from evetac_cli.stages.grasp.loop import TrialBuffer, run_grasp
from evetac_cli.stages.grasp.setup import (
    grasp_parameters,
    make_law,
    make_timing,
    model_headers,
    model_path_for,
    open_detector,
)
from evetac_cli.stages.trials import OUTPUT, SimulatedTrial, SolverFigures
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe

METHOD = 5


def make_recipe(trial: SimulatedTrial, params: Grasp) -> Recipe:
    """What determines the recording of a grasp."""
    parameters = grasp_parameters(trial, params, Control(make_law(params), params.control_hz))
    parents = model_headers(model_path_for(params))
    return Recipe(OUTPUT, METHOD, parameters, seed=trial.seed, parents=parents, simulated_source=True)


def run(trial: SimulatedTrial, params: Grasp, *, force: bool, progress: Progress) -> Outcome:
    """Simulate one grasp, and write it with what became of it."""
    model_path, control = model_path_for(params), Control(make_law(params), params.control_hz)
    recipe = make_recipe(trial, params)
    parameters = recipe.parameters
    if up_to_date(trial.output, recipe, force=force):
        return outcome(trial, made=False, simulated=True)
    from evetac_cli.devices.simulated import rig  # builds on numba: only when there is something to simulate

    devices = rig(parameters, trial.seeds(), lift_s=params.lift_s, balance_s=params.balance_s)
    timing = make_timing(params)
    buffer = TrialBuffer()
    try:
        detector = None
        if model_path is not None:
            with StageFile(model_path, "model") as model:
                detector = open_detector(model, devices.camera.sensor, params.tracker)
        slices = run_grasp(
            devices, detector, control, timing, buffer.append, lambda done: progress(done, timing.end_ms)
        )
    finally:
        devices.close()
    arrays = buffer.arrays()
    figures = grasp_outcome.outcome(arrays, parameters["sensor_row"]["mm_per_px"], timing.end_ms)
    arrays |= {"control/outcome": json.dumps(figures), "truth/sampled_parameters": devices.sampled}
    write_stage(trial.output, recipe, {**devices.camera.sensor, **arrays, "t_offset": np.int64(0)})
    slipping = detector.count if detector else 0
    solver = SolverFigures()
    solver.add(arrays)
    figures |= solver.figures(trial.plan["scene"]["solver"])
    return outcome(trial, made=True, simulated=True, slices=slices, slices_with_slip=slipping, **figures)
