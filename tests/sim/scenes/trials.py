"""PlanTemplate and trials of scenes that come with evetac, as tests of single parts of a scene need them."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from evetac_cli.evaluate.stability.cases import merge
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.setup.plan import Plan, first_plan

Changes = Mapping[str, Mapping[str, Any]]  # of the tables of a scene, key by key
NONE: Changes = MappingProxyType({})


def quiet_plan(scene_name: str, changes: Changes = NONE) -> Plan:
    """The plan of a smooth object, touched in its middle, off which it swings, before a camera without noise."""
    planned = merge(first_plan(scene_name), {"randomise": {"touch_mm": None}, "roughness": None}, changes)
    return replace(planned, sensor=replace(planned.sensor, noise_hz=0.0, hot_pixels=0))


def grasp_of(planned: Plan, *seed: int, **durations: float) -> GraspSimulation:
    """The trial of a plan; its mechanics and its optics draw from the random streams 0 and 1 of a seed, or of none."""
    return GraspSimulation(planned, *(np.random.default_rng([*seed, part]) for part in range(2)), **durations)
