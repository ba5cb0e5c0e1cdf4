"""The rule by which the probabilities of a detector raise an alarm; detector, controller, tables and figures share it.

A slice alarms if it and the two slices before it reach the threshold. A single patch of gel that lets go raises the
probability for a slice or two and is not slip. Counted alarms are at least 200 ms apart. An alarm that continues is
counted again after 200 ms, so a detector that always alarms has five alarms per second, not a single one.

Time is the slice index, one slice per millisecond. The first slice that reaches the threshold, which the paper uses for
timing, is in metrics.py.

A `WarningCurve` is the cost of warnings: false alarms per minute against the share of slips warned of, by threshold.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICES_PER_S
from evetac_cli.kernels import estimates
from evetac_cli.kernels.slip.metrics import Prediction, is_slip

ALARM_SLICES = 3  # consecutive slices that reach the threshold
APART_MS = 200  # from one counted alarm to the next
# An alarm is false unless the contact slips near it. Where the true slipping share of the contact is known, that is
# MUCH_SLIPS or more between BEFORE_MS before and AFTER_MS after the alarm. Labels only tell when the object slides,
# before which the contact has slipped in part for a while: there it is slip up to NEAR_SLIP_MS before or after.
MUCH_SLIPS, BEFORE_MS, AFTER_MS = 0.3, 20, 60
NEAR_SLIP_MS = 200
LEADS_MS = (0, 5, 10, 20, 40)  # lead times of warnings that are reported


@dataclass
class AlarmState:
    """State of the rule, slice by slice; alarms: number of slices that alarmed so far."""

    threshold: float
    alarms: int = 0
    alarming: bool = False  # whether the last slice alarmed
    _on_end: int = 0  # consecutive slices, up to the last, that reach the threshold


def start(threshold: float) -> AlarmState:
    """Return the state before the first slice."""
    return AlarmState(threshold)


def step(state: AlarmState, probability: float) -> bool:
    """Return whether the next slice alarms; NaN does not."""
    state._on_end = state._on_end + 1 if is_slip(probability, state.threshold) else 0
    state.alarming = state._on_end >= ALARM_SLICES
    state.alarms += state.alarming
    return state.alarming


def levels(probability: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the highest threshold at which each slice alarms, (slices,): the minimum over it and the two before.

    NaN if one of the three probabilities is NaN or missing.
    """
    single = probability.astype(np.float32)
    level = np.full(len(single), np.nan, np.float32)
    if len(single) >= ALARM_SLICES:
        level[ALARM_SLICES - 1 :] = np.lib.stride_tricks.sliding_window_view(single, ALARM_SLICES).min(axis=1)
    return level


def alarming(probability: NDArray[np.floating], threshold: float) -> NDArray[np.bool_]:
    """Return which slices alarm, (slices,): the same as `step` for one slice after the other."""
    return is_slip(levels(probability), threshold)


