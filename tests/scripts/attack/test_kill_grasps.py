"""The plan and the sums of scripts/attack/kill_grasps.py; the kills themselves need a quiet machine."""

from argparse import Namespace
from collections import Counter
from typing import Any

from scripts.attack.kill_grasps import planned, summary


def chosen(**more: Any) -> Namespace:
    given = {"kills": 40, "stops": 20, "commands": ["grasp"], "watchdog_ms": 60, "busy": 0, "seed": 0}
    return Namespace(**{**given, **more})


def test_the_plan_has_as_many_kills_and_stops_as_asked_for() -> None:
    """Assert their numbers, half of each timed from the motor's first current, and that no two trials are the same."""
    trials = planned(chosen())
    counts = Counter((plan["how"], plan["since"]) for plan in trials)
    expected = {("kill", "start"): 20, ("kill", "current"): 20, ("stop", "start"): 10, ("stop", "current"): 10}
    assert counts == expected
    assert {plan["command"] for plan in trials} == {"grasp"}
    assert len({tuple(plan.items()) for plan in trials}) == 60
    both = Counter((plan["command"], plan["since"]) for plan in planned(chosen(stops=0, commands=["grasp", "record"])))
    assert set(both.values()) == {10}


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
