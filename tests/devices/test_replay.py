"""A replayed recording: bounded in memory, and no hostile file makes it run away."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.cameras import ReplayCamera
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe, content_digest
from tests import small_files


def recorded(path: Path, t: list[int], starts: list[int]) -> Path:
    """A recording of events at these times, whose slices begin at these events."""
    zeros = np.zeros(len(t), np.uint16)
    arrays: dict[str, Any] = {
        "events/t": np.array(t, np.int64),
        "events/x": zeros,
        "events/y": zeros,
        "events/p": zeros.astype(np.uint8),
        "ms_to_idx": np.array(starts, np.int64),
        "t_offset": np.int64(0),
        "sensor/frame_px": np.array([640, 480], np.int32),
        "sensor/name": "unknown",
    }
    write_stage(path, Recipe("recording", 1, {}, content=content_digest(arrays)), arrays)
    return path


def test_a_recording_with_little_in_it_is_handed_out_whole(tmp_path: Path) -> None:
    """Assert that all slices come, most of them empty."""
    slices = 5500
    path = recorded(tmp_path / "a.recording.h5", [10, 4_000_500], [0, *[1] * 4000, *[2] * (slices - 4000)])
    sizes = [part.size for part in iter(ReplayCamera(path).read, None)]
    assert [k for k, size in enumerate(sizes) if size] == [0, 4000]
    assert len(sizes) == slices


@pytest.mark.parametrize("t", [[10, 10**15], [10, 5 * SLICE_US, 3 * SLICE_US]])
def test_events_out_of_their_slices_are_refused(t: list[int], tmp_path: Path) -> None:
    """Assert words, and no memory, for events later than all slices, or times that go back."""
    with small_files.nonsense_is_written():
        path = recorded(tmp_path / "a.recording.h5", t, [0] + [len(t)] * 10)
    with pytest.raises(InputError, match="ms_to_idx does not fit events/t|events/t is impossible"):
        camera = ReplayCamera(path)
        while camera.read() is not None:
            pass
