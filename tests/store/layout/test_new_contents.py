"""Files are refused before they take their place where their contents make no sense, wherever blocks are cut."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import SchemaError
from evetac_cli.inspect import validate
from evetac_cli.store.files import NOT_WRITTEN, StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import everything, label_arrays

LABELS = Recipe("labels", 1, {})
RECORDING = Recipe("recording", 1, {}, seed=1)
EVENTS, SLICES = 60, 6


def labels(**changes: Any) -> dict[str, Any]:
    """Labels of 100 slices with slip from 70 on."""
    return label_arrays(np.arange(100) >= 70, 70) | changes


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"label": np.where(np.arange(100) < 70, 0, 2).astype(np.int8)}, "label is impossible"),
        ({"onset_slice": np.int64(71)}, "70, the first slice of slip"),
        ({"abstained": np.uint8(1), "onset_slice": np.int64(69)}, "a slice before all slip with label -1"),
    ],
)
def test_arrays_without_sense_leave_nothing(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    """Assert that each limit and rule of the schema is held before anything is written."""
    path = tmp_path / "a.labels.h5"
    with pytest.raises(SchemaError, match=words) as refused:
        write_stage(path, LABELS, labels(**changes))
    assert str(refused.value).startswith(f"{path}: ")
    assert refused.value.hint == NOT_WRITTEN
    assert everything(tmp_path) == []
    write_stage(path, LABELS, labels())


def columns() -> dict[str, Any]:
    """Events of a few slices, all in order."""
    return {
        "events/t": np.arange(EVENTS, dtype=np.int64) * (1000 * SLICES // EVENTS),
        "events/x": np.arange(EVENTS, dtype=np.uint16),
        "events/y": np.arange(EVENTS, dtype=np.uint16),
        "events/p": (np.arange(EVENTS) % 2).astype(np.uint8),
    }


def blocks(arrays: dict[str, Any], size: int) -> Iterator[dict[str, Any]]:
    for first in range(0, EVENTS, size):
        yield {name: rows[first : first + size] for name, rows in arrays.items()}


def write_events(path: Path, size: int, starts: Any = None, **changes: tuple[int, int]) -> None:
    """Write a recording in blocks of events, with other values at some places of its columns."""
    arrays = columns()
    for name, (place, value) in changes.items():
        arrays[f"events/{name}"][place] = value
    whole = {
        "ms_to_idx": np.arange(SLICES + 1, dtype=np.int64) * (EVENTS // SLICES) if starts is None else starts,
        "t_offset": np.int64(0),
        "sensor/frame_px": np.array([640, 480], np.int32),
        "sensor/name": "unknown",
    }
    write_stage(path, RECORDING, whole, blocks(arrays, size), dict.fromkeys(arrays, EVENTS))


@pytest.mark.parametrize("size", [7, EVENTS])
@pytest.mark.parametrize(("name", "value", "place"), [("x", 640, 30), ("p", 2, EVENTS - 1), ("t", -1, 0)])
def test_a_block_without_sense_leaves_the_old_file(
    tmp_path: Path, name: str, value: int, place: int, size: int
) -> None:
    """Assert that one bad event is found in whichever block it comes, and the file that was there stays."""
    path = tmp_path / "a.recording.h5"
    write_events(path, size)
    assert validate.run([path]).summary["invalid"] == 0
    before = path.read_bytes()
    with pytest.raises(SchemaError, match=f"events/{name} is impossible") as refused:
        write_events(path, size, **{name: (place, value)})
    assert refused.value.hint == NOT_WRITTEN
    assert path.read_bytes() == before
    assert everything(tmp_path) == [path.name]


def test_a_dataset_that_the_limits_need_is_missing(tmp_path: Path) -> None:
    """Assert that blocks whose limits need what was not given are refused in words."""
    whole = {"ms_to_idx": np.zeros(1, np.int64), "t_offset": np.int64(0), "sensor/name": "unknown"}
    with pytest.raises(SchemaError, match=r"sensor/frame_px is missing"):
        write_stage(tmp_path / "a.recording.h5", RECORDING, whole, blocks(columns(), EVENTS), {})
    assert everything(tmp_path) == []


def test_labels_may_abstain(tmp_path: Path) -> None:
    """Assert that an onset which cannot be told may lie in slices that are not examined, before all slip."""
    label = (np.arange(100) >= 70).astype(np.int8)
    label[60:70] = -1
    path = tmp_path / "a.labels.h5"
    write_stage(path, LABELS, labels(label=label, onset_slice=np.int64(65), abstained=np.uint8(1), doubt="slow"))
    with StageFile(path, "labels") as file:
        file.check()
        assert int(file.read("onset_slice")) == 65
