"""Open, check, skip and write stage files.

A file is opened only if it is what the caller expects, and written all-or-nothing: into a temporary file beside the
target, which is renamed when it is complete. Two writers of the same target do not disturb each other: the later
rename wins, and with the same recipe both wrote the same arrays.
"""

import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import NoneType
from typing import Any, Self

import h5py

from evetac_cli.errors import EvetacError, ForeignFile, InputError, SchemaError, made_by
from evetac_cli.interrupts import leave_if_interrupted
from evetac_cli.kernels.sensitivity import DATASETS, Sensitivity, sensitivity_of
from evetac_cli.store.hdf5.checked_hdf5 import MOST_READ_BYTES, MOST_TEXT_BYTES, CheckedHdf5, damage_in_words
from evetac_cli.store.hdf5.chunks import RowReader, RowWriter, put
from evetac_cli.store.hdf5.disk import existing_folder, new_file, taking_the_place_of
from evetac_cli.store.layout import contents, netcdf, schema
from evetac_cli.store.layout.new_contents import NewContents
from evetac_cli.store.layout.provenance import (
    Header,
    Recipe,
    canonical,
    first_difference,
    folded,
    identity_fault,
    other_recipe,
    unfolded,
)
from evetac_cli.text_files import SEED_BITS, parse_json


class StageFile:
    """A stage file, open for reading: header, datasets by path."""

    def __init__(self, path: Path, kind: str | tuple[str, ...] | None = None) -> None:
        """Open and check; InputError if it is missing, not ours, of another kind, or of an earlier or newer version."""
        self.path = Path(path)
        self._file = CheckedHdf5(self.path, "an evetac stage file", FOREIGN)
        try:
            self.header = _read_header(self._file)
            _check_kind(self.path, self.header, (kind,) if isinstance(kind, str) else kind)
            fault = identity_fault(self.header)
            if fault:
                raise SchemaError(fault, where=str(self.path))
            self._datasets = self._file.datasets()
            self._readers: dict[str, RowReader] = {}
            with damage_in_words(self.path, "its contents"):
                stored = self.contents()
                lines = schema.problems(schema.load(self.kind), stored)
                dimensions = self._file.dimensions
                lines += [f"{path} is not in the schema" for path in netcdf.strays(self.kind, dimensions)]
            major, minor = (int(part) for part in self.header["version"].split("."))
            known_minor = int(schema.load(self.kind).version.split(".")[1])
            if major == schema.MAJOR and minor > known_minor:  # a newer minor version only adds
                lines = [line for line in lines if "is not in the schema" not in line]
            lines = lines or netcdf.dimension_problems(self.kind, stored, dimensions)
            schema.refuse(self.kind, lines, str(self.path))
            contents.check_small(self, stored)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; arrays already read stay valid."""
        self._file.close()

    @property
    def kind(self) -> str:
        """The kind of file, one of schema.KINDS."""
        return str(self.header["kind"])

    def has(self, path: str) -> bool:
        """Whether the file holds a dataset, or datasets in a group, of this path."""
        return path in self._datasets or any(name.startswith(f"{path}/") for name in self._datasets)

    @property
    def sensitivity(self) -> Sensitivity:
        """What is known of how strongly the sensor answers contact."""
        return sensitivity_of({path: self.read(path) for path in DATASETS.values() if self.has(path)})

    def read(self, path: str, start: int = 0, stop: int | None = None) -> Any:
        """A whole dataset, or its rows [start, stop); a str for text, a numpy scalar for a scalar.

        SchemaError where values are not what the schema allows.
        """
        dataset = self._datasets.get(path)
        if dataset is None:
            raise InputError(f"{path} is not in this {self.kind}", where=str(self.path))
        with damage_in_words(self.path, path):
            values = self._values(path, dataset, start, stop)
        contents.check_values(self, path, values, start)
        return values

    def _values(self, path: str, dataset: h5py.Dataset, start: int, stop: int | None) -> Any:
        if schema.describe_stored(dataset) == "utf8":
            return self._file.text(path, dataset)
        if dataset.shape == ():
            return dataset[()]
        start, stop, _ = slice(start, stop).indices(len(dataset))
        size = max(0, stop - start) * math.prod(dataset.shape[1:]) * dataset.dtype.itemsize
        if size > MOST_READ_BYTES:
            raise InputError(
                f"{path} is too long to be read at once",
                where=str(self.path),
                expected=f"at most {MOST_READ_BYTES / 1e9:.1f} GB",
                found=f"{size / 1e9:.1f} GB",
                hint="cut the recording with `evetac trim`",
            )
        if path not in self._readers:
            self._readers[path] = RowReader(dataset)
        array = self._readers[path].read(start, stop)
        return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))

    def length(self, path: str) -> int:
        """Number of rows of a dataset, without reading it."""
        return int(self._datasets[path].shape[0])

    def contents(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Path -> (dtype, shape) of every dataset; dimensions are none, as they hold no values."""
        return {name: (schema.describe_stored(item), item.shape or ()) for name, item in self._datasets.items()}


