"""Slip labels, and metrics of slip detectors: time of the first detection, F1, choice of checkpoint and threshold.

Metrics follow the paper, Evaluation Procedure & Metrics. Time is the slice index, one slice per millisecond. A slice
before the history is full, or without contact for a network with memory, has no probability: it is NaN, is not a
sample, and never counts as slip.

Labels are int8 per slice: 1 slip, 0 no slip, -1 not examined. The rule that turns a probability into a decision is the
same in training, evaluation, grasp and view. It rounds both probability and threshold to float32 before `>=`.
Probabilities are float32 but thresholds are stored as float64, so the result would otherwise depend on the precision of
the comparison. Of the grid of thresholds, 18 of 49 (0.7 and 0.95 among them) are larger than the nearest float32.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import check_range

BUSY_EVENTS = 25  # a slice with more events outside the window is busy (paper, Model Training & Data Selection)


def check_labels(label: NDArray[np.int8], onset: int) -> None:
    """Assert that labels are (slices,) of -1, 0 or 1 and the onset is one of the slices, or -1."""
    assert label.ndim == 1 and np.all((label >= -1) & (label <= 1))
    assert -1 <= onset < len(label)


def shift_labels(label: NDArray[np.int8], horizon_ms: int) -> NDArray[np.int8]:
    """Return labels for predicting slip: slice t gets the label of slice t + horizon_ms (paper, Slip Prediction).

    Slice t keeps its own label if that slice is past the end or either of them was not examined. ValueError for a
    negative horizon.
    """
    check_range("horizon_ms", horizon_ms)
    future = np.full_like(label, -1)
    future[: max(len(label) - horizon_ms, 0)] = label[horizon_ms:]
    return np.where((future >= 0) & (label >= 0), future, label)


@overload
def is_slip(probability: float, threshold: float) -> bool: ...


@overload
def is_slip(probability: NDArray[np.floating], threshold: float) -> NDArray[np.bool_]: ...


def is_slip(probability: float | NDArray[np.floating], threshold: float) -> bool | NDArray[np.bool_]:
    """Whether a probability, or each of an array, is slip: probability >= threshold in float32; NaN is not slip."""
    if isinstance(probability, np.ndarray):
        detected: NDArray[np.bool_] = probability.astype(np.float32) >= np.float32(threshold)
        return detected
    return bool(np.float32(probability) >= np.float32(threshold))


EARLIEST_MS = -50  # a first detection from this time relative to the labels' onset,
LATEST_MS = 20  # ... until this time, both included, is "correct"
F1_CUT_MS = 20  # F1 uses slices until this time after the onset

Timing = Literal["early", "correct", "late"]

# 0 to 1 by 0.025, as in the paper; plus values close to 1, where the best thresholds of detectors trained on equal
# shares of slip and no slip are. Dividing keeps 0.5 and 1 exact.
THRESHOLDS = np.sort(np.concatenate([np.arange(41) / 40, 1 - np.array([16, 12, 8, 6, 4, 3, 2, 1]) / 1000]))
LAST_CHECKPOINTS = 3  # the paper chooses among this many


class Counts(NamedTuple):
    """Numbers of slices by outcome; they may be summed over trajectories."""

    true_positives: int
    false_positives: int
    false_negatives: int

    @property
    def precision(self) -> float:
        """Share of the detected slices that slip; 0 if none is detected."""
        return self.true_positives / max(self.true_positives + self.false_positives, 1)

    @property
    def recall(self) -> float:
        """Share of the slipping slices that are detected; 0 if none slips."""
        return self.true_positives / max(self.true_positives + self.false_negatives, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall (the paper's text says geometric), 0 where it is undefined."""
        if self.true_positives == 0:
            return 0.0
        return 2 * self.true_positives / (2 * self.true_positives + self.false_positives + self.false_negatives)


def onset(detected: NDArray[np.bool_]) -> int:
    """Return the first slice of slip in (slices,) detections; -1 for none."""
    assert detected.ndim == 1 and detected.dtype == np.bool_
    return int(np.argmax(detected)) if detected.any() else -1


