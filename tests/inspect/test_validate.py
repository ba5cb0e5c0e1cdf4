"""validate reads a file of any length in the same memory, and compares names with histories."""

import tracemalloc
from pathlib import Path

import numpy as np

from evetac_cli.inspect import validate
from evetac_cli.store.files import header_of, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import event_arrays, events_at
from tests.small_files import recording_of, tracks


def test_m11_validate_takes_no_more_memory_for_more_events(tmp_path: Path) -> None:
    """Assert that twice as many events take no more memory, those of an import, whose arrays are hashed, too."""
    peaks = []
    for events_a_slice in (2_500, 5_000):
        arrays = event_arrays(events_at(np.repeat(np.arange(1000) * 1000, events_a_slice)), 1000)
        path = tmp_path / f"{events_a_slice}.recording.h5"
        write_stage(path, Recipe("recording", 1, {}, content="0" * 64), arrays, force=True)
        tracemalloc.start()
        (row,) = validate.run([path]).rows
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert row["faults"] == "the arrays were changed: their digest is not the one in the header"
    assert peaks[1] < 1.2 * peaks[0]
    assert peaks[1] < 40e6


def test_names_that_were_exchanged(tmp_path: Path) -> None:
    """Assert that tracks under the name of another recording are reported, if that recording is validated as well."""
    recordings = [recording_of(tmp_path / f"{name}.recording.h5", [count] * 20) for name, count in (("a", 2), ("b", 3))]
    for number, recording in enumerate(recordings):
        tracks(tmp_path / f"{'ba'[number]}.tracks.h5", header_of(recording, "recording"))
    exchanged = sorted(tmp_path.glob("*.tracks.h5"))
    found = {row["file"]: row["faults"] for row in validate.run([*recordings, *exchanged]).rows}
    for path in exchanged:
        assert "made from another recording than" in found[str(path)]
    assert all(row["faults"] is None for row in validate.run(exchanged).rows)
    tracks(tmp_path / "a.tracks.h5", header_of(recordings[0], "recording"))
    assert validate.run([recordings[0], tmp_path / "a.tracks.h5"]).summary["invalid"] == 0
