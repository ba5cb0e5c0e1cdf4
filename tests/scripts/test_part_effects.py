"""Which parts there are, that each is one of scene or sensor that evetac knows, and what is made of trials."""

import json
import sys
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import part_effects
import reproduce
import results
import studies
from part_effects import BY_NAME, NONE, PARTS, Part

from evetac_cli.errors import InputError
from evetac_cli.jobs import Row
from evetac_cli.sim.parts import rows_of


def slip(part: str, seed: int, **figures: Any) -> Row:
    """The line of a slip."""
    what = {"part": part, "says": BY_NAME[part].says, "kind": "slip", "object": 2, "seed": seed, "commit": "c"}
    counts = {"labels_counts": [20, 0, 0], "slip_counts": [20, 0, 0]}
    usual = {"events_ms": 50.0, "labels_in_time": True, "slip_in_time": True, "record_us": 100.0, **counts}
    return {**what, **usual, **figures}


@lru_cache
def without(part: str, kind: str, object_: int) -> Any:
    """The trial that others are compared with, planned once."""
    with TemporaryDirectory() as folder:
        return part_effects.planned(BY_NAME[part], kind, object_, 5, Path(folder))[0]


SLOW = {"second finger"}  # the gel of another finger is built for each of four plans


@pytest.mark.parametrize(
    "part",
    [pytest.param(part, id=part.name, marks=pytest.mark.slow if part.name in SLOW else ()) for part in PARTS[1:]],
)
def test_a_part_is_built(part: Part, tmp_path: Path) -> None:
    """Assert that scene and sensor with a part are valid, and make another trial of the same seeds than without."""
    for kind, object_ in (("slip", 8), ("lift", 11)):
        if part.slips or kind == "lift":
            made, _ = part_effects.planned(part, kind, object_, 5, tmp_path)
            other = without(part.against, kind, object_)
            assert made.plan != other.plan
            assert (made.seed, made.number, made.plan.called) == (other.seed, other.number, other.plan.called)
            assert {row["part"] for row in rows_of(made.plan)} == {row["part"] for row in rows_of(other.plan)}


def test_a_part_that_is_none(tmp_path: Path) -> None:
    """Assert that a misspelt part is refused as in a file."""
    for part in (Part("a", "", {"light": {"flikker": 1}}), Part("b", "", sensor={"leek_hz": 1.0})):
        with pytest.raises(InputError, match="did you mean"):
            part_effects.planned(part, "slip", 8, 0, tmp_path)


def test_trials_that_are_to_be_run() -> None:
    """Assert that a part comes with those it is compared with, by the same seeds, and is not slipped in vain."""
    sizes = {"parts": ("uneven light", "encoder noise"), "slips": 2, "grasps": 1, "seed": 7}
    planned = list(part_effects.trials(sizes))
    assert [row["part"] for row in planned[:4]] == [NONE, "slow pixels", "bandwidth by light", "uneven light"]
    assert [(row["object"], row["seed"]) for row in planned[::4]][:2] == [(2, 7), (8, 8)]
    assert [row["part"] for row in planned if row["kind"] == "lift"].count("encoder noise") == 1
    assert len(planned) == 2 * 4 + 5
    assert len({part_effects.identity(row) for row in planned}) == len(planned)
    with pytest.raises(InputError, match="no such part"):
        list(part_effects.trials({**sizes, "parts": ("leek",)}))


def test_figures() -> None:
    """Assert means, medians of run times, and F1 over the slices of all trials."""
    rows = [slip(NONE, 0), slip(NONE, 1, events_ms=70.0, record_us=900.0, labels_counts=[0, 10, 20]), slip(NONE, 2)]
    assert part_effects.figure("events_ms", rows) == pytest.approx(170 / 3)
    assert part_effects.figure("record_us", rows) == 100.0
    assert part_effects.figure("labels_f1", rows) == pytest.approx(2 * 40 / (2 * 40 + 10 + 20))
    assert part_effects.figure("slip_f1", rows) == 1.0
    assert part_effects.figure("held", rows) is None


def test_changes() -> None:
    """Assert that pairs of one seed are compared, that an interval is about their differences, and none is of two."""
    seeds = range(5)
    without = [slip(NONE, seed, events_ms=50.0 + 10 * seed) for seed in seeds]
    with_leak = [slip("leak", seed, events_ms=53.0 + 10 * seed + (seed % 2)) for seed in seeds]
    figures, changes = part_effects.tables([*with_leak, *without, slip(NONE, 99, events_ms=1e6)])
    assert [row["part"] for row in figures] == [NONE, "leak"]
    (more,) = (row for row in changes if row["figure"] == "events_ms")
    assert more["trials"] == 5 and more["more"] == pytest.approx(3.4)
    assert 3.0 <= more["low"] < 3.4 < more["high"] <= 4.0
    assert [row["figure"] for row in part_effects.sure(changes)] == ["events_ms"]
    assert not part_effects.tables([*with_leak[:2], *without])[1]
    other_size = [{**row, "says": "another size"} for row in with_leak]
    assert [row["part"] for row in part_effects.tables([*other_size, *without])[0]] == [NONE]


def test_a_part_that_a_stage_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the reason is kept and counted, and that the trial is in no figure and no change."""

    def refuse(*trial: object) -> Row:
        raise InputError("slip cannot be labelled")

    monkeypatch.setattr(part_effects, "slip", refuse)
    lines = [slip(part, seed) for part in (NONE, "leak") for seed in range(3)]
    what = {key: slip("leak", 3)[key] for key in ("part", "says", "kind", "object", "seed")}
    refused = part_effects.run(what)
    assert refused == {**what, "refused": "slip cannot be labelled"}
    (_, leak), changes = part_effects.tables([*lines, slip(NONE, 3, events_ms=99.0), refused])
    assert (leak["slips"], leak["refused"], leak["events_ms"]) == (4, 1, 50.0)
    assert {row["trials"] for row in changes} == {3}


def test_the_table_of_the_docs(tmp_path: Path) -> None:
    """Assert that it shows a figure of each part, and the interval of its change where it does not hold 0."""
    rows = [slip(part, seed, events_ms=50.0 + 9.0 * (part == "leak")) for part in (NONE, "leak") for seed in range(3)]
    evaluations = {"part-effects": part_effects.evaluation(rows)}
    whole = reproduce.result(studies.PART_EFFECTS, evaluations, ["make part-effects"])
    (tmp_path / "part-effects.json").write_text(json.dumps(whole))
    page = "<!-- table part-effects -->\nas it was\n<!-- end of part-effects -->\n"
    filled = results.fill_page(page, tmp_path)
    assert "3 slips and 0 grasps with each (commit c" in filled and "seeds of recordings 0-2" in filled
    assert f"| none | {BY_NAME[NONE].says} | 50.0 |" in filled
    assert "| leak | 0.1 Hz a pixel | 59.0, +9.0 to +9.0 |" in filled
    assert "as it was" not in filled
