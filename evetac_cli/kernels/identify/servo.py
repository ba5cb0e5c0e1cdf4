"""The gain of a position servo: the current that it gives for each tick that its goal is ahead."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.identify.estimates import LEVEL, Estimate

Floats = NDArray[np.float64]

STILL_MS = 16.0  # a goal has come to the servo after so long
FEWEST = 50  # rows
RESAMPLES = 200
LEAST_SHARE = 0.002  # half width of the interval at least
MOST_PART = 0.98  # of the largest current: beyond it a limit may hold


def gain(
    time_us: NDArray[np.int64],
    goal_ticks: NDArray[np.float64],
    place_ticks: NDArray[np.float64],
    current_ma: Floats,
    rng: np.random.Generator,
) -> Estimate:
    """Gain in mA a tick, from rows of goals (given after what the row measured) and of place and current.

    Rows count where the goal has been the same for STILL_MS and place and goal differ. ValueError with fewer than
    FEWEST of them, or where the current does not follow the goal.
    """
    time_ms = np.asarray(time_us, np.float64) * 1e-3
    new = np.flatnonzero(np.diff(goal_ticks, prepend=np.nan) != 0)  # the first row is one
    last = new[np.searchsorted(new, np.arange(len(time_ms)), side="left") - 1]  # goal that was given before the row
    behind_ticks = goal_ticks[last] - place_ticks
    free = np.abs(current_ma) < MOST_PART * np.abs(current_ma).max(initial=0.0)
    counts = (np.arange(len(time_ms)) > last) & (time_ms - time_ms[last] >= STILL_MS) & (behind_ticks != 0)
    if (counts & free).sum() >= FEWEST:
        counts &= free
    if counts.sum() < FEWEST:
        raise ValueError(f"too few rows in which the servo was behind a goal: {counts.sum()} of {FEWEST}")
    each = current_ma[counts] / behind_ticks[counts]
    value = float(np.median(each))
    if not value > 0:
        raise ValueError("the current does not follow the goal")
    medians = np.median(each[rng.integers(0, len(each), (RESAMPLES, min(len(each), 2000)))], axis=1)
    low, high = np.percentile(medians, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    half = max(2 * float(np.subtract(*np.percentile(each, [75, 25]))) / np.sqrt(len(each)), LEAST_SHARE * value)
    return Estimate(value, min(float(low), value - half), max(float(high), value + half))