def timing(t_model: int, t_label: int) -> Timing:
    """Return the timing of a first detection relative to the labels' onset (paper, Evaluation Procedure & Metrics).

    Both are slice indices. Correct means -50 ms <= t_model - t_label <= +20 ms. No detection (t_model -1) is late.
    """
    assert t_label >= 0 and t_model >= -1
    if t_model == -1 or t_model - t_label > LATEST_MS:
        return "late"
    return "early" if t_model - t_label < EARLIEST_MS else "correct"


def counts(label: NDArray[np.int8], detected: NDArray[np.bool_], onset: int) -> Counts:
    """Return the outcomes of one trajectory up to 20 ms after its onset.

    The cut keeps the slices [0, onset + 20), so exactly 20 slices starting at the onset; with onset -1 it keeps all.
    Slices labelled -1 never count: pass -1 also for slices without a full history.
    """
    check_labels(label, onset)
    assert detected.shape == label.shape and detected.dtype == np.bool_
    end = len(label) if onset == -1 else onset + F1_CUT_MS
    label = label[:end]
    detected = detected[:end]
    return Counts(
        true_positives=int(np.count_nonzero(detected & (label == 1))),
        false_positives=int(np.count_nonzero(detected & (label == 0))),
        false_negatives=int(np.count_nonzero(~detected & (label == 1))),
    )


@dataclass(frozen=True)
class Prediction:
    """The probabilities of a detector for one trajectory, together with its labels.

    `probability`: (slices,), NaN where there is none. `label`: int8 (slices,) 1 slip, 0 no slip, -1 not examined,
    shifted if slip is predicted. `onset`: first slice of slip in the labels before the shift, or -1. `object`: the name
    by which scores are grouped. `sensor`: its name. `timed`: whether the labels determine the onset precisely enough
    for timing. `slip_share`: true slipping share of the contact (slices,), by which alarms are then false; None if only
    labels are known.
    """

    probability: NDArray[np.floating]
    label: NDArray[np.int8]
    onset: int
    object: str = ""
    sensor: str = ""
    timed: bool = True
    slip_share: NDArray[np.floating] | None = None

    def __post_init__(self) -> None:
        check_labels(self.label, self.onset)
        assert self.probability.shape == self.label.shape
        defined = self.probability[~np.isnan(self.probability)]
        if not np.all((defined >= 0) & (defined <= 1)):
            raise ValueError("expected probabilities within 0..1, or NaN")

    def detected(self, threshold: float) -> NDArray[np.bool_]:
        """Return which slices (slices,) count as slip."""
        return is_slip(self.probability, threshold)

    def counts(self, threshold: float) -> Counts:
        """Return the outcomes over the slices with a probability and a label."""
        label = np.where(np.isnan(self.probability), np.int8(-1), self.label)
        return counts(label, self.detected(threshold), self.onset)


def score(predictions: Sequence[Prediction], threshold: float) -> dict[str, float | int | None]:
    """Return the scores of a detector over trajectories at one threshold, as a flat row.

    - slips: trajectories with an onset that their labels determine. abstained: those whose labels abstain. no_slip: the
      rest. The three add up to trajectories.
    - slip_early, slip_correct, slip_late: shares of slips; None without any.
    - f1: counts are pooled over each object's trajectories, and the F1 of all objects are averaged, as in the paper's
      bars.
    - f1_pooled, precision, recall and the counts pool all trajectories; with one object f1 equals f1_pooled.
    - alarms_without_slip: trajectories without an onset in which slip was detected.
    """
    assert predictions
    assert 0 <= threshold <= 1
    timings: list[Timing] = []
    alarms = 0
    by_object: dict[str, list[Counts]] = {}
    for prediction in predictions:
        first = onset(prediction.detected(threshold))
        if prediction.onset >= 0 and prediction.timed:
            timings.append(timing(first, prediction.onset))
        elif first >= 0 and prediction.timed:
            alarms += 1
        by_object.setdefault(prediction.object, []).append(prediction.counts(threshold))
    per_object = [_pool(outcomes) for outcomes in by_object.values()]
    pooled = _pool(per_object)
    slips, abstained = len(timings), sum(not prediction.timed for prediction in predictions)
    return {
        "trajectories": len(predictions),
        "objects": len(per_object),
        "slips": slips,
        "abstained": abstained,
        "no_slip": len(predictions) - slips - abstained,
        "threshold": float(threshold),
        "slip_early": timings.count("early") / slips if slips else None,
        "slip_correct": timings.count("correct") / slips if slips else None,
        "slip_late": timings.count("late") / slips if slips else None,
        "f1": sum(outcome.f1 for outcome in per_object) / len(per_object),
        "f1_pooled": pooled.f1,
        "precision": pooled.precision,
        "recall": pooled.recall,
        "true_positives": pooled.true_positives,
        "false_positives": pooled.false_positives,
        "false_negatives": pooled.false_negatives,
        "alarms_without_slip": alarms,
    }


