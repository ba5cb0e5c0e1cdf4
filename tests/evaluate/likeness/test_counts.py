"""evaluate likeness: rates and loud slices before an onset."""

import math

import numpy as np
import pytest

from evetac_cli.evaluate.likeness.counts import LOUD, SliceCounts, about_slip, loud_ms, rate


def counts(onset: int | None = 700) -> SliceCounts:
    """A quiet second with loud slices 600, 500, 20 and 1 ms before slice 700, and in it."""
    sensing = np.full(1000, 10)
    sensing[[100, 200, 680, 699, 700]] = LOUD + 1
    sensing[690] = LOUD
    return SliceCounts(sensing, np.zeros(1000, np.int64), onset, 50)


def test_loud_slices_before_the_onset() -> None:
    """Assert that those above the line in the 500 ms before the onset are told, by their time before it."""
    assert loud_ms(counts()) == [500, 20, 1]
    assert loud_ms(counts(None)) == []
    assert loud_ms(counts(100)) == []


def test_rates_about_the_onset() -> None:
    """Assert means of what is recorded, also where it begins later, and none of nothing; the same as about_slip's."""
    assert rate(counts(), -500, -100) == pytest.approx(10 + 91 / 400)
    assert rate(counts(100), -500, 0) == 10.0
    assert math.isnan(rate(counts(0), -500, -100))
    found = about_slip(counts())
    assert found["events_ms_30_before"] == rate(counts(), -30, 0) == pytest.approx(10 + (2 * 91 + 90) / 30)
    assert found["events_ms_100_to_30_before"] == rate(counts(), -100, -30) == 10.0
    assert found["events_ms_30_after"] == rate(counts(), 0, 30) == pytest.approx(10 + 91 / 30)
