"""What programs of others read in our files: xarray, pandas, h5py, h5glance and h5dump; no plugin, no netCDF4."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.inspect import validate
from evetac_cli.resources import MODEL
from evetac_cli.store.files import StageFile, put_header, replacing, write_stage
from evetac_cli.store.hdf5.chunks import put
from evetac_cli.store.layout import netcdf, schema
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.layout.schema import KINDS, Dataset
from evetac_cli.store.recordings.segments import RecordingWriter
from tests.conftest import Made
from tests.make import label_arrays

WEIGHTS = {"conv.weight": (8, 8, 3), "out.weight": (1, 8), "out.bias": (1,)}
SHARED = {"slices": 90, "dots": 56, "rows": 7, "columns": 8, "events": 300}  # other dimensions have 11 rows
UNIT = "N m"  # of the column of another stream
LABELS = label_arrays(np.zeros(90), -1)
TEXT = f'{{"object": 8, "units": {{"camera.dropped": "{UNIT}"}}}}'


def every_dataset(kind: str, rows: dict[str, int] = SHARED) -> dict[str, Any]:
    """Arrays, numbers and texts for every path of a schema, optional ones too."""
    rng = np.random.default_rng(17)
    arrays: dict[str, Any] = {}
    for row in schema.load(kind).datasets:
        if row.dims is None:
            arrays |= {row.path[:-1] + name: rng.random(shape, np.float32) for name, shape in WEIGHTS.items()}
            continue
        named = [str(dim).partition("+") for dim in row.dims]
        shape = [int(name) if name.isdigit() else rows.get(name, 11) + int(more or 0) for name, _, more in named]
        value: Any = rng.integers(0, 100, shape)
        arrays[row.path.replace("*", "camera.dropped")] = TEXT if row.dtype == "utf8" else value.astype(row.dtype)
    return arrays


def written(path: Path, kind: str, arrays: dict[str, Any], **about: Any) -> Path:
    """A file of these arrays, whatever their values, with the header of a recipe."""
    with replacing(path) as h5:
        for name, value in arrays.items():
            put(h5, name, value)
        put_header(h5, Recipe(kind, 3, {"preset": "paper"}, **{"seed": 5, **about}).header())
    return path


def said(row: Dataset, name: str) -> tuple[str, str]:
    """The unit and the long name of a dataset of a schema, written from `every_dataset`."""
    if not row.described_in:
        return row.unit or "1", row.meaning
    column, group = name.split("/")[::-1][:2]
    return UNIT, f"{column}, {group}"


def datasets(h5: h5py.File) -> dict[str, Any]:
    """Every dataset by its path, dimensions left out."""
    listed: dict[str, Any] = {}
    h5.visititems(lambda name, item: listed.update({name: item}) if isinstance(item, h5py.Dataset) else None)
    return {name: item for name, item in listed.items() if not item.is_scale}


def in_xarray(path: Path) -> dict[str, xarray.DataArray]:
    """Every variable by its path, as xarray reads it with all its defaults (a warning is an error here)."""
    with xarray.open_datatree(path, engine="h5netcdf") as tree:
        tree.load()
    return {
        f"{node.path}/{name}".lstrip("/"): variable
        for node in tree.subtree
        for name, variable in node.to_dataset(inherit=False).variables.items()
    }


@pytest.mark.parametrize("kind", KINDS)
def test_xarray_reads_every_kind(tmp_path: Path, kind: str) -> None:
    """Assert that xarray reads numbers as they were, times too, with units and a name for every dimension."""
    arrays = every_dataset(kind)
    read = in_xarray(written(tmp_path / "a.h5", kind, arrays))
    assert read.keys() == arrays.keys()
    for name, variable in read.items():
        row = schema.load(kind).find(name)
        assert row is not None
        assert (variable.attrs["units"], variable.attrs["long_name"]) == said(row, name)
        if row.dtype == "utf8":
            assert variable.item() == TEXT
        else:
            np.testing.assert_array_equal(variable.values, arrays[name], strict=True)
        named = [str(dim) for dim in row.dims or () if isinstance(dim, str)]
        assert [dim for dim in variable.dims if dim in named or dim == "slice_edges"] == [
            "slice_edges" if dim == "slices+1" else dim for dim in named
        ]


@pytest.mark.slow
def test_files_of_every_stage(made: Made) -> None:
    """Assert that xarray reads what stages write, and the package's model, as evetac does, labelled and simulated."""
    features = made.beside(made.recordings[0], "features")
    others = [made.beside(made.recordings[0], kind) for kind in ("labels", "tracks")]
    for path in (made.recordings[0], features, *others, made.model, made.force_model, made.grasp, MODEL):
        read = in_xarray(path)
        with StageFile(path) as file:
            assert read.keys() == file.contents().keys()
            for name, variable in read.items():
                stored = file.read(name)
                np.testing.assert_array_equal(variable.values, stored, strict=not isinstance(stored, str))
                assert {"units", "long_name"} <= variable.attrs.keys()
        with xarray.open_dataset(path, engine="h5netcdf") as root:
            assert root.attrs["simulated"] == "yes"
            assert root.attrs["title"].startswith("Simulated: ")


