"""The extreme cases of the dot tracker in a short form: each stays finite, and faults would be seen."""

import numpy as np
import pytest

from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.tracker import PRESETS
from evetac_cli.numerics.rows import refusal
from evetac_cli.numerics.tracker import stability
from evetac_cli.numerics.tracker.stability import duplicated_row, extreme_cases, nonsense, track_row

CASES = {case.name: case for case in extreme_cases()}
NONSENSE = dict(nonsense())


@pytest.mark.parametrize("preset", list(PRESETS))
@pytest.mark.parametrize("name", CASES)
def test_extremes_stay_finite(name, preset):
    """Assert that every preset stays finite and in the frame in every case."""
    row = track_row(CASES[name], preset, slices=13)
    assert row["ok"], row
    assert row["outcome"].startswith("finite")


@pytest.mark.parametrize("preset", list(PRESETS))
def test_order_does_not_matter_when_events_come_twice(preset):
    """Assert that duplicated events in any order give the same bits."""
    assert duplicated_row(preset, slices=10)["ok"]


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_is_refused(name):
    """Assert that nonsense is refused with the reason."""
    row = refusal(name, NONSENSE[name])
    assert row["ok"]
    assert len(row["outcome"]) > len("refused: ") + 10


def test_stable_follows_where_it_should():
    """Assert that under a hand, with one polarity only, and swinging 2 px a slice, no dot is off by a pixel."""
    for name in (
        "a hand passes over, 20,000 events a slice",
        "all events brighter",
        "1e6 events a slice, for 3 slices",
        "vibration of 1 px at 498 Hz",
    ):
        row = track_row(CASES[name], "stable", slices=150)
        assert row["dots_lost"] == 0
        assert row["error_px_worst"] < 1.0


def test_faults_are_seen(monkeypatch):
    """Assert that a place that is no number is not ok, nor nonsense that is accepted, nor an error without words."""

    def step(state, *columns):
        state.dot_xy_px[3] = np.nan

    monkeypatch.setattr(stability.tracker, "step", step)
    row = track_row(CASES["no events"], "paper", slices=2)
    assert not row["ok"]
    assert row["outcome"].startswith("not finite")
    monkeypatch.undo()
    assert tracker.step is not step
    assert refusal("x", lambda: None)["outcome"] == "accepted"
    assert not refusal("x", lambda: None)["ok"]
    assert not refusal("x", lambda: 1 / 0)["ok"]
