"""Paired differences against values worked out by hand."""

import math

import numpy as np
import pytest

from evetac_cli.evaluate.common.rows import difference


def array(*values: float) -> np.ndarray:
    return np.array(values)


def test_the_interval_is_students() -> None:
    """Assert mean and interval of the differences 1, 2, 3: 2 +- 4.303 / sqrt(3)."""
    apart = difference(array(2, 4, 6), array(1, 2, 3))
    assert (apart.mean, apart.trials) == (2.0, 3)
    assert apart.low == pytest.approx(2 - 4.30265 / math.sqrt(3), abs=1e-4)
    assert apart.high == pytest.approx(2 + 4.30265 / math.sqrt(3), abs=1e-4)


def test_trials_without_a_value_are_left_out() -> None:
    """Assert that only trials with both values count, and that with one or none there is no interval."""
    assert difference(array(2, math.nan, 6), array(1, 2, 3)).trials == 2
    alone = difference(array(5), array(3))
    assert (alone.mean, alone.trials) == (2.0, 1)
    assert alone.low is None
    assert difference(array(math.nan), array(3)).trials == 0


def test_intervals_hold_what_they_promise() -> None:
    """Assert that of 2,000 intervals over 5 normal differences 95 % hold the true mean, give or take 1.5 %."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(2000):
        apart = difference(rng.normal(0.7, 2.0, 5), np.zeros(5))
        held += apart.low <= 0.7 <= apart.high
    assert held / 2000 == pytest.approx(0.95, abs=0.015)
