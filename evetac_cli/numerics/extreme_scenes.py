"""Scenes with one extreme or unpleasant part, a line each: tables that `evaluate stability` merges into a scene."""

from collections.abc import Mapping
from typing import Any

Plan = dict[str, Any]
Tables = Mapping[str, Mapping[str, Any]]

# Into the scene `slip`, which the dot tracker follows: the weight is handed over from 0.2 to 0.5 s, and the current
# falls from 0.9 s on until the object slips. The grip is near its limit from the start, so that this comes soon.
SLIP_SOON: Tables = {"time": {"longest_s": 2.0}, "gripper": {"start_factor": [1.3, 1.5]}}
SLIPS: dict[str, Tables] = {
    "as usual": {},
}

# Into the scene `lift`: the fingers touch until 1.5 s, the hand rises from 2 s on, balance begins at 5 s.
LIFTS: dict[str, Tables] = {
    "gear friction x0.7": {"gripper": {"friction_factor": [0.7, 0.7]}},
    "gear friction x0.85": {"gripper": {"friction_factor": [0.85, 0.85]}},
    "gear friction x1.15": {"gripper": {"friction_factor": [1.15, 1.15]}},
    "gear friction x1.3": {"gripper": {"friction_factor": [1.3, 1.3]}},
}


def merge(plan: Plan, *changes: Tables) -> Plan:
    """A plan whose scene has these tables beside or instead of its own; neither is changed."""
    scene = dict(plan["scene"])
    for tables in changes:
        for name, table in tables.items():
            scene[name] = {**scene.get(name, {}), **table}
    return {**plan, "scene": scene}
