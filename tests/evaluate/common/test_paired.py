"""Paired differences and the Pareto front that they allow, against values worked out by hand."""

import math

import numpy as np
import pytest

from evetac_cli.evaluate.common.rows import difference, share_difference


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


def test_rounded_values_are_never_sure_too_soon() -> None:
    """Assert that three equal differences are sure where values are exact, and not where they are whole numbers."""
    ours, theirs = array(3, 5, 7), array(2, 4, 6)
    assert difference(ours, theirs).low == 1.0
    assert difference(ours, theirs, resolution=1.0).low < 0.0


def test_intervals_hold_what_they_promise() -> None:
    """Assert that of 2,000 intervals over 5 normal differences 95 % hold the true mean, give or take 1.5 %."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(2000):
        apart = difference(rng.normal(0.7, 2.0, 5), np.zeros(5))
        held += apart.low <= 0.7 <= apart.high
    assert held / 2000 == pytest.approx(0.95, abs=0.015)


def test_the_interval_of_a_difference_of_shares_holds_what_it_promises() -> None:
    """Assert sign and size of a difference, and that at least 93 % of 2,000 intervals over 40 pairs hold the truth."""
    ours, theirs = np.array([True, True, True, False]), np.array([True, False, False, False])
    assert share_difference(ours, theirs).mean == 0.5
    assert share_difference(theirs, ours).mean == -0.5
    rng, held = np.random.default_rng(5), 0
    for _ in range(2000):
        of_the_trial = rng.uniform(size=40)  # both depend on how hard the trial is
        one, other = of_the_trial + rng.normal(0, 0.1, 40) < 0.8, of_the_trial + rng.normal(0, 0.1, 40) < 0.7
        apart = share_difference(one, other)
        held += apart.low <= 0.0992 <= apart.high  # the truth, of 20 million pairs
    assert held / 2000 > 0.93
