"""Times between events of hot pixels: steps of the time stamps, the shortest time, and a law of two exponentials.

Times between events are those of one pixel, in us. Sources: none; what fits a real DVXplorer (sim/camera/noise.py).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.identify.estimates import Estimate, of_samples

Floats = NDArray[np.float64]

FEWEST_INTERVALS = 200  # for steps and dead time
MOST_INTERVALS = 20_000  # of which steps are looked for
LONGEST_INTERVAL_US = 20_000.0  # for steps: in longer ones an error of the step adds up to a whole step
HIGHEST_HZ, STEP_HZ = 20_000.0, 5.0  # of scans
SLOWEST_SCAN = 3.0  # in units of the mean rate: slower scans could not be told from slow pixels
COHERENT = 0.8  # mean of the phases' unit vectors; 1 if all intervals are whole steps
DEAD_SHARES = (0.02, 0.04)  # of the intervals, from which the shortest possible one is extrapolated
RESAMPLES = 200
FEWEST_FOR_TWO = 15  # intervals of a pixel from which two exponentials are told from one
WORTH_IT = 2.0  # log likelihood by which two must be better (Akaike: two more parameters)
MEANS = np.geomspace(0.05, 1e4, 48)  # in steps: means of an exponential that are tried
ROUNDS = 25  # of expectation maximisation for a share
EXACT_BELOW, BINS_A_DECADE = 32, 20  # intervals of so many steps and more are counted in bins


class TwoExponentials(NamedTuple):
    """Share of the intervals that come from the shorter exponential, and its mean beyond the dead time, in us."""

    short_share: float
    short_us: float


def time_step(interval_us: Floats) -> Estimate | None:
    """The step of which all intervals are multiples, in us; 0 where there is none, None if there are too few.

    The longest step at which the phases agree as well as at any.
    """
    near = interval_us[(interval_us > 0) & (interval_us < LONGEST_INTERVAL_US)]
    if len(near) < FEWEST_INTERVALS:
        return None
    near = near[:: max(1, len(near) // MOST_INTERVALS)]
    scan_hz = np.arange(SLOWEST_SCAN * 1e6 / near.mean(), HIGHEST_HZ, STEP_HZ)
    whole_us, count = np.unique(near, return_counts=True)
    turn = np.exp(2j * np.pi * 1e-6 * STEP_HZ * whole_us)
    phase = np.exp(2j * np.pi * 1e-6 * scan_hz[0] * whole_us) * count if len(scan_hz) else np.empty(0)
    coherence = np.empty(len(scan_hz))
    for place in range(len(scan_hz)):
        coherence[place] = abs(phase.sum()) / len(near)
        phase = phase * turn
    coherent = np.flatnonzero(coherence >= max(COHERENT, 0.95 * coherence.max(initial=0.0)))
    if not len(coherent):
        return Estimate(0.0, 0.0, 0.0)
    first = coherent[0]
    best = first + int(np.argmax(coherence[first : first + 20]))
    step_us = 1e6 / scan_hz[best]
    for _ in range(3):
        steps = np.round(near / step_us)
        step_us = float((steps @ near) / (steps @ steps))
    off_us = near - np.round(near / step_us) * step_us
    half_us = 1.96 * float(np.sqrt((steps**2) @ (off_us**2))) / float(steps @ steps)
    return Estimate(step_us, step_us - half_us, step_us + half_us)


def dead_time(interval_us: Floats, step_us: float, rng: np.random.Generator) -> Estimate | None:
    """The shortest time between two events of one pixel, in us; None if there are too few.

    Extrapolated from two small quantiles, so that rare shorter ones do not count, with a bootstrap interval.
    """
    if len(interval_us) < FEWEST_INTERVALS:
        return None
    ordered = np.sort(interval_us)
    size = len(ordered)
    first, second = DEAD_SHARES

    def extrapolated(lower: Floats, upper: Floats) -> Floats:
        near, far = (ordered[np.minimum((share * size).astype(np.int64), size - 1)] for share in (lower, upper))
        dead_us: Floats = np.maximum(2.0 * near - far, 0.0)
        return np.round(dead_us / step_us) * step_us if step_us else dead_us

    # Where quantiles of a resample lie among the ordered values: shares of gamma variates.
    parts = rng.gamma(size * np.array([first, second - first, 1 - second]), size=(RESAMPLES, 3))
    shares = np.cumsum(parts, axis=1) / parts.sum(axis=1, keepdims=True)
    value = extrapolated(np.array([first]), np.array([second]))[0]
    return of_samples(float(value), extrapolated(shares[:, 0], shares[:, 1]))


def two_exponentials(interval_us: Floats, dead_us: float, step_us: float) -> TwoExponentials:
    """The law of a pixel's intervals beyond the dead time: two exponentials where they fit better than one.

    Maximum likelihood over a table of means. Intervals are whole steps of `step_us` (0: of a microsecond).
    """
    unit_us = max(step_us, 1.0)
    steps = np.maximum(np.round((interval_us - dead_us) / unit_us), 0.0)
    if len(steps) < FEWEST_FOR_TWO:
        return TwoExponentials(0.0, 0.0)
    binned = np.where(
        steps < EXACT_BELOW,
        steps,
        np.round(10 ** (np.round(np.log10(np.maximum(steps, 1.0)) * BINS_A_DECADE) / BINS_A_DECADE)),
    )
    value, count = np.unique(binned, return_counts=True)
    means = MEANS * (200.0 / unit_us if step_us == 0.0 else 1.0)
    likelihood = np.maximum(_share_of_steps(value[None], means[:, None]), 1e-300)
    one = float((np.log(likelihood) @ count).max())
    short, long = np.triu_indices(len(means), 1)
    shorter, longer = likelihood[short], likelihood[long]
    weight = np.full(len(short), 0.5)
    for _ in range(ROUNDS):
        part = weight[:, None] * shorter
        weight = (part / (part + (1 - weight[:, None]) * longer)) @ count / count.sum()
    both = np.log(weight[:, None] * shorter + (1 - weight[:, None]) * longer) @ count
    best = int(np.argmax(both))
    if both[best] - one < WORTH_IT:
        return TwoExponentials(0.0, 0.0)
    return TwoExponentials(float(min(weight[best], 0.99)), float(means[short[best]] * unit_us))


def _share_of_steps(steps: Floats, mean: Floats) -> Floats:
    """Share of the intervals that span so many whole steps, if they are exponential and start anywhere in a step."""
    survival = np.exp(-1.0 / mean)
    some: Floats = np.where(
        steps <= 0, 1 - mean * (1 - survival), mean * (1 - survival) ** 2 * survival ** np.maximum(steps - 1, 0)
    )
    return some
