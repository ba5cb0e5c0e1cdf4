"""What would decide a comparison: by hand, against trials that were drawn, and the sentence on what is left open."""

import math
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.evaluate import EvaluateCost
from evetac_cli.evaluate.cost.deciding import (
    MOST_TRIALS,
    Effort,
    share_trials_needed,
    trials_needed,
    undecided,
    verdict,
)
from evetac_cli.evaluate.paired import ConfidenceInterval, difference, share_difference


def drawn(count: int, mean: float) -> ConfidenceInterval:
    """The difference of so many trials with this mean and a standard deviation of exactly 1."""
    values = np.random.default_rng(1).standard_normal(count)
    values = (values - values.mean()) / values.std(ddof=1)
    return difference(values + mean, np.zeros(count))


@pytest.mark.parametrize("mean", [0.5, -0.2, 0.05])
def test_as_many_trials_as_are_needed_decide(mean: float) -> None:
    """Assert that with the same mean and spread so many trials leave out 0, and one fewer do not."""
    needed = trials_needed(drawn(4, mean))
    assert verdict(drawn(needed, mean)) == ("yes", None)
    assert verdict(drawn(needed - 1, mean)) == ("no", needed)


def test_as_many_trials_as_shares_need() -> None:
    """Assert that so many rounds of the same trials decide a difference of shares, and one fewer do not."""
    ours, theirs = np.array([True, False, False]), np.zeros(3, bool)
    needed = share_trials_needed(ours, theirs)
    assert needed % 3 == 0
    rounds = needed // 3
    assert share_difference(np.tile(ours, rounds), np.tile(theirs, rounds)).low > 0.0
    assert share_difference(np.tile(ours, rounds - 1), np.tile(theirs, rounds - 1)).low <= 0.0
    apart = share_difference(ours, theirs)
    assert Effort(EvaluateCost(part="pipeline"), 3, 1.0).deciding(apart, (ours, theirs))["decide_min"] == needed
    balanced = np.arange(3000) < 1500
    assert share_trials_needed(balanced, np.arange(3000) < 1499) == MOST_TRIALS + 1


def test_verdicts() -> None:
    """Assert what is said of differences that are sure, unsure, of one trial, of none, and of none that was seen."""
    assert verdict(ConfidenceInterval(1.0, 0.5, 1.5, 4)) == ("yes", None)
    assert verdict(ConfidenceInterval(-1.0, -1.5, -0.5, 4)) == ("yes", None)
    assert verdict(ConfidenceInterval(1.0, math.nan, math.nan, 1)) == ("no", 4)
    assert verdict(ConfidenceInterval(math.nan, math.nan, math.nan, 0)) == ("not compared", None)
    assert verdict(ConfidenceInterval(0.0, -1.0, 1.0, 4)) == ("no difference seen", None)
    assert verdict(ConfidenceInterval(1e-9, -1.0, 1.0, 4)) == ("no", MOST_TRIALS + 1)


def test_the_command_is_the_same_run_with_more_trials() -> None:
    """Assert that --full, --seed and --model come along, and that minutes are those of as many trials."""
    apart = drawn(4, 0.5)
    needed = trials_needed(apart)
    plain = Effort(EvaluateCost(part="pipeline"), 4, 0.5).deciding(apart)
    assert plain == {
        "decided": "no",
        "decide_with": f"evetac evaluate cost pipeline --trials {needed}",
        "decide_min": round(0.5 * needed, 1),
    }
    params = EvaluateCost(part="grasp", seed=7, full=True, model=Path("my models"))
    other = Effort(params, 2, 3.0).deciding(apart)  # of two objects, two trials each
    trials = math.ceil(needed / 2)
    assert other["decide_with"] == f"evetac evaluate cost grasp --trials {trials} --seed 7 --full --model 'my models'"
    assert other["decide_min"] == 3.0 * trials
    beyond = Effort(params, 4, 3.0).deciding(ConfidenceInterval(1e-9, -1.0, 1.0, 4))
    assert beyond == {"decided": "no, not with 10,000 trials", "decide_with": None, "decide_min": None}


def test_columns_of_a_row() -> None:
    """Assert that the setting which others are compared with has nothing to decide, and another's None is unknown."""
    effort = Effort(EvaluateCost(part="grasp"), 1, 1.0)
    row = {"setting": "paper, usual", "mean": 0.0, "low": 0.0, "high": 0.0, "trials": 2}
    assert effort.beside(row, "usual", "mean", "low", "high", "trials")["decided"] is None
    late = {"setting": "paper, late", "mean": None, "low": None, "high": None, "trials": 0}
    assert effort.beside(late, "usual", "mean", "low", "high", "trials") == late | {
        "decided": "not compared",
        "decide_with": None,
        "decide_min": None,
    }


def test_what_is_left_open() -> None:
    """Assert that undecided rows are counted, and that the cheapest command is named."""

    def row(decided: str | None, command: str | None, minutes: float | None) -> dict[str, object]:
        return {"decided": decided, "decide_with": command, "decide_min": minutes}

    assert undecided([{"setting": "a"}, row("yes", None, None), row(None, None, None)]) == []
    open_rows = [row("yes", None, None), row("no", "long", 40.0), row("no", "short", 4.5)]
    assert undecided(open_rows) == ["Undecided: 2 of 3 differences. Decide the first with: short (4.5 min)."]
    assert undecided([row("no difference seen", None, None)]) == ["Undecided: 1 of 1 differences."]
