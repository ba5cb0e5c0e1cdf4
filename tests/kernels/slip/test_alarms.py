"""Alarms: three slices in a row, 200 ms apart, the same live and offline; leads and false ones."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.kernels.slip import alarms
from evetac_cli.kernels.slip.metrics import is_slip

PROBABILITIES = st.lists(st.sampled_from([float("nan"), 0.2, 0.7, 0.95, 1.0]), max_size=40)


def test_an_alarm_is_three_slices_on_end() -> None:
    """Assert that a spike of two slices is none, and that the third in a row and those after it are."""
    told = alarms.alarming(np.array([0, 0.9, 0.9, 0, 0.9, 0.9, 0.9, 0.9, 0]), 0.9)
    assert np.flatnonzero(told).tolist() == [6, 7]


@given(PROBABILITIES, st.sampled_from([0.2, 0.7, 0.95]))
def test_live_is_offline(values: list[float], threshold: float) -> None:
    """Assert that slice by slice the same slices alarm as over the whole, where floats of two sizes meet as well."""
    probability = np.array(values, np.float32)
    state = alarms.start(threshold)
    live = [alarms.step(state, float(value)) for value in probability]
    offline = alarms.alarming(probability, threshold)
    assert live == offline.tolist()
    assert state.alarms == offline.sum()


def test_alarms_count_200_ms_apart() -> None:
    """Assert that alarms within 200 ms count once, and one that goes on counts again every 200 ms."""
    told = np.zeros(1000, np.bool_)
    told[[10, 150, 209, 210, 500]] = True
    assert alarms.onsets(told).tolist() == [10, 210, 500]
    assert len(alarms.onsets(np.ones(1000, np.bool_))) == 5


def test_near_slip_no_alarm_is_false() -> None:
    """Assert that slices within 200 ms of slip, before and after it, and unexamined ones, are not judged."""
    label = np.zeros(1000, np.int8)
    label[:100], label[500:520] = -1, 1
    quiet = alarms.nothing_slips(label)
    assert np.flatnonzero(quiet).tolist() == [*range(100, 300), *range(720, 1000)]
    assert np.flatnonzero(alarms.nothing_slips(label, 530)).tolist() == [*range(100, 300), *range(731, 1000)]


@pytest.mark.parametrize(("first", "last", "lead"), [(90, 110, 10), (100, 101, 0), (104, 120, -4), (0, 110, 100)])
def test_lead_is_that_of_the_warning_that_lasts(first: int, last: int, lead: int) -> None:
    """Assert that a warning counts from where it begins for good, and one after the onset by how late it is."""
    told = np.zeros(130, np.bool_)
    told[first:last] = True
    if lead < 100:
        told[40:60] = True  # a warning that does not last
    assert alarms.lead_ms(told, 100) == lead


@given(st.lists(st.floats(0, 1, width=32), min_size=12, max_size=30), st.integers(0, 11), st.integers(0, 6))
def test_the_level_of_a_lead(values: list[float], onset: int, ahead_ms: int) -> None:
    """Assert that slip is warned of so long ahead at a threshold just where it does not exceed that lead's level."""
    probability = np.array(values, np.float32)
    level = alarms.lead_level(alarms.levels(probability), onset, ahead_ms)
    for threshold in {0.0, 0.5, *values}:
        lead = alarms.lead_ms(alarms.alarming(probability, threshold), onset)
        assert is_slip(level, threshold) == (lead is not None and lead >= ahead_ms)
