"""Choose the gel's grid of a grasp for which neither a flag nor its scene states the pitch of the nodes.

It is the coarsest that resolves the slip of the object, so that the onset of slip does not depend on it. The choice
follows from the trial's plan and seeds alone, before anything is simulated. A trial with virtual devices keeps the
usual grid, because it has to run in real time.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from evetac_cli.errors import SceneError
from evetac_cli.store.recordings.slip_grid import FEWEST_NODES, resolving_mm
from evetac_cli.trials.trial import SimulatedTrial

GRIP = 2.5  # margin: normal force over the slip limit at which slip is resolved; objects also slip in too tight a grip
FINEST_MM = 0.5  # finest pitch that is chosen


def nodes_of_slip(trial: SimulatedTrial, grip: float = 1.0) -> float:
    """Return half the shortest wavelength of unstable slip, in grid nodes; infinity if slip is stable.

    grip: normal force over the slip limit. SceneError if the trial cannot be simulated.
    """
    from evetac_cli.sim.scenes.building import simulation_of  # imports numba
    from evetac_cli.sim.scenes.gripped import GraspSimulation

    simulation = simulation_of(trial.plan, trial.seeds())
    return simulation.pads.nodes_of_slip(grip) if isinstance(simulation, GraspSimulation) else math.inf


def chosen(trial: SimulatedTrial) -> SimulatedTrial:
    """Return the trial on the coarsest grid that resolves the slip of its object with the margin GRIP.

    The grid is not coarser than the scene's, nor finer than FINEST_MM; the finest may do without the margin. The trial
    itself if its own grid resolves the slip, or if none does.
    """
    usual_mm = trial.plan.scene.solver.node_pitch_mm
    pitch_mm, finer = usual_mm, trial
    try:
        while (nodes := nodes_of_slip(finer, GRIP)) < FEWEST_NODES:
            if pitch_mm <= FINEST_MM:
                return finer if nodes_of_slip(finer) >= FEWEST_NODES else trial
            pitch_mm = max(resolving_mm(nodes, pitch_mm), FINEST_MM)
            scene = trial.plan.scene
            scene = replace(scene, solver=replace(scene.solver, node_pitch_mm=pitch_mm))
            finer = replace(trial, plan=replace(trial.plan, scene=scene), usual_pitch_mm=usual_mm)
    except SceneError:  # reported when the trial is run
        return trial
    return finer


def notes(trials: Sequence[SimulatedTrial]) -> list[str]:
    """Return a sentence on the grids that were chosen; none if all trials have their scene's."""
    finer = [trial for trial in trials if trial.usual_pitch_mm is not None]
    if not finer:
        return []
    pitches_mm = sorted({trial.plan.scene.solver.node_pitch_mm for trial in finer})
    span = " to ".join(f"{pitch_mm:.2f}" for pitch_mm in dict.fromkeys((pitches_mm[0], pitches_mm[-1])))
    objects = list(dict.fromkeys(str(trial.plan.object_name) for trial in finer))
    which = f"object{'s' if len(objects) > 1 else ''} {', '.join(objects)}"
    which += f", {len(finer)} of {len(trials)} trials" if len(trials) > 1 else ""
    usual = f"default {finer[0].usual_pitch_mm:g}"
    resolved = "slip resolved" + ", unless the grip is tight" * (pitches_mm[0] <= FINEST_MM)
    return [f"gel grid {span} mm for {which} ({usual}): {resolved}"]
