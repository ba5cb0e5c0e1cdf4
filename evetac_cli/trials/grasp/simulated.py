"""A grasp in a simulated scene, whose time passes as its slices are read.

Its outcome is in the file and in the row (sim/grasp_outcome.py).
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from evetac_cli.devices import Rig
from evetac_cli.events import Events
from evetac_cli.jobs import Outcome, Progress, outcome, silent
from evetac_cli.sim import grasp_outcome
from evetac_cli.sim.setup.parts import Timer, untimed
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials import live_view
from evetac_cli.trials.grasp.loop import TwoFingers, grasp_slices
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector
from evetac_cli.trials.grasp.settings import SimulatedGrasp
from evetac_cli.trials.live_view import LiveView, shown_in_real_time
from evetac_cli.trials.trial import OUTPUT, SolverFigures

METHOD = 13
TRAJECTORY = 32  # length of the trajectory name, as for uuid4
# both simulated cameras have one clock
SAME_CLOCK = {"capture/ended": "the grasp is over", "capture/clock_offset_us": np.float64(0.0)}


def recipes(trial: SimulatedGrasp) -> tuple[Recipe, ...]:
    """Return the recipe of each file of a grasp; the files of two fingers share the name of their trajectory."""
    parameters, parents = trial.settings.parameters(trial), trial.settings.parents()
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=trial.seed, parents=parents, simulated_source=True)
    if trial.second_output is None:
        return (recipe,)
    shared = {**recipe.parameters, "trajectory": recipe.id[:TRAJECTORY]}
    return tuple(replace(recipe, parameters={**shared, "finger": place}) for place in (1, 2))


def are_up_to_date(trial: SimulatedGrasp, *, force: bool) -> bool:
    """Return whether all files of a grasp exist; InputError if an existing file has another recipe."""
    found = [
        up_to_date(output, recipe, force=force) for output, recipe in zip(trial.outputs, recipes(trial), strict=True)
    ]
    return all(found)


def run(trial: SimulatedGrasp, *, force: bool, progress: Progress) -> Outcome:
    """Simulate one grasp, and write it with its outcome."""
    if are_up_to_date(trial, force=force):
        return outcome(trial, made=False, simulated=True)
    recipe, *others = recipes(trial)
    buffer, second = TrialBuffer(), TrialBuffer()
    with live_view.opened(trial, f"grasp {trial.output.name}", moves=False) as view:
        devices, slipping = play(trial, buffer.append, progress=progress, view=view, append_second=second.append)
    second_slip_share = None
    if trial.second_output is not None and devices.second is not None:
        sensor = {**devices.second.camera.sensor, "truth/sampled_parameters": devices.sampled}
        of_second = {**sensor, **second.arrays(), "t_offset": np.int64(0), **SAME_CLOCK}
        second_slip_share = of_second["truth/visible_slip_share"]
        write_stage(trial.second_output, others[0], of_second, force=force)
    arrays = buffer.arrays()
    figures = grasp_outcome.outcome(
        arrays, trial.plan.sensor.mm_per_px, trial.timing.end_ms, second_slip_share=second_slip_share
    )
    arrays |= {"control/outcome": json.dumps(figures), "truth/sampled_parameters": devices.sampled}
    arrays = {**devices.camera.sensor, **arrays, "t_offset": np.int64(0)}
    made = write_stage(trial.output, recipe, arrays, force=force) is not None
    slices = len(buffer.events)
    if trial.second_output is not None:
        figures |= {"second_output": str(trial.second_output)}
    solver = SolverFigures()
    solver.add(arrays)
    figures |= solver.figures(trial.plan.scene.solver)
    return outcome(trial, made=made, simulated=True, slices=slices, slices_with_slip=slipping, **figures)


def play(
    trial: SimulatedGrasp,
    append: Callable[[Events, dict[str, Any]], None],
    timer: Timer = untimed,
    *,
    progress: Progress = silent,
    view: LiveView | None = None,
    append_second: Callable[[Events, Mapping[str, Any]], None] = lambda events, rows: None,
) -> tuple[Rig, int]:
    """Pass every slice of a grasp and its rows to `append`, until the grasp ends or `append` raises.

    timer: measures its parts; append_second: receives the slices of a second finger. Returns the closed devices, and
    the number of slices with detected slip, summed over both fingers.
    """
    from evetac_cli.devices.simulated import rig  # imports numba, so only if there is something to simulate

    settings, timing = trial.settings, trial.timing
    devices = rig(trial.plan, trial.seeds(), timer, lift_s=settings.lift_s, balance_s=settings.balance_s)
    try:
        if view is not None:
            view.begin(devices.camera.sensor)
        append = shown_in_real_time(view, append)
        first = settings.open_detector(devices.camera.sensor)
        detector: OnlineSlipDetector | TwoFingers | None = first
        if devices.second is not None:
            camera, truth = devices.second
            other = settings.open_detector(camera.sensor)
            detector = TwoFingers(first, other, camera, lambda events: append_second(events, truth()))
        slices = grasp_slices(devices, detector, settings.control(), timing, timer)
        for done, (events, rows) in enumerate(slices, start=1):
            append(events, rows)
            if done % 100 == 0:
                progress(done, timing.end_ms)
    finally:
        devices.close()
    return devices, detector.count if detector else 0
