"""scripts/studies/likeness/tables.py: the page's tables have every fact, what was ours, and the counts."""

import json
from pathlib import Path
from typing import Any

from evetac_cli.evaluate.likeness.facts import facts
from scripts.studies.likeness import tables as likeness_tables


def measured(folder: Path, **values: list[float]) -> None:
    """Figures of ours of some facts, by name with _ for -."""
    rows = [{"name": name.replace("_", "-"), "values": one, "n": 3, "from": "a test"} for name, one in values.items()]
    about: dict[str, Any] = {"made": "commit abc", "commands": ["evetac x"], "sizes": {"recording_seeds": [1, 2]}}
    (folder / "likeness").mkdir()
    (folder / "likeness" / "after.json").write_text(json.dumps({**about, "rows": rows}))


def test_facts_stand_beside_ours(tmp_path: Path) -> None:
    """Assert how figures of ours compare, that they are counted, and that those off have a reason."""
    measured(tmp_path, one_slice=[0.35], data_rate_whole=[0.017])
    counted = likeness_tables.as_counted(tmp_path)
    assert "| 0.35 (off; n 3) |" in counted and "| 0.017 (within; n 3) |" in counted and "| not measured |" in counted
    assert likeness_tables.STUDY.pages["likeness-off"](tmp_path).startswith("- `one-slice`: the simulated slip is slow")
    assert "1 of these 19 facts are within" in likeness_tables.answer(tmp_path)


def test_every_fact_has_a_row(tmp_path: Path) -> None:
    """Assert that each fact stands in one of the two tables, once, with its public figure and class."""
    measured(tmp_path, one_slice=[0.35])
    text = likeness_tables.as_counted(tmp_path) + likeness_tables.as_others(tmp_path)
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    for fact in facts():
        (line,) = (line for line in lines if f"`{fact.name}`: " in line)
        assert fact.public in line and fact.kind in line
        assert line.count(" | ") == 3, fact.name
