"""The tracker's cost and stability suites in a short form, and that faults would be seen."""

import json

import numpy as np
import pytest

from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.tracker import PRESETS
from evetac_cli.numerics import tracker_cost, tracker_stability
from evetac_cli.numerics.tracker.stability import ROWS, case_row, cases, duplicated_row, nonsense

SHORT = tracker_cost.Extent((60, 25, 60), 25)
CASES = {case.name: case for case in cases()}
NONSENSE = dict(nonsense())


@pytest.fixture(scope="module")
def rows() -> list[dict[str, object]]:
    """All rows of the cost, from short workloads."""
    return list(tracker_cost.tracker_cost(0, SHORT))


def test_cost_has_a_row_for_every_setting_and_workload(rows):
    """Assert that rows are as many as announced, of one shape, and finite."""
    assert len(rows) == tracker_cost.rows(SHORT)
    assert len({tuple(row) for row in rows}) == 1
    assert len({(row["part"], row["setting"]) for row in rows}) == len(rows)
    json.dumps(rows, allow_nan=False)
    assert [name for name in rows[0] if name.startswith("time_us_")][2:] == [
        f"time_us_{count}" for count in (0, 50, 200, 1000, 5000, 20000)
    ]
    for preset in PRESETS:
        assert sum(row["setting"] == f"{preset}, all events" for row in rows) == 3


def test_stable_beats_standing_still_and_the_paper(rows):
    """Assert that on every workload, short as it is, `stable` is better than standing still and than `paper`."""
    for part in {row["part"] for row in rows}:
        error = {row["setting"]: row["error_px_rms"] for row in rows if row["part"] == part}
        still = next(row["still_px_rms"] for row in rows if row["part"] == part)
        assert error["stable, all events"] < min(still, error["paper, all events"])


@pytest.mark.parametrize("preset", list(PRESETS))
@pytest.mark.parametrize("name", CASES)
def test_extremes_stay_finite(name, preset):
    """Assert that every preset stays finite and in the frame in every case."""
    row = case_row(CASES[name], preset, slices=13)
    assert row["ok"], row
    assert row["outcome"].startswith("finite")


@pytest.mark.parametrize("preset", list(PRESETS))
def test_order_does_not_matter_when_events_come_twice(preset):
    """Assert that duplicated events in any order give the same bits."""
    assert duplicated_row(preset, slices=10)["ok"]


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_is_refused(name):
    """Assert that nonsense is refused with the reason."""
    row = ROWS.refusal(name, NONSENSE[name])
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
        row = case_row(CASES[name], "stable", slices=150)
        assert row["dots_lost"] == 0
        assert row["error_px_worst"] < 1.0


def test_faults_are_seen(monkeypatch):
    """Assert that a place that is no number is not ok, nor nonsense that is accepted, nor an error without words."""

    def step(state, *columns):
        state.dot_xy_px[3] = np.nan

    monkeypatch.setattr(tracker_stability.tracker, "step", step)
    row = case_row(CASES["no events"], "paper", slices=2)
    assert not row["ok"]
    assert row["outcome"].startswith("not finite")
    monkeypatch.undo()
    assert tracker.step is not step
    assert ROWS.refusal("x", lambda: None)["outcome"] == "accepted"
    assert not ROWS.refusal("x", lambda: None)["ok"]
    assert not ROWS.refusal("x", lambda: 1 / 0)["ok"]
