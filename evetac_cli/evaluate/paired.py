"""Paired comparison of settings on the same trials: mean differences, their confidence intervals, the Pareto front.

The interval is Student's for the mean of paired differences, two-sided, at CONFIDENCE. A bootstrap would be too narrow:
with the few trials that fit into three minutes it only resamples the same few values. Shares of trials have their own
intervals, because Student's interval of a share of 0 or 1 would be too narrow.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.estimates import share as wilson

CONFIDENCE = 0.95


class ConfidenceInterval(NamedTuple):
    """Mean of paired differences or share, the ends of its interval, and the number of trials; NaN if too few."""

    mean: float
    low: float
    high: float
    trials: int


def difference(ours: Floats, theirs: Floats, resolution: float = 0.0) -> ConfidenceInterval:
    """Return the mean of ours - theirs over the trials in which both are known (not NaN).

    resolution: that of both values, such as a slice of 1 ms. Two rounded values differ by chance with a standard
    deviation of resolution / sqrt(6). The standard deviation is never assumed smaller, so that a few equal differences
    do not count as certain.
    """
    apart = ours - theirs
    apart = apart[np.isfinite(apart)]
    count = len(apart)
    if count == 0:
        return ConfidenceInterval(math.nan, math.nan, math.nan, 0)
    mean = float(apart.mean())
    if count == 1:
        return ConfidenceInterval(mean, math.nan, math.nan, 1)
    spread = max(float(apart.std(ddof=1)), resolution / math.sqrt(6.0))
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1)) * spread / math.sqrt(count)
    return ConfidenceInterval(mean, mean - half, mean + half, count)


def share(flags: Flags) -> ConfidenceInterval:
    """Return the share of trials in which a condition holds, with Wilson's interval."""
    count = len(flags)
    if count == 0:
        return ConfidenceInterval(math.nan, math.nan, math.nan, 0)
    return ConfidenceInterval(*wilson(int(np.count_nonzero(flags)), count), count)


def share_difference(ours: Flags, theirs: Flags) -> ConfidenceInterval:
    """Return the difference, ours - theirs, of two shares over the same trials.

    The interval is Wald's with half a trial added to each of the four cells of the table of pairs (Agresti and Min,
    Statistics in Medicine 24, 2005). Therefore a difference of 0 is not certain either. With 40 trials the interval has
    its nominal coverage; with 20 the coverage may be 91 %.
    """
    count = len(ours)
    if count == 0:
        return ConfidenceInterval(math.nan, math.nan, math.nan, 0)
    gained, lost = int(np.count_nonzero(ours & ~theirs)), int(np.count_nonzero(theirs & ~ours))
    middle = (gained - lost) / (count + 2)
    z = float(stats.norm.ppf(0.5 + CONFIDENCE / 2))
    half = z * math.sqrt(gained + lost + 1 - (gained - lost) ** 2 / (count + 2)) / (count + 2)
    return ConfidenceInterval((gained - lost) / count, max(middle - half, -1.0), min(middle + half, 1.0), count)


def finite_or_none(value: float) -> float | None:
    """Return the value for a table: None instead of NaN."""
    return value if math.isfinite(value) else None


def on_front(errors: Sequence[Floats], times: Sequence[Floats], resolution: float = 0.0) -> list[bool]:
    """Return which settings are certainly on the Pareto front of error and run time.

    errors and times: an array per setting, all over the same trials. A setting is on the front if every other setting
    has a larger error or a longer run time, and the interval of the difference excludes 0. If there are too few trials
    to distinguish two settings, neither of them is on the front.
    """

    def larger(theirs: Floats, ours: Floats, step: float) -> bool:
        return difference(theirs, ours, step).low > 0.0

    return [
        all(
            larger(times[other], times[one], 0.0) or larger(errors[other], errors[one], resolution)
            for other in range(len(errors))
            if other != one
        )
        for one in range(len(errors))
    ]
