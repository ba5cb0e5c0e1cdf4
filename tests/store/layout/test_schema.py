"""The schema checker: files and arrays laid out from the tables themselves, then damaged in one place."""

import json
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from evetac_cli.resources import schemas
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.schema import KINDS, Schema

Stored = dict[str, tuple[str, tuple[int, ...]]]
STARS = ("conv/weight", "bias")  # what stands for `*` at the end of a path


def sizes() -> Iterator[int]:
    """A size of its own for every named dim, so that no two are equal by chance."""
    yield from range(11, 10_000, 10)


def layout(table: Schema, *, required_only: bool = False) -> Stored:
    """Path -> (dtype, shape) of a file that is as its schema says."""
    size, fresh = {}, sizes()
    stored: Stored = {}
    for row in table.datasets:
        in_optional_group = row.path.split("/")[0] in table.optional_groups
        if required_only and (row.optional or in_optional_group):
            continue
        shape = []
        for dim in row.dims or ():
            if isinstance(dim, str):
                name, _, more = dim.partition("+")
                if name not in size:
                    size[name] = next(fresh)
                shape.append(size[name] + int(more or 0))
            else:
                shape.append(dim)
        for path in [named(row.path, star) for star in STARS]:
            stored[path] = (row.dtype, tuple(shape))
    return stored


def named(path: str, star: str = STARS[0]) -> str:
    """A path in which names stand for each `*`."""
    path = path.replace("/*/", "/arm/")
    return path[:-1] + star if path.endswith("*") else path


def with_shape(stored: Stored, path: str, shape: tuple[int, ...]) -> Stored:
    """The same layout, but for one shape."""
    return {**stored, path: (stored[path][0], shape)}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("required_only", [False, True])
def test_valid_layouts_have_no_problems(kind: str, required_only: bool) -> None:
    """Assert that a file with everything, and one with only what is required, are valid."""
    table = schema.load(kind)
    assert schema.problems(table, layout(table, required_only=required_only)) == []


def paths(kind: str) -> list[str]:
    """The datasets of a kind."""
    return [row.path for row in schema.load(kind).datasets]


@pytest.mark.parametrize("kind", KINDS)
def test_every_missing_dataset_is_named(kind: str) -> None:
    """Assert that leaving out a dataset is a problem that names it and says what it is, unless it is optional."""
    table = schema.load(kind)
    for path in paths(kind):
        row = table.find(named(path))
        assert row is not None
        left = {name: about for name, about in layout(table).items() if table.find(name) is not row}
        lines = schema.problems(table, left)
        if row.optional:
            assert lines == []
        else:
            assert lines == [f"{path.replace('/*/', '/arm/')} is missing: {row.meaning}"]


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_dtype_is_named(kind: str) -> None:
    """Assert that a dtype that differs only in width or sign is a problem that says both."""
    table = schema.load(kind)
    stored = layout(table)
    for path in map(named, paths(kind)):
        dtype, shape = stored[path]
        other = {"int64": "int32", "uint8": "int8", "float64": "float32", "utf8": "uint8"}.get(dtype, "float64")
        assert schema.problems(table, {**stored, path: (other, shape)}) == [
            f"{path}: expected dtype {dtype}, found {other}"
        ]


@pytest.mark.parametrize("kind", KINDS)
def test_every_axis_is_checked(kind: str) -> None:
    """Assert that a longer axis is a problem where its size is fixed or shared, and none where it stands alone."""
    table = schema.load(kind)
    stored = layout(table)
    for path in (named(path) for path in paths(kind) if not path.endswith("*")):
        row = table.find(path)
        assert row is not None
        assert row.dims is not None
        shape = stored[path][1]
        for axis, dim in enumerate(row.dims):
            longer = tuple(size + (place == axis) for place, size in enumerate(shape))
            lines = schema.problems(table, with_shape(stored, path, longer))
            name = str(dim).partition("+")[0]
            dims = [(other, d) for other in stored for d in getattr(table.find(other), "dims", None) or ()]
            uses = [other for other, d in dims if str(d).partition("+")[0] == name]
            if isinstance(dim, int):
                assert lines == [f"{path}: expected size {dim}, found {dim + 1}"]
            elif len(uses) > 1:
                assert lines
                assert all(line.split(":")[0] in uses for line in lines)
            else:
                assert lines == []


@pytest.mark.parametrize("shape", [(), (5, 1), (1, 5)])
def test_wrong_number_of_dims(shape: tuple[int, ...]) -> None:
    """Assert that a column given as a scalar or a matrix is refused."""
    table = schema.load("labels")
    lines = schema.problems(table, with_shape(layout(table), "label", shape))
    assert lines == [f"label: expected dims ['slices'], found shape {list(shape)}"]


def test_one_start_more_than_slices() -> None:
    """Assert that ms_to_idx must have exactly one row more than there are slices."""
    table = schema.load("recording")
    stored = layout(table)
    slices = stored["truth/slip"][1][0]
    assert stored["ms_to_idx"][1] == (slices + 1,)
    for wrong in (slices, slices + 2):
        lines = schema.problems(table, with_shape(stored, "ms_to_idx", (wrong,)))
        assert any(f"ms_to_idx: expected {slices + 1}" in line or "as in ms_to_idx" in line for line in lines)


def test_minus_one_slices_are_refused() -> None:
    """Assert that an empty ms_to_idx is refused: it would be a recording of -1 slices."""
    table = schema.load("recording")
    alone = layout(table, required_only=True)
    assert schema.problems(table, with_shape(alone, "ms_to_idx", (1,))) == []
    assert schema.problems(table, with_shape(alone, "ms_to_idx", (0,))) == [
        "ms_to_idx: expected at least 1 for `slices+1`, found 0"
    ]


