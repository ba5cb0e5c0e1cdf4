"""A grasp in a simulated scene, whose time passes as its slices are read.

What became of it is in the file and in the row (sim/grasp_outcome.py).
"""

import json
from collections.abc import Callable
from typing import Any

import numpy as np

from evetac_cli.devices import Rig
from evetac_cli.events import Events
from evetac_cli.jobs import Outcome, Progress, outcome, silent
from evetac_cli.kernels.grip.control import Control
from evetac_cli.params.grasp import Grasp
from evetac_cli.sim import grasp_outcome
from evetac_cli.stages.grasp.loop import run_grasp
from evetac_cli.stages.grasp.setup import (
    grasp_parameters,
    make_law,
    make_timing,
    model_headers,
    model_path_for,
    open_detector,
    view_of,
)
from evetac_cli.stages.live_view import LiveView, shown_in_real_time
from evetac_cli.stages.trials import OUTPUT, SimulatedTrial, SolverFigures
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.trial_writer import TrialBuffer

METHOD = 8


def make_recipe(trial: SimulatedTrial, params: Grasp) -> Recipe:
    """What determines the recording of a grasp."""
    parameters = grasp_parameters(trial, params, Control(make_law(params), params.control_hz))
    parents = model_headers(model_path_for(params))
    return Recipe(OUTPUT, METHOD, parameters, seed=trial.seed, parents=parents, simulated_source=True)


def run(trial: SimulatedTrial, params: Grasp, *, force: bool, progress: Progress) -> Outcome:
    """Simulate one grasp, and write it with what became of it."""
    recipe = make_recipe(trial, params)
    if up_to_date(trial.output, recipe, force=force):
        return outcome(trial, made=False, simulated=True)
    buffer, timing = TrialBuffer(), make_timing(params, trial.plan)
    with view_of(trial, params) as view:
        devices, slipping = play(trial, buffer.append, params=params, progress=progress, view=view)
    arrays = buffer.arrays()
    figures = grasp_outcome.outcome(arrays, trial.plan.sensor.mm_per_px, timing.end_ms)
    arrays |= {"control/outcome": json.dumps(figures), "truth/sampled_parameters": devices.sampled}
    write_stage(trial.output, recipe, {**devices.camera.sensor, **arrays, "t_offset": np.int64(0)})
    slices = len(buffer.events)
    solver = SolverFigures()
    solver.add(arrays)
    figures |= solver.figures(trial.plan.scene.solver)
    return outcome(trial, made=True, simulated=True, slices=slices, slices_with_slip=slipping, **figures)


def play(
    trial: SimulatedTrial,
    append: Callable[[Events, dict[str, Any]], None],
    *,
    params: Grasp,
    progress: Progress = silent,
    view: LiveView | None = None,
) -> tuple[Rig, int]:
    """Hand over every slice of a grasp and its rows, until it ends or `append` raises.

    Returns its devices, closed, and in how many slices the detector saw slip.
    """
    from evetac_cli.devices.simulated import rig  # builds on numba: only when there is something to simulate

    model_path, control, timing = (
        model_path_for(params),
        Control(make_law(params), params.control_hz),
        make_timing(params, trial.plan),
    )
    devices = rig(trial.plan, trial.seeds(), lift_s=params.lift_s, balance_s=params.balance_s)
    try:
        if view is not None:
            view.begin(devices.camera.sensor)
        append = shown_in_real_time(view, append)
        detector = None
        if model_path is not None:
            with StageFile(model_path, "model") as model:
                detector = open_detector(model, devices.camera.sensor, params.tracker, params.slip_threshold)
        run_grasp(devices, detector, control, timing, append, lambda done: progress(done, timing.end_ms))
    finally:
        devices.close()
    return devices, detector.count if detector else 0