@pytest.mark.parametrize("kind", KINDS)
def test_dimensions_take_no_room(tmp_path: Path, kind: str) -> None:
    """Assert that dimensions hold no bytes, are attached to every axis, and are where no dataset can be."""
    with h5py.File(written(tmp_path / "a.h5", kind, every_dataset(kind))) as h5:
        scales: list[Any] = []
        h5.visititems(lambda name, item: scales.append(item) if getattr(item, "is_scale", False) else None)
        assert all(scale.id.get_storage_size() == 0 and scale.id.get_offset() is None for scale in scales)
        for name, dataset in datasets(h5).items():
            for axis, dim in enumerate(dataset.dims):
                assert [len(dim), dim[0].shape] == [1, (dataset.shape[axis],)], name
    paths = {row.path for row in schema.load(kind).datasets}
    groups = {path.rpartition("/")[0] for path in paths}
    assert not set(netcdf.dimension_paths(kind).values()) & (paths | groups)


def test_header_in_words(tmp_path: Path) -> None:
    """Assert that the root says in plain attributes what the JSON header says."""
    recording = Recipe("recording", 7, {}, seed=1, simulated_source=True).header()
    path = written(tmp_path / "a.h5", "labels", LABELS, seed=2, parents=(recording,))
    with h5py.File(path) as h5, StageFile(path) as file:
        said = dict(h5.attrs)
        assert said.pop("header")
        assert said == {
            "title": f"Simulated: {schema.load('labels').meaning}",
            "kind": "labels",
            "schema_version": schema.load("labels").version,
            "method": 3,
            "seed": 2,
            "recipe_id": file.header["id"],
            "simulated": "yes",
            "source": "simulated data",
        }


@pytest.fixture
def labels_file(tmp_path: Path) -> Path:
    """A labels file as its stage might write it."""
    path = tmp_path / "a.labels.h5"
    write_stage(path, Recipe("labels", 1, {}, seed=5), LABELS)
    return path


def hold_values(h5: h5py.File) -> None:
    h5["slices"][...] = 7


def have_many_names(h5: h5py.File) -> None:
    """HDF5's own functions for scales write past their buffers here, and the process may end at any later time."""
    del h5["slices"].attrs["NAME"]
    h5["slices"].attrs["NAME"] = np.array([netcdf.NO_VARIABLE.encode()] * 5)


@pytest.mark.parametrize("change", [hold_values, have_many_names])
def test_damaged_dimensions_are_refused(labels_file: Path, change: Callable[[h5py.File], None]) -> None:
    """Assert that what lies in the place of a dimension and is none is never read, and no such file called whole."""
    with h5py.File(labels_file, "r+") as h5:
        change(h5)
    with StageFile(labels_file) as file:
        assert not file.has("slices")
        with pytest.raises(InputError, match="slices is not in this labels"):
            file.read("slices")
        with pytest.raises(InputError, match="slices is (not in the schema|incomplete)"):
            file.check()
    assert validate.run([labels_file]).summary["invalid"] == 1


def test_segments_say_what_they_hold(tmp_path: Path) -> None:
    """Assert that what is rescued of a recording with plain tools has its units, and the joined file everything."""
    static = {"sensor/frame_px": np.array([640, 480], np.int32), "sensor/name": "unknown", "t_offset": np.int64(0)}
    writer = RecordingWriter(tmp_path / "a.recording.h5", static)
    rows = {row.path: 0 for row in schema.load("recording").datasets if row.path.startswith("gripper/")}
    none: NDArray[Any] = np.empty(0, np.int64)
    for _ in range(3):
        writer.append(Events(none, none.astype("u2"), none.astype("u2"), none.astype("u1")), rows)
    writer.close_segment()
    units: dict[str, str] = {}
    for part in ("static.h5", "000000.h5"):
        with h5py.File(writer.folder / part) as h5:
            units |= {name: item.attrs["units"] for name, item in datasets(h5).items() if "units" in item.attrs}
    assert units == {
        **{name: schema.load("recording").find(name).unit or "1" for name in (*static, *rows)},  # type: ignore[union-attr]
        **{"events/t": "us", "events/x": "px", "events/y": "px", "events/p": "1"},
    }
    writer.finish(Recipe("recording", 1, {}, seed=1))
    read = in_xarray(tmp_path / "a.recording.h5")
    assert read["gripper/current_ma"].attrs["units"] == "mA"
    assert read["gripper/current_ma"].sizes == {"commands": 3}
