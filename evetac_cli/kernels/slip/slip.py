"""What a slip detector is and how well it does: the table of architectures, the metrics, and the choice of a threshold.

Why so: the architectures stand here and not beside the networks, because `grasp` and `evaluate` need a detector's
history and inputs but must not import torch. This module needs numpy alone.

Time is the slice index, one slice a millisecond. A slice counts as slip where probability >= threshold. A slice before
the history is full has no probability: it is NaN there, it is not a sample, and it never counts as slip.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

EARLIEST_MS = -50  # a first detection from here ...
LATEST_MS = 20  # ... to here, both included, after the labels' onset is "correct"
F1_CUT_MS = 20  # F1 ends here after the onset
THRESHOLDS = np.arange(41) / 40  # 0 to 1 by 0.025; dividing keeps 0.5 and 1 exact
LAST_CHECKPOINTS = 3  # the paper chooses among these

CHANNELS = ("distance", "events", "x", "y")  # what is known of every dot and slice; displacements in px
GEL_PX = (540, 480)  # width and height of an event image: the frame without the window strip

Timing = Literal["early", "correct", "late"]


class View(NamedTuple):
    """How a network sees one channel of a dot: newest slices as they are, then means over consecutive blocks.

    With `change`, all but the first value v are given as newest value - v: a displacement of many px that creeps by
    hundredths of a px would else hide the creep.
    """

    channel: str  # one of CHANNELS
    recent: int = 0  # newest slices, newest first
    block: int = 1  # slices of a block
    means: int = 0  # blocks, the newest first
    change: bool = False

    @property
    def history(self) -> int:
        """Slices that it reaches back, the newest one included."""
        return max(self.recent, self.block * self.means)


@dataclass(frozen=True)
class DotArchitecture:
    """A network that encodes each dot, then looks at their grid: a row of the paper's table, or one of our own."""

    name: str
    views: tuple[View, ...]  # in the order of the inputs
    fc1: int  # widths of the two layers that encode a dot
    fc2: int
    every: int = 1  # slices from one prediction to the next; held in between

    def __post_init__(self) -> None:
        channels = [view.channel for view in self.views]
        if not self.views or len(set(channels)) < len(channels) or not set(channels) <= set(CHANNELS):
            raise ValueError(f"views: expected different channels of {', '.join(CHANNELS)}, found {channels}")
        for view in self.views:
            if min(view.recent, view.means) < 0 or view.block < 1 or view.recent + view.means < 1:
                raise ValueError(f"view: expected at least one slice or block of at least one slice, found {view}")
            if view.change and view.recent < 1:
                raise ValueError(f"view: expected a newest slice to take the change from, found {view}")
        across = [tuple(view[1:]) for view in self.views if view.channel in ("x", "y")]
        if len(across) == 1 or (across and across[0] != across[1]):
            raise ValueError(f"views: expected x and y seen alike, so that they can be rotated, found {self.views}")
        if min(self.fc1, self.fc2, self.every) < 1:
            raise ValueError(f"at least one unit a layer and one slice a prediction are needed, found {self}")

    @property
    def history(self) -> int:
        """Slices that one prediction needs."""
        return max(view.history for view in self.views)

    @property
    def inputs_per_dot(self) -> int:
        """Length of the vector that describes one dot, l_i in the paper's table."""
        return sum(view.recent + view.means for view in self.views)

    def columns_of(self, channel: str) -> slice:
        """Where among the inputs of a dot a channel is; an empty slice if it is not seen."""
        first = 0
        for view in self.views:
            if view.channel == channel:
                return slice(first, first + view.recent + view.means)
            first += view.recent + view.means
        return slice(0, 0)

    @property
    def train_cut_ms(self) -> int:
        """How much of a trajectory after its onset is trained on."""
        return _train_cut_ms(self.history)


