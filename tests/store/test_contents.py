"""Limits of the schema, block by block: what is read is checked, wherever the blocks are cut, and in bounded memory."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from evetac_cli.errors import SchemaError
from evetac_cli.events import slice_starts
from evetac_cli.inspect import validate
from evetac_cli.kernels.slip import architectures, networks
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.store import contents, schema
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.read import open_recording
from tests import small_files


def write_long(path: Path, slices: int, events_a_slice: int) -> Path:
    """A recording with so many events in each slice, at the slice's beginning."""
    t = np.repeat(np.arange(slices, dtype=np.int64) * 1000, events_a_slice)
    arrays = {
        "events/t": t,
        "events/x": np.zeros(len(t), np.uint16),
        "events/y": np.zeros(len(t), np.uint16),
        "events/p": np.zeros(len(t), np.uint8),
        "ms_to_idx": slice_starts(t, slices),
        "t_offset": np.int64(0),
        "sensor/frame_px": np.array([640, 480], np.int32),
        "sensor/name": "unknown",
    }
    write_stage(path, Recipe("recording", 1, {}, seed=1), arrays)
    return path


def set_value(path: Path, dataset: str, index: int, value: int) -> None:
    with h5py.File(path, "r+") as h5:
        h5[dataset][index] = value


@pytest.mark.parametrize("values", [1, 2, 3, 5, 7, 1000])
def test_a_fault_is_found_wherever_the_blocks_are_cut(
    values: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a time that goes backwards is found within a block and from one block to the next."""
    monkeypatch.setattr(contents, "BLOCK_VALUES", values)
    monkeypatch.setattr(contents, "SMALL_VALUES", 0)
    path = tmp_path / "a.recording.h5"
    small_files.recording(path)
    assert validate.run([path]).summary["invalid"] == 0
    set_value(path, "control/t_us", 6, 9999)
    (row,) = validate.run([path]).rows
    assert "control/t_us" in row["faults"]
    assert "never decreasing" in row["faults"]


@pytest.mark.parametrize("index", [0, 3, 4999, 5000, 9999])
@pytest.mark.parametrize(("dataset", "value"), [("events/x", 640), ("events/p", 2), ("events/t", -1)])
def test_large_datasets_are_checked_where_they_are_read(dataset: str, value: int, index: int, tmp_path: Path) -> None:
    """Assert that a recording with one bad event opens, and that reading it is refused where that event lies."""
    path = write_long(tmp_path / "a.recording.h5", 1000, 10)
    set_value(path, dataset, index, value)
    with open_recording(path) as recording:
        for first in range(0, 1000, 100):
            holds = first <= index // 10 < first + 100
            if not holds:
                recording.between(first, first + 100)
                continue
            with pytest.raises(SchemaError, match=dataset):
                recording.between(first, first + 100)


@pytest.mark.parametrize("index", [0, 7, 60, 99])
def test_events_of_another_slice_are_refused(index: int, tmp_path: Path) -> None:
    """Assert that events outside the slice that ms_to_idx puts them in are refused by every range that holds them."""
    path = write_long(tmp_path / "a.recording.h5", 100, 10)
    starts = np.arange(101) * 10
    starts[index + 1 : 100] += 1  # the slice after it loses its first event to it
    if index == 99:
        starts[99] -= 1
    with h5py.File(path, "r+") as h5:
        h5["ms_to_idx"][...] = starts
    wrong = index if index < 99 else 98
    with open_recording(path) as recording:
        for first, last in ((0, 100), (index - index % 10, index - index % 10 + 10), (0, index + 1)):
            with pytest.raises(SchemaError, match="ms_to_idx does not fit events/t"):
                recording.between(first, last)
        recording.between(0, max(0, wrong - 1))
    (row,) = validate.run([path]).rows
    assert "ms_to_idx does not fit events/t" in row["faults"]


def test_files_of_version_1_2_are_read(tmp_path: Path) -> None:
    """Assert that the limits are held against files of the version before them, whose datasets are the same."""
    path = tmp_path / "a.recording.h5"
    small_files.recording(path)
    copy = Path(shutil.copy(path, tmp_path / "b.recording.h5"))
    with h5py.File(copy, "r+") as h5:
        text = h5.attrs["header"]
        now = f'"version": "{schema.load("recording").version}"'
        assert now in text
        h5.attrs["header"] = text.replace(now, '"version": "1.2"')
    assert validate.run([copy]).summary["invalid"] == 0
    set_value(copy, "control/phase", 0, 3)
    with pytest.raises(SchemaError, match="control/phase is impossible"):
        StageFile(copy)


def test_an_index_into_a_dataset_that_is_missing_is_refused(tmp_path: Path) -> None:
    """Assert that a file whose onset points into labels that it does not have is refused in words."""
    path = tmp_path / "a.features.h5"
    small_files.features(path, ())
    with h5py.File(path, "r+") as h5:
        del h5["label"]
    with pytest.raises(SchemaError, match="onset_slice is impossible") as refused:
        StageFile(path)
    assert "label" in str(refused.value)


@pytest.mark.parametrize("name", ARCHITECTURES)
@pytest.mark.parametrize("grid", [(7, 8), (2, 4), (5, 9)])
def test_shapes_of_weights_are_those_of_the_networks(name: str, grid: tuple[int, int]) -> None:
    """Assert that the shapes that model files are held to are those of the networks that are trained."""
    network = networks.build(ARCHITECTURES[name], *grid)
    shapes = {layer: array.shape for layer, array in networks.weights(network).items()}
    assert architectures.weight_shapes(ARCHITECTURES[name], *grid) == shapes
