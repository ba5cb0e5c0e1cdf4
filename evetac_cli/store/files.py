"""Open, check, skip and write stage files.

When a file is opened, its kind, version, header, names, dtypes and shapes are checked, and that nothing in it refers to
other files. Each dataset is checked before it is first read: that its rows were written, and that its values are valid
and fit those of other datasets. Not all datasets are checked at once: for the 32 datasets of a recording this would
take ten times as long, and most commands read only a few. Use `check` to check a whole file.

A file is written atomically: to a temporary file next to the target, which is checked and renamed when it is complete.
If another run has put a file there in the meantime, this ends as it would have, had that file been there before
(`up_to_date`).
"""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Self

import h5py

from evetac_cli.errors import EvetacError, InputError, SchemaError
from evetac_cli.interrupts import leave_if_interrupted
from evetac_cli.kernels.slip.architectures import SENSITIVITY_DATASETS, Sensitivity, sensitivity_of
from evetac_cli.store.hdf5.checked_hdf5 import CheckedHdf5, damage_in_words
from evetac_cli.store.hdf5.chunks import RowWriter, put
from evetac_cli.store.hdf5.disk import Recheck, existing_folder, new_file, taking_the_place_of
from evetac_cli.store.layout import ancestry, contents, netcdf, schema
from evetac_cli.store.layout.provenance import (
    FOREIGN,
    Header,
    Recipe,
    check_kind,
    first_difference,
    folded,
    other_recipe,
    read_header,
    recompute_id,
)
from evetac_cli.store.layout.rules import Rule, Shapes

NOT_WRITTEN = "the file was not written; check its inputs with `evetac validate`"


