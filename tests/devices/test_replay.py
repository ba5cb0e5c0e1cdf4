"""A replayed recording: bounded in memory, and no hostile file makes it run away."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices import replay
from evetac_cli.devices.replay import ReplayCamera
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Slicer
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


def test_silence_is_cut_a_second_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a recording with little in it is handed out whole, and never more than a block of slices is cut."""
    most: list[int] = []
    close_until = Slicer.close_until

    def noted(slicer: Slicer, slices: int) -> Any:
        closed = close_until(slicer, slices)
        most.append(len(closed))
        return closed

    monkeypatch.setattr(Slicer, "close_until", noted)
    slices = 5500
    path = recorded(tmp_path / "a.recording.h5", [10, 4_000_500], [0, *[1] * 4000, *[2] * (slices - 4000)])
    camera = ReplayCamera(path)
    sizes = [part.size for part in iter(camera.read, None)]
    assert [k for k, size in enumerate(sizes) if size] == [0, 4000]
    assert len(sizes) == slices
    assert max(most) <= replay.BLOCK_SLICES


@pytest.mark.parametrize("t", [[10, 10**15], [10, 5 * SLICE_US, 3 * SLICE_US]])
def test_events_out_of_their_slices_are_refused(t: list[int], tmp_path: Path) -> None:
    """Assert words, and no memory, for events later than all slices, or times that go back."""
    with small_files.nonsense_is_written():
        path = recorded(tmp_path / "a.recording.h5", t, [0] + [len(t)] * 10)
    with pytest.raises(InputError, match="ms_to_idx does not fit events/t|events/t is impossible"):
        camera = ReplayCamera(path)
        while camera.read() is not None:
            pass
