"""The contents of each kind of file. The tables in schemas/ are the only definition of layouts, and used for checks.

A schema is a flat table: path -> dtype, named dims, unit, meaning. Every named dim has one size in a file; `slices+1`
is the dim `slices` plus one. Dims may be null (any shape). A path that ends in `*` matches any path. A `*` between
slashes is a group whose name can be chosen, of which there may be several: `streams/*/t_us`. Each such group has its
own sizes of dims, which no dataset outside such a group uses, and all its required datasets. A group listed in
`optional_groups` is either present with all its required datasets, or missing. `described_in` names the JSON text of
the group with the `units` of its columns.

A dataset may have limits, which store/layout/contents.py checks:

    minimum, maximum, above   numbers that values may reach, and one that they must exceed
    finite                    true, or "or NaN"; every float says which
    nan_where                 a dot is NaN only where this grid has none
    increasing                "strictly" or "never decreasing", in the order in which values are stored
    index_of                  values are rows of another dataset; with `+1` in the dims, where its rows begin and end
    one_of                    the only values
    inside_frame, margin_px   x, y or xy within the sensor's frame, or at most this many px outside it
    json                      a text is a JSON "object" or a "list of flat objects"
    why                       the reason for a limit, where it is not obvious
"""

import functools
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import SchemaError
from evetac_cli.resources import schemas

KINDS = ("recording", "labels", "tracks", "features", "model", "force-model", "touch", "report")
MAJOR = 1


PLAIN = {"i": "int", "u": "uint", "f": "float"}  # kinds of numpy's dtypes


@dataclass(frozen=True)
class Limits:
    """Limits for the values of a dataset, as described above; by default there are none."""

    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    finite: bool | str = ""
    nan_where: str = ""
    increasing: str = ""
    index_of: str = ""
    one_of: tuple[Any, ...] = ()
    inside_frame: str = ""
    margin_px: int = 0
    json: str = ""
    why: str = ""


ANYTHING = Limits()


@dataclass(frozen=True)
class Dataset:
    """One dataset of a schema: its dtype, named dims (None: any shape), unit, meaning and limits."""

    path: str
    dtype: str
    dims: tuple[str | int, ...] | None
    unit: str
    meaning: str
    optional: bool
    limits: Limits = ANYTHING
    described_in: str = ""

    def describes(self, path: str) -> bool:
        """Whether this row describes a path."""
        if "*" not in self.path:
            return path == self.path
        pattern = re.escape(self.path).replace(r"/\*/", "/[^/]+/")
        return re.fullmatch(re.sub(r"/\\\*$", "/.+", pattern), path) is not None

    def named_group(self, path: str) -> str:
        """Return the group with a chosen name that contains a dataset of this row; empty if there is none."""
        before, star, _ = self.path.partition("*/")
        return "/".join(path.split("/")[: before.count("/") + 1]) if star else ""

    @property
    def edges(self) -> bool:
        """Whether its values are the starts of parts of another dataset, followed by the end of the last part."""
        return bool(self.limits.index_of and self.dims) and str(self.dims[-1]).endswith("+1")  # type: ignore[index]


@dataclass(frozen=True)
class Schema:
    """The table of datasets of one kind of file, with its version and the groups that may be missing."""

    kind: str
    version: str
    meaning: str
    optional_groups: tuple[str, ...]
    datasets: tuple[Dataset, ...]

    def find(self, path: str) -> Dataset | None:
        """Return the row that describes a path; None if there is none."""
        dataset = self._by_path.get(path)
        return dataset or next((row for row in self.datasets if "*" in row.path and row.describes(path)), None)

    @functools.cached_property
    def _by_path(self) -> dict[str, Dataset]:
        """Rows with a fixed path, by path; most rows have one, and a file needs thousands of look-ups."""
        return {row.path: row for row in self.datasets if "*" not in row.path}


@functools.cache
def load(kind: str) -> Schema:
    """Return the schema of a kind, in its newest version."""
    table = json.loads((schemas() / f"{kind}.v{MAJOR}.json").read_text())
    rows = tuple(
        Dataset(
            path,
            row["dtype"],
            None if row["dims"] is None else tuple(row["dims"]),
            row["unit"],
            row["meaning"],
            row.get("optional", False),
            _limits(row),
            row.get("described_in", ""),
        )
        for path, row in table["datasets"].items()
    )
    return Schema(kind, table["version"], table["meaning"], tuple(table["optional_groups"]), rows)


