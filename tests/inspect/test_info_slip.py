"""info: covariates of the slip of a recording, by truth or by labels."""

import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.inspect import info
from evetac_cli.kernels.slip.covariates import WORDS
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings import slip_grid
from evetac_cli.store.recordings.read import open_recording, true_onset
from tests.conftest import Made
from tests.make import event_arrays, events_at, label_arrays, write_recording

SLICES, ONSET = 2000, 1500


def row_of(path: Path) -> dict[str, Any]:
    (row,) = info.run([path]).rows
    return row


def real_slip(path: Path) -> Path:
    """A recording without truth, 40 events in each slice within 250 ms of the slip that its labels know, 10 before."""
    at = np.arange(SLICES)
    events = events_at(np.repeat(at * 1000, np.where(np.abs(at - ONSET + 0.5) < 250, 40, 10)))
    write_recording(path, event_arrays(events, SLICES))
    with open_recording(path) as recording:
        header = recording.header
    labels = path.with_name(path.name.replace(".recording.", ".labels."))
    write_stage(labels, Recipe("labels", 1, {}, parents=(header,)), label_arrays(at >= ONSET, ONSET), force=True)
    return labels


def test_of_a_simulated_slip(made: Made) -> None:
    """Assert that a simulated slip is shown with its true onset and every covariate that its short trial can tell."""
    row = row_of(made.recordings[0])
    with open_recording(made.recordings[0]) as recording:
        assert row["slip_onset_ms"] == true_onset(recording)
    assert row["slip_source"] == "truth"
    told = {"incipient_80_to_gross_ms", "creep_to_gross_ms", "events_per_ms_about_slip", "unloading_n_per_s"}
    assert told <= row.keys()


def test_of_labels_alone(tmp_path: Path) -> None:
    """Assert that of a recording without truth labels and events tell two, and the others are named."""
    path = tmp_path / "a.recording.h5"
    labels = real_slip(path)
    row = row_of(path)
    assert (row["slip_onset_ms"], row["slip_source"]) == (ONSET, "labels")
    assert (row["events_per_ms_about_slip"], row["held_over_25_events"]) == (40.0, 0.0)
    assert row["slip_unknown"].split(", ") == [
        name for name in WORDS if name not in ("events_per_ms_about_slip", "held_over_25_events")
    ]
    labels.unlink()
    assert not any(name.startswith("slip_") for name in row_of(path))


def test_labels_of_another_recording_tell_nothing(tmp_path: Path) -> None:
    """Assert that labels which belong to another recording, or are damaged, are passed over and info goes on."""
    path, other = tmp_path / "a.recording.h5", tmp_path / "b.recording.h5"
    real_slip(path).unlink()
    write_recording(other, event_arrays(events_at([5]), SLICES))
    foreign = real_slip(tmp_path / "c.recording.h5")
    shutil.move(foreign, tmp_path / "b.labels.h5")
    (tmp_path / "a.labels.h5").write_text("no")
    for one in (path, other):
        assert not any(name.startswith("slip_") for name in row_of(one))


def test_without_slip_no_event_is_read(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that of a simulated recording that does not slip nothing is said, and its events are not looked at.

    But for what is said of its gel's nodes, which are fine enough or not, whether it slips or not.
    """
    path = tmp_path / "still.recording.h5"
    shutil.copy(made.recordings[0], path)
    with h5py.File(path, "r+") as h5:
        h5["truth/slip"][...] = 0
    monkeypatch.setattr("evetac_cli.store.recordings.onset.gel_counts", lambda *_: pytest.fail("events read"))
    assert {name for name in row_of(path) if name.startswith("slip_")} == {slip_grid.COLUMN}
