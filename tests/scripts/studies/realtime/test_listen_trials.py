"""Trials with kills: what is measured of a recording by the time that its events show, and that none is lost."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scripts.studies.realtime import listen_trials
from tests.patience import PATIENCE_S

KEPT: dict[str, Any] = {
    **{"kill": "", "continues": True, "faults": None, "events_missing": 0, "marks": 2},
    **{"starts_late_ms": -0.5, "ends_early_ms": -1.0},
}


@pytest.mark.parametrize(
    ("changed", "kept"),
    [
        ({}, True),
        ({"marks": 1}, False),
        ({"events_missing": 1}, False),
        ({"starts_late_ms": 0.1}, False),
        ({"ends_early_ms": 0.1}, False),
        ({"ends_early_ms": 250.0, "kill": "server"}, True),
        ({"ends_early_ms": 450.0, "kill": "server"}, False),
        ({"continues": False}, False),
        ({"faults": "x"}, False),
    ],
)
def test_what_counts_as_kept(changed: dict[str, Any], kept: bool) -> None:
    """Assert that a trial with anything missing is not kept, but for the last moment before a kill of the server."""
    assert listen_trials.is_kept(KEPT | changed) is kept


@pytest.mark.slow
def test_no_trial_is_lost(tmp_path: Path) -> None:
    """Assert that trials with a kill of each kind are kept, and that unauthorised get nothing."""
    rows = tmp_path / "rows.jsonl"
    few = ("--trials", "4", "--connections", "1", "--clients", "1", "--servers", "1")
    command = [sys.executable, listen_trials.__file__, "-o", str(rows), *few]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stderr
    made = [json.loads(line) for line in rows.read_text().splitlines()]
    assert [row["kept"] for row in made if "trial" in row] == [True] * 4
    assert all(row["refused"] for row in made if "client" in row)
