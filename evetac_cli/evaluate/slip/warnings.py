"""Warnings of slip and false alarms: columns and tables of a report on slip in addition to timing and F1.

A warning is an alarm that lasts until slip: three slices in a row that reach the threshold (kernels/slip/alarms.py).
Timing, in contrast, considers only the first slice, as in the paper. Figures are means over objects with equal weights,
and over the seeds of a setting. Trials share objects, sensors or both, so the intervals come from resampling objects
and sensors. They do not include the randomness of training.

Whether an alarm is false is decided by kernels/slip/alarms.py: by the true slipping share of the contact where it is
known, else by the labels.

`judge` counts over a trial with many slips whose truth is known. The warning of a gross slip is then the alarm that is
on when it begins, unless that alarm began as a false one. An alarm that begins while the object has been sliding for
LATE_MS or more is not a warning and is not counted.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Singles
from evetac_cli.evaluate.common.rows import ends
from evetac_cli.jobs import Rows
from evetac_cli.kernels import estimates
from evetac_cli.kernels.estimates import Estimate
from evetac_cli.kernels.slip import alarms, metrics, reliability
from evetac_cli.kernels.slip.metrics import Prediction
from evetac_cli.kernels.slip.reliability import ReliabilityBin

LATE_MS = 20  # of sliding, after which an alarm is no warning
WARNED = {ahead_ms: f"warned_{ahead_ms}_ms" for ahead_ms in alarms.LEADS_MS}  # columns: warned at least this long ahead


class Judged(NamedTuple):
    """Result of a detector on one trajectory.

    is_correct is None if it does not count as a slip; lead_ms also without a warning.
    """

    object: str
    sensor: str
    slips: bool  # at an onset that the labels determine; neither timing nor warnings count where they abstain
    is_correct: bool | None
    lead_ms: int | None
    false_alarms: int
    quiet_slices: int

    @classmethod
    def of(cls, prediction: Prediction, threshold: float) -> "Judged":
        """Evaluate a prediction at a threshold."""
        alarming = alarms.alarming(prediction.probability, threshold)
        slips = prediction.onset >= 0 and prediction.timed
        first = metrics.onset(prediction.detected(threshold))
        return cls(
            prediction.object,
            prediction.sensor,
            slips,
            metrics.timing(first, prediction.onset) == "correct" if slips else None,
            alarms.lead_ms(alarming, prediction.onset) if slips else None,
            *alarms.false_alarms(prediction, threshold),
        )

    def warned(self, ahead_ms: int) -> bool:
        """Whether it warned of the slip at least this long ahead."""
        return self.lead_ms is not None and self.lead_ms >= ahead_ms


Seeds = Sequence[Sequence[Judged]]  # results of each model of a setting on the same trajectories


class Shares(NamedTuple):
    """Weights of trials that share objects and sensors, in the mean and in each round of resampling.

    clusters: effective number of trials: the smaller of the numbers of objects and of sensors.
    """

    counts: NDArray[np.float64]  # (trials,), equal total weight for each object
    weights: NDArray[np.float64]  # (rounds, trials)
    clusters: int

    @classmethod
    def of(cls, trials: Sequence[Judged]) -> "Shares":
        """Compute the weights of some trials."""
        objects, sensors = [one.object for one in trials], [one.sensor for one in trials]
        counts = np.array([1 / objects.count(name) for name in objects])
        several = [levels for levels in (len(set(objects)), len(set(sensors))) if levels > 1]
        return cls(counts, estimates.cluster_weights(objects, sensors), min(several, default=len(trials)))

    def mean(self, values: NDArray[np.float64]) -> Estimate | None:
        """Return the mean over objects of a share per trial, (trials,).

        If the share is 0 in all trials or 1 in all, resampling has no spread: the interval is Wilson's for `clusters`
        trials.
        """
        if values.all() and values.min() == 1 or not values.any():
            return estimates.share(self.clusters if values.any() else 0, self.clusters)
        return estimates.ratio_of_clusters(self.counts * values, self.counts, self.weights)


def columns(judged: Seeds, predictions: Sequence[Sequence[Prediction]]) -> dict[str, Any]:
    """Return the columns of a setting."""
    slips = [place for place, one in enumerate(judged[0]) if one.slips]
    figures: dict[str, Any] = {}
    if slips:
        shares = Shares.of([judged[0][place] for place in slips])
        warned = {
            name: shares.mean(_of_seeds([[seed[place].warned(ahead_ms) for place in slips] for seed in judged]))
            for ahead_ms, name in WARNED.items()
        }
        figures |= {name: None if one is None else one.value for name, one in warned.items()}
        figures |= ends("slip_correct", correct(judged)) | ends("warned_10_ms", warned["warned_10_ms"])
    else:
        figures |= dict.fromkeys(WARNED.values()) | ends("slip_correct", None) | ends("warned_10_ms", None)
    false = false_alarms(judged)
    minutes = sum(one.quiet_slices for one in judged[0]) / alarms.SLICES_PER_MIN
    leads = [seed[place].lead_ms for seed in judged for place in slips]
    known_leads = [lead for lead in leads if lead is not None]
    return {
        **figures,
        "lead_ms_median": float(np.median(known_leads)) if known_leads else None,
        "false_alarms_per_min": None if false is None else false.value,
        **ends("false_alarms_per_min", false),
        "minutes_without_slip": minutes,
        "calibration_error": reliability.expected_error(bins(predictions)),
    }


def false_alarms(judged: Seeds) -> Estimate | None:
    """Return false alarms per minute over all trials and seeds; None if no trial has a slice without slip.

    The interval is Poisson's if there are no false alarms.
    """
    trials = judged[0]
    count = _of_seeds([[one.false_alarms for one in seed] for seed in judged])
    minutes = np.array([one.quiet_slices for one in trials]) / alarms.SLICES_PER_MIN
    if not minutes.sum():
        return None
    if not count.any():
        return estimates.poisson_rate(0, float(minutes.sum()))
    weights = estimates.cluster_weights([one.object for one in trials], [one.sensor for one in trials])
    return estimates.ratio_of_clusters(count, minutes, weights)


def bins(predictions: Sequence[Sequence[Prediction]]) -> list[ReliabilityBin]:
    """Return predicted probability and frequency of slip by bin, over all trajectories and seeds."""
    return reliability.bins(*reliability.judged([one for of_seed in predictions for one in of_seed]))


def reliability_rows(setting: str, predictions: Sequence[Sequence[Prediction]]) -> Rows:
    """Return a row for each bin of probability that contains predictions."""
    return [
        {
            "setting": setting,
            "predicted_from": one.low,
            "predicted_to": one.high,
            "slices": one.slices,
            "predicted": one.mean_probability,
            "observed": one.observed,
        }
        for one in bins(predictions)
    ]


def group(judged: Seeds, factor: str, name: str) -> dict[str, Any]:
    """Return plain shares over the trials of one object or one sensor (factor), and all seeds.

    The interval of correct timing comes from resampling the trajectories of an object, or the objects of a sensor.
    """
    of_seeds = [[one._replace(sensor="") for one in seed if getattr(one, factor) == name] for seed in judged]
    members = [one for seed in of_seeds for one in seed]
    slips = [one for one in members if one.slips]
    minutes = sum(one.quiet_slices for one in members) / alarms.SLICES_PER_MIN
    return {
        **ends("slip_correct", correct(of_seeds)),
        "warned_10_ms": float(np.mean([one.warned(10) for one in slips])) if slips else None,
        "false_alarms_per_min": sum(one.false_alarms for one in members) / minutes if minutes else None,
        "minutes_without_slip": minutes / len(judged),
    }


def correct(judged: Seeds) -> Estimate | None:
    """Return the share of slips with correct timing; None without any."""
    slips = [[one for one in seed if one.slips] for seed in judged]
    if not slips[0]:
        return None
    return Shares.of(slips[0]).mean(_of_seeds([[float(bool(one.is_correct)) for one in seed] for seed in slips]))


def _of_seeds(values: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """Return the mean over seeds, (trials,)."""
    mean: NDArray[np.float64] = np.array(values, np.float64).mean(axis=0)
    return mean


def begins(flags: Flags, apart_ms: int) -> list[int]:
    """Return the slices at which flags become set after a pause of a given length."""
    found: list[int] = []
    last = -apart_ms - 1
    for at in np.flatnonzero(flags).tolist():
        if at - last > apart_ms:
            found.append(at)
        last = at
    return found


def slip_begins(slips: Flags) -> list[int]:
    """Return the slices at which gross slip begins after alarms.APART_MS without any."""
    return begins(slips, alarms.APART_MS)


class AlarmCounts(NamedTuple):
    """Results of a trial at one threshold: false alarms, and how early each slip was warned of (None: not)."""

    false: int
    leads_ms: list[int | None]


def judge(alarming: Flags, share: Singles, slips: Flags) -> AlarmCounts:
    """Classify alarms (slices,) by the true slipping share of the contact, and compare them with gross slip."""
    slips_at = slip_begins(slips)
    slides = slips.copy()  # slices at which an alarm would be late
    for begin in slips_at:
        slides[begin : begin + LATE_MS + 1] = False
    is_false = alarms.nothing_slips(np.zeros(len(slips), np.int8), slip_share=share)
    leads: list[int | None] = []
    for begin in slips_at:
        lead = alarms.lead_ms(alarming, begin)
        warned = lead is not None and lead >= -LATE_MS and not is_false[begin - lead]
        leads.append(lead if warned else None)
    return AlarmCounts(int(is_false[alarms.onsets(alarming & ~slides)].sum()), leads)
