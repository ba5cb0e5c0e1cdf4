"""Extreme scenes: each is one that the schema knows, so that no key is left out without a word, and another plan."""

import json
from dataclasses import replace

import jsonschema
import pytest

from evetac_cli.evaluate.stability.extreme_scenes import LIFTS, MORE_LIFTS, SLIP_SOON, SLIPS, merge
from evetac_cli.resources import schemas
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.sim.setup.scene import LightSettings, LightStep
from evetac_cli.sim.setup.tables import as_table

ALL = [("slip", name, SLIPS[name]) for name in SLIPS] + [
    ("lift", name, tables) for name, tables in (LIFTS | MORE_LIFTS).items()
]


@pytest.mark.parametrize(("base", "name", "tables"), ALL, ids=[f"{base}: {name}" for base, name, _ in ALL])
def test_an_extreme_scene_is_a_scene(base, name, tables):
    """Assert that the merged scene is valid, and differs from the scene unless it is the usual one."""
    planned = first_plan(base)
    changed = merge(planned, SLIP_SOON, tables) if base == "slip" else merge(planned, tables)
    jsonschema.validate(as_table(changed.scene), json.loads((schemas() / "scene.v1.json").read_text()))
    assert (merge(planned, tables) == planned) == (name == "as usual")


def test_scenes_are_merged_into_the_plan():
    """Assert that a table's keys come beside or instead of the scene's own, and that the plan given stays as it was."""
    slip = first_plan("slip")
    step = {"at_s": 4.0, "factor": 0.5}
    merged = merge(slip, {"gripper": {"start_factor": [5.0, 6.0], "backlash_ticks": 2.0}}, {"light": {"step": step}})
    gripper = replace(slip.scene.gripper, start_factor=(5.0, 6.0), backlash_ticks=2.0)
    light = LightSettings(step=LightStep(**step))
    assert merged == replace(slip, scene=replace(slip.scene, gripper=gripper, light=light))
    assert slip == first_plan("slip") != merged