def onsets(alarms: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the slices of counted alarms, of (slices,) that alarm: the first, then each at least 200 ms later."""
    slices = np.flatnonzero(alarms)
    counted = []
    place = 0
    while place < len(slices):
        counted.append(slices[place])
        place = int(np.searchsorted(slices, slices[place] + APART_MS))
    return np.array(counted, np.int64)


def nothing_slips(
    label: NDArray[np.int8], onset: int = -1, slip_share: NDArray[np.floating] | None = None
) -> NDArray[np.bool_]:
    """Return the slices in which an alarm is false: labelled no slip (0), and nothing slips near them.

    onset: first slice of slip in the labels before they were shifted, -1 for none. slip_share: true slipping share of
    the contact, (slices,), NaN where it is unknown; None if only the labels are known.
    """
    slips = label == 1
    if onset >= 0:
        slips[onset] = True
    before, after = NEAR_SLIP_MS, NEAR_SLIP_MS
    if slip_share is not None:
        slips |= slip_share >= MUCH_SLIPS
        before, after = BEFORE_MS, AFTER_MS
    so_far = np.concatenate([[0], np.cumsum(slips)])
    places = np.arange(len(label))
    first, last = np.maximum(places - before, 0), np.minimum(places + after + 1, len(label))
    quiet: NDArray[np.bool_] = (label == 0) & (so_far[last] == so_far[first])
    return quiet


def lead_ms(alarms: NDArray[np.bool_], onset: int) -> int | None:
    """Return how long before the onset the last uninterrupted warning began, of (slices,) that alarm.

    Negative if the first alarm comes after the onset; None if there is none.
    """
    assert 0 <= onset < len(alarms)
    if not alarms[onset]:
        later = np.flatnonzero(alarms[onset:])
        return -int(later[0]) if len(later) else None
    silent = np.flatnonzero(~alarms[:onset])
    return onset - (int(silent[-1]) + 1 if len(silent) else 0)


def lead_level(level: NDArray[np.float32], onset: int, ahead_ms: int) -> float:
    """Return the highest threshold that warns of slip this long ahead, from `levels` (slices,); NaN for none."""
    if onset < ahead_ms:
        return float("nan")
    return float(level[onset - ahead_ms : onset + 1].min())


WARNED_MS = 10  # ms ahead of slip: lead time of the warnings that a model file reports for its threshold
SLICES_PER_MIN = 60 * SLICES_PER_S
# Evenly spaced in log odds, by 0.1 from -8 to 12. A calibrated detector returns 0.001 for most slices, and one trained
# on equal shares of slip and no slip returns 0.9999 for some slices that do not slip.
THRESHOLDS = 1.0 / (1.0 + np.exp(-np.arange(-80, 121) / 10.0))


class WarningCurve(NamedTuple):
    """By threshold, rising: false alarms per minute, and the share of slips warned of at least 10 ms ahead.

    minutes: time in which nothing slips. slips: number of slips that could be warned of.

    A threshold is chosen by the upper limit of its rate, because a rate that was counted in a few minutes is often
    exceeded in others, and choosing the lowest of many thresholds picks one that was lucky.
    """

    threshold: NDArray[np.float64]
    false_alarms_per_min: NDArray[np.float64]
    warned_share: NDArray[np.float64]  # NaN without slips
    minutes: float
    slips: int

    @property
    def most_per_min(self) -> NDArray[np.float64]:
        """The upper limit of each rate, one-sided with 95 % confidence, for a Poisson count.

        ValueError if no slice is known to be free of slip.
        """
        from scipy.special import gammaincinv  # here, because it takes a while to load

        if not self.minutes:
            raise ValueError("expected slices without slip, at least 200 ms from any slip, found none")
        counted = np.rint(self.false_alarms_per_min * self.minutes)
        most: NDArray[np.float64] = gammaincinv(counted + 1.0, estimates.LEVEL) / self.minutes
        return most

    def threshold_for(self, per_min: float) -> float:
        """Return the lowest threshold with, by its upper limit, at most this many false alarms per minute.

        If the minutes are too few for that, the lowest with the fewest alarms that were counted. ValueError if no slice
        is known to be free of slip.
        """
        most = self.most_per_min
        return float(self.threshold[np.argmax(most <= max(per_min, most[-1]))])

    def at(self, threshold: float) -> tuple[float, float]:
        """Return false alarms per minute and share of slips warned of at a threshold: those of the next lower one."""
        place = max(int(np.searchsorted(self.threshold, threshold, side="right")) - 1, 0)
        return float(self.false_alarms_per_min[place]), float(self.warned_share[place])


def warning_curve(predictions: Sequence[Prediction]) -> WarningCurve:
    """Return the curve of a detector's predictions for a number of trajectories, at THRESHOLDS."""
    false = np.zeros(len(THRESHOLDS))
    slices = 0
    warned = []
    for one in predictions:
        level = levels(one.probability)
        quiet = _judged_quiet(one)
        slices += int(np.count_nonzero(quiet))
        quiet_level = np.where(quiet, level, np.float32(np.nan))
        highest = np.fmax.reduce(quiet_level, initial=-1.0)
        for place, threshold in enumerate(THRESHOLDS):
            if not is_slip(float(highest), threshold):
                break  # no higher threshold is reached
            false[place] += len(onsets(is_slip(quiet_level, threshold)))
        if one.onset >= 0:
            warned.append(lead_level(level, one.onset, WARNED_MS))
    shares = [np.mean(is_slip(np.array(warned), at)) if warned else np.nan for at in THRESHOLDS]
    minutes = slices / SLICES_PER_MIN
    return WarningCurve(THRESHOLDS, false / minutes if minutes else false, np.array(shares), minutes, len(warned))


def false_alarms(prediction: Prediction, threshold: float) -> tuple[int, int]:
    """Return the number of false alarms at a threshold, and of slices with a probability in which nothing slips."""
    quiet = _judged_quiet(prediction)
    return len(onsets(alarming(prediction.probability, threshold) & quiet)), int(np.count_nonzero(quiet))


def _judged_quiet(one: Prediction) -> NDArray[np.bool_]:
    quiet: NDArray[np.bool_] = nothing_slips(one.label, one.onset, one.slip_share) & ~np.isnan(one.probability)
    return quiet
