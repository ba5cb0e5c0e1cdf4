"""One slice alone: the threshold is chosen on other objects, and the first slice above it is judged."""

import numpy as np
import pytest

from evetac_cli.evaluate.likeness.measures import NEVER_MS, THRESHOLDS, SliceCounts, about_slip, judge, slip

ONSET, SLICES = 1000, 1500


def counts(*bursts: tuple[int, int], start: int = 100, onset: int | None = ONSET) -> SliceCounts:
    """10 events in every slice, and bursts of so many events at so many ms after the onset."""
    sensing = np.full(SLICES, 10, np.int64)
    for after_ms, events in bursts:
        sensing[ONSET + after_ms] = events
    return SliceCounts(sensing, np.full(SLICES, 5, np.int64), onset, start)


def test_first_detection_by_each_threshold() -> None:
    """Assert that each threshold finds the first slice above it, none before the ramp, and says where there is none."""
    found = dict(zip(THRESHOLDS, slip("a", counts((-950, 5000), (-60, 80), (3, 500))).after_ms, strict=True))
    assert found[25] == found[75] == -60
    assert found[100] == found[400] == 3
    assert found[600] == NEVER_MS
    with pytest.raises(ValueError, match="onset"):
        slip("a", counts(onset=None))


def test_the_threshold_comes_from_other_objects() -> None:
    """Assert that no object judges its own threshold: quiet objects choose one that a loud one passes too early."""
    quiet = [slip(name, counts((-200, 30), (-5, 60))) for name in "ab"]
    loud = slip("c", counts((-200, 120), (-5, 700)))
    found = judge([*quiet, loud])
    # c is judged by 35, the lowest that is right for a and b, and early; a by what is best for b and c: 35 too
    assert found["one_threshold_correct"] == pytest.approx(2 / 3)
    assert found["one_threshold_over_50_ms_ahead"] == pytest.approx(1 / 3)
    assert found["one_threshold_10_to_0_ms_ahead"] == pytest.approx(2 / 3)
    assert judge(quiet[:1]) == {} and judge([loud, loud]) == {}


def test_rates_about_slip() -> None:
    """Assert that rates, shares and the loudest slice about the onset are those of the counts."""
    steady = counts()
    steady.sensing[ONSET : ONSET + 30] = 110
    steady.sensing[ONSET - 100 : ONSET - 30] = 20
    steady.sensing[300:310] = 26
    row = about_slip(steady)
    assert steady.floor == 10.0
    assert row["before_over_after"] == pytest.approx(0.1)
    assert row["loudest_slice"] == 110 and row["loudest_slice_50_before"] == 26
    assert row["held_above_25_share"] == pytest.approx(10 / 500)
    assert row["window_share_after_slip"] == pytest.approx(250 * 5 / (30 * 110 + 220 * 10 + 250 * 5))
    assert row["events_ms_about_slip"] == pytest.approx((30 * 110 + 70 * 20 + 400 * 10) / 500)
    assert about_slip(counts(onset=None)) == {}
