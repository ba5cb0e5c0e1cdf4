"""The rule that turns a slip probability into a decision, the same in training, evaluation, grasp and view.

Why so: probabilities are float32 and thresholds are stored as float64, and the result of `>=` depends on the precision
of the comparison: of the grid of thresholds 18 of 49 (0.7 and 0.95 among them) are larger than the float32 nearest to
them. So both are rounded to float32 first.
"""

from typing import overload

import numpy as np
from numpy.typing import NDArray


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