@pytest.mark.parametrize("group", schema.load("recording").optional_groups)
def test_optional_group_is_all_or_nothing(group: str) -> None:
    """Assert that one dataset of an optional group asks for all its required ones, also if that one is optional."""
    table = schema.load("recording")
    base, full = layout(table, required_only=True), layout(table)
    members = [path for path in full if path.startswith(group + "/")]
    required = {path for path in members if not getattr(table.find(path), "optional", True)}
    assert schema.problems(table, base | {path: full[path] for path in members}) == []
    for path in members:
        missing = {line.split(" ")[0] for line in schema.problems(table, {**base, path: full[path]})}
        assert missing == required - {path}


def test_groups_with_names_of_their_own() -> None:
    """Assert that each has sizes and required datasets of its own, and that no dim is used inside and outside."""
    table = schema.load("recording")
    base = layout(table, required_only=True)
    arm = {"streams/arm/t_us": ("int64", (5,)), "streams/arm/about": ("utf8", ()), "streams/arm/x_m": ("float64", (5,))}
    foot = {"streams/foot/t_us": ("int64", (7,)), "streams/foot/about": ("utf8", ())}
    assert schema.problems(table, base | arm | foot) == []
    assert schema.problems(table, base | arm | {"streams/arm/y_m": ("float64", (7,))}) == [
        "streams/arm/y_m: expected 5 for `samples` (as in streams/arm/t_us), found 7"
    ]
    (line,) = schema.problems(table, base | arm | {"streams/foot/t_us": ("int64", (7,))})
    assert line.startswith("streams/foot/about is missing")
    (line,) = schema.problems(table, base | {"streams/t_us": ("int64", (5,))})
    assert line == "streams/t_us is not in the schema of a recording file"
    for kind in KINDS:
        rows = [(row.named_group(row.path), row.dims or ()) for row in schema.load(kind).datasets]
        inside, outside = ({dim for group, dims in rows if bool(group) == named for dim in dims} for named in (1, 0))
        assert not {dim for dim in inside & outside if isinstance(dim, str)}


def test_wildcard() -> None:
    """Assert that `weights/*` takes any name and depth, asks for at least one, and takes nothing beside its group."""
    table = schema.load("model")
    rest = {path: about for path, about in layout(table).items() if not path.startswith("weights/")}
    assert schema.problems(table, rest)[0].startswith("weights/* is missing")
    for path in ("weights/a", "weights/a/b.c", "weights/*"):
        assert schema.problems(table, rest | {path: ("float32", (3, 1, 4))}) == []
    for path in ("weights", "weightsX/a", "other/weights/a"):
        lines = schema.problems(table, rest | {path: ("float32", (3,))})
        assert f"{path} is not in the schema of a model file" in lines


def test_describe_stored(tmp_path: Path) -> None:
    """Assert that stored text is utf8 however it is stored, and that what only looks like text is not."""
    with h5py.File(tmp_path / "a.h5", "w") as h5:
        h5["growing"] = "text"
        h5["fixed"] = np.bytes_("text")
        h5["ragged"] = h5.create_dataset("r", (2,), dtype=h5py.vlen_dtype(np.int32))
        h5["nothing"] = h5py.Empty("int64")
        h5["backwards"] = np.zeros(3, ">i8")
        described = {name: schema.describe_stored(h5[name]) for name in h5 if name != "r"}
    assert described == {
        "growing": "utf8",
        "fixed": "utf8",
        "ragged": "object",
        "nothing": "nothing",
        "backwards": "int64",
    }


@pytest.mark.parametrize("kind", KINDS)
def test_tables_are_sound(kind: str) -> None:
    """Assert that a table says its own kind and major version, real dtypes, and only groups that it has."""
    table = json.loads((schemas() / f"{kind}.v{schema.MAJOR}.json").read_text())
    assert table["kind"] == kind
    assert table["version"].split(".")[0] == str(schema.MAJOR)
    assert set(table["optional_groups"]) <= {path.split("/")[0] for path in table["datasets"] if "/" in path}
    for path, row in table["datasets"].items():
        assert row["dtype"] == "utf8" or np.dtype(row["dtype"]).name == row["dtype"], path
        assert row["meaning"], path
        limits = set(schema.Limits.__dataclass_fields__)
        assert set(row) <= {"dtype", "dims", "unit", "meaning", "optional", "described_in"} | limits, path


@pytest.mark.parametrize("kind", KINDS)
def test_limits_are_sound(kind: str) -> None:
    """Assert that limits name datasets that exist, fit the dtype, and that every float says whether it is finite."""
    table = schema.load(kind)
    for path in paths(kind):
        row = table.find(named(path))
        assert row is not None
        limits = row.limits
        assert limits.finite in ((True, "or NaN") if row.dtype.startswith("float") else ("",))
        assert limits.increasing in ("", "strictly", "never decreasing")
        assert limits.inside_frame in ("", "x", "y", "xy")
        assert limits.json in ("", "object", "list of flat objects")
        for other in (limits.index_of, limits.nan_where):
            assert not other or table.find(other) is not None
        assert not limits.inside_frame or table.find("sensor/frame_px") is not None
        assert limits.minimum is None or limits.maximum is None or limits.minimum < limits.maximum
        if limits.inside_frame == "xy":
            assert row.dims is not None
            assert row.dims[-1] == 2
        for value in limits.one_of:
            assert isinstance(value, str) == (row.dtype == "utf8")
