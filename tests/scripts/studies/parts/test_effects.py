"""Which parts there are, that each is one of scene or sensor that evetac knows, and what is made of trials."""

from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from evetac_cli.jobs import Row
from evetac_cli.sim.setup.parts import rows_of
from scripts.studies.parts import effects
from scripts.studies.parts.effects import BY_NAME, NONE, PARTS, Part


def slip(part: str, seed: int, **figures: Any) -> Row:
    """The line of a slip."""
    what = {"part": part, "size": BY_NAME[part].size, "kind": "slip", "object": 2, "seed": seed, "commit": "c"}
    counts = {"labels_counts": [20, 0, 0], "slip_counts": [20, 0, 0]}
    usual = {"events_ms": 50.0, "labels_in_time": True, "slip_in_time": True, "record_us": 100.0, **counts}
    return {**what, **usual, **figures}


@lru_cache
def without(part: str, kind: str, object_: int) -> Any:
    """The trial that others are compared with, planned once."""
    with TemporaryDirectory() as folder:
        return effects.planned(BY_NAME[part], kind, object_, 5, Path(folder))[0]


SLOW = {"second finger"}  # the gel of another finger is built for each of four plans


@pytest.mark.parametrize(
    "part",
    [pytest.param(part, id=part.name, marks=pytest.mark.slow if part.name in SLOW else ()) for part in PARTS[1:]],
)
def test_a_part_is_built(part: Part, tmp_path: Path) -> None:
    """Assert that scene and sensor with a part are valid, and make another trial of the same seeds than without."""
    for kind, object_ in (("slip", 8), ("lift", 11)):
        if part.slips or kind == "lift":
            made, _ = effects.planned(part, kind, object_, 5, tmp_path)
            other = without(part.against, kind, object_)
            assert made.plan != other.plan
            assert (made.seed, made.number, made.plan.object_name) == (other.seed, other.number, other.plan.object_name)
            assert {row["part"] for row in rows_of(made.plan)} == {row["part"] for row in rows_of(other.plan)}


def test_changes() -> None:
    """Assert that pairs of one seed are compared, that an interval is about their differences, and none is of two."""
    seeds = range(5)
    without = [slip(NONE, seed, events_ms=50.0 + 10 * seed) for seed in seeds]
    with_leak = [slip("leak", seed, events_ms=53.0 + 10 * seed + (seed % 2)) for seed in seeds]
    figures, changes = effects.tables([*with_leak, *without, slip(NONE, 99, events_ms=1e6)])
    assert [row["part"] for row in figures] == [NONE, "leak"]
    (more,) = (row for row in changes if row["figure"] == "events_ms")
    assert more["trials"] == 5 and more["more"] == pytest.approx(3.4)
    assert 3.0 <= more["low"] < 3.4 < more["high"] <= 4.0
    assert [row["figure"] for row in effects.sure(changes)] == ["events_ms"]
    assert not effects.tables([*with_leak[:2], *without])[1]
    other_size = [{**row, "size": "another size"} for row in with_leak]
    assert [row["part"] for row in effects.tables([*other_size, *without])[0]] == [NONE]