class StageFile:
    """A stage file, open for reading, with its header and datasets by path."""

    def __init__(self, path: Path, kind: str | tuple[str, ...] | None = None) -> None:
        """Open and check a file; InputError if it is missing, not evetac's, of another kind, or of another version."""
        self.path = Path(path)
        self._file = CheckedHdf5(self.path, "an evetac stage file", FOREIGN)
        try:
            self.header = read_header(self._file)
            check_kind(self.path, self.header, (kind,) if isinstance(kind, str) else kind)
            if recompute_id(self.header) != self.header["id"]:
                fault = "its header was edited: the recipe id does not fit it"
                raise SchemaError(fault, where=str(self.path))
            self._found = self._file.survey(partial(netcdf.is_dimension, self.kind))
            self._looked_at: set[str] = set()
            self._passed: set[Rule] = set()
            with damage_in_words(self.path, "its contents"):
                self._shapes: Shapes = {
                    name: (schema.describe_stored(one), one.shape or ()) for name, one in self._found.items()
                }
                lines = schema.problems(schema.load(self.kind), self._shapes)
            self._refuse_if(lines)
            contents.check_shapes(self, self._shapes)
            with damage_in_words(self.path, "its history"):
                if self.kind in ancestry.TRAINED:
                    tables = self.read(ancestry.TRAJECTORIES), self.read(ancestry.ANCESTORS)
                    self.header = ancestry.with_tables(self.header, *tables)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; arrays that were read stay valid."""
        self._found.clear()  # otherwise h5py searches for open objects of the file, which takes as long as opening it
        self._file.close()

    @property
    def kind(self) -> str:
        """The kind of file, one of schema.KINDS."""
        return str(self.header["kind"])

    def has(self, path: str) -> bool:
        """Whether the file has a dataset with this path, or datasets in a group with this path."""
        return path in self._shapes or any(name.startswith(f"{path}/") for name in self._shapes)

    @property
    def sensitivity(self) -> Sensitivity:
        """The sensor's known sensitivity to contact."""
        return sensitivity_of({path: self.read(path) for path in SENSITIVITY_DATASETS.values() if self.has(path)})

    def check(self) -> None:
        """Check every dataset as before reading it; InputError if one is damaged or invalid.

        Only the values of small datasets, and of those that have to fit others, are read; `evetac validate` reads all.
        """
        self._refuse_if([f"{path} is not in the schema" for path in self._file.survey() if path not in self._shapes])
        for path in self._shapes:
            self._look_at(path)

    def read(self, path: str, start: int = 0, stop: int | None = None) -> Any:
        """Return a whole dataset, or its rows [start, stop); a str for text, a numpy scalar for a scalar.

        SchemaError if values violate the schema, or do not fit those of other datasets.
        """
        self._look_at(path)
        with damage_in_words(self.path, path):
            values = self._values(path, start, stop)
        contents.check_values(self, path, values, start)
        return values

    def _refuse_if(self, lines: list[str]) -> None:
        """Raise SchemaError for differences from the schema; additions of a newer minor version are allowed."""
        major, minor = (int(part) for part in self.header["version"].split("."))
        known_minor = int(schema.load(self.kind).version.split(".")[1])
        if major == schema.MAJOR and minor > known_minor:
            lines = [line for line in lines if "is not in the schema" not in line]
        schema.refuse(self.kind, lines, str(self.path))

    def _look_at(self, path: str) -> None:
        """Check a dataset before any of it is returned; InputError if it is missing, damaged or harmful."""
        if path in self._looked_at:
            return
        if path not in self._shapes:
            raise InputError(f"{path} is not in this {self.kind}", where=str(self.path))
        with damage_in_words(self.path, path):
            self._file.check(path, self._found[path])
        self._looked_at.add(path)  # before its values are read to be checked
        try:
            contents.check_first(self, path, self._shapes, self._passed)
        except BaseException:
            self._looked_at.clear()  # also datasets that a failed rule has read
            raise

    def _values(self, path: str, start: int, stop: int | None) -> Any:
        found = self._found[path]
        if not found.shape:
            if self._shapes[path][0] == "utf8":
                return self._file.text(path, found)
            return h5py.Dataset(found)[()]
        start, stop, _ = slice(start, stop).indices(found.shape[0])
        array = h5py.Dataset(found)[start : max(start, stop)]
        return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))

    def length(self, path: str) -> int:
        """Return the number of rows of a dataset, all of which are stored, without reading it."""
        self._look_at(path)
        rows: int = self._shapes[path][1][0]
        return rows

    def contents(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Return path -> (dtype, shape) of every dataset; dimensions, which have no values, are not included."""
        return dict(self._shapes)


def header_of(path: Path, kind: str | None = None) -> Header:
    """Return the header of a stage file, of any kind or a given one; InputError for another file."""
    with StageFile(path, kind) as file:
        return file.header


def is_foreign(path: Path) -> bool:
    """Whether a file is an HDF5 file of another program; False for a file that cannot be read."""
    try:
        with CheckedHdf5(path) as file:
            return file.text_attribute("header") is None
    except EvetacError:
        return False


def up_to_date(path: Path, recipe: Recipe, *, force: bool = False) -> bool:
    """Return whether `path` already has the result of this recipe.

    If it has anything else: InputError with the first difference, or False with `force`, to replace it. This is checked
    before any work is done, so that a refusal comes immediately and not after an hour, and again by `write_stage`.

    Of a file with this recipe only the header is read, because its contents are checked when they are read; with
    `force` the whole file is checked, so that a damaged one is replaced.
    """
    if os.path.isdir(path):
        raise InputError("the output is a folder", where=str(path))
    if not os.path.exists(path):
        existing_folder(path.parent)
        return False
    if not force:
        with suppress(InputError), CheckedHdf5(path) as file:
            header = read_header(file)
            if header["id"] == recipe.id == recompute_id(header):
                return True
    try:
        with StageFile(path) as existing:
            existing.check()
            header = existing.header
            of_devices = existing.has("capture/ended") and header["content"] is not None and not header["parents"]
    except InputError as error:
        if force:
            return False
        message, hint = "the output exists and is not a valid evetac file", "--force replaces it"
        raise InputError(message, where=str(path), found=error.message, hint=hint) from None
    if force:
        return bool(header["id"] == recipe.id)
    if of_devices:
        message = "the output exists: it is a recording of devices, which cannot be made again"
        hint = "-o NAME writes to another file; --force replaces the recording, which is then lost"
        raise InputError(message, where=str(path), hint=hint)
    raise other_recipe(str(path), first_difference(recipe, header))


def output_path(source: Path, kind: str, out: Path | None) -> Path:
    """Return `<name>.<kind>.h5` next to the input or in the folder `out`, or `out` itself if it ends in .h5."""
    if out is not None and out.suffix == ".h5":
        return out
    return (out or source.parent) / f"{stem(source)}.{kind}.h5"


def stem(path: Path) -> str:
    """Return the name of a trial: the file name without `.<kind>.h5`, or without its suffix for other files."""
    name = path.name
    if name.endswith(".h5"):
        name = name[:-3]
        base, _, kind = name.rpartition(".")
        return base if base and kind in schema.KINDS else name
    return path.stem


@contextmanager
def replacing(path: Path, check: Callable[[], bool | None] | None = None) -> Iterator[h5py.File]:
    """Yield a new HDF5 file that replaces `path` if the block succeeds, and is removed if it fails.

    check: of the file that it would replace, as for `taking_the_place_of`.
    """
    with taking_the_place_of(path, check=check) as temporary, new_file(temporary) as h5:
        yield h5


def write_stage(
    path: Path,
    recipe: Recipe,
    arrays: Mapping[str, Any],
    blocks: Iterable[Mapping[str, Any]] = (),
    lengths: Mapping[str, int] | None = None,
    *,
    force: bool = False,
) -> Header | None:
    """Check arrays against the schema of the kind and its limits, and write them with their header, atomically.

    Returns the header; None if another run has made the file with this recipe since `up_to_date`. InputError if another
    run has put anything else there, unless `force`.

    blocks: the next rows of further datasets, for results that do not fit in memory. Each of these datasets must be in
    at least one block, possibly with no rows. lengths: number of rows of each; a dataset without one grows.
    """
    with writing(path, recipe.kind, arrays, lengths or {}, force=force) as growing:
        for block in blocks:
            growing.append(block)
        header = growing.finish(recipe)
    return header if growing.made else None


@contextmanager
def writing(
    path: Path, kind: str, arrays: Mapping[str, Any], lengths: Mapping[str, int] | None = None, *, force: bool
) -> Iterator["StageWriter"]:
    """Yield a writer for a new file whose rows come in blocks; the file appears only if the writer was finished.

    If another run has put a file there in the meantime, the block ends as `up_to_date` does.

    arrays: the datasets that are known.
    lengths: number of rows of each other dataset; a dataset without one grows.
    """
    recheck = Recheck(lambda: writer.recipe is None or up_to_date(path, writer.recipe, force=force))
    with taking_the_place_of(path, check=recheck) as temporary:
        with new_file(temporary) as h5:
            writer = StageWriter(h5, kind, arrays, lengths or {})
            yield writer
        if writer.recipe is not None:
            _check_new(temporary, path)
    writer.made = recheck.made


def _check_new(temporary: Path, path: Path) -> None:
    """Read all of a new file before it takes its place at `path`; SchemaError if a reader would refuse it."""
    try:
        with StageFile(temporary) as file:
            file.check()
            for name, (_, shape) in file.contents().items():
                contents.check_dataset(file, name, shape)
    except SchemaError as error:
        error.where, error.hint = str(path), NOT_WRITTEN
        raise


class StageWriter:
    """Writes the datasets of a file whose recipe may be known only at the end.

    made: after the block of `writing`, whether the file was made; False if another run made it with this recipe.
    """

    def __init__(self, h5: h5py.File, kind: str, arrays: Mapping[str, Any], lengths: Mapping[str, int]) -> None:
        self.recipe: Recipe | None = None
        self.made = False
        self._h5, self._kind, self._lengths = h5, kind, lengths
        self._arrays = arrays
        self._rows: dict[str, RowWriter] = {}

    def append(self, block: Mapping[str, Any]) -> None:
        """Write the next rows, possibly none, of some datasets. Ctrl-C is raised here."""
        leave_if_interrupted()
        for name, rows in block.items():
            if name not in self._rows:
                self._rows[name] = RowWriter(self._h5, name, rows.dtype, rows.shape[1:], self._lengths.get(name))
            self._rows[name].append(rows)

    def finish(self, recipe: Recipe, arrays: Mapping[str, Any] | None = None) -> Header:
        """Write the whole datasets, with more of them in `arrays`, and complete the file."""
        for writer in self._rows.values():
            writer.close()
        short = [
            name for name, rows in self._lengths.items() if name not in self._rows or self._rows[name].rows != rows
        ]
        if short:
            raise ValueError(f"blocks: expected all rows of {', '.join(short)}, found others")
        header = recipe.header()
        whole = {**self._arrays, **(arrays or {}), **ancestry.stored_tables(header)}
        shapes = {name: schema.describe(value) for name, value in whole.items()}
        shapes |= {name: (schema.describe_stored(self._h5[name]), self._h5[name].shape) for name in self._rows}
        schema.refuse(self._kind, schema.problems(schema.load(self._kind), shapes))
        for name, value in whole.items():
            put(self._h5, name, value)
        put_header(self._h5, header)
        self.recipe = recipe
        return header


def put_header(h5: h5py.File, header: Header) -> None:
    """Write the header, as JSON in the root's attribute `header`, and the metadata for other programs (netcdf.py).

    It must be called last, because the dimensions are those of the existing datasets.
    """
    h5.attrs["header"] = json.dumps(folded(header), sort_keys=True, allow_nan=False)
    netcdf.describe_file(h5, header)