FOREIGN = "event files of other programs are read with `evetac record --from FILE`"

# What every header says, and as what.
HEADER: dict[str, tuple[type, ...]] = {
    "kind": (str,),
    "version": (str,),
    "method": (int,),
    "parameters": (dict,),
    "seed": (int, NoneType),
    "parents": (list,),
    "content": (str, NoneType),
    "id": (str,),
    "simulated": (bool,),
    "history": (dict,),
}


def _read_header(file: CheckedHdf5) -> Header:
    path, text = file.path, file.text_attribute("header")
    if text is None:
        raise ForeignFile("this HDF5 file was not made by evetac: it has no header", where=str(path), hint=FOREIGN)
    try:
        header = dict(parse_json(text, most_values=math.inf, whole_bits=SEED_BITS))
        canonical(header)
        header = unfolded(header, MOST_TEXT_BYTES)
    except (KeyError, ValueError, TypeError):
        raise SchemaError("its header is not valid", where=str(path), expected="schemas/header.v1.json") from None
    number = header.get("version")
    version = re.fullmatch("([0-9]{1,9})[.]([0-9]{1,9})", number) if isinstance(number, str) else None
    if version and (int(version[1]), int(version[2])) < (schema.MAJOR, schema.OLDEST_MINOR):
        raise InputError(
            "written by an earlier version of evetac and cannot be read",
            where=str(path),
            expected=f"version {schema.MAJOR}.{schema.OLDEST_MINOR} or newer",
            found=f"{header.get('kind')} version {version[0]}",
            hint="make it again from its recipe: names of datasets and parameters have changed",
        )
    if version and int(version[1]) > schema.MAJOR:  # said first: such a header may look different
        raise InputError(
            f"made by a newer evetac: {header.get('kind')} version {version[0]}",
            where=str(path),
            expected=f"version {schema.MAJOR}.x",
            hint="update evetac",
        )
    missing = [key for key in HEADER if key not in header]
    if missing:
        raise SchemaError("its header is incomplete", where=str(path), found=f"no {', '.join(missing)}")
    wrong = [key for key, types in HEADER.items() if not isinstance(header[key], types)]
    wrong += [] if version or "version" in wrong else ["version"]
    if not wrong:
        ancestors = header["history"].values()
        wrong += [] if all(isinstance(parent, str) for parent in header["parents"]) else ["parents"]
        wrong += [] if all(isinstance(ancestor, dict) and "kind" in ancestor for ancestor in ancestors) else ["history"]
    if wrong:
        raise SchemaError(
            f"its header is not valid: {', '.join(wrong)}", where=str(path), expected="schemas/header.v1.json"
        )
    return header


def header_of(path: Path, kind: str | None = None) -> Header:
    """The header of a stage file, of any kind or of one; InputError where it is no such file."""
    with StageFile(path, kind) as file:
        return file.header


def is_foreign(path: Path) -> bool:
    """Whether a file is HDF5 of another program; of what cannot be read it is not known, and not said."""
    try:
        with CheckedHdf5(path) as file:
            return file.text_attribute("header") is None
    except EvetacError:
        return False


def _check_kind(path: Path, header: Header, wanted: tuple[str, ...] | None) -> None:
    if wanted and header["kind"] not in wanted:
        raise InputError(
            "wrong kind of file",
            where=str(path),
            expected=" or ".join(wanted),
            found=str(header["kind"]),
            hint="; ".join(map(made_by, wanted)),
        )
    if header["kind"] not in schema.KINDS:
        raise SchemaError("unknown kind", where=str(path), expected=", ".join(schema.KINDS), found=str(header["kind"]))


def up_to_date(path: Path, recipe: Recipe, *, force: bool = False) -> bool:
    """Whether `path` already holds the result of this recipe.

    InputError if it holds anything else, naming the first difference, unless `force`: then it will be replaced.
    Checked before any work is done, so that a refusal comes at once and not after an hour.
    """
    if os.path.isdir(path):
        raise InputError("the output is a folder", where=str(path))
    if not os.path.exists(path):
        existing_folder(path.parent)
        return False
    try:
        with StageFile(path) as existing:
            header = existing.header
            of_devices = existing.has("capture/ended") and header["content"] is not None and not header["parents"]
    except InputError as error:
        if force:
            return False
        raise InputError(
            "the output exists and is not a valid evetac file",
            where=str(path),
            found=str(error).splitlines()[0].removeprefix(f"{path}: "),
            hint="--force replaces it",
        ) from None
    if header["id"] == recipe.id:
        return True
    if force:
        return False
    if of_devices:
        raise InputError(
            "the output exists: a recording of devices, which cannot be made again",
            where=str(path),
            hint="-o NAME writes elsewhere; --force replaces it, and it is lost",
        )
    raise other_recipe(str(path), first_difference(recipe, header))