def _limits(row: Mapping[str, Any]) -> Limits:
    values: dict[str, Any] = {name: row[name] for name in Limits.__dataclass_fields__ if name in row}
    if "one_of" in values:
        values["one_of"] = tuple(values["one_of"])
    return Limits(**values)


def problems(schema: Schema, stored: Mapping[str, tuple[str, tuple[int, ...]]]) -> list[str]:
    """Compare a file's datasets, path -> (dtype, shape), with its schema; return a line per difference."""
    groups = {path.split("/")[0] for path in stored if "/" in path}
    lines = [
        f"{path} is missing: {row.meaning}"
        for row in schema.datasets
        if not row.optional and row.path not in stored
        for path in _missing(schema, row, stored, groups)
    ]
    sizes: dict[tuple[str, str], tuple[int, str]] = {}
    for path, (dtype, shape) in stored.items():
        described = schema.find(path)
        if described is None:
            lines.append(f"{path} is not in the schema of a {schema.kind} file")
            continue
        if dtype != described.dtype:
            lines.append(f"{path}: expected dtype {described.dtype}, found {dtype}")
        if described.dims is not None:
            lines += _shape_problems(path, described.dims, shape, sizes, described.named_group(path))
    return lines


def _missing(schema: Schema, row: Dataset, stored: Mapping[str, Any], groups: Collection[str]) -> Iterator[str]:
    """Yield the paths at which a required dataset is missing; groups: groups that are not empty."""
    before, star, after = row.path.partition("*/")
    if star:
        inside = [path.removeprefix(before) for path in stored if path.startswith(before)]
        names = {path.partition("/")[0] for path in inside if "/" in path}
        yield from (path for name in sorted(names) if (path := f"{before}{name}/{after}") not in stored)
        return
    group = row.path.split("/")[0]
    group_absent = group in schema.optional_groups and group not in groups
    if not group_absent and not ("*" in row.path and any(map(row.describes, stored))):
        yield row.path


def _shape_problems(
    path: str,
    dims: tuple[str | int, ...],
    shape: tuple[int, ...],
    sizes: dict[tuple[str, str], tuple[int, str]],
    group: str,
) -> list[str]:
    """Compare one shape with its dims, and store the first size of each dim of a group in `sizes`."""
    if len(shape) != len(dims):
        return [f"{path}: expected dims {list(dims)}, found shape {list(shape)}"]
    lines = []
    for dim, size in zip(dims, shape, strict=True):
        if isinstance(dim, int):
            if size != dim:
                lines.append(f"{path}: expected size {dim}, found {size}")
            continue
        name, _, more = dim.partition("+")
        base = size - int(more or 0)
        if base < 0:
            lines.append(f"{path}: expected at least {more} for `{dim}`, found {size}")
            continue
        first, where = sizes.setdefault((group, name), (base, path))
        if base != first:
            lines.append(f"{path}: expected {first + int(more or 0)} for `{dim}` (as in {where}), found {size}")
    return lines


def describe(value: Any) -> tuple[str, tuple[int, ...]]:
    """Return dtype name and shape of a value to be stored; a str counts as `utf8`."""
    if isinstance(value, str):
        return "utf8", ()
    array = np.asarray(value)
    return array.dtype.name, array.shape


def typed_rows(kind: str, rows: Mapping[str, Sequence[Any]]) -> dict[str, NDArray[Any]]:
    """Return rows that were collected one by one as arrays with the schema's dtypes; KeyError for an unknown path."""
    table = load(kind)
    arrays = {}
    for path, values in rows.items():
        row = table.find(path)
        if row is None:
            raise KeyError(path)
        arrays[path] = np.asarray(values, dtype=row.dtype)
    return arrays


def refuse(kind: str, lines: list[str], where: str = "") -> None:
    """Raise SchemaError with the first `lines` of `problems`, if there are any."""
    if lines:
        expected, found = f"schemas/{kind}.v{MAJOR}.json", "; ".join(lines[:8])
        raise SchemaError(f"not a valid {kind}", where=where, expected=expected, found=found)


def describe_stored(dataset: Any) -> str:
    """Return the schema's dtype name for an HDF5 dataset, or for the id of one."""
    if dataset.shape is None:  # HDF5's null dataspace: a name without a value
        return "nothing"
    dtype = dataset.dtype
    if dtype.kind in PLAIN:  # the same as numpy's name, in a tenth of the time
        return f"{PLAIN[dtype.kind]}{8 * dtype.itemsize}"
    return str(dtype.name) if h5py.check_string_dtype(dtype) is None else "utf8"
