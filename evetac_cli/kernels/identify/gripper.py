"""Delay of commands, encoder noise and servo gain of a gripper, estimated from its recorded rows.

A command takes effect after a fixed delay plus a uniform random part, the jitter, as in the simulated gripper. For each
command, two readings bracket the time at which it took effect. The likelihood of all brackets is computed on a grid of
delay and jitter.

An encoder reads whole ticks: the integer part of the motor's position plus normal noise. The exact position between two
ticks is unknown while the motor rests, so the likelihood is summed over all positions with equal weight. Rests at
several positions carry more information than one long rest.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from evetac_cli.arrays import Floats
from evetac_cli.kernels.estimates import LEVEL, Estimate

ALONE_MS = 16.0  # a command counts only if no other command is closer in time than this
FEWEST_COMMANDS = 20  # for delay and jitter
STEP_MS = 0.05  # grid step of delay and jitter
# of the log likelihood at the ends of the interval: 1.92 is 95 % for a smooth one, but whole ms give it corners
DROP = 3.0
STRAY = 1e-3  # share of commands that may be late by any amount

FEWEST_READINGS = 20  # of one rest
MOST_TICKS = 5.0  # largest standard deviation on the grid
SPREADS = np.concatenate([[0.0], np.geomspace(0.005, MOST_TICKS, 300)])  # standard deviations on the grid, in ticks
PLACES = (np.arange(200) + 0.5) / 200  # positions within one tick on the grid

STILL_MS = 16.0  # time after which a goal has certainly reached the servo
FEWEST_ROWS = 50  # in which the servo is behind its goal
RESAMPLES = 200  # of the bootstrap
LEAST_SHARE = 0.002  # smallest half width of the interval, as a share of the gain
MOST_PART = 0.98  # rows above this share of the largest current are left out: a current limit may act there


def lateness(
    time_us: NDArray[np.int64], commanded_ma: NDArray[np.float64], measured_ma: NDArray[np.float64], step_ms: float
) -> Floats:
    """Return the times in ms between which each command took effect, (commands, 2); the second is inf if unseen.

    A row's current is measured before its command is issued. A command has taken effect when the current is nearer to
    the new command than to the previous one. `step_ms`: shortest time after which a reading can show a command without
    delay; 1 in a simulation with steps of 1 ms.
    """
    time_ms = np.asarray(time_us, np.float64) * 1e-3
    changes = np.flatnonzero(np.diff(commanded_ma) != 0) + 1
    gaps = np.diff(time_ms[changes], prepend=-np.inf, append=np.inf)
    alone = (gaps[:-1] >= ALONE_MS) & (gaps[1:] >= ALONE_MS)
    between = []
    for row in changes[alone]:
        before, after = commanded_ma[row - 1], commanded_ma[row]
        until = np.searchsorted(time_ms, time_ms[row] + ALONE_MS, side="right")
        readings = measured_ma[row + 1 : until]
        seen = np.flatnonzero(np.abs(readings - after) < np.abs(readings - before))
        passed = time_ms[row:until] - time_ms[row] - step_ms
        if not len(readings):
            continue
        between.append((passed[seen[0]], passed[seen[0] + 1]) if len(seen) else (passed[-1], np.inf))
    return np.array(between, np.float64).reshape(-1, 2)


def delay_and_jitter(between_ms: Floats) -> tuple[Estimate, Estimate]:
    """Return delay and jitter in ms from the brackets of `lateness`; ValueError with fewer than FEWEST_COMMANDS."""
    if len(between_ms) < FEWEST_COMMANDS:
        raise ValueError(f"too few commands: {len(between_ms)} of {FEWEST_COMMANDS}")
    if not np.isfinite(between_ms[:, 1]).mean() > 0.5:
        raise ValueError(f"most commands took no effect within {ALONE_MS:g} ms")
    rounded = np.round(between_ms, 2)
    bounds, count = np.unique(rounded, axis=0, return_counts=True)
    most_ms = float(rounded[np.isfinite(rounded[:, 1]), 1].max()) + 1.0
    values = np.arange(0.0, max(most_ms, 1.0), STEP_MS) + STEP_MS / 2
    delay, jitter = values[:, None], values[None, :]
    log_likelihood = np.zeros((len(values), len(values)))
    for (low, high), times in zip(bounds, count, strict=True):
        reached = np.clip((high - delay) / jitter, 0.0, 1.0) if np.isfinite(high) else 1.0
        share = reached - np.clip((low - delay) / jitter, 0.0, 1.0)
        log_likelihood += times * np.log((1 - STRAY) * np.maximum(share, 0.0) + STRAY * 0.02)
    return _of_axis(values, log_likelihood), _of_axis(values, log_likelihood.T)


def _of_axis(values: Floats, log_likelihood: Floats) -> Estimate:
    """Return the mean of the grid's row values, and an interval of all values that are likely with any column.

    Reason: if commands always take the same number of ms, delay and jitter are only known to add up to a value within
    one ms. All values in that ms are equally likely, its ends as much as its middle.
    """
    weight = np.exp(log_likelihood - log_likelihood.max()).sum(axis=1)
    likely = values[log_likelihood.max(axis=1) >= log_likelihood.max() - DROP]
    return Estimate(
        float(values @ weight / weight.sum()), float(likely[0]) - STEP_MS / 2, float(likely[-1]) + STEP_MS / 2
    )


def encoder_noise(rests: Sequence[NDArray[np.integer]]) -> Estimate:
    """Return the standard deviation in ticks from the readings of each rest; ValueError if all rests are too short."""
    rests = [rest for rest in rests if len(rest) >= FEWEST_READINGS]
    if not rests:
        raise ValueError("the motor never rests")
    log_likelihood = np.zeros(len(SPREADS))
    for rest in rests:
        ticks, count = np.unique(np.asarray(rest, np.int64), return_counts=True)
        middle = int(np.round(np.median(rest)))
        at = (middle - 1 + np.arange(3))[:, None] + PLACES  # the motor rests within a tick of the most frequent reading
        places = at.reshape(-1)
        each = np.empty((len(SPREADS), len(places)))
        for number, spread in enumerate(SPREADS):
            up = _below((ticks[:, None] + 1 - places), spread) - _below((ticks[:, None] - places), spread)
            each[number] = count @ np.log(np.maximum(up, 1e-12))
        most = each.max()
        log_likelihood += np.log(np.exp(each - most).mean(axis=1) + 1e-300) + most
    weight = np.exp(log_likelihood - log_likelihood.max())
    widths = np.diff(SPREADS, append=SPREADS[-1])
    edges = np.append(SPREADS, SPREADS[-1])
    share = np.concatenate([[0.0], np.cumsum(weight * widths)]) / (weight @ widths)
    low, value, high = np.interp([(1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2], share, edges)
    return Estimate(float(value), float(low), float(high))


def _below(distance: Floats, spread: float) -> Floats:
    """Return the share of readings that are below a distance from the motor's position."""
    if spread == 0.0:
        return (distance > 0).astype(np.float64)
    below: Floats = stats.norm.cdf(distance / spread)
    return below


