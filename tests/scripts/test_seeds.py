"""Which seeds constants saw, and that no table reports them."""

import importlib
import json
import re
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.resources import PACKAGE

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
SEEN = json.loads((ROOT / "scripts" / "seeds.json").read_text())
TABLES = {str(path.relative_to(RESULTS).with_suffix("")): path for path in RESULTS.rglob("*.json")}


def seeds_of(table: dict[str, Any]) -> set[int]:
    """The seeds that a table reports: those that its sizes name, and those of its commands."""
    sizes = table.get("sizes", {})
    named = {seed for key in ("recording_seeds", "contact_seeds", "trial_seeds") for seed in sizes.get(key) or []}
    if {"first", "last"} <= sizes.keys():
        named |= set(range(sizes["first"], sizes["last"] + 1))
    for command in table.get("commands", []):
        for first, last in re.findall(r"--seeds? (\d+)(?:-(\d+))?", command):
            named |= set(range(int(first), int(last or first) + 1))
    return named


def seen_by(group: dict[str, Any]) -> set[int]:
    """The seeds that the constants of a group saw; none where they are not known."""
    ranges = [one if isinstance(one, list) else [one, one] for one in group["seeds"] or []]
    return {seed for first, last in ranges for seed in range(first, last + 1)}


def concerns(group: dict[str, Any], name: str, table: dict[str, Any]) -> bool:
    """Whether constants of a group enter a table."""
    if not any(fnmatch(name, pattern) for pattern in group["tables"]):
        return False
    first, last = group.get("label_methods", (None, None))
    method = table.get("methods", {}).get("label")
    return first is None or (method is not None and method >= first and (last is None or method <= last))


def overlaps() -> dict[tuple[str, str], list[int]]:
    """Table and group -> seeds that the table reports and the group's constants saw."""
    found = {}
    for name, path in TABLES.items():
        table = json.loads(path.read_text())
        for group in SEEN["groups"]:
            if concerns(group, name, table) and (both := seeds_of(table) & seen_by(group)):
                found[name, group["name"]] = sorted(both)
    return found


def test_no_table_reports_seeds_that_its_constants_saw() -> None:
    """Assert that tables report no such seeds, but for the exceptions, each of which is one still, and has a reason."""
    allowed = {(name, one["group"]): one["seeds"] for name, ones in SEEN["exceptions"].items() for one in ones}
    assert overlaps() == allowed
    assert all(one["why"] for ones in SEEN["exceptions"].values() for one in ones)


def test_exceptions_are_counted() -> None:
    """Assert that there are no more exceptions than the ten tables of an earlier edition's labels."""
    assert sum(map(len, SEEN["exceptions"].values())) <= 10


def test_every_table_has_its_constants_named() -> None:
    """Assert that each table belongs to a group of constants, or is said to have none."""
    patterns = [pattern for group in SEEN["groups"] for pattern in group["tables"]] + list(SEEN["no_constants"])
    assert [name for name in TABLES if not any(fnmatch(name, pattern) for pattern in patterns)] == []


@pytest.mark.parametrize("group", SEEN["groups"], ids=lambda group: group["name"])
def test_groups_name_what_there_is(group: dict[str, Any]) -> None:
    """Assert that the module of a group exists, and that seeds which are not known are said to be so."""
    assert (PACKAGE / group["module"].partition(" before ")[0]).exists()
    assert bool(group["seeds"]) != bool(group.get("why_unknown"))


def test_seeds_that_modules_state_are_in_the_file() -> None:
    """Assert that every seed that a kernel's text says constants were chosen on is in a group of its module."""
    stated = re.compile(r"seeds (\d+)(?:(?:-| to )(\d+))?")
    for group in SEEN["groups"]:
        path = PACKAGE / group["module"].partition(" before ")[0]
        if path.suffix != ".py" or "kernels" not in group["module"]:
            continue
        same = [one for one in SEEN["groups"] if one["module"].partition(" before ")[0] == group["module"]]
        seen = set().union(*map(seen_by, same))
        for first, last in stated.findall(" ".join(path.read_text().split())):
            if int(first) > 9 and "below" not in first:
                assert {int(first), int(last or first)} <= seen, (group["module"], first, last)


def test_seeds_of_trainings_on_motions_are_in_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that every recording that motion_recordings.py makes has a seed that its group names."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    made = importlib.import_module("motion_recordings")
    (seen,) = (seen_by(group) for group in SEEN["groups"] if group["module"] == "../scripts/motion_recordings.py")
    for role, first in made.FIRST_SEEDS.items():
        trials = max(made.COUNTS[role].values()) * len(made.OBJECTS[role])
        assert set(range(first, first + trials)) <= seen


def test_an_overlap_is_found() -> None:
    """Assert that a table of seeds that its labels saw is one that the rule finds, and one of other labels is not."""
    (labels,) = (group for group in SEEN["groups"] if group["name"] == "labels")
    table: dict[str, Any] = {"methods": {"label": 6}, "commands": ["judge_labels.py --seeds 4095-4100"]}
    assert concerns(labels, "labels", table)
    assert seeds_of(table) & seen_by(labels) == {4100}
    assert not concerns(labels, "labels", {**table, "methods": {"label": 5}})
    assert not concerns(labels, "vibration", table)