@dataclass(frozen=True)
class ImageArchitecture:
    """The paper's baseline on event images of 540 x 480 px: four convolutions of 5 x 5 with max pooling, two layers.

    `pool_px` sums the image over squares of so many px first, so that a CPU can train it; `pools` (width, height) are
    those after each convolution, and must bring the image to a single pixel.
    """

    name: str
    history: int
    pools: tuple[tuple[int, int], ...]
    pool_px: int = 1
    every: int = 1

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """(history, height, width) of one input."""
        return self.history, GEL_PX[1] // self.pool_px, GEL_PX[0] // self.pool_px

    @property
    def train_cut_ms(self) -> int:
        """How much of a trajectory after its onset is trained on."""
        return _train_cut_ms(self.history)


Architecture = DotArchitecture | ImageArchitecture

_PAPER_POOLS = ((3, 3), (3, 3), (4, 4), (9, 7))
# why so: 90 x 80 px hold the first of the paper's pools; then only these leave 5 x 5 px for every convolution
_POOLS_6X6 = ((3, 3), (2, 2), (1, 1), (4, 2))


def _train_cut_ms(history: int) -> int:
    """15 ms for a history of 10 or less, 20 ms to 20, 50 ms beyond (paper, Model Training & Data Selection)."""
    if history <= 10:
        return 15
    return 20 if history <= 20 else 50


def _both(recent: int, block: int = 1, means: int = 0) -> tuple[View, View]:
    return View("distance", recent, block, means), View("events", recent, block, means)


ARCHITECTURES: dict[str, Architecture] = {
    row.name: row
    for row in (
        # the paper's table of model configurations
        DotArchitecture("no-hist", _both(1), fc1=10, fc2=4),
        DotArchitecture("hist10", _both(10), fc1=12, fc2=4),
        DotArchitecture("events-only", (View("events", 10),), fc1=8, fc2=4),
        DotArchitecture("disp-only", (View("distance", 10),), fc1=8, fc2=4),
        DotArchitecture("hist20", _both(20), fc1=20, fc2=8),
        DotArchitecture("down5", _both(0, 5, 10), fc1=12, fc2=4, every=5),
        DotArchitecture("fast-slow", _both(10, 10, 5), fc1=15, fc2=8),
        # and its baselines
        ImageArchitecture("no-hist-img", 1, _PAPER_POOLS),
        ImageArchitecture("hist10-img", 10, _PAPER_POOLS),
        ImageArchitecture("no-hist-img-6x6", 1, _POOLS_6X6, pool_px=6),
        ImageArchitecture("hist10-img-6x6", 10, _POOLS_6X6, pool_px=6),
        # Ours, on the time scales of fast-slow. Before an object slips, its rim creeps while its middle sticks: what
        # tells is which way a dot moves against its neighbours, by hundredths of a px a ms. The paper's models see the
        # distance from rest alone, which has no direction and hides changes as small. So: direction, and changes.
        # Twice the time (100 ms) was no better on unseen objects.
        DotArchitecture(
            "disp-xy",
            (
                View("x", 10, 10, 5, change=True),
                View("y", 10, 10, 5, change=True),
                View("events", 10, 10, 5),
            ),
            fc1=24,
            fc2=8,
        ),
    )
}


def shift(label: NDArray[np.int8], horizon_ms: int) -> NDArray[np.int8]:
    """Labels for predicting slip: slice t is what slice t + ahead_ms is labelled (paper, Slip Prediction).

    Where that slice is not there or was not examined, and where t itself was not, t keeps its own label.
    """
    if horizon_ms < 0:
        raise ValueError(f"ahead_ms: expected at least 0, found {horizon_ms}")
    future = np.full_like(label, -1)
    future[: max(len(label) - horizon_ms, 0)] = label[horizon_ms:]
    return np.where((future >= 0) & (label >= 0), future, label)


