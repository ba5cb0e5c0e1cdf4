"""The extreme cases of the dot tracker in a short form: how far off it is, where it should not be, and faults seen."""

import numpy as np
import pytest

from evetac_cli.evaluate.cost.tracker import DOTS_PX
from evetac_cli.evaluate.stability import tracker as stability
from evetac_cli.evaluate.stability.cases import P99_DOT, SAME_DOTS, WORST_DOT
from evetac_cli.evaluate.stability.tracker import duplicated_rows, extreme_cases, scene_rows, track_rows
from evetac_cli.kernels.tracking.presets import PRESETS

CASES = {case.name: case for case in extreme_cases()}
DISTANCES = [WORST_DOT.quantity, P99_DOT.quantity]


REFUSED_STEPS = {f"step size {gain:g}" for gain in stability.GAINS if gain > 0.03}
REFUSED_WEIGHTS = {name: 1e2 if preset.fit else 1e-4 for name, preset in PRESETS.items()}  # those above


@pytest.mark.parametrize("preset", list(PRESETS))
@pytest.mark.parametrize("name", CASES)
def test_extremes_are_measured_or_refused(name, preset):
    """Assert that constants beyond the step limit are refused, and that all else is measured, in finite distances."""
    rows = track_rows(CASES[name], preset, slices=13)
    weight = CASES[name].changes.get("regulariser_weight", 0.0)
    if weight > REFUSED_WEIGHTS[preset] or (name in REFUSED_STEPS and not PRESETS[preset].fit):
        (row,) = rows
        assert row["ok"]
        assert row["outcome"].startswith("refused: ")
        return
    assert [row["quantity"] for row in rows] == DISTANCES
    assert np.isfinite([row["value"] for row in rows]).all()
    assert {row["preset"] for row in rows} == {preset}


@pytest.mark.parametrize("preset", list(PRESETS))
def test_order_does_not_matter_when_events_come_twice(preset):
    """Assert that duplicated events in any order give the same bits."""
    rows = {row["quantity"]: row for row in duplicated_rows(preset, slices=10)}
    assert rows[SAME_DOTS.quantity]["ok"]


def test_stable_follows_where_it_should():
    """Assert that under a hand, with one polarity only, and swinging 2 px a slice, `stable` is within its bounds."""
    for name in (
        "a hand passes over, 20,000 events a slice",
        "all events brighter",
        "1e6 events a slice, for 3 slices",
        "vibration of 1 px at 498 Hz",
    ):
        rows = track_rows(CASES[name], "stable", slices=150)
        assert all(row["ok"] for row in rows), rows
        assert "0 of 63 dots flagged lost" in rows[0]["outcome"]


def test_a_dot_astray_is_not_ok_unless_it_is_flagged(monkeypatch):
    """Assert that one dot 30 px off fails the worst distance alone, and nothing where the tracker flags it as lost."""

    def step(state, *columns):
        state.dot_xy_px[3] = DOTS_PX[3] + (18.0, 24.0)
        state.lost[3] = flagged

    flagged = False
    monkeypatch.setattr(stability.tracker, "step", step)
    worst, p99 = track_rows(CASES["no events"], "paper", slices=3)
    assert (worst["ok"], worst["value"]) == (False, pytest.approx(30.0))
    assert "0 of 63 dots flagged lost, 1 others off by more than 5 px at the end" in worst["outcome"]
    flagged = True
    rows = track_rows(CASES["no events"], "paper", slices=3)
    assert [row["value"] for row in rows] == [0.0, 0.0]
    assert "1 of 63 dots flagged lost, 0 others" in rows[0]["outcome"]


@pytest.mark.slow
def test_dots_that_leave_the_frame_are_as_far_off_as_they_are_until_they_are_flagged():
    """Assert that dots which jump out of the frame count until all are flagged, and soon."""
    worst, _ = track_rows(CASES["dots leave the frame at 5 px/ms"], "stable", slices=200)
    assert 5.0 < worst["value"] < 20.0
    assert worst["outcome"].startswith("63 of 63 dots flagged lost, 0 others")
    without_flags, _ = track_rows(CASES["dots leave the frame at 5 px/ms"], "paper", slices=200)
    assert without_flags["value"] > 300.0


@pytest.mark.slow
def test_a_scene_is_simulated_once_for_all_presets(monkeypatch):
    """Assert that presets follow the same slices of a short slip, from the dots that they are told of."""
    started = []

    def play(trial):
        started.append(trial)
        return real(trial)

    real = stability.play
    monkeypatch.setattr(stability, "play", play)
    monkeypatch.setattr(stability, "SLIP_SOON", {"time": {"longest_s": 0.6}})
    stability._simulated.cache_clear()
    rows = [row for preset in PRESETS for row in scene_rows("as usual", preset, 3)]
    stability._simulated.cache_clear()
    assert [trial.seed for trial in started] == [3]
    assert [row["quantity"] for row in rows] == DISTANCES * len(PRESETS)
    assert {row["case"] for row in rows} == {"slip, as usual"}
    assert rows[-2]["preset"] == "stable"
    assert rows[-2]["ok"]
