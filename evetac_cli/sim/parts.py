"""The parts of a simulated scene, in the order in which they are listed for users, and the simulation of a plan."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from evetac_cli.errors import SceneError
from evetac_cli.sim.camera import camera_parts
from evetac_cli.sim.scenes import finger_drive, gel_view, held_object, pads, shared
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.scenes.pressing import Pressing
from evetac_cli.sim.scenes.rubbing import Rubbing
from evetac_cli.sim.scenes.vibrating import Vibration
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.scene_part import ScenePart, Timer, untimed

MODULES = (shared, finger_drive, pads, held_object, gel_view, camera_parts)
# All parts that these modules define; those in the camera come last.
PARTS: tuple[type[ScenePart], ...] = tuple(
    part
    for module in MODULES
    for part in vars(module).values()
    if isinstance(part, type) and issubclass(part, ScenePart) and part.__module__ == module.__name__ and part.NAME
)


def rows_of(plan: Plan) -> list[dict[str, Any]]:
    """Return a row per part: the values that describe it if the plan has it, None if it is left out."""
    return [{"part": part.NAME, "built": part.describe(plan)} for part in PARTS]


def switched(plan: Plan) -> dict[str, Plan]:
    """Return, by part, the plan with which the cost of that part is measured: the same plan with the part switched."""
    plans = {part.NAME: part.switched(plan) for part in PARTS}
    return {name: other for name, other in plans.items() if other is not None}


# Kinds of scene without a gripper.
DRIVEN: dict[str, type[Pressing] | type[Vibration]] = {"press": Pressing, "rub": Rubbing, "tone": Vibration}

Simulation = GraspSimulation | Pressing | Vibration


def simulation_of(
    plan: Plan, seeds: np.random.SeedSequence, timer: Timer = untimed, /, **durations: float
) -> Simulation:
    """Build the parts that a plan names; mechanics and optics have separate random streams.

    timer: measures the parts. durations: lift_s and balance_s of a scene in which an object is lifted. SceneError if
    the plan cannot be simulated.
    """
    mechanics, optics = (np.random.default_rng(seed) for seed in seeds.spawn(2))
    second = None if plan.second is None else np.random.default_rng(seeds.spawn(1)[0])
    driven = DRIVEN.get(plan.scene.kind)
    with scene_in_words(plan.scene.name):
        if driven is not None:
            return driven(plan, mechanics, optics, timer=timer)
        return GraspSimulation(plan, mechanics, optics, timer=timer, second_optics_rng=second, **durations)


@contextmanager
def scene_in_words(scene: str) -> Iterator[None]:
    """Report errors of the kernels as errors of the scene: each value is in range, but not all values go together."""
    try:
        yield
    except (ValueError, ZeroDivisionError, OverflowError) as error:
        raise SceneError(f"cannot be simulated: {error}", where=f"scene {scene}") from error
