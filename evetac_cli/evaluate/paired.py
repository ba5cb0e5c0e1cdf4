"""Settings that were tried on the same trials: how far apart they are, how surely, and which of them are worth it.

The interval is Student's for the mean of paired differences, two-sided, at CONFIDENCE. Why so: with the few trials that
three minutes allow, a bootstrap can only draw again what it has seen, and its intervals are too narrow. Shares of
trials have intervals of their own: a share of 0 or 1 is not as sure as Student's would have it.
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
    """A mean of paired differences or a share, the ends of its interval, and over how many trials; NaN if too few."""

    mean: float
    low: float
    high: float
    trials: int


def difference(ours: Floats, theirs: Floats, resolution: float = 0.0) -> ConfidenceInterval:
    """The mean of ours - theirs over the trials in which both are known (not NaN).

    resolution: of both values, such as a slice of 1 ms. Two rounded values differ by chance with a standard deviation
    of resolution / sqrt(6); fewer is never assumed, so that a few equal differences do not count as sure.
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


def share(held: Flags) -> ConfidenceInterval:
    """The share of trials in which something holds, with Wilson's interval."""
    count = len(held)
    if count == 0:
        return ConfidenceInterval(math.nan, math.nan, math.nan, 0)
    return ConfidenceInterval(*wilson(int(np.count_nonzero(held)), count), count)


def share_difference(ours: Flags, theirs: Flags) -> ConfidenceInterval:
    """How much larger our share is than theirs over the same trials.

    The interval is Wald's with half a trial more in each of the four cells of the table of pairs (Agresti and Min,
    Statistics in Medicine 24, 2005), so that a difference of 0 is not sure either. With 40 trials it holds what it
    promises; with 20 it may hold 91 %.
    """
    count = len(ours)
    if count == 0:
        return ConfidenceInterval(math.nan, math.nan, math.nan, 0)
    gained, lost = int(np.count_nonzero(ours & ~theirs)), int(np.count_nonzero(theirs & ~ours))
    middle = (gained - lost) / (count + 2)
    z = float(stats.norm.ppf(0.5 + CONFIDENCE / 2))
    half = z * math.sqrt(gained + lost + 1 - (gained - lost) ** 2 / (count + 2)) / (count + 2)
    return ConfidenceInterval((gained - lost) / count, max(middle - half, -1.0), min(middle + half, 1.0), count)


def known(value: float) -> float | None:
    """A value for a table, which has None for NaN."""
    return value if math.isfinite(value) else None


def on_front(errors: Sequence[Floats], times: Sequence[Floats], resolution: float = 0.0) -> list[bool]:
    """Which settings are surely on the Pareto front of error and run time: arrays over the same trials, one a setting.

    A setting is where, for every other one, the interval of the difference says that the other is slower or has the
    larger error. Where trials are too few to tell two settings apart, neither is.
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
