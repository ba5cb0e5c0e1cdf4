"""What docs/results say of a fact: columns, figures that follow from several rows, and what the tables do not have."""

import json
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.evaluate.likeness.facts import Ours, by_name, facts
from scripts.reproduce.facts import RESULTS
from scripts.studies.likeness.run import of_table


def told(folder: Path, fact: str, **rows: list[dict[str, Any]]) -> Ours:
    """What a table of these rows, by name with _ for -, tells of a fact."""
    for name, of_name in rows.items():
        text = json.dumps({"made": "commit abc", "rows": of_name, "sizes": {"recordings": 7}})
        (folder / f"{name.replace('_', '-')}.json").write_text(text)
    return of_table(by_name(fact), folder)


def network(name: str, correct: float, f1: float, **more: Any) -> dict[str, Any]:
    """A row of the networks that were trained by the paper's recipe, judged on the objects that they learned from."""
    of_recipe = {"objects_words": "trained on", "preset": "paper", "horizon_ms": 0}
    return {"model": name, **of_recipe, "slip_correct": correct, "f1": f1, **more}


def test_a_column_and_its_trials(tmp_path: Path) -> None:
    """Assert that a column of the row is taken, with its number of trials and the version of the table."""
    found = told(tmp_path, "grasps-kept", grasps=[{"setting": "paper", "success": 0.9, "trials": 12}])
    assert found.values == (0.9,) and found.n == 12
    assert found.origin == "docs/results/grasps.json, commit abc"


def test_order_of_networks(tmp_path: Path) -> None:
    """Assert that the order counts pairs, of timing and F1, and is not told where a network is missing."""
    rows = [network("fast-slow", 0.9, 0.8), network("hist20", 0.8, 0.9), network("hist10", 0.7, 0.7)]
    missing = told(tmp_path, "order-of-networks", paper_recipe=rows)
    assert missing.values == () and "does not have it" in missing.not_measured
    others = [network("hist10", 0.0, 0.0, objects_words="unseen")]  # which do not count
    found = told(tmp_path, "order-of-networks", paper_recipe=[*rows, network("no-hist", 0.1, 0.1), *others])
    assert found.values == pytest.approx((11 / 12,)) and found.n == 7


def test_every_table_that_a_fact_names_is_there() -> None:
    """Assert that docs/results has the tables, and that most facts find their figures in them."""
    named = [fact for fact in facts() if fact.table]
    assert all((RESULTS / f"{fact.table}.json").is_file() for fact in named)
    assert sum(bool(of_table(fact, RESULTS).values) for fact in named) >= len(named) - 2
