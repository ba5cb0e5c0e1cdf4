"""Read events from numpy files: `.npy` with a structured array or a table (N, 4), `.npz` with one of these or columns.

    structured    fields t, x, y, p by the names in columns.py; written by tonic, expelliarmus and faery
    (N, 4)        four columns, in the user's order or the first that fits (columns.py)
    columns       arrays t, x, y, p of one length in an npz

numpy.load reads them, a `.npy` as far as it is needed. Objects, which would require loading a pickle, are refused. From
an archive, no more is unpacked than a recording of its size can contain.
"""

import math
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.read.columns import (
    ColumnTimes,
    Order,
    by_name,
    declared_order,
    declared_unit,
    guess_order,
    places_of,
    refuse_columns,
)
from evetac_cli.formats.read.damage import read_in_words, refuse_too_much
from evetac_cli.formats.read.source import (
    EventColumns,
    EventSource,
    ImportFormat,
    at_index,
    check_lengths,
    choose_frame,
)

NPY, ZIP = b"\x93NUMPY", b"PK\x03\x04"
BATCH_ROWS = 1 << 18
EXPECTED = "t, x, y, p: as arrays of an npz, as fields of a structured array, or as the columns of an array (N, 4)"
COMPARE = "is the file complete? compare its size with that of the original"
OBJECTS = "save the Python objects as numbers: evetac never loads objects, because they can run code"


class Array(NamedTuple):
    """An array's type and shape, as its header states them."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def is_column(self) -> bool:
        """Whether it is a one-dimensional list of plain numbers, also if other axes have length 1."""
        return self.dtype.kind in "iubf" and bool(self.shape) and math.prod(self.shape) == max(self.shape)

    @property
    def is_table(self) -> bool:
        """Whether it may contain all columns of events."""
        if self.dtype.names:
            plain = all(self.dtype[name].kind in "iubf" for name in self.dtype.names)
            return len(self.shape) == 1 and plain and by_name(self.dtype.names) is not None
        return self.dtype.kind in "iuf" and len(self.shape) == 2 and self.shape[1] == 4

    def __str__(self) -> str:
        kind = f"fields {', '.join(self.dtype.names)}" if self.dtype.names else str(self.dtype)
        return f"{kind[:120]} of shape {self.shape}"


def open_numpy(
    path: Path,
    frame_px: tuple[int, int] | None,
    stream: str | None = None,
    columns: str | None = None,
    time_unit: str | None = None,
) -> EventSource:
    """Return the events of an npy or npz file; raise FrameUnknown without frame_px, which these files do not store."""
    where = str(path)
    source = EventSource("numpy", (1, 1), (), may_be_empty=True)
    with read_in_words(where, "the file cannot be read as npy or npz", COMPARE):
        with path.open("rb") as file:
            packed = file.read(len(ZIP)) == ZIP
        if packed:
            arrays = _headers(path, where)
        else:
            (table,) = _loaded(path, [])
            arrays = {"": Array(table.dtype, table.shape)}
        used, order = _choose(arrays, stream, source, where)
        source.frame_px = choose_frame(None, frame_px, where)
        parts = _columns(_loaded(path, used))
    guessed = ""
    if order is None:
        sample = np.stack([part[:BATCH_ROWS] for part in parts], axis=1)
        guessed = guess_order(sample) if columns is None else ""
        order = Order(places_of(guessed or declared_order(str(columns), where)), None)
    else:
        refuse_columns(columns, where)
    source.times = ColumnTimes(where, declared_unit(time_unit, order.us_per_unit, where))
    source.guessed_order = guessed
    source.batches = _batches([parts[place] for place in order.places], source.times)
    return source


def _headers(path: Path, where: str) -> dict[str, Array]:
    """Return the arrays of an npz by name."""
    arrays: dict[str, Array] = {}
    with zipfile.ZipFile(path) as archive:
        refuse_too_much(sum(member.file_size for member in archive.infolist()), path.stat().st_size, where)
        for member in archive.infolist():
            if not member.filename.endswith(".npy"):
                message, hint = "the archive has files that are not numpy arrays", "unpack it and import the event file"
                raise InputError(message, where=where, found=member.filename[:80], hint=hint)
            with archive.open(member) as content:
                version = npy.read_magic(content)
                with _no_warnings():
                    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
                    shape, _, dtype = read(content)
            arrays[member.filename.removesuffix(".npy")] = Array(dtype, shape)
    return arrays


def _choose(
    arrays: dict[str, Array], stream: str | None, source: EventSource, where: str
) -> tuple[list[str], Order | None]:
    """Return the names of the arrays with the events, and the order of their columns if names define it."""
    columns = [name for name, array in arrays.items() if array.is_column]
    order = by_name(columns)
    tables = sorted(name for name, array in arrays.items() if array.is_table)
    if stream is None and order is not None:
        used = [columns[place] for place in order.places]
        check_lengths([math.prod(arrays[name].shape) for name in used], where)
        order = Order((0, 1, 2, 3), order.us_per_unit)
    elif tables and (stream is None or stream in tables):
        used = [tables[0] if stream is None else stream]
        others = ", ".join(name for name in tables if name not in used)
        if others and stream is None:
            source.notes.append(f"read the array {used[0]}; the file also has: {others} (choose with --stream)")
        rows, fields = arrays[used[0]].shape[0], arrays[used[0]].dtype.names
        order = by_name(fields) if fields else None
        source.left_out |= {
            f"values of {name}": rows for at, name in enumerate(fields or ()) if order and at not in order.places
        }
    elif stream is not None:
        expected = " or ".join(tables) or "no --stream: the file has only one stream"
        raise InputError("the file has no such array of events", where=where, expected=expected, found=stream[:80])
    else:
        found = ", ".join(f"{name} {array}".strip() for name, array in list(arrays.items())[:8]) or "nothing"
        hint = OBJECTS if any(array.dtype.hasobject for array in arrays.values()) else ""
        raise InputError("the file has no event columns", where=where, expected=EXPECTED, found=found, hint=hint)
    source.left_out |= {f"values of {name}": math.prod(arrays[name].shape) for name in arrays if name not in used}
    return used, order


@contextmanager
def _no_warnings() -> Iterator[None]:
    """Ignore numpy's warnings about headers that Python 2 wrote."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _loaded(path: Path, used: list[str]) -> list[NDArray[Any]]:
    with _no_warnings():
        file = np.load(path, mmap_mode="r")
        if isinstance(file, np.ndarray):
            return [file]
        with file:
            return [file[name] for name in used]


def _columns(arrays: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Return the columns of events in the order of the file."""
    if len(arrays) == 4:
        return [one.reshape(-1) for one in arrays]
    (table,) = arrays
    return [table[name] for name in table.dtype.names] if table.dtype.names else list(table.T)


def _batches(columns: list[NDArray[Any]], times: ColumnTimes) -> Iterator[EventColumns]:
    for start in range(0, len(columns[0]), BATCH_ROWS):
        t, x, y, p = (np.asarray(column[start : start + BATCH_ROWS]) for column in columns)
        place = partial(at_index, start)
        yield EventColumns(times.us(t, place), x, y, p, place)


FORMAT = ImportFormat((NPY, ZIP), open_numpy, ("stream", "columns", "time_unit"))
