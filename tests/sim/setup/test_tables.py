"""Tables of TOML as frozen types: schemas, objects and tables say the same, and what is none is refused in words."""

import json
import tomllib
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import pytest

from evetac_cli.resources import SCENES, schemas, table
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.sim.setup.scene import Scene, Solver
from evetac_cli.sim.setup.scene_file import merged
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.sim.setup.sensor_file import FOR_EACH_TRIAL, rows
from evetac_cli.sim.setup.tables import as_table, read_table
from scripts.schemas import TYPES, rules_of, text_of

SENSORS = {name: row for name, row in rows().items() if name not in FOR_EACH_TRIAL}
PACKAGED = [
    *(pytest.param(Scene, tomllib.loads(path.read_text()), id=path.stem) for path in sorted(SCENES.glob("*.toml"))),
    *(pytest.param(Sensor, row, id=name) for name, row in SENSORS.items()),
    *(pytest.param(TouchedObject, row, id=number) for number, row in table("objects").items()),
]


def properties(rules: dict[str, Any], place: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """The rules of every field, those of tables within too, with their places."""
    for name, each in rules.get("properties", {}).items():
        yield f"{place}{name}", each
        yield from properties(each, f"{place}{name}.")


def single(rules: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The rules of the single values of a field, those in lists too."""
    within = [*rules.get("anyOf", []), *([rules["items"]] if "items" in rules else [])]
    if not within:
        yield rules
    for each in within:
        yield from single(each)


@pytest.mark.parametrize("kind", TYPES)
def test_schemas_are_those_of_the_types(kind: str) -> None:
    """Assert that the public schemas are what scripts/schemas.py writes."""
    assert (schemas() / f"{kind}.v1.json").read_text() == text_of(kind)


@pytest.mark.parametrize("kind", TYPES)
def test_every_field_says_what_it_is(kind: str) -> None:
    """Assert that every field has a description, and every number a range."""
    for place, rules in properties(rules_of(TYPES[kind][0])):
        assert rules["description"].strip(), place
        for each in single(rules):
            if each.get("type") in ("number", "integer"):
                assert {"minimum", "exclusiveMinimum"} & each.keys(), place
                assert "maximum" in each, place


def in_ranges(named: Any, again: Any) -> Any:
    """A table in which each number that stands for both ends of a range is that range, where another table has one."""
    if isinstance(named, dict):
        return {
            key: in_ranges(value, again.get(key) if isinstance(again, dict) else None) for key, value in named.items()
        }
    return [named, named] if isinstance(named, float) and isinstance(again, list) else named


@pytest.mark.parametrize(("type_", "named"), PACKAGED)
def test_a_table_comes_back(type_: type[Any], named: dict[str, Any]) -> None:
    """Assert that the table of an object gives it again, and holds nothing that its first table does not name.

    A range that is named by one number comes back as both of its ends.
    """
    one = read_table(type_, named, "here")
    again = as_table(one)
    assert read_table(type_, again, "here") == one
    solver = again.pop("solver", {})
    assert merged(in_ranges(named, again), again) == in_ranges(named, again)
    assert merged(as_table(Solver()), named.get("solver", {})) == {**as_table(Solver()), **solver}


def test_numbers_are_what_the_type_says() -> None:
    """Assert that 341 and 341.0 are one table, that of a float, and that a number alone is a range of two."""
    named = {"shape": "flat", "static_friction": 0.9, "mass_g": 341, "tilt_deg": 2}
    one, other = (as_table(read_table(TouchedObject, {**named, **more}, "here")) for more in ({}, {"mass_g": 341.0}))
    assert json.dumps(one) == json.dumps(other)
    assert json.dumps(one["mass_g"]) == "341.0"
    assert one["tilt_deg"] == [2.0, 2.0]
    assert type(as_table(read_table(Solver, {"scans_per_ms": 10}, "here"))["scans_per_ms"]) is int


def test_a_solver_is_written_whole() -> None:
    """Assert that all settings of a solver are written, also those at their defaults, but one of step and tolerance."""
    names = set(asdict(Solver()))
    assert set(as_table(Solver())) == names - {"step_ms"}
    assert set(as_table(Solver(step_ms=0.5))) == names - {"tolerance_um"}
    assert set(as_table(Solver(step_ms=0.5, tolerance_um=0.1))) == names - {"tolerance_um"}
    slip = tomllib.loads((SCENES / "slip.toml").read_text())
    finer = as_table(read_table(Scene, {**slip, "solver": {"node_pitch_mm": 0.5}}, "here"))
    assert finer["solver"] == {**as_table(Solver()), "node_pitch_mm": 0.5}
    assert type(as_table(read_table(Solver, {"camera_substeps": 5.0}, "here"))["camera_substeps"]) is int