class Counts(NamedTuple):
    """Slices by outcome; sums of counts over trajectories are counts again."""

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
    """Judge a first detection against the labels' onset, both slice indices (paper, Evaluation Procedure & Metrics).

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


def f1(label: NDArray[np.int8], detected: NDArray[np.bool_], onset: int) -> float:
    """F1 score of one trajectory; what is counted is said at `counts`."""
    return counts(label, detected, onset).f1


@dataclass(frozen=True)
class Prediction:
    """What a detector says of one trajectory, and what its labels say.

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
        known = self.probability[np.count_nonzero(np.isnan(self.probability)) :]
        # a NaN after the first number leaves a NaN in `known`, and no comparison with NaN is true
        if not np.all((known >= 0) & (known <= 1)):
            raise ValueError("expected probabilities within 0..1, NaN only before the history is full")

    def detected(self, threshold: float) -> NDArray[np.bool_]:
        """Slices that count as slip: probability >= threshold."""
        # a numpy float64 would lift float32 probabilities to its own precision, where 0.975 is not 0.975
        return self.probability >= float(threshold)

    def counts(self, threshold: float) -> Counts:
        """Outcomes over the slices that have a probability and a label."""
        label = np.where(np.isnan(self.probability), np.int8(-1), self.label)
        return counts(label, self.detected(threshold), self.onset)


def score(predictions: Sequence[Prediction], threshold: float) -> dict[str, float | int | None]:
    """Score a detector over trajectories at one threshold, as a flat row.

    - slip_early, slip_correct, slip_late: shares of the trajectories with an onset; None where no trajectory has one.
    - f1: the counts are pooled over each object's trajectories, and the objects' F1 are averaged, as in the paper's
      bars. f1_pooled, precision, recall and the counts pool all trajectories; with one object f1 equals f1_pooled.
    - alarms_without_slip: trajectories without an onset in which something was detected all the same.
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


class Choice(NamedTuple):
    """The chosen checkpoint and threshold, and the best threshold and score of every checkpoint."""

    checkpoint: int
    threshold: float
    score: float
    thresholds: NDArray[np.float64]  # (checkpoints,)
    scores: NDArray[np.float64]  # (checkpoints,)


def choose_threshold(checkpoints: Sequence[Sequence[Prediction]]) -> Choice:
    """Choose checkpoint and threshold by the mean of slip-correct share and F1 (paper, Evaluation Procedure & Metrics).

    `checkpoints` holds, for each checkpoint in the order of training, its predictions for the same validation
    trajectories. The grid is 0 to 1 by 0.025; F1 is `f1` of `score`. Only the last three checkpoints can be chosen,
    but each one's best threshold is reported. Ties within a checkpoint go to the lower threshold, which reacts
    earlier; ties between checkpoints go to the later one, which has seen more. ValueError where no trajectory slips,
    as the slip-correct share then says nothing.
    """
    if not checkpoints:
        raise ValueError("expected at least one checkpoint, found none")
    thresholds = np.empty(len(checkpoints))
    scores = np.empty(len(checkpoints))
    for index, predictions in enumerate(checkpoints):
        along_grid = np.array([_goodness(predictions, threshold) for threshold in THRESHOLDS])
        best = int(np.argmax(along_grid))  # the first of equals, so the lowest threshold
        thresholds[index] = THRESHOLDS[best]
        scores[index] = along_grid[best]
    last = scores[-LAST_CHECKPOINTS:]
    chosen = len(scores) - 1 - int(np.argmax(last[::-1]))  # the last of equals
    return Choice(chosen, float(thresholds[chosen]), float(scores[chosen]), thresholds, scores)


def _goodness(predictions: Sequence[Prediction], threshold: float) -> float:
    row = score(predictions, threshold)
    if row["slip_correct"] is None or row["f1"] is None:
        raise ValueError("expected at least one validation trajectory with an onset, found none")
    return (row["slip_correct"] + row["f1"]) / 2


def _pool(outcomes: Sequence[Counts]) -> Counts:
    return Counts(*(sum(column) for column in zip(*outcomes, strict=True)))


def check_labels(label: NDArray[np.int8], onset: int) -> None:
    """Raise ValueError unless labels are (slices,) of -1, 0 or 1 and the onset is one of the slices, or -1."""
    if label.ndim != 1 or not np.all((label >= -1) & (label <= 1)):
        raise ValueError(
            f"expected labels (slices,) of -1, 0 or 1, found shape {label.shape}, values {np.unique(label)}"
        )
    if not -1 <= onset < len(label):
        raise ValueError(f"expected an onset within -1..{len(label) - 1}, found {onset}")
