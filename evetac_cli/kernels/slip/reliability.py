"""Reliability of a detector's probabilities, and the two numbers that calibrate them.

A detector is trained on batches with equal shares of slip and no slip, but a trial contains little slip. It returns
0.75 for slices of which a fifth slip. The calibration is a scale and an offset of the log odds, fitted by maximum
likelihood to trajectories that were not used for training. It does not change the order of any two slices. Source: J.
Platt, Probabilistic outputs for support vector machines, 1999.

Slices count up to 20 ms after the onset, as for F1. After that all slices slip, for as long as a trial happens to last.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels import estimates
from evetac_cli.kernels.slip.metrics import F1_CUT_MS, Prediction

ABOVE = 0.1  # reliability only uses slices with a higher probability: most others are near 0
BINS = np.linspace(0.1, 1.0, 10)  # edges
PENALTY = 1e-6  # on both numbers; it only keeps the equations solvable if all slices have the same probability
NEAREST = 1e-7  # to 0 and 1: float32 has no probability closer to 1 except 1
MOST_ODDS = 50.0  # log odds that are certain in float32


class OddsScale(NamedTuple):
    """Calibrated log odds are scale * log odds + offset."""

    scale: float
    offset: float

    def inverse(self) -> "OddsScale":
        """Return the inverse calibration."""
        return OddsScale(1 / self.scale, -self.offset / self.scale)

    def of(self, probability: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return calibrated probabilities; NaN stays NaN."""
        odds = np.clip(self.scale * _log_odds(probability) + self.offset, -MOST_ODDS, MOST_ODDS)
        single: NDArray[np.float32] = (1.0 / (1.0 + np.exp(-odds))).astype(np.float32)
        return single


def fit(predictions: Sequence[Prediction]) -> OddsScale:
    """Return the calibration that makes the labels most likely.

    ValueError without slices of both kinds, or if slip is more frequent at lower probabilities.
    """
    probability, slips = judged(predictions)
    if not 0 < np.count_nonzero(slips) < len(slips):
        raise ValueError("expected slices with slip and slices without, found only one kind")
    columns = np.stack([_log_odds(probability), np.ones(len(probability))], axis=1)
    # Platt's targets: one more slice of each kind, so that a perfect separation does not make anything certain.
    count = np.count_nonzero(slips)
    target = np.where(slips, (count + 1) / (count + 2), 1 / (len(slips) - count + 2))
    scale, offset = estimates.logistic_weights(columns, target, np.full(2, PENALTY), np.ones(len(slips))).tolist()
    if not (np.isfinite([scale, offset]).all() and scale > 0):
        raise ValueError(f"expected slip to be more frequent at higher probabilities, found a scale of {scale:g}")
    return OddsScale(scale, offset)


def judged(predictions: Sequence[Prediction]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the probabilities of all slices with a label, up to 20 ms after the onset, and which of them slip."""
    parts = []
    for one in predictions:
        end = len(one.label) if one.onset < 0 else one.onset + F1_CUT_MS
        probability, label = one.probability[:end], one.label[:end]
        counts = (label >= 0) & ~np.isnan(probability)
        parts.append((probability[counts].astype(np.float64), label[counts] == 1))
    if not parts:
        return np.empty(0), np.empty(0, np.bool_)
    probabilities, slips = zip(*parts, strict=True)
    return np.concatenate(probabilities), np.concatenate(slips)


class ReliabilityBin(NamedTuple):
    """The slices with a probability between low and high: their number, mean probability, and share that slips."""

    low: float
    high: float
    slices: int
    mean_probability: float
    observed: float  # share


def bins(probability: NDArray[np.float64], slips: NDArray[np.bool_]) -> list[ReliabilityBin]:
    """Return the bins of width 0.1, starting at 0.1; bins without a slice are left out."""
    place = np.minimum(np.searchsorted(BINS, probability, side="right") - 1, len(BINS) - 2)
    result = []
    for number in range(len(BINS) - 1):
        of_bin = (place == number) & (probability > ABOVE)
        if of_bin.any():
            mean_probability, observed = float(probability[of_bin].mean()), float(slips[of_bin].mean())
            count = int(np.count_nonzero(of_bin))
            result.append(
                ReliabilityBin(float(BINS[number]), float(BINS[number + 1]), count, mean_probability, observed)
            )
    return result


def expected_error(bins: Sequence[ReliabilityBin]) -> float | None:
    """Return the mean difference of probability and slipping share, over slices above 0.1; None without such slices."""
    slices = sum(one.slices for one in bins)
    if not slices:
        return None
    return sum(one.slices * abs(one.mean_probability - one.observed) for one in bins) / slices


def _log_odds(probability: NDArray[np.floating]) -> NDArray[np.float64]:
    kept = np.clip(probability.astype(np.float64), NEAREST, 1 - NEAREST)
    odds: NDArray[np.float64] = np.log(kept) - np.log1p(-kept)
    return odds
