"""Tables of TOML as frozen types: schemas, objects and tables say the same, and what is none is refused in words."""

import json
import tomllib
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any, ClassVar

import pytest

from evetac_cli.errors import InputError, SceneError
from evetac_cli.resources import SCENES, schemas, table
from evetac_cli.sim.setup.driven import FaceMotion
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.scene_file import load, merged
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.sim.setup.sensor_rows import FOR_EACH_TRIAL, rows
from evetac_cli.sim.setup.solver import Solver
from evetac_cli.sim.setup.tables import as_table, between, build, check, number, numbers, one_of, rules_of
from evetac_cli.sim.setup.tables import table as inner
from scripts.schemas import TYPES, text_of

SENSORS = {name: row for name, row in rows().items() if name not in FOR_EACH_TRIAL}
PACKAGED = [
    *(pytest.param(Scene, tomllib.loads(path.read_text()), id=path.stem) for path in sorted(SCENES.glob("*.toml"))),
    *(pytest.param(Sensor, row, id=name) for name, row in SENSORS.items()),
    *(pytest.param(TouchedObject, row, id=number) for number, row in table("objects").items()),
]


@dataclass(frozen=True, kw_only=True)
class Wave:
    """A wave."""

    at_s: tuple[float, ...] = numbers("when", 0, 10, (1, 3), order="strictly rising")
    height_mm: tuple[float, ...] = numbers("how high", 0, 10, (1, 3), order="rising")
    depth_m: float | None = number("of the water", 0, 100, default=None, needed_in=("sea",), only_in=("sea", "lake"))

    COLUMNS: ClassVar = ("at_s", "height_mm")


@dataclass(frozen=True, kw_only=True)
class Water:
    """Water with a wave."""

    kind: str = one_of("what it is", ("sea", "lake", "cup"))
    wave: Wave | None = inner(Wave, needed_in=("sea",))
    warm_c: tuple[float, float] = between("range of its warmth", None, 100, above=0, or_one=True, default=(10.0, 20.0))


WAVE = {"at_s": [0.0, 1.0], "height_mm": [2.0, 2.0]}


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
    check(type_, named, "here")
    one = build(type_, named)
    again = as_table(one)
    assert build(type_, again) == one
    solver = again.pop("solver", {})
    assert merged(in_ranges(named, again), again) == in_ranges(named, again)
    assert merged(as_table(Solver()), named.get("solver", {})) == {**as_table(Solver()), **solver}


@pytest.mark.parametrize(("type_", "named"), PACKAGED)
def test_a_default_that_is_named_is_the_same_table(type_: type[Any], named: dict[str, Any]) -> None:
    """Assert that a table that names every default gives the same object and the same table."""
    one = build(type_, named)
    whole = asdict(one, dict_factory=lambda items: {name: value for name, value in items if value is not None})
    assert build(type_, whole) == one
    assert as_table(build(type_, whole)) == as_table(one)


def test_numbers_are_what_the_type_says() -> None:
    """Assert that 341 and 341.0 are one table, that of a float, and that a number alone is a range of two."""
    named = {"shape": "flat", "static_friction": 0.9, "mass_g": 341, "tilt_deg": 2}
    one, other = (as_table(build(TouchedObject, {**named, **more})) for more in ({}, {"mass_g": 341.0}))
    assert json.dumps(one) == json.dumps(other)
    assert json.dumps(one["mass_g"]) == "341.0"
    assert one["tilt_deg"] == [2.0, 2.0]
    assert type(as_table(build(Solver, {"scans_per_ms": 10}))["scans_per_ms"]) is int


def test_a_solver_is_written_whole() -> None:
    """Assert that all settings of a solver are written, also those at their defaults, but one of step and tolerance."""
    names = set(asdict(Solver()))
    assert set(as_table(Solver())) == names - {"step_ms"}
    assert set(as_table(Solver(step_ms=0.5))) == names - {"tolerance_um"}
    assert set(as_table(Solver(step_ms=0.5, tolerance_um=0.1))) == names - {"tolerance_um"}
    slip = tomllib.loads((SCENES / "slip.toml").read_text())
    finer = as_table(build(Scene, {**slip, "solver": {"node_pitch_mm": 0.5}}))
    assert finer["solver"] == {**as_table(Solver()), "node_pitch_mm": 0.5}
    with pytest.raises(InputError, match=r"solver: invalid value\n  expected: one of tolerance_um and step_ms"):
        check(Scene, {**slip, "solver": {"step_ms": 0.5, "tolerance_um": 0.1}}, "here")


