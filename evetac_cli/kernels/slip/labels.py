"""Slip labels as detectors are trained and evaluated on them: int8 per slice, 1 slip, 0 no slip, -1 not examined."""

import numpy as np
from numpy.typing import NDArray


def check_labels(label: NDArray[np.int8], onset: int) -> None:
    """Raise ValueError unless labels are (slices,) of -1, 0 or 1 and the onset is one of the slices, or -1."""
    if label.ndim != 1 or not np.all((label >= -1) & (label <= 1)):
        raise ValueError(
            f"expected labels (slices,) of -1, 0 or 1, found shape {label.shape}, values {np.unique(label)}"
        )
    if not -1 <= onset < len(label):
        raise ValueError(f"expected an onset within -1..{len(label) - 1}, found {onset}")


def shift_labels(label: NDArray[np.int8], horizon_ms: int) -> NDArray[np.int8]:
    """Labels for predicting slip: slice t gets the label of slice t + horizon_ms (paper, Slip Prediction).

    Where that slice is past the end or was not examined, and where t itself was not, t keeps its own label. ValueError
    for a negative horizon.
    """
    if horizon_ms < 0:
        raise ValueError(f"horizon_ms: expected at least 0, found {horizon_ms}")
    future = np.full_like(label, -1)
    future[: max(len(label) - horizon_ms, 0)] = label[horizon_ms:]
    return np.where((future >= 0) & (label >= 0), future, label)
