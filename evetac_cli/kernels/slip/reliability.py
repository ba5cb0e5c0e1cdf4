"""Whether what a detector says happens as often as it says, and the two numbers that make it so.

A detector learns from batches with as much slip as not, where a trial has little: it says 0.75 of slices of which a
fifth slip. A scale and an offset of its log odds, by maximum likelihood on trajectories that it did not learn from,
change no order of two slices. Source: J. Platt, Probabilistic outputs for support vector machines, 1999.

Slices count up to 20 ms after the onset, as for F1: after that all slip, for as long as a trial happens to go on.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels import logistic
from evetac_cli.kernels.slip.metrics import F1_CUT_MS, Prediction

ABOVE = 0.1  # calibration is judged on slices of which so much is said: of most others nothing is
BINS = np.linspace(0.1, 1.0, 10)  # edges
PENALTY = 1e-6  # of both numbers; it only keeps the equations solvable where all slices say the same
NEAREST = 1e-7  # to 0 and 1: float32 has no probability nearer to 1 but 1
MOST_ODDS = 50.0  # log odds that are certain in float32


class OddsScale(NamedTuple):
    """Calibrated log odds are scale * log odds + offset."""

    scale: float
    offset: float

    def inverse(self) -> "OddsScale":
        """The one that takes this one back."""
        return OddsScale(1 / self.scale, -self.offset / self.scale)

    def of(self, probability: NDArray[np.floating]) -> NDArray[np.float32]:
        """Calibrated probabilities; NaN stays."""
        odds = np.clip(self.scale * _log_odds(probability) + self.offset, -MOST_ODDS, MOST_ODDS)
        single: NDArray[np.float32] = (1.0 / (1.0 + np.exp(-odds))).astype(np.float32)
        return single


def fit(predictions: Sequence[Prediction]) -> OddsScale:
    """The calibration under which labels are likeliest.

    ValueError without slices of both kinds, or where slip is the likelier the less of it the detector says.
    """
    probability, slips = judged(predictions)
    if not 0 < np.count_nonzero(slips) < len(slips):
        raise ValueError("expected slices that slip and others, found one kind")
    columns = np.stack([_log_odds(probability), np.ones(len(probability))], axis=1)
    # Platt's targets: one more slice of each kind, so that slices told apart without error make nothing certain.
    count = np.count_nonzero(slips)
    target = np.where(slips, (count + 1) / (count + 2), 1 / (len(slips) - count + 2))
    scale, offset = logistic.fit(columns, target, np.full(2, PENALTY), np.ones(len(slips))).tolist()
    if not (np.isfinite([scale, offset]).all() and scale > 0):
        raise ValueError(f"expected more slip where more is said, found a scale of {scale:g}")
    return OddsScale(scale, offset)


def judged(predictions: Sequence[Prediction]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Probabilities of all slices that have one and a label, up to 20 ms after the onset, and which of them slip."""
    parts = []
    for one in predictions:
        end = len(one.label) if one.onset < 0 else one.onset + F1_CUT_MS
        probability, label = one.probability[:end], one.label[:end]
        counts = (label >= 0) & ~np.isnan(probability)
        parts.append((probability[counts].astype(np.float64), label[counts] == 1))
    if not parts:
        return np.empty(0), np.empty(0, np.bool_)
    said, slips = zip(*parts, strict=True)
    return np.concatenate(said), np.concatenate(slips)


class ReliabilityBin(NamedTuple):
    """Of the slices of which between low and high is said: how many, what is said, and how many of them slip."""

    low: float
    high: float
    slices: int
    said: float  # mean
    happened: float  # share


def bins(probability: NDArray[np.float64], slips: NDArray[np.bool_]) -> list[ReliabilityBin]:
    """What is said and what happens, in steps of 0.1 from 0.1 on; steps without a slice are left out."""
    place = np.minimum(np.searchsorted(BINS, probability, side="right") - 1, len(BINS) - 2)
    made = []
    for number in range(len(BINS) - 1):
        of_bin = (place == number) & (probability > ABOVE)
        if of_bin.any():
            said, happened = float(probability[of_bin].mean()), float(slips[of_bin].mean())
            count = int(np.count_nonzero(of_bin))
            made.append(ReliabilityBin(float(BINS[number]), float(BINS[number + 1]), count, said, happened))
    return made


def expected_error(bins: Sequence[ReliabilityBin]) -> float | None:
    """Mean difference of what is said and what happens over slices above 0.1; None where there are none."""
    slices = sum(one.slices for one in bins)
    if not slices:
        return None
    return sum(one.slices * abs(one.said - one.happened) for one in bins) / slices


def _log_odds(probability: NDArray[np.floating]) -> NDArray[np.float64]:
    kept = np.clip(probability.astype(np.float64), NEAREST, 1 - NEAREST)
    odds: NDArray[np.float64] = np.log(kept) - np.log1p(-kept)
    return odds
