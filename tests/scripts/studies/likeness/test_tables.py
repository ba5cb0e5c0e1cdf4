"""scripts/studies/likeness/tables.py: the page's tables have every fact, what was ours, and the counts."""

import json
from pathlib import Path
from typing import Any

from evetac_cli.evaluate.likeness.facts import facts
from scripts.reproduce.results import as_table
from scripts.studies.likeness import tables as likeness_tables


def measured(folder: Path, when: str, **values: list[float]) -> None:
    """Figures of ours of some facts, by name with _ for -."""
    rows = [{"name": name.replace("_", "-"), "values": one, "n": 3, "from": "a test"} for name, one in values.items()]
    about: dict[str, Any] = {"made": f"commit {when}", "commands": ["evetac x"], "sizes": {"recording_seeds": [1, 2]}}
    (folder / "likeness").mkdir(exist_ok=True)
    (folder / "likeness" / f"{when}.json").write_text(json.dumps({**about, "rows": rows}))


def test_before_and_after_stand_beside_each_other(tmp_path: Path) -> None:
    """Assert that a second run gives a second column, counts for both, and misses with reasons of the latest."""
    measured(tmp_path, "before", one_slice=[0.35], data_rate_whole=[0.017])
    text = likeness_tables.as_pages(tmp_path, as_table)["likeness-counted"]
    assert "| before | command |" in text and "after" not in text.partition("| 1. ")[0]
    assert "0.35 (off; n 3; a test)" in text and "0.017 (within; n 3; a test)" in text
    assert "2 of these 19 facts are measured; 1 are within the published spread, 0 more" in text
    assert "- `one-slice`: the simulated slip is slow" in text
    measured(tmp_path, "after", one_slice=[0.84], data_rate_whole=[0.03])
    text = likeness_tables.as_pages(tmp_path, as_table)["likeness-counted"]
    assert "| before | after | command |" in text
    assert "After: 2 of these 19 facts are measured; 1 are within the published spread, 1 more" in text
    assert "- `one-slice`:" not in text and "| not measured |" in text


def test_every_fact_has_a_row(tmp_path: Path) -> None:
    """Assert that each fact stands in one of the two tables, once, with its source, class and command."""
    measured(tmp_path, "before", one_slice=[0.35])
    text = "".join(likeness_tables.as_pages(tmp_path, as_table).values())
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    for fact in facts():
        (line,) = (line for line in lines if f"`{fact.name}`: " in line)
        assert fact.source in line and fact.kind in line and fact.command.partition(" (")[0] in line
        assert line.count(" | ") == 4, fact.name
