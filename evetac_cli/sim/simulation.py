"""The simulation of a plan, for a scene of any kind."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from evetac_cli.errors import SceneError
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.scenes.pressing import Pressing
from evetac_cli.sim.scenes.rubbing import Rubbing
from evetac_cli.sim.scenes.vibrating import Vibration
from evetac_cli.sim.setup.parts import Timer, untimed
from evetac_cli.sim.setup.plan import Plan

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
