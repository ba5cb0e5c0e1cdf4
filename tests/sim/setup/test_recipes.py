"""Recipes of scenes, sensors and objects: the same content is the same recipe, however it is written."""

import hashlib
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest

from evetac_cli.resources import SCENES
from evetac_cli.resources import table as packaged
from evetac_cli.sim.setup import object_file, scene_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.sensor_file import FOR_EACH_TRIAL, of_row, rows
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.store.layout.provenance import canonical

# First half of the SHA-256 over the recipes of all packaged ones; changes when one of their values or defaults does.
HELD = {
    "scene": "8d93e7c05d8d085763cd5cfb193e65db",
    "sensor": "6f59c91ee2b9985baa5e257493620d13",
    "object": "910d70af0c7e4ae9acb7d81074677ade",
}


def recipes(kind: str, way: Any) -> Iterator[str]:
    """The recipe of each packaged table of a kind, written in another way."""
    if kind == "scene":
        for path in sorted(SCENES.glob("*.toml")):
            yield canonical(as_table(scene_file.of_table(way(tomllib.loads(path.read_text())), "here")))
    elif kind == "sensor":
        for name, row in rows().items():
            if name not in FOR_EACH_TRIAL:
                yield canonical(as_table(of_row(way(row), "here")))
        for name in FOR_EACH_TRIAL:
            yield canonical(as_table(one_sensor(f"{name}:7")))
    else:
        for row in packaged("objects").values():
            yield canonical(as_table(object_file.of_keys(way(row), "here")))


def turned(table: Any) -> Any:
    """A table with its keys in the opposite order."""
    return {key: turned(table[key]) for key in reversed(table)} if isinstance(table, dict) else table


def whole(table: Any) -> Any:
    """A table in which every number without a fraction is written without a point: 341 for 341.0."""
    if isinstance(table, dict):
        return {key: whole(value) for key, value in table.items()}
    if isinstance(table, list):
        return [whole(value) for value in table]
    return int(table) if isinstance(table, float) and table.is_integer() else table


@pytest.mark.parametrize("way", [dict, turned, whole], ids=["as it is", "turned", "whole numbers"])
@pytest.mark.parametrize("kind", HELD)
def test_recipes_are_held(kind: str, way: Any) -> None:
    """Assert that the recipes of all packaged tables are the held ones, whatever the order of keys and 341 or 341.0."""
    digest = hashlib.sha256("\n".join(recipes(kind, way)).encode()).hexdigest()
    assert digest[:32] == HELD[kind]


def test_a_range_of_one_number_and_a_named_default_add_nothing() -> None:
    """Assert that [1, 1] and 1 are one recipe, and that a value that is the default is not part of it."""
    slip = tomllib.loads((SCENES / "slip.toml").read_text())
    grip = {**slip["gripper"], "friction_factor": [0.7, 0.7], "start_more_n": 0, "current": None}
    ways = [{**grip, "friction_factor": 0.7}, {**grip, "start_more_n": 0.0, "fall_factor": 1, "close_s": 0}]
    tables = [
        as_table(scene_file.of_table(scene_file.merged(slip, {"gripper": way, **more}), "here"))
        for way, more in ((grip, {}), (ways[0], {"solver": {"theta": 0.51}}), (ways[1], {"gel": {"sideways": False}}))
    ]
    assert tables[0] == tables[1] == tables[2]
    assert tables[0]["gripper"].keys() == {*slip["gripper"], "friction_factor"}
