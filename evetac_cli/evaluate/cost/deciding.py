"""How an undecided comparison in a report could be decided: the command with enough trials, and its run time.

A paired difference is decided if its interval excludes 0. The interval narrows with the square root of the number of
trials (and with Student's factor). So the observed spread shows how many trials would exclude 0 if the difference stays
as it is. If no difference was observed, no estimate is possible.
"""

import math
import shlex
from typing import NamedTuple

import numpy as np
from scipy import stats

from evetac_cli.arrays import Flags
from evetac_cli.commands.evaluate import EvaluateCost
from evetac_cli.evaluate.paired import CONFIDENCE, ConfidenceInterval, share_difference
from evetac_cli.jobs import Row, Rows

MOST_TRIALS = 10_000  # largest value of --trials
FEWEST_TRIALS = 4  # with fewer the spread is meaningless


class Effort(NamedTuple):
    """A run of `evaluate cost`: its parameters, its trials as counted by --trials, processor time per trial."""

    params: EvaluateCost
    trials: int
    minutes_a_trial: float

    def command(self, trials: int) -> str:
        """Return the command of the same run with this many trials."""
        words = ["evetac evaluate cost", self.params.part, f"--trials {trials}"]
        words += [f"--seed {self.params.seed}"] if self.params.seed != EvaluateCost.seed else []
        words += ["--full"] if self.params.full else []
        words += [f"--model {shlex.quote(str(self.params.model))}"] if self.params.model is not None else []
        return " ".join(words)

    def deciding(self, apart: ConfidenceInterval, shares: tuple[Flags, Flags] | None = None) -> Row:
        """Return columns for a paired difference: whether it is decided, or the command and minutes to decide it.

        shares: for a difference of shares, the trials in which the condition holds, ours and theirs. Minutes are
        processor time on the machine of this run, estimated from its own trials.
        """
        decided, needed = verdict(apart)
        if needed is not None and shares is not None:
            needed = share_trials_needed(*shares)
        if needed is None:
            return {"decided": decided, "decide_with": None, "decide_min": None}
        trials = max(math.ceil(needed * self.trials / apart.trials), self.trials + 1)
        if trials > MOST_TRIALS:
            return {"decided": f"no, not with {MOST_TRIALS:,} trials", "decide_with": None, "decide_min": None}
        return {
            "decided": decided,
            "decide_with": self.command(trials),
            "decide_min": round(trials * self.minutes_a_trial, 1),
        }

    def beside(self, row: Row, compared_with: str, *columns: str) -> Row:
        """Return the row with these columns, for a difference in four of its own: mean, low, high, trials.

        compared_with: the setting with which others are compared; its own row has nothing to decide.
        """
        if row["setting"].endswith(compared_with):
            return {**row, "decided": None, "decide_with": None, "decide_min": None}
        mean, low, high, trials = (math.nan if row[name] is None else float(row[name]) for name in columns)
        return {**row, **self.deciding(ConfidenceInterval(mean, low, high, int(trials)))}


def verdict(apart: ConfidenceInterval) -> tuple[str, int | None]:
    """Return whether a difference is decided, in words, and the number of trials to decide it if known."""
    if math.isnan(apart.mean):
        return "not compared", None
    if apart.low > 0.0 or apart.high < 0.0:
        return "yes", None
    if math.isnan(apart.low):  # one trial
        return "no", FEWEST_TRIALS
    if apart.mean == 0.0:
        return "no difference seen", None
    return "no", trials_needed(apart)


def trials_needed(apart: ConfidenceInterval) -> int:
    """Return the number of trials for the interval to exclude 0, if mean and spread stay as they are.

    At most MOST_TRIALS + 1. apart: undecided, of at least two trials, with a mean other than 0.
    """
    spread = 0.5 * (apart.high - apart.low) / _factor(apart.trials)
    too_few, enough = apart.trials, MOST_TRIALS + 1
    while enough - too_few > 1:
        middle = (too_few + enough) // 2
        if spread * _factor(middle) < abs(apart.mean):
            enough = middle
        else:
            too_few = middle
    return enough


def share_trials_needed(ours: Flags, theirs: Flags) -> int:
    """Return the same for shares: the existing trials are repeated as often as needed; at most MOST_TRIALS + 1."""
    too_few, enough = 1, MOST_TRIALS // len(ours) + 1
    while enough - too_few > 1:
        middle = (too_few + enough) // 2
        apart = share_difference(np.tile(ours, middle), np.tile(theirs, middle))
        if apart.low > 0.0 or apart.high < 0.0:
            enough = middle
        else:
            too_few = middle
    return enough * len(ours) if enough <= MOST_TRIALS // len(ours) else MOST_TRIALS + 1


def _factor(trials: int) -> float:
    """Return half an interval divided by the standard deviation of a difference."""
    return float(stats.t.ppf(0.5 + CONFIDENCE / 2, trials - 1)) / math.sqrt(trials)


def undecided(rows: Rows) -> list[str]:
    """Return a sentence on undecided rows, with the cheapest command that decides one; [] if all are decided."""
    compared = [row for row in rows if row.get("decided") is not None]
    open_ = [row for row in compared if str(row["decided"]).startswith("no")]
    if not open_:
        return []
    words = f"Undecided: {len(open_)} of {len(compared)} differences"
    commands = [row for row in open_ if row["decide_with"] is not None]
    if not commands:
        return [f"{words}."]
    cheapest = min(commands, key=lambda row: float(row["decide_min"]))
    return [f"{words}. Decide the first with: {cheapest['decide_with']} ({cheapest['decide_min']:g} min)."]
