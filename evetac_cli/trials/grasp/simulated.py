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
from evetac_cli.sim import grasp_outcome
from evetac_cli.sim.parts import Timer, untimed
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials import live_view
from evetac_cli.trials.grasp.loop import run_grasp
from evetac_cli.trials.grasp.settings import SimulatedGrasp
from evetac_cli.trials.live_view import LiveView, shown_in_real_time
from evetac_cli.trials.trial import OUTPUT, SolverFigures

METHOD = 12


def make_recipe(trial: SimulatedGrasp) -> Recipe:
    """What determines the recording of a grasp."""
    parameters, parents = trial.settings.parameters(trial), trial.settings.parents()
    return Recipe(OUTPUT, METHOD, parameters, seed=trial.seed, parents=parents, simulated_source=True)


def run(trial: SimulatedGrasp, *, force: bool, progress: Progress) -> Outcome:
    """Simulate one grasp, and write it with what became of it."""
    recipe = make_recipe(trial)
    if up_to_date(trial.output, recipe, force=force):
        return outcome(trial, made=False, simulated=True)
    buffer = TrialBuffer()
    with live_view.opened(trial, f"grasp {trial.output.name}", moves=False) as view:
        devices, slipping = play(trial, buffer.append, progress=progress, view=view)
    arrays = buffer.arrays()
    figures = grasp_outcome.outcome(arrays, trial.plan.sensor.mm_per_px, trial.timing.end_ms)
    arrays |= {"control/outcome": json.dumps(figures), "truth/sampled_parameters": devices.sampled}
    write_stage(trial.output, recipe, {**devices.camera.sensor, **arrays, "t_offset": np.int64(0)})
    slices = len(buffer.events)
    solver = SolverFigures()
    solver.add(arrays)
    figures |= solver.figures(trial.plan.scene.solver)
    return outcome(trial, made=True, simulated=True, slices=slices, slices_with_slip=slipping, **figures)


def play(
    trial: SimulatedGrasp,
    append: Callable[[Events, dict[str, Any]], None],
    timer: Timer = untimed,
    *,
    progress: Progress = silent,
    view: LiveView | None = None,
) -> tuple[Rig, int]:
    """Hand over every slice of a grasp and its rows, until it ends or `append` raises.

    timer: measures its parts. Returns its devices, closed, and in how many slices the detector saw slip.
    """
    from evetac_cli.devices.simulated import rig  # builds on numba: only when there is something to simulate

    settings, timing = trial.settings, trial.timing
    devices = rig(trial.plan, trial.seeds(), timer, lift_s=settings.lift_s, balance_s=settings.balance_s)
    try:
        if view is not None:
            view.begin(devices.camera.sensor)
        append = shown_in_real_time(view, append)
        detector = None if settings.detector is None else settings.detector.open(devices.camera.sensor)
        control = settings.control()
        run_grasp(devices, detector, control, timing, append, lambda done: progress(done, timing.end_ms), timer)
    finally:
        devices.close()
    return devices, detector.count if detector else 0
