"""The sums of scripts/attack/kill_grasps.py; the kills themselves need a quiet machine."""

from typing import Any

from scripts.attack.kill_grasps import summary


def row(ms: float, *, had_current: bool = True, again: bool = False) -> dict[str, Any]:
    late = {"machine_late_ms_p99": 0.1, "machine_late_ms_most": 1.0}
    return {"without_current_ms": ms, "had_current": had_current, "gripped_again": again, "traceback": False, **late}


def test_the_sum_of_trials() -> None:
    """Assert that the longest of all stands in it, with how many were over 100 ms, and that none is none."""
    whole = summary([row(60.0), row(0.0, had_current=False), row(100.0), row(100.1, again=True)])
    assert (whole["trials"], whole["with_current_when_struck"]) == (4, 3)
    assert (whole["without_current_ms_most"], whole["over_100_ms"], whole["gripped_again"]) == (100.1, 1, 1)
    assert whole["without_current_ms_median"] == 100.0
    assert summary([])["without_current_ms_most"] is None
