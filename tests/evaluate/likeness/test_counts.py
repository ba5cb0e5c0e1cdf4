"""evaluate likeness: rates about an onset."""

import math

import numpy as np
import pytest

from evetac_cli.evaluate.likeness.counts import SliceCounts, about_slip, rate


def counts(onset: int | None = 700) -> SliceCounts:
    """A quiet second with loud slices 600, 500, 20 and 1 ms before slice 700, and in it."""
    sensing = np.full(1000, 10)
    sensing[[100, 200, 680, 699, 700]] = 101
    sensing[690] = 100
    return SliceCounts(sensing, np.zeros(1000, np.int64), onset, 50)


def test_rates_about_the_onset() -> None:
    """Assert means of what is recorded, also where it begins later, and none of nothing; the same as about_slip's."""
    assert rate(counts(), -500, -100) == pytest.approx(10 + 91 / 400)
    assert rate(counts(100), -500, 0) == 10.0
    assert math.isnan(rate(counts(0), -500, -100))
    found = about_slip(counts())
    assert found["events_ms_30_before"] == rate(counts(), -30, 0) == pytest.approx(10 + (2 * 91 + 90) / 30)
    assert found["events_ms_100_to_30_before"] == rate(counts(), -100, -30) == 10.0
    assert found["events_ms_30_after"] == rate(counts(), 0, 30) == pytest.approx(10 + 91 / 30)