def servo_gain(
    time_us: NDArray[np.int64],
    goal_ticks: NDArray[np.float64],
    place_ticks: NDArray[np.float64],
    current_ma: Floats,
    rng: np.random.Generator,
) -> Estimate:
    """Return the servo gain in mA per tick, from rows of goal, position and current.

    A row's goal was given after its position and current were measured. Rows count if the goal has been the same for
    STILL_MS and differs from the position. ValueError with fewer than FEWEST_ROWS of them, or if the current does not
    follow the goal.
    """
    time_ms = np.asarray(time_us, np.float64) * 1e-3
    new = np.flatnonzero(np.diff(goal_ticks, prepend=np.nan) != 0)  # the first row counts as a change
    # the goal in force when the row was measured
    last = new[np.searchsorted(new, np.arange(len(time_ms)), side="left") - 1]
    behind_ticks = goal_ticks[last] - place_ticks
    free = np.abs(current_ma) < MOST_PART * np.abs(current_ma).max(initial=0.0)
    counts = (np.arange(len(time_ms)) > last) & (time_ms - time_ms[last] >= STILL_MS) & (behind_ticks != 0)
    if (counts & free).sum() >= FEWEST_ROWS:
        counts &= free
    if counts.sum() < FEWEST_ROWS:
        raise ValueError(f"too few rows in which the servo was behind a goal: {counts.sum()} of {FEWEST_ROWS}")
    each = current_ma[counts] / behind_ticks[counts]
    value = float(np.median(each))
    if not value > 0:
        raise ValueError("the current does not follow the goal")
    medians = np.median(each[rng.integers(0, len(each), (RESAMPLES, min(len(each), 2000)))], axis=1)
    low, high = np.percentile(medians, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    half = max(2 * float(np.subtract(*np.percentile(each, [75, 25]))) / np.sqrt(len(each)), LEAST_SHARE * value)
    return Estimate(value, min(float(low), value - half), max(float(high), value + half))
