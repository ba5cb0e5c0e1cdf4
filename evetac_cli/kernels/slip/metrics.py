"""How well a slip detector does: when it first detects slip, and F1 (paper, Evaluation Procedure & Metrics).

Time is the slice index, one slice a millisecond. A slice before the history is full has no probability: it is NaN,
is not a sample, and never counts as slip.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.decision import is_slip
from evetac_cli.kernels.slip.labels import check_labels

EARLIEST_MS = -50  # a first detection from here ...
LATEST_MS = 20  # ... to here, both included, after the labels' onset is "correct"
F1_CUT_MS = 20  # F1 ends here after the onset

Timing = Literal["early", "correct", "late"]


class Counts(NamedTuple):
    """Numbers of slices by outcome; they may be summed over trajectories."""

    true_positives: int
    false_positives: int
    false_negatives: int

    @property
    def precision(self) -> float:
        """Share of the detected slices that slip; 0 where nothing was detected."""
        return self.true_positives / max(self.true_positives + self.false_positives, 1)

    @property
    def recall(self) -> float:
        """Share of the slipping slices that were detected; 0 where nothing slips."""
        return self.true_positives / max(self.true_positives + self.false_negatives, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall (the paper's text says geometric), 0 where it is undefined."""
        if self.true_positives == 0:
            return 0.0
        return 2 * self.true_positives / (2 * self.true_positives + self.false_positives + self.false_negatives)


def onset(detected: NDArray[np.bool_]) -> int:
    """First slice of slip in (slices,) detections; -1 where there is none."""
    if detected.ndim != 1 or detected.dtype != np.bool_:
        raise ValueError(f"expected detections as bool (slices,), found {detected.dtype} {detected.shape}")
    return int(np.argmax(detected)) if detected.any() else -1


def timing(t_model: int, t_label: int) -> Timing:
    """Timing of a first detection against the labels' onset, two slices (paper, Evaluation Procedure & Metrics).

    Correct is -50 ms <= t_model - t_label <= +20 ms, both included. No detection (t_model -1) is late.
    """
    if t_label < 0 or t_model < -1:
        raise ValueError(f"expected an onset of at least 0 and a detection of at least -1, found {t_label}, {t_model}")
    if t_model == -1 or t_model - t_label > LATEST_MS:
        return "late"
    return "early" if t_model - t_label < EARLIEST_MS else "correct"


def counts(label: NDArray[np.int8], detected: NDArray[np.bool_], onset: int) -> Counts:
    """Count the outcomes of one trajectory up to 20 ms after its onset.

    The cut keeps the slices [0, onset + 20), so exactly 20 slices from the onset on; with onset -1 it keeps all.
    Slices labelled -1 never count: pass -1 also where the history was not yet full.
    """
    check_labels(label, onset)
    if detected.shape != label.shape or detected.dtype != np.bool_:
        raise ValueError(f"expected detections as bool {label.shape}, found {detected.dtype} {detected.shape}")
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
    """The probabilities of a detector for one trajectory, beside its labels.

    probability (slices,), NaN until the history is full; label int8 (slices,) 1 slip, 0 no slip, -1 not examined,
    shifted where slip is predicted; onset: first slice of slip in the labels as they were before the shift, or -1;
    object: the name that scores are grouped by.
    """

    probability: NDArray[np.floating]
    label: NDArray[np.int8]
    onset: int
    object: str = ""

    def __post_init__(self) -> None:
        check_labels(self.label, self.onset)
        if self.probability.shape != self.label.shape:
            raise ValueError(f"expected probabilities {self.label.shape}, found {self.probability.shape}")
        defined = self.probability[np.count_nonzero(np.isnan(self.probability)) :]
        # a NaN after the first number leaves a NaN in `defined`, and no comparison with NaN is true
        if not np.all((defined >= 0) & (defined <= 1)):
            raise ValueError("expected probabilities within 0..1, NaN only before the history is full")

    def detected(self, threshold: float) -> NDArray[np.bool_]:
        """Slices (slices,) that count as slip."""
        return is_slip(self.probability, threshold)

    def counts(self, threshold: float) -> Counts:
        """Outcomes over the slices that have a probability and a label."""
        label = np.where(np.isnan(self.probability), np.int8(-1), self.label)
        return counts(label, self.detected(threshold), self.onset)


def score(predictions: Sequence[Prediction], threshold: float) -> dict[str, float | int | None]:
    """Score a detector over trajectories at one threshold, as a flat row.

    - slip_early, slip_correct, slip_late: shares of the trajectories with an onset; None where no trajectory has one.
    - f1: the counts are pooled over each object's trajectories, and the objects' F1 are averaged, as in the paper's
      bars. f1_pooled, precision, recall and the counts pool all trajectories; with one object f1 equals f1_pooled.
    - alarms_without_slip: trajectories without an onset in which slip was detected.
    """
    if not predictions:
        raise ValueError("expected at least one trajectory to score, found none")
    if not 0 <= threshold <= 1:
        raise ValueError(f"expected a threshold within 0..1, found {threshold}")
    timings: list[Timing] = []
    alarms = 0
    by_object: dict[str, list[Counts]] = {}
    for prediction in predictions:
        first = onset(prediction.detected(threshold))
        if prediction.onset >= 0:
            timings.append(timing(first, prediction.onset))
        elif first >= 0:
            alarms += 1
        by_object.setdefault(prediction.object, []).append(prediction.counts(threshold))
    per_object = [_pool(outcomes) for outcomes in by_object.values()]
    pooled = _pool(per_object)
    slips = len(timings)
    return {
        "trajectories": len(predictions),
        "objects": len(per_object),
        "slips": slips,
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
