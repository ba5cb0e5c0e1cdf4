"""The part `label`: real labels of a short slip, every method against the reference."""

import json

import pytest

from evetac_cli.evaluate.cost import EvaluateCost, labels
from evetac_cli.evaluate.cost import command as cost
from evetac_cli.jobs import silent
from evetac_cli.store.recordings.read import open_recording
from tests.conftest import Made


@pytest.fixture
def one_recording(monkeypatch: pytest.MonkeyPatch, made: Made) -> None:
    """Label one short recording instead of ten long ones."""
    monkeypatch.setattr(labels, "_record", lambda *_: [made.recordings[0]])
    monkeypatch.setattr(labels, "AROUND_MS", 20)


@pytest.mark.slow
def test_rows_of_labels(monkeypatch: pytest.MonkeyPatch, one_recording: None) -> None:
    """Assert a row a setting with errors and run times, the reference first, agreeing with itself."""
    chosen = [labels.methods()[number] for number in (0, 1, 5, 6)]
    monkeypatch.setattr(labels, "methods", lambda: chosen)
    rows = labels.measure(EvaluateCost(part="label"), (), silent)
    assert [row["setting"] for row in rows] == [setting for setting, _ in chosen]
    assert all(row["part"] == "label" and row["time_us_p99"] >= row["time_us_median"] > 0 for row in rows)
    assert rows[0]["speedup"] == 1
    assert rows[0]["error_ms_reference"] == 0
    assert rows[1]["error_ms_reference"] <= 1
    assert [row["trials"] for row in rows] == [1] * 4
    json.dumps(rows, allow_nan=False)
    assert {name for name in rows[0] if name.startswith("error_")} == set(cost.PARTS["label"].errors)


@pytest.mark.slow
def test_searching_gives_the_onset_of_every_slice(made: Made, one_recording: None) -> None:
    """Assert that the reference's onset lies near the true one, and that the stage agrees."""
    settings = dict(labels.methods())
    with open_recording(made.recordings[0]) as recording:
        true = labels._true_onset(recording)
        onset, _ = settings["farneback of both regions, every slice"](recording)
        searched, _ = settings["farneback, steps of 5 ms"](recording)
    assert abs(onset - true) <= 20
    assert abs(searched - onset) <= 1
