"""Calibration: the scale and offset that made a detector overconfident are found, and its error is told."""

import numpy as np
import pytest

from evetac_cli.kernels.slip import reliability
from evetac_cli.kernels.slip.metrics import Prediction


def overconfident(scale: float, offset: float, slices: int = 40_000) -> Prediction:
    """Slices that slip as often as scale * log odds + offset says."""
    rng = np.random.default_rng(4)
    odds = rng.normal(-1, 3, slices)
    happens = rng.random(slices) < 1 / (1 + np.exp(-(scale * odds + offset)))
    predicted = (1 / (1 + np.exp(-odds))).astype(np.float32)
    return Prediction(predicted, happens.astype(np.int8), -1)


def test_scale_and_offset_are_found() -> None:
    """Assert that both are found to some percent, and that calibrated probabilities happen as often as they say."""
    one = overconfident(0.5, -1.5)
    found = reliability.fit([one])
    assert found == pytest.approx((0.5, -1.5), abs=0.08)

    def error(probability: np.ndarray) -> float | None:
        predicted, slips = reliability.judged([Prediction(probability, one.label, -1)])
        return reliability.expected_error(reliability.bins(predicted, slips))

    before, after = error(one.probability), error(found.of(one.probability))
    assert before is not None and after is not None
    assert after < 0.03 < 0.25 < before


def test_slices_long_after_the_onset_do_not_count() -> None:
    """Assert that unexamined slices, those without a probability and those 20 ms after the onset are left out."""
    probability, label = np.full(200, 0.5), np.zeros(200, np.int8)
    probability[:5], label[5:10], label[100:] = np.nan, -1, 1
    predicted, slips = reliability.judged([Prediction(probability, label, 100)])
    assert (len(predicted), slips.sum()) == (110, 20)


def test_reliability_by_hand() -> None:
    """Assert that the error is the mean of the steps' differences, by their slices, and nothing below 0.1 counts."""
    predicted = np.array([0.05] * 50 + [0.25] * 4 + [1.0] * 6)
    slips = np.array([1] * 50 + [1, 0, 0, 0] + [1, 1, 1, 0, 0, 0], np.bool_)
    bins = reliability.bins(predicted, slips)
    assert [(one.slices, one.mean_probability, one.observed) for one in bins] == [(4, 0.25, 0.25), (6, 1.0, 0.5)]
    assert reliability.expected_error(bins) == pytest.approx(0.3)
    assert reliability.expected_error([]) is None


def test_what_cannot_be_calibrated_is_refused() -> None:
    """Assert that slices of one kind, and a detector that says the contrary, are refused in words."""
    with pytest.raises(ValueError, match="one kind"):
        reliability.fit([Prediction(np.full(10, 0.5), np.zeros(10, np.int8), -1)])
    with pytest.raises(ValueError, match="scale of -"):
        reliability.fit([overconfident(-1.0, 0.0, 2000)])
