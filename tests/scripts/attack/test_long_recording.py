"""A recording of any length, made of the end of a short one."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.events import SLICE_US
from evetac_cli.inspect import validate
from evetac_cli.store.recordings.read import open_recording
from scripts.attack.long_recording import Repeated
from tests.conftest import Made

BUSY = 50.0  # events a slice


@pytest.fixture(scope="module")
def repeated(made: Made) -> Repeated:
    """The end of a short trial."""
    with open_recording(made.recordings[0]) as trial:
        return Repeated(trial, BUSY)


def test_it_is_the_part_again_and_again(repeated: Repeated, tmp_path: Path) -> None:
    """Assert that every repetition is the part, moved in time, that the last is cut, and that the file says so."""
    path = tmp_path / "long.recording.h5"
    slices = 2 * repeated.slices + 7
    repeated.write(path, slices)
    assert validate.run([path]).rows[0]["faults"] is None
    part = repeated.rows
    with open_recording(path) as long:
        assert len(long) == slices
        assert long.header["simulated"]
        assert long.header["parameters"]["repeated"]["slices"] == repeated.slices
        for times in range(2):
            events = long.between(times * repeated.slices, (times + 1) * repeated.slices)
            assert (events.t == part["events/t"] + times * repeated.slices * SLICE_US).all()
            assert (events.x == part["events/x"]).all()
        last = long.between(2 * repeated.slices, slices)
        assert (last.y == part["events/y"][: last.size]).all()
        assert last.size == repeated.starts[7]
        slip = long.read("truth/slip")
        assert (slip == np.resize(part["truth/slip"], slices)).all()
        assert (np.diff(long.read("gripper/t_us")) > 0).all()


def test_its_segments_are_repaired(repeated: Repeated, tmp_path: Path) -> None:
    """Assert that the folder of the same recording, as one that broke off leaves it, is made whole."""
    slices = repeated.slices + 3
    repeated.leave_segments(tmp_path / "broken.recording.h5", slices)
    (row,) = validate.repair([tmp_path / "broken.recording.part"]).rows
    assert row["fault"] is None
    assert row["slices_kept"] == slices
