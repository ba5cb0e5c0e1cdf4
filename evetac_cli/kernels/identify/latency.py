"""How late a gripper's commands take effect, from when a new current was commanded and when it was first measured.

A command takes effect after a delay and a random part of a jitter, uniform, as in the simulated gripper. Each command
tells two readings between which it took effect; how likely delay and jitter make all of them is computed on a grid.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.identify.estimates import Estimate

Floats = NDArray[np.float64]

ALONE_MS = 16.0  # a command counts that no other one precedes or follows by less
FEWEST = 20  # commands
STEP_MS = 0.05  # of the grid
DROP = 3.0  # of the log likelihood: 1.92 for 95 % if it were smooth, but whole ms make it one with corners
STRAY = 1e-3  # share of commands that may be late by anything


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
    """Delay and jitter in ms from what `lateness` found; ValueError with fewer than FEWEST commands."""
    if len(between_ms) < FEWEST:
        raise ValueError(f"too few commands: {len(between_ms)} of {FEWEST}")
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
