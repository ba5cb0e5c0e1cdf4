"""validate reads a file of any length in the same memory."""

import tracemalloc
from pathlib import Path

import numpy as np

from evetac_cli.inspect import validate
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import event_arrays, events_at


def write_long(path: Path, slices: int, events_a_slice: int) -> Path:
    """A recording with so many events in each slice, at the slice's beginning."""
    arrays = event_arrays(events_at(np.repeat(np.arange(slices) * 1000, events_a_slice)), slices)
    write_stage(path, Recipe("recording", 1, {}, content="0" * 64), arrays)
    return path


def test_m11_validate_takes_no_more_memory_for_more_events(tmp_path: Path) -> None:
    """Assert that twice as many events take no more memory, those of an import, whose arrays are hashed, too."""
    peaks = []
    for events_a_slice in (2_500, 5_000):
        path = write_long(tmp_path / f"{events_a_slice}.recording.h5", 1000, events_a_slice)
        tracemalloc.start()
        (row,) = validate.run([path]).rows
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert row["faults"] == "the arrays were changed: their digest is not the one in the header"
    assert peaks[1] < 1.2 * peaks[0]
    assert peaks[1] < 40e6
