"""The cost of slip warnings: false alarms per minute against the share of slips warned of, by threshold.

Alarms are those of alarms.py. A threshold chosen by a number of false alarms per minute is therefore valid for
detector, controller and tables.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICES_PER_S
from evetac_cli.kernels.slip import alarms
from evetac_cli.kernels.slip.labels import is_slip
from evetac_cli.kernels.slip.metrics import Prediction

WARNED_MS = 10  # ms ahead of slip: lead time of the warnings that a model file reports for its threshold
SLICES_PER_MIN = 60 * SLICES_PER_S
# Evenly spaced in log odds, by 0.1 from -8 to 12. A calibrated detector returns 0.001 for most slices, and one trained
# on equal shares of slip and no slip returns 0.9999 for some slices that do not slip.
THRESHOLDS = 1.0 / (1.0 + np.exp(-np.arange(-80, 121) / 10.0))


class WarningCurve(NamedTuple):
    """By threshold, rising: false alarms per minute, and the share of slips warned of at least 10 ms ahead.

    minutes: time in which nothing slips. slips: number of slips that could be warned of.
    """

    threshold: NDArray[np.float64]
    false_alarms_per_min: NDArray[np.float64]
    warned_share: NDArray[np.float64]  # NaN without slips
    minutes: float
    slips: int

    def threshold_for(self, per_min: float) -> float:
        """Return the lowest threshold with at most this many false alarms per minute, or the highest of all.

        ValueError if no slice is known to be free of slip.
        """
        if not self.minutes:
            raise ValueError("expected slices without slip, at least 200 ms from any slip, found none")
        few = np.flatnonzero(self.false_alarms_per_min <= per_min)
        return float(self.threshold[few[0] if len(few) else -1])

    def at(self, threshold: float) -> tuple[float, float]:
        """Return false alarms per minute and share of slips warned of at a threshold: those of the next lower one."""
        place = max(int(np.searchsorted(self.threshold, threshold, side="right")) - 1, 0)
        return float(self.false_alarms_per_min[place]), float(self.warned_share[place])


def of_predictions(predictions: Sequence[Prediction]) -> WarningCurve:
    """Return the curve of a detector's predictions for a number of trajectories, at THRESHOLDS."""
    false = np.zeros(len(THRESHOLDS))
    slices = 0
    warned = []
    for one in predictions:
        level = alarms.levels(one.probability)
        quiet = alarms.nothing_slips(one.label, one.onset) & ~np.isnan(one.probability)
        slices += int(np.count_nonzero(quiet))
        quiet_level = np.where(quiet, level, np.float32(np.nan))
        highest = np.fmax.reduce(quiet_level, initial=-1.0)
        for place, threshold in enumerate(THRESHOLDS):
            if not is_slip(float(highest), threshold):
                break  # no higher threshold is reached
            false[place] += len(alarms.onsets(is_slip(quiet_level, threshold)))
        if one.onset >= 0:
            warned.append(alarms.lead_level(level, one.onset, WARNED_MS))
    shares = [np.mean(is_slip(np.array(warned), at)) if warned else np.nan for at in THRESHOLDS]
    minutes = slices / SLICES_PER_MIN
    return WarningCurve(THRESHOLDS, false / minutes if minutes else false, np.array(shares), minutes, len(warned))


def false_alarms(prediction: Prediction, threshold: float) -> tuple[int, int]:
    """Return the number of false alarms at a threshold, and of slices with a probability in which nothing slips."""
    quiet = alarms.nothing_slips(prediction.label, prediction.onset) & ~np.isnan(prediction.probability)
    alarming = alarms.alarming(prediction.probability, threshold)
    return len(alarms.onsets(alarming & quiet)), int(np.count_nonzero(quiet))
