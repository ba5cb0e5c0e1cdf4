"""One rule says when a probability is slip: for one probability and for an array, in every precision."""

import numpy as np
import pytest

from evetac_cli.kernels.slip.decision import is_slip
from evetac_cli.kernels.slip.metrics import Prediction
from evetac_cli.kernels.slip.threshold import THRESHOLDS


@pytest.mark.parametrize("threshold", THRESHOLDS.tolist())
def test_the_threshold_and_its_neighbours(threshold: float) -> None:
    """Assert that a float32 probability is slip from the threshold's own float32 on, one at a time and in an array."""
    at = np.float32(threshold)
    below, above = np.nextafter(at, np.float32(-1)), np.nextafter(at, np.float32(2))
    for value, expected in ((below, False), (at, True), (above, True)):
        assert is_slip(value, threshold) is expected
        assert is_slip(float(value), threshold) is expected  # as the online detector has it
        assert is_slip(float(value), np.float64(threshold)) is expected  # as a model file has it
    for dtype in (np.float32, np.float64):
        values = np.array([below, at, above], dtype)
        assert is_slip(values, threshold).tolist() == [False, True, True]
        assert is_slip(values, np.float64(threshold)).tolist() == [False, True, True]


def test_a_comparison_in_double_precision_would_miss_some() -> None:
    """Assert that the rule is needed: 18 thresholds of the grid are larger than the float32 nearest to them."""
    missed = [threshold for threshold in THRESHOLDS.tolist() if not float(np.float32(threshold)) >= threshold]
    assert len(missed) == 18
    assert {0.7, 0.95} <= set(missed)


def test_no_probability_is_no_slip() -> None:
    """Assert that NaN, before the history is full, is not slip at any threshold."""
    assert is_slip(float("nan"), 0.0) is False
    assert is_slip(np.array([np.nan, 0.0], np.float32), 0.0).tolist() == [False, True]


def test_predictions_decide_by_the_rule() -> None:
    """Assert that what training and evaluation count as detected is what the rule says, for every threshold."""
    for threshold in THRESHOLDS:
        probability = np.array([np.nan, np.nextafter(np.float32(threshold), np.float32(-1)), threshold], np.float32)
        probability = np.clip(probability, 0, 1)
        detected = Prediction(probability, np.zeros(3, np.int8), -1).detected(threshold)
        assert detected.tolist() == [is_slip(float(value), float(threshold)) for value in probability]
