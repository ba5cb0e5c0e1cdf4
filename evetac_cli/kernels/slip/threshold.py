"""Which checkpoint of a training, and which threshold, make a detector: chosen on validation trajectories."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.metrics import Prediction, score

# 0 to 1 by 0.025, as the paper; and closer to 1, where detectors that were trained on equal shares of slip and no slip
# have theirs. Dividing keeps 0.5 and 1 exact.
THRESHOLDS = np.sort(np.concatenate([np.arange(41) / 40, 1 - np.array([16, 12, 8, 6, 4, 3, 2, 1]) / 1000]))
LAST_CHECKPOINTS = 3  # the paper chooses among these


class Choice(NamedTuple):
    """The chosen checkpoint and threshold, and the best threshold and score of every checkpoint.

    detected_share, slip_share: of the validation slices that have a label and a probability, those that are slip by the
    chosen threshold, and by their label.
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
    trajectories. The grid is THRESHOLDS; F1 is `f1` of `score`. Only the last three checkpoints can be chosen,
    but each one's best threshold is reported. Ties within a checkpoint go to the lower threshold, which reacts
    earlier; ties between checkpoints go to the later one, which has seen more. ValueError where no trajectory slips,
    because timing is then undefined.
    """
    if not checkpoints:
        raise ValueError("expected at least one checkpoint, found none")
    thresholds = np.empty(len(checkpoints))
    scores = np.empty(len(checkpoints))
    for index, predictions in enumerate(checkpoints):
        along_grid = np.array([_timing_and_f1(predictions, threshold) for threshold in THRESHOLDS])
        best = int(np.argmax(along_grid))  # the first of equals, so the lowest threshold
        thresholds[index] = THRESHOLDS[best]
        scores[index] = along_grid[best]
    last = scores[-LAST_CHECKPOINTS:]
    chosen = len(scores) - 1 - int(np.argmax(last[::-1]))  # the last of equals
    threshold = float(thresholds[chosen])
    detected_share, slip_share = _shares(checkpoints[chosen], threshold)
    return Choice(chosen, threshold, float(scores[chosen]), thresholds, scores, detected_share, slip_share)


def _timing_and_f1(predictions: Sequence[Prediction], threshold: float) -> float:
    row = score(predictions, threshold)
    if row["slip_correct"] is None or row["f1"] is None:
        raise ValueError("expected at least one validation trajectory with an onset, found none")
    return (row["slip_correct"] + row["f1"]) / 2


def _shares(predictions: Sequence[Prediction], threshold: float) -> tuple[float, float]:
    """Of the slices that have a label and a probability, the share that is detected, and the share that slips."""
    judged = [(one.label >= 0) & ~np.isnan(one.probability) for one in predictions]
    pairs = list(zip(predictions, judged, strict=True))
    detected = np.concatenate([one.detected(threshold)[counts] for one, counts in pairs])
    slips = np.concatenate([one.label[counts] == 1 for one, counts in pairs])
    return float(detected.mean()), float(slips.mean())
