"""The warning curve: false alarms per minute and slips warned of, by threshold."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.kernels import estimates
from evetac_cli.kernels.slip import alarms
from evetac_cli.kernels.slip.metrics import Prediction


def prediction(probability: NDArray[np.floating], onset: int = -1) -> Prediction:
    """A prediction whose labels say slip from the onset on."""
    label = np.zeros(len(probability), np.int8)
    if onset >= 0:
        label[onset:] = 1
    return Prediction(probability, label, onset)


def one_of_each() -> list[Prediction]:
    """A minute in which nothing slips, with alarms of 0.5 and 0.9, and two slips: of 0.8 for 20 ms and 0.95 for 5."""
    quiet = np.full(60_000, 0.01)
    quiet[1000:1010], quiet[30_000:30_010], quiet[40_000:40_002] = 0.5, 0.9, 1.0
    long, short = np.full(500, 0.01), np.full(500, 0.01)
    long[378:], short[393:] = 0.8, 0.95
    return [prediction(quiet), prediction(long, 400), prediction(short, 400)]


def test_curve_by_hand() -> None:
    """Assert that alarms of a minute and slips warned of 10 ms ahead are counted at each threshold."""
    curve = alarms.warning_curve(one_of_each())
    assert (curve.minutes, curve.slips) == (pytest.approx(1.0, rel=0.01), 2)
    for threshold, false, warned in ((0.3, 2, 0.5), (0.6, 1, 0.5), (0.85, 1, 0.0), (0.93, 0, 0.0)):
        per_min, share = curve.at(threshold)
        assert per_min == pytest.approx(false, rel=0.01)
        assert share == warned
    assert np.all(np.diff(curve.false_alarms_per_min) <= 0)


def test_the_threshold_is_the_lowest_that_keeps_to_the_number() -> None:
    """Assert that a chosen threshold has no more false alarms than allowed, and the one below it has."""
    curve = alarms.warning_curve(one_of_each())
    for count, least, most in ((1, 0.5, 0.53), (0, 0.9, 0.92)):
        upper = estimates.poisson_rate(count, curve.minutes).high  # two-sided, so higher than one-sided
        threshold = curve.threshold_for(upper)
        assert least < threshold < most


def test_a_rate_is_kept_with_confidence() -> None:
    """Assert that in 95 of 100 sets of trials the chosen threshold keeps the rate that was asked for."""
    rng = np.random.default_rng(0)
    true_per_min, minutes = np.linspace(3.0, 0.0, 31), 16.0
    kept = 0
    for _ in range(2000):
        counted = rng.poisson(true_per_min * minutes)
        lowest_first = np.minimum.accumulate(counted) / minutes
        curve = alarms.WarningCurve(np.linspace(0.0, 1.0, 31), lowest_first, np.zeros(31), minutes, 0)
        kept += true_per_min[curve.threshold == curve.threshold_for(1.0)][0] <= 1.0
    assert kept / 2000 > 0.94
    assert curve.most_per_min[-1] == pytest.approx(-np.log(0.05) / minutes)  # of no alarm at all


def test_without_quiet_slices_no_threshold_is_chosen() -> None:
    """Assert that a choice by false alarms is refused where every slice is near slip, and that all then is unknown."""
    curve = alarms.warning_curve([prediction(np.full(300, 0.5), 150)])
    with pytest.raises(ValueError, match="without slip"):
        curve.threshold_for(1.0)
