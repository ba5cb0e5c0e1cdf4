"""Extreme scenes: each is one that the schema knows, so that no key is left out without a word, and another plan."""

import json

import jsonschema
import pytest

from evetac_cli.numerics.extreme_scenes import LIFTS, MORE_LIFTS, SLIP_SOON, SLIPS, merge
from evetac_cli.resources import schemas
from evetac_cli.sim import scene

ALL = [("slip", name, SLIPS[name]) for name in SLIPS] + [
    ("lift", name, tables) for name, tables in (LIFTS | MORE_LIFTS).items()
]


@pytest.mark.parametrize(("base", "name", "tables"), ALL, ids=[f"{base}: {name}" for base, name, _ in ALL])
def test_an_extreme_scene_is_a_scene(base, name, tables):
    """Assert that the merged scene is valid, and differs from the scene unless it is the usual one."""
    plan = {"scene": scene.load(base)}
    changed = merge(plan, SLIP_SOON, tables) if base == "slip" else merge(plan, tables)
    jsonschema.validate(changed["scene"], json.loads((schemas() / "scene.v1.json").read_text()))
    assert (merge(plan, tables) == plan) == (name == "as usual")


def test_scenes_are_merged_into_the_plan():
    """Assert that a table's keys come beside or instead of the scene's own, and that the plan given stays as it was."""
    plan = {"scene": {"gripper": {"a": 1, "b": 2}}, "object": 3}
    merged = merge(plan, {"gripper": {"b": 5}}, {"light": {"c": 4}})
    assert merged == {"scene": {"gripper": {"a": 1, "b": 5}, "light": {"c": 4}}, "object": 3}
    assert plan == {"scene": {"gripper": {"a": 1, "b": 2}}, "object": 3}