@pytest.mark.parametrize(
    "named",
    [
        {"kind": "sea", "wave": {**WAVE, "depth_m": 9}},
        {"kind": "lake", "wave": {**WAVE, "depth_m": 9.0}},
        {"kind": "cup", "wave": {"at_s": [0], "height_mm": [1]}, "warm_c": 60},
        {"kind": "cup", "warm_c": [60, 60.0]},
    ],
)
def test_what_is_right_passes(named: dict[str, Any]) -> None:
    """Assert that whole numbers are numbers, a range may be one number, and a table may be left out."""
    check(Water, named, "here")


@pytest.mark.parametrize(
    ("named", "says"),
    [
        ({"kind": "cup", "wave": {**WAVE, "at_s": [1.0, 1.0]}}, "wave.at_s: expected strictly rising values"),
        ({"kind": "cup", "wave": {**WAVE, "height_mm": [2.0, 1.0]}}, "wave.height_mm: expected rising values"),
        ({"kind": "cup", "warm_c": [20.0, 10.0]}, "warm_c: expected the lower end first"),
        (
            {"kind": "cup", "wave": {**WAVE, "height_mm": [2.0]}},
            "wave.height_mm: lists of different lengths\n  expected: one value for each of the 2 in at_s\n"
            "  found:    2 in at_s, 1 in height_mm",
        ),
        ({"kind": "sea"}, "wave is missing\n  expected: wave, wave.depth_m\n  found:    kind sea"),
        ({"kind": "sea", "wave": WAVE}, "wave.depth_m is missing"),
        (
            {"kind": "cup", "wave": {**WAVE, "depth_m": 9.0}},
            "wave.depth_m is for another kind of scene\n  expected: kind sea, lake\n  found:    kind cup",
        ),
        ({"kind": "lake", "wave": {"at_s": [0.0]}}, "keys are missing in wave\n  expected: height_mm"),
        ({"wave": WAVE}, "keys are missing\n  expected: kind\n  found:    none of them\n  try:      name it"),
        ({"kind": "se", "wave": WAVE}, "kind: unknown value\n  expected: sea, lake, cup\n  found:    se\n  try:"),
        ({"kind": "cup", "wave": {**WAVE, "heigth_mm": [1.0]}}, "unknown key wave.heigth_mm"),
        ({"kind": "cup", "wave": 3}, "wave: expected a table"),
        ({"kind": "cup", "wave": {**WAVE, "at_s": []}}, "wave.at_s: wrong number of entries"),
        ({"kind": "cup", "wave": {**WAVE, "at_s": [True, 1.0]}}, "wave.at_s.0: expected a number"),
        ({"kind": "cup", "wave": {**WAVE, "at_s": [0.0, 11.0]}}, "wave.at_s.1: out of range\n  expected: 0 to 10"),
        ({"kind": "cup", "warm_c": 0}, "warm_c: out of range\n  expected: more than 0 to 100"),
        ({"kind": "cup", "warm_c": [10.0, 101.0]}, "warm_c.1: out of range"),
        ({"kind": "cup", "warm_c": "hot"}, "warm_c: expected a number"),
    ],
)
def test_what_is_wrong_is_said(named: dict[str, Any], says: str) -> None:
    """Assert that order, lengths, kinds, keys, types and ranges are refused by place, as the error asked for."""
    with pytest.raises(SceneError) as refused:
        check(Water, named, "here", if_missing="name it", error=SceneError)
    assert str(refused.value).startswith("here: " + says)


def test_a_part_of_a_table() -> None:
    """Assert that keys may be missing where a part is checked, and more be needed where a whole is."""
    check(Water, {"warm_c": 20.0}, "here", whole=False)
    with pytest.raises(InputError, match="keys are missing\n  expected: kind, warm_c"):
        check(Water, {}, "here", needed=("warm_c",))


@pytest.mark.parametrize(("type_", "key"), [(Solver, "camera_substeps"), (FaceMotion, "count"), (Sensor, "hot_pixels")])
def test_a_whole_number_with_a_point_is_whole(type_: type[Any], key: str) -> None:
    """Assert that 5.0, which JSON schema takes for a whole number, is one, and no other recipe than 5."""
    named = {item.name: 1 for item in fields(type_) if item.default is MISSING and item.name != key}
    value = getattr(build(type_, {**named, key: 5.0}), key)
    assert value == 5 and isinstance(value, int)


def test_a_key_of_another_kind_of_motion_is_said() -> None:
    """Assert that what only one kind of motion has is refused as such in another."""
    motion = {"kind": "strokes", "normal_n": 1.0, "press_s": 1.0, "lines": 2, "speed_mm_s": 1.0, "approach_s": 1.0}
    scene = {**as_table(load("press")), "motion": {**motion, "pause_s": 1.0}}
    with pytest.raises(InputError, match=r"motion\.pause_s is for another kind of motion"):
        check(Scene, scene, "here")
