"""What the rows of a gripper tell of it: how late its commands take effect, its encoder's noise, its servo's gain.

A command takes effect after a delay and a random part of a jitter, uniform, as in the simulated gripper. Each command
tells two readings between which it took effect; how likely delay and jitter make all of them is computed on a grid.

An encoder reads whole ticks: the whole part of the motor's place and normal noise. Where a motor rests between two
ticks is not known, so it is summed over, all places equally likely; rests at several places tell more than a long one.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from evetac_cli.arrays import Floats
from evetac_cli.kernels.estimates import LEVEL, Estimate

ALONE_MS = 16.0  # a command counts that no other one precedes or follows by less
FEWEST_COMMANDS = 20
STEP_MS = 0.05  # of the grid
DROP = 3.0  # of the log likelihood: 1.92 for 95 % if it were smooth, but whole ms make it one with corners
STRAY = 1e-3  # share of commands that may be late by anything

FEWEST_READINGS = 20  # of a rest
MOST_TICKS = 5.0
SPREADS = np.concatenate([[0.0], np.geomspace(0.005, MOST_TICKS, 300)])
PLACES = (np.arange(200) + 0.5) / 200

STILL_MS = 16.0  # a goal has come to the servo after so long
FEWEST_ROWS = 50
RESAMPLES = 200
LEAST_SHARE = 0.002  # half width of the interval at least
MOST_PART = 0.98  # of the largest current: beyond it a limit may hold


def lateness(
    time_us: NDArray[np.int64], commanded_ma: NDArray[np.float64], measured_ma: NDArray[np.float64], step_ms: float
) -> Floats:
    """Between which times in ms each command took effect, (commands, 2); the second is infinite where none was seen.

    A row's current is measured before its command is given. step_ms: what passes from a command without delay until a
    reading can show it; 1 in a simulation of 1 ms. A command has taken effect where the current is nearer to the new
    one than to that before.
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
    """Delay and jitter in ms from what `lateness` found; ValueError with fewer than FEWEST_COMMANDS."""
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
    """Mean of what the rows of a table stand for, and all that is likely enough with any column.

    Why so: where commands always take as many ms, delay and jitter are only known to lie within one ms together, and
    its ends are as likely as its middle.
    """
    weight = np.exp(log_likelihood - log_likelihood.max()).sum(axis=1)
    likely = values[log_likelihood.max(axis=1) >= log_likelihood.max() - DROP]
    return Estimate(
        float(values @ weight / weight.sum()), float(likely[0]) - STEP_MS / 2, float(likely[-1]) + STEP_MS / 2
    )


def encoder_noise(rests: Sequence[NDArray[np.integer]]) -> Estimate:
    """Standard deviation in ticks, from the readings of each rest; ValueError where none has FEWEST_READINGS."""
    rests = [rest for rest in rests if len(rest) >= FEWEST_READINGS]
    if not rests:
        raise ValueError("the motor never rests")
    log_likelihood = np.zeros(len(SPREADS))
    for rest in rests:
        ticks, count = np.unique(np.asarray(rest, np.int64), return_counts=True)
        middle = int(np.round(np.median(rest)))
        at = (middle - 1 + np.arange(3))[:, None] + PLACES  # the motor rests within a tick of what is read mostly
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
    """Share of the readings below a distance from the motor's place."""
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
    """Gain in mA a tick, from rows of goals (given after what the row measured) and of place and current.

    Rows count where the goal has been the same for STILL_MS and place and goal differ. ValueError with fewer than
    FEWEST_ROWS of them, or where the current does not follow the goal.
    """
    time_ms = np.asarray(time_us, np.float64) * 1e-3
    new = np.flatnonzero(np.diff(goal_ticks, prepend=np.nan) != 0)  # the first row is one
    last = new[np.searchsorted(new, np.arange(len(time_ms)), side="left") - 1]  # goal that was given before the row
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
