"""How noisy an encoder is that reads whole ticks, from readings while its motor rests.

A reading is the whole part of the motor's place and normal noise. Where a motor rests between two ticks is not known,
so it is summed over, all places equally likely; rests at several places tell more than a long one.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from evetac_cli.kernels.identify.estimates import LEVEL, Estimate

Floats = NDArray[np.float64]

FEWEST = 20  # readings of a rest
MOST_TICKS = 5.0
SPREADS = np.concatenate([[0.0], np.geomspace(0.005, MOST_TICKS, 300)])
PLACES = (np.arange(200) + 0.5) / 200


def noise(rests: Sequence[NDArray[np.integer]]) -> Estimate:
    """Standard deviation in ticks, from the readings of each rest; ValueError where there is no rest of FEWEST."""
    rests = [rest for rest in rests if len(rest) >= FEWEST]
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
