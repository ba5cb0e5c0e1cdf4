"""Limits of the schema, block by block: what is read is checked, wherever the blocks are cut, and in bounded memory."""

import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.errors import SchemaError
from evetac_cli.inspect import validate
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.slip import architectures, networks
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.resources import MODEL
from evetac_cli.stages import slip_detectors
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout import contents, rules, schema
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from tests import small_files
from tests.make import event_arrays, events_at


def write_long(path: Path, slices: int, events_a_slice: int) -> Path:
    """A recording with so many events in each slice, at the slice's beginning."""
    arrays = event_arrays(events_at(np.repeat(np.arange(slices) * 1000, events_a_slice)), slices)
    write_stage(path, Recipe("recording", 1, {}, seed=1), arrays)
    return path


def set_value(path: Path, dataset: str, index: int, value: int) -> None:
    with h5py.File(path, "r+") as h5:
        h5[dataset][index] = value


@pytest.mark.parametrize("values", [1, 7, 1000])
def test_a_fault_is_found_wherever_the_blocks_are_cut(
    values: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a time that goes backwards is found within a block and from one block to the next."""
    monkeypatch.setattr(rules, "BLOCK_VALUES", values)
    monkeypatch.setattr(contents, "SMALL_VALUES", 0)
    path = tmp_path / "a.recording.h5"
    small_files.recording(path)
    assert validate.run([path]).summary["invalid"] == 0
    set_value(path, "control/t_us", 6, 9999)
    (row,) = validate.run([path]).rows
    assert "control/t_us" in row["faults"]
    assert "never decreasing" in row["faults"]


@pytest.mark.parametrize("index", [0, 5000, 9999])
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
    with StageFile(copy) as file, pytest.raises(SchemaError, match="control/phase is impossible"):
        file.read("control/phase")


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
@pytest.mark.parametrize("grid", [(7, 8), (2, 4)])
def test_shapes_of_weights_are_those_of_the_networks(name: str, grid: tuple[int, int]) -> None:
    """Assert that the shapes that model files are held to are those of the networks that are trained."""
    network = networks.build(ARCHITECTURES[name], *grid)
    shapes = {layer: array.shape for layer, array in networks.weights(network).items()}
    assert architectures.weight_shapes(ARCHITECTURES[name], *grid) == shapes


def test_an_ensemble_of_networks_is_refused(tmp_path: Path) -> None:
    """Assert that a model file whose weights are of numbered networks, as 0.2 wrote them, is refused in words."""
    path = shutil.copy(MODEL, tmp_path / "a.model.h5")
    with h5py.File(path, "r+") as h5:
        for name in [*h5["weights"]]:
            h5.copy(f"weights/{name}", f"weights/1.{name}")
            h5.move(f"weights/{name}", f"weights/0.{name}")
    with StageFile(path) as file, pytest.raises(SchemaError, match="(?s)train the model again.*ensemble of networks"):
        slip_detectors.load_detector(file)
    assert validate.run([path]).summary["invalid"] == 1


def lines(rows: int, columns: int, dx: float, dy: float, skew: float = 0.0) -> Any:
    """A grid of dots with these steps to the right and down; skew: how far a step down leads to the right."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([100 + dx * x + skew * y, 100 + dy * y], axis=-1).astype(float)


NO_GRIDS: dict[str, tuple[Any, float, str]] = {
    "all at one place": (np.full((3, 4, 2), 100.0), 15.0, "two at"),
    "two at one place": (np.concatenate([lines(2, 4, 50, 50), lines(1, 4, 50, 50)]), 15.0, "two at"),
    "two nearly at one place": (lines(3, 4, 50, 0.5), 0.2, "two at"),
    "all on one line": (lines(3, 4, 20, 1e-3, 70), 5.0, "all dots on one line"),
    "a sloping line": (np.stack([np.arange(12.0).reshape(3, 4) * 9 + 100] * 2, axis=-1), 5.0, "all dots on one line"),
    "a radius of a pitch": (lines(3, 4, 50, 50), 50.0, "radius 50 px"),
    "a radius of a frame": (lines(3, 4, 50, 50), 600.0, "radius 600 px"),
    "beside the frame": (lines(3, 4, 500, 50), 15.0, "row 0"),
    "far beside the frame": (lines(3, 4, 50, 50) + 1e9, 15.0, "1000000100"),
    "no radius": (lines(3, 4, 50, 50), 0.0, "0.0"),
}


@pytest.mark.parametrize("name", NO_GRIDS)
def test_dots_that_no_gel_can_have(name: str, tmp_path: Path) -> None:
    """Assert that tracks with such dots are neither read nor called valid."""
    dots, radius_px, said = NO_GRIDS[name]
    path = tmp_path / "a.tracks.h5"
    small_files.tracks(path, small_files.recording(tmp_path / "a.recording.h5"))
    with h5py.File(path, "r+") as file:
        file["sensor/dot_xy_px"][...] = dots
        file["sensor/dot_radius_px"][...] = radius_px
    with (
        StageFile(path) as file,
        pytest.raises(SchemaError, match="sensor/dot_(xy|radius)_px is impossible") as refused,
    ):
        file.read("sensor/dot_xy_px")
    assert said in refused.value.found
    assert validate.run([path]).summary["invalid"] == 1


GRIDS: dict[str, tuple[Any, float]] = {
    "a row of dots": (lines(1, 12, 40, 40), 10.0),
    "a row of dots in no grid": (np.random.default_rng(1).permutation(lines(3, 4, 60, 50).reshape(-1, 2))[None], 10.0),
    "a column of dots": (lines(12, 1, 40, 30), 10.0),
    "dots that touch": (lines(3, 4, 20, 20), 10.0),
    "a steep grid": (lines(3, 4, 60, 60, 30), 10.0),
    "two dots of a grid": (np.where(np.arange(12).reshape(3, 4, 1) < 2, lines(3, 4, 60, 60), np.nan), 10.0),
    "a diagonal of a grid": (np.where(np.eye(3, 4)[..., None] > 0, lines(3, 4, 60, 60), np.nan), 10.0),
    "one dot": (np.where(np.arange(12).reshape(3, 4, 1) < 1, lines(3, 4, 60, 60), np.nan), 10.0),
}


@pytest.mark.parametrize("name", GRIDS)
def test_odd_grids_that_a_gel_can_have(name: str) -> None:
    """Assert that rows, columns, dense, steep and nearly empty grids are none of those."""
    assert grid.impossible(*GRIDS[name]) is None
