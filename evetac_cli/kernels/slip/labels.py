"""Slip labels for training and evaluation, and the rule that turns a probability into a decision.

Labels are int8 per slice: 1 slip, 0 no slip, -1 not examined. The rule is the same in training, evaluation, grasp and
view. It rounds both probability and threshold to float32 before `>=`. Probabilities are float32 but thresholds are
stored as float64, so the result would otherwise depend on the precision of the comparison. Of the grid of thresholds,
18 of 49 (0.7 and 0.95 among them) are larger than the nearest float32.
"""

from typing import overload

import numpy as np
from numpy.typing import NDArray

from evetac_cli.checks import check_range

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
