"""An estimate with its 95 % interval, the intervals of counts and shares, and logistic regression.

scipy.stats takes half a second to load, so functions that need a distribution import it themselves.
"""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats

LEVEL = 0.95  # confidence level of all intervals
BLOCKS = 20  # equal blocks of time from which callers estimate the variation of a rate
ROUNDS = 2000  # of resampling: 50 of them are beyond either end of a 95 % interval


class Estimate(NamedTuple):
    """A value and the ends of its 95 % confidence interval."""

    value: float
    low: float
    high: float


def poisson_rate(events: int, exposure: float) -> Estimate:
    """Return a rate from a Poisson count in an exposure (time, or pixels times time), with its exact interval."""
    from scipy import stats

    tail = (1 - LEVEL) / 2
    low = stats.chi2.ppf(tail, 2 * events) / 2 if events else 0.0
    high = stats.chi2.ppf(1 - tail, 2 * events + 2) / 2
    return Estimate(events / exposure, low / exposure, high / exposure)


def rate_over_blocks(counts: NDArray[np.integer], exposure: float) -> Estimate:
    """Return a rate from counts in equal blocks of time; `exposure` is that of all blocks.

    The interval is Poisson's if the counts vary no more than that allows, else Student's from their own variation.
    """
    from scipy import stats

    events = int(counts.sum())
    poisson = poisson_rate(events, exposure)
    degrees = len(counts) - 1
    if degrees < 1 or events == 0:
        return poisson
    dispersion = float(np.sum((counts - counts.mean()) ** 2) / counts.mean())
    if dispersion <= stats.chi2.ppf(0.99, degrees):
        return poisson
    half = stats.t.ppf((1 + LEVEL) / 2, degrees) * counts.std(ddof=1) * np.sqrt(len(counts)) / exposure
    return Estimate(poisson.value, max(0.0, poisson.value - half), poisson.value + half)


def share(hits: int, count: int) -> Estimate:
    """Return the share of `count` trials with a hit, with Wilson's interval; 0 to 1 without trials."""
    if count == 0:
        return Estimate(float("nan"), 0.0, 1.0)
    from scipy import stats

    interval = stats.binomtest(hits, count).proportion_ci(LEVEL, method="wilson")
    return Estimate(hits / count, float(interval.low), float(interval.high))


def mean(value: float, sd: float, count: int) -> Estimate:
    """Return the mean of `count` values with this standard deviation, with Student's interval."""
    from scipy import stats

    half = float(stats.t.ppf((1 + LEVEL) / 2, count - 1)) * sd / float(np.sqrt(count))
    return Estimate(value, value - half, value + half)


def of_samples(value: float, samples: NDArray[np.float64]) -> Estimate:
    """Return a value with the interval of its resampled values (percentiles)."""
    low, high = np.percentile(samples, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return Estimate(value, float(min(low, value)), float(max(high, value)))


def cluster_weights(*factors: Sequence[Hashable]) -> NDArray[np.float64]:
    """Return the weight of each trial in each round of resampling, (ROUNDS, trials), for trials that share factors.

    factors: for each factor, such as the object or the sensor, its level in each trial. Each round resamples the levels
    of every factor, and a trial's weight is the product of its levels' counts. A factor with one level is left out; if
    none is left, the trials are resampled. The random numbers are always the same. Source: A. B. Owen, The pigeonhole
    bootstrap, 2007.
    """
    rng = np.random.default_rng(0)
    trials = len(factors[0])
    weights = np.ones((ROUNDS, trials))
    several = [factor for factor in factors if len(set(factor)) > 1] or [range(trials)]
    for factor in several if trials else []:
        number_by_level = {level: number for number, level in enumerate(dict.fromkeys(factor))}
        counts = rng.multinomial(len(number_by_level), np.full(len(number_by_level), 1 / len(number_by_level)), ROUNDS)
        weights *= counts[:, [number_by_level[level] for level in factor]]
    return weights


def ratio_of_clusters(
    above: NDArray[np.float64], below: NDArray[np.float64], weights: NDArray[np.float64]
) -> Estimate | None:
    """Return the ratio of two sums over trials, (trials,) each, with its interval from `cluster_weights`.

    None if the lower sum is 0. For a mean in which trials count by shares, pass values times shares, and shares.
    """
    if not below.sum() > 0:
        return None
    whole = weights @ below
    samples = (weights @ above)[whole > 0] / whole[whole > 0]
    return of_samples(float(above.sum() / below.sum()), samples)


NEWTON_ROUNDS = 50  # of Newton's method, without any other stopping rule
LONGEST_STEP = 3.0  # largest change of a weight per round: far from the optimum a whole Newton step would overshoot


def logistic_weights(columns: Floats, label: Floats, penalty: Floats, importance: Floats) -> Floats:
    """Return weights (k,) of a logistic regression, by Newton's method, from columns (n, k) and labels 0 or 1 (n,).

    They minimise the negative log likelihood plus half of penalty (k,) times the squared weights; importance (n,):
    weight of each row.
    """
    from scipy.special import expit  # here, because other users of the module do not need scipy

    weights = np.zeros(columns.shape[1])
    for _ in range(NEWTON_ROUNDS):
        probability = expit(columns @ weights)
        slope = columns.T @ (importance * (probability - label)) + penalty * weights
        bend = (columns * (importance * probability * (1 - probability))[:, None]).T @ columns + np.diag(penalty)
        weights = weights - np.clip(np.linalg.solve(bend, slope), -LONGEST_STEP, LONGEST_STEP)
    return weights
