"""Which seeds, figures and facts constants saw; no table reports such seeds, and no constant saw a judging seed."""

import re
import tomllib
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.evaluate import PAPER
from evetac_cli.resources import PACKAGE
from scripts.reproduce.seeds import faults, fit_faults, known, seen_by, tables
from scripts.studies.slip import recordings

ROOT = Path(__file__).resolve().parents[3]
SEEN = known()
TABLES = tables()
FACTS = tomllib.loads((PACKAGE / "data" / "likeness.toml").read_text())["fact"]


def test_no_table_reports_seeds_that_its_constants_saw() -> None:
    """Assert that all tables and groups keep the rule."""
    assert list(faults(SEEN, TABLES)) == []


def test_what_was_fitted_is_named_by_its_constants() -> None:
    """Assert that every fitted figure of the paper and every fact used to fit is in a group, and the reverse."""
    assert list(fit_faults(SEEN["groups"], PAPER.figures, FACTS)) == []


def group_with(**changed: Any) -> dict[str, Any]:
    """The group of the edge scene, changed."""
    (edge,) = (group for group in SEEN["groups"] if group["name"] == "edge scene")
    return {**edge, **changed}


JUDGED = {"frozen": "ccbcd6aa", "sizes": {"recording_seeds": [102_000]}}


@pytest.mark.parametrize(
    ("group", "table", "fault"),
    [
        (group_with(seeds=[102_000]), {}, "its constants saw [102000], on which frozen tables are judged"),
        (group_with(seeds=[[99_990, 100_001]]), {}, "its constants saw [100000, 100001]"),
        (group_with(seeds=[102_000]), JUDGED, "reports the seeds [102000]"),
        (group_with(), {**JUDGED, "sizes": {"recording_seeds": [99_999]}}, "is frozen, but is judged on [99999]"),
        (group_with(), {**JUDGED, "sizes": {}}, "is frozen, but is judged on unknown seeds"),
        (group_with(), {"sizes": {"seeds": "100000-100001"}}, "does not name the frozen commit"),
        (group_with(seeds=[7]), {"commands": ["x --seeds 5-7"]}, "reports the seeds [7]"),
    ],
)
def test_a_broken_rule_is_found(group: dict[str, Any], table: dict[str, Any], fault: str) -> None:
    """Assert that a constant that saw a judging seed, and a table that reports a seen seed, are found."""
    seen = {"groups": [group]}
    assert any(fault in found for found in faults(seen, {"tracking-edge": table}))
    assert list(faults({"groups": [group_with()]}, {"tracking-edge": JUDGED})) == []


def test_a_fit_that_is_not_named_is_found() -> None:
    """Assert that a figure or fact is found if its group is missing, or if only the group says that it is fitted."""
    without = [group for group in SEEN["groups"] if group["name"] != "edge scene"]
    found = " ".join(fit_faults(without, PAPER.figures, FACTS))
    assert "('consistent', 'paper')" in found and "tracked-regularised" in found
    plain = {**PAPER.figures, ("consistent", "paper"): replace(PAPER.figures["consistent", "paper"], fitted_in="")}
    assert "has no `fitted_in`" in " ".join(fit_faults(SEEN["groups"], plain, FACTS))
    other = group_with(name="other", paper=[["nothing"]], likeness=["lost-regularised"])
    found = " ".join(fit_faults([*SEEN["groups"], other], PAPER.figures, FACTS))
    assert "no figure of the paper" in found and "`lost-regularised`, which is not used to fit" in found


def test_every_table_has_its_constants_named() -> None:
    """Assert that each table belongs to a group of constants, or is said to have none."""
    patterns = [pattern for group in SEEN["groups"] for pattern in group["tables"]] + list(SEEN["no_constants"])
    assert [name for name in TABLES if not any(fnmatch(name, pattern) for pattern in patterns)] == []


@pytest.mark.parametrize("group", SEEN["groups"], ids=lambda group: group["name"])
def test_groups_name_what_there_is(group: dict[str, Any]) -> None:
    """Assert that the module of a group exists, and that seeds which are not known are said to be so."""
    assert (PACKAGE / group["module"].partition(" before ")[0]).exists()
    assert bool(group["seeds"]) != bool(group.get("why_unknown"))
    assert all(tuple(key) in PAPER.figures for key in group.get("near", []))


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


def test_seeds_of_trainings_on_motions_are_in_the_file() -> None:
    """Assert that every recording that studies/slip/recordings.py makes has a seed that its group names."""
    (seen,) = (seen_by(group) for group in SEEN["groups"] if group["module"] == "../scripts/studies/slip/recordings.py")
    for role, first in recordings.FIRST_SEEDS.items():
        trials = max(recordings.COUNTS[role].values())
        assert set(range(first, first + trials)) <= seen
