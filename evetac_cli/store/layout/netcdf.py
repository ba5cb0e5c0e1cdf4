"""Metadata in files for xarray, netCDF, MATLAB and HDFView: units, long names, named dimensions, a readable header.

All of it comes from the kind's schema and from the header, and is written when a file is complete. It is not part of
arrays or recipe ids, and evetac itself reads only the JSON header.

A dimension is one in the sense of netCDF-4: a dataset that is attached to others as an HDF5 dimension scale. Those of
evetac have no values, since the coordinate is the plain index, so they take no space on disk. Each is in the deepest
group that contains all datasets that may have it, where netCDF looks for it. Units are written as in evetac's names:
`us`, `ms`. xarray converts `microseconds` and the like to durations, but not these symbols, so times stay numbers.
There is no `Conventions`: CF requires units of UDUNITS, which has neither `px` nor `ticks`. Texts have a variable
length, because h5py returns texts of fixed length as bytes.
"""

import functools
import re
from typing import Any

import h5py

from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.layout.schema import Dataset
from evetac_cli.text_files import parse_json

NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable."  # netCDF's text for a scale without values
LARGEST_INT = 2**63 - 1  # largest number of an attribute
# Names of dimensions that a schema gives as a number: by the dataset, or else by the number.
FIXED = {
    "frame_px": ("width_height",),
    "window_px": ("x0_y0_x1_y1",),
    "dot_shape": ("rows_columns",),
    "lost_slices": ("gaps", "first_end"),
    "slope_n_px": ("displacement_xy", "xy"),  # netCDF wants no dimension twice in one dataset
}
BY_SIZE = {2: "xy", 3: "median_p99_most"}
EDGES = {"slices+1": "slice_edges"}
ANY_SHAPE = re.compile("size_[0-9]+(_[0-9]+)?")  # dimensions of datasets whose shape the schema leaves open


def describe_file(h5: h5py.File, header: Header) -> None:
    """Write all metadata of this module to a file that has all of its datasets."""
    table = schema.load(header["kind"])
    for name, value in header_in_words(header).items():
        h5.attrs[name] = value
    datasets: dict[str, Any] = {}
    h5.visititems(lambda name, item: datasets.update({name: item}) if isinstance(item, h5py.Dataset) else None)
    for name, dataset in datasets.items():
        row = table.find(name)
        if row is None:
            continue
        describe_dataset(dataset, row)
        if row.described_in:
            _describe_column(h5, dataset, row.named_group(name), row.described_in)
        for axis, dimension in enumerate(_dimensions(header["kind"], row, name, dataset.shape)):
            scale = h5.get(dimension)
            if scale is None:
                scale = _new_scale(h5, dimension, dataset.shape[axis])
            dataset.dims[axis].attach_scale(scale)


def describe_dataset(dataset: Any, row: Dataset | None) -> None:
    """Write `units`, which is `1` without a unit, and `long_name`, if a schema describes the dataset."""
    if row is None:
        return
    dataset.attrs["units"] = row.unit or "1"
    dataset.attrs["long_name"] = row.meaning


def _describe_column(h5: h5py.File, column: Any, group: str, described_in: str) -> None:
    """Write the unit of a column and its description, from the JSON text of its group."""
    about = parse_json(h5[f"{group}/{described_in}"].asstr()[()])
    name = column.name.rpartition("/")[2]
    column.attrs["units"] = about.get("units", {}).get(name) or "1"
    column.attrs["long_name"] = f"{name}, {about.get('what') or group.rpartition('/')[2]}"


@functools.lru_cache(maxsize=1000)
def is_dimension(kind: str, path: str) -> bool:
    """Whether an object at a path can only be a dimension of a file of this kind, and not a dataset."""
    places = dimension_paths(kind).values()
    patterns = [re.escape(place).replace(r"\*", "[^/]+") for place in places if "*" in place]
    is_place = path in places or any(re.fullmatch(pattern, path) for pattern in patterns) or _of_open_shape(kind, path)
    return is_place and schema.load(kind).find(path) is None


def _of_open_shape(kind: str, path: str) -> bool:
    group, _, name = path.rpartition("/")
    return group in _open_groups(kind) and ANY_SHAPE.fullmatch(name) is not None


@functools.cache
def dimension_paths(kind: str) -> dict[str, str]:
    """Return name -> path of each dimension of a kind, in the deepest group with all datasets that may have it.

    A `*` represents the name of a group that can be chosen.
    """
    homes: dict[str, list[str]] = {}
    for row in schema.load(kind).datasets:
        groups = row.path.split("/")[:-1]
        for name in _names(row):
            shared = homes.setdefault(name, groups)
            same = [a == b for a, b in zip(shared, groups, strict=False)]
            homes[name] = shared[: (*same, False).index(False)]
    return {name: "/".join([*groups, name]) for name, groups in homes.items()}


def header_in_words(header: Header) -> dict[str, str | int]:
    """Return the header as attributes of the root: plain values, and title and source as in CF."""
    table = schema.load(header["kind"])
    seed = header["seed"]
    words: dict[str, str | int] = {
        "title": f"Simulated: {table.meaning}" if header["simulated"] else table.meaning,
        "kind": header["kind"],
        "schema_version": header["version"],
        "method": header["method"],
        "recipe_id": header["id"],
        "simulated": "yes" if header["simulated"] else "no",
        "source": "simulated data" if header["simulated"] else "data from devices or other programs",
    }
    if seed is not None:
        words["seed"] = seed if abs(seed) <= LARGEST_INT else str(seed)
    return words


def _names(row: Dataset) -> list[str]:
    """Return the names of a dataset's dimensions; none if the schema leaves its shape open."""
    if row.dims is None:
        return []
    fixed = FIXED.get(row.path.rpartition("/")[2])
    if fixed is not None:
        return list(fixed)
    return [
        BY_SIZE.get(dim, f"size_{dim}") if isinstance(dim, int) else EDGES.get(dim, dim.replace("+", "_plus_"))
        for dim in row.dims
    ]


def _dimensions(kind: str, row: Dataset, path: str, shape: tuple[int, ...]) -> list[str]:
    """Return the paths of the dimensions of the dataset at a path."""
    if row.dims is not None:
        group = row.named_group(path).rpartition("/")[2]
        return [dimension_paths(kind)[name].replace("*", group) for name in _names(row)]
    group = row.path.rpartition("/")[0]
    before = [shape[:axis].count(size) for axis, size in enumerate(shape)]
    return [
        f"{group}/size_{size}" + (f"_{count + 1}" if count else "") for size, count in zip(shape, before, strict=True)
    ]


@functools.cache
def _open_groups(kind: str) -> frozenset[str]:
    """Return the groups with datasets whose shape the schema leaves open."""
    return frozenset(row.path.rpartition("/")[0] for row in schema.load(kind).datasets if row.dims is None)


def _new_scale(h5: h5py.File, path: str, length: int) -> Any:
    """Create a dimension: a dataset without values, which takes no space."""
    scale = h5.create_dataset(path, shape=(length,), dtype=">f4", track_times=False)
    scale.make_scale(f"{NO_VARIABLE}{length:10d}")
    return scale