def _pool(outcomes: Sequence[Counts]) -> Counts:
    return Counts(*(sum(column) for column in zip(*outcomes, strict=True)))


class Choice(NamedTuple):
    """The chosen checkpoint and threshold, and the best threshold and score of every checkpoint.

    detected_share, slip_share: among the validation slices with a label and a probability, the share detected at the
    chosen threshold, and the share labelled slip.
    """

    checkpoint: int
    threshold: float
    score: float
    thresholds: NDArray[np.float64]  # (checkpoints,)
    scores: NDArray[np.float64]  # (checkpoints,)
    detected_share: float
    slip_share: float


def choose_threshold(checkpoints: Sequence[Sequence[Prediction]]) -> Choice:
    """Choose checkpoint and threshold by the mean of slip-correct share and F1 (paper, Evaluation Procedure & Metrics).

    `checkpoints` holds, for each checkpoint in the order of training, its predictions for the same validation
    trajectories. The grid is THRESHOLDS; F1 is `f1` of `score`. Only the last three checkpoints can be chosen, but the
    best threshold of each is reported. Ties within a checkpoint go to the lower threshold, which reacts earlier; ties
    between checkpoints go to the later one, which was trained longer. ValueError if no trajectory slips, because timing
    is then undefined.
    """
    assert checkpoints
    thresholds = np.empty(len(checkpoints))
    scores = np.empty(len(checkpoints))
    for index, predictions in enumerate(checkpoints):
        along_grid = np.array([_timing_and_f1(predictions, threshold) for threshold in THRESHOLDS])
        best = int(np.argmax(along_grid))  # the first of equals, so the lowest threshold
        thresholds[index] = THRESHOLDS[best]
        scores[index] = along_grid[best]
    last = scores[-LAST_CHECKPOINTS:]
    best_checkpoint = len(scores) - 1 - int(np.argmax(last[::-1]))  # the last of equals
    threshold = float(thresholds[best_checkpoint])
    detected_share, slip_share = shares(checkpoints[best_checkpoint], threshold)
    return Choice(
        best_checkpoint, threshold, float(scores[best_checkpoint]), thresholds, scores, detected_share, slip_share
    )


def _timing_and_f1(predictions: Sequence[Prediction], threshold: float) -> float:
    row = score(predictions, threshold)
    if row["slip_correct"] is None or row["f1"] is None:
        raise ValueError("expected at least one validation trajectory with an onset, found none")
    return (row["slip_correct"] + row["f1"]) / 2


def shares(predictions: Sequence[Prediction], threshold: float) -> tuple[float, float]:
    """Return, among the slices with a label and a probability, the share that is detected, and the share that slips."""
    judged = [(one.label >= 0) & ~np.isnan(one.probability) for one in predictions]
    pairs = list(zip(predictions, judged, strict=True))
    detected = np.concatenate([one.detected(threshold)[counts] for one, counts in pairs])
    slips = np.concatenate([one.label[counts] == 1 for one, counts in pairs])
    return float(detected.mean()), float(slips.mean())