def output_path(source: Path, kind: str, out: Path | None) -> Path:
    """`<name>.<kind>.h5` beside the input; in the folder `out`; or the file `out` if it ends in .h5."""
    if out is not None and out.suffix == ".h5":
        return out
    return (out or source.parent) / f"{stem(source)}.{kind}.h5"


def stem(path: Path) -> str:
    """The name of a trial: the file name without `.<kind>.h5` (or without its suffix, for files of other programs)."""
    name = path.name
    if name.endswith(".h5"):
        name = name[:-3]
        base, _, kind = name.rpartition(".")
        return base if base and kind in schema.KINDS else name
    return path.stem


@contextmanager
def replacing(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file that takes the place of `path` when the block ends well, and leaves no trace when it does not."""
    with taking_the_place_of(path) as temporary, new_file(temporary) as h5:
        yield h5


def write_stage(
    path: Path,
    recipe: Recipe,
    arrays: Mapping[str, Any],
    blocks: Iterable[Mapping[str, Any]] = (),
    lengths: Mapping[str, int] | None = None,
) -> Header:
    """Check arrays against the schema of the kind, and its limits, and write them with their header, all or nothing.

    blocks: the next rows of further datasets, for results that do not fit in memory. Each of these datasets is in some
    block, if only with no rows. lengths: how many rows each will have; one that is not named grows.
    """
    if lengths is not None:
        with writing(path, recipe.kind, arrays, lengths) as growing:
            for block in blocks:
                growing.append(block)
            return growing.finish(recipe)
    schema.check(recipe.kind, arrays)
    NewContents(path, recipe.kind, arrays).check_rest()
    header = recipe.header()
    with replacing(path) as h5:
        for name, value in arrays.items():
            put(h5, name, value)
        put_header(h5, header)
    return header


@contextmanager
def writing(
    path: Path, kind: str, arrays: Mapping[str, Any], lengths: Mapping[str, int] | None = None
) -> Iterator["StageWriter"]:
    """A new file of rows that come block by block; all or nothing, and nothing where it was not finished.

    arrays: the datasets that are known, among them those that others are held to, as events to the frame. lengths: how
    many rows each of the others will have; one that is not named grows.
    """
    try:
        with replacing(path) as h5:
            writer = StageWriter(h5, path, kind, arrays, lengths or {})
            yield writer
            if not writer.finished:
                raise _NotFinished
    except _NotFinished:
        pass


class _NotFinished(Exception):
    """Whoever wrote a file found that it is not needed."""


class StageWriter:
    """Writes the datasets of a file, of which it may be known at the end alone which recipe they follow."""

    def __init__(
        self, h5: h5py.File, path: Path, kind: str, arrays: Mapping[str, Any], lengths: Mapping[str, int]
    ) -> None:
        self.finished = False
        self._h5, self._kind, self._lengths = h5, kind, lengths
        self._arrays = dict(arrays)
        self._new = NewContents(path, kind, self._arrays)
        self._rows: dict[str, RowWriter] = {}

    def append(self, block: Mapping[str, Any]) -> None:
        """Check and write the next rows of some datasets, if only none of them. Ctrl-C is heard here."""
        leave_if_interrupted()
        for name, rows in block.items():
            if name not in self._rows:
                self._rows[name] = RowWriter(self._h5, name, rows.dtype, rows.shape[1:], self._lengths.get(name))
            self._new.check_block(name, rows, self._rows[name].rows)
            self._rows[name].append(rows)

    def finish(self, recipe: Recipe, arrays: Mapping[str, Any] | None = None) -> Header:
        """Write the datasets that are known as a whole, more of which are in `arrays`; check all, and end the file."""
        for writer in self._rows.values():
            writer.close()
        short = [
            name for name, rows in self._lengths.items() if name not in self._rows or self._rows[name].rows != rows
        ]
        if short:
            raise ValueError(f"blocks: expected all rows of {', '.join(short)}, found others")
        self._new.add(arrays or {})
        self._arrays |= arrays or {}
        for name, value in self._arrays.items():
            put(self._h5, name, value)
        self._new.shapes |= {
            name: (schema.describe_stored(self._h5[name]), self._h5[name].shape) for name in self._rows
        }
        schema.refuse(self._kind, schema.problems(schema.load(self._kind), self._new.shapes))
        self._new.check_rest(self._h5)
        header = recipe.header()
        put_header(self._h5, header)
        self.finished = True
        return header


def put_header(h5: h5py.File, header: Header) -> None:
    """Write the header, as JSON in the attribute `header` of the root, and what other programs read (netcdf.py).

    Comes last: dimensions are those of the datasets that are there.
    """
    h5.attrs["header"] = json.dumps(folded(header), sort_keys=True, allow_nan=False)
    netcdf.describe_file(h5, header)
