"""Read events from numpy files: `.npy` with a structured array or a table (N, 4), `.npz` with one of these or columns.

    structured    fields t, x, y, p by the names in column_order; written by tonic, expelliarmus and faery
    (N, 4)        four columns, in the user's order or the first that fits (column_order)
    columns       arrays t, x, y, p of one length in an npz; in EVIMO, x and y are one array (N, 2)

The bytes are read here in blocks, not by numpy.load. Objects, which would require loading a pickle, are refused. From
an archive, no more is unpacked than a recording of its size can contain.
"""

import io
import math
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.read.column_order import (
    Order,
    by_name,
    guess_order,
    places_of,
    refuse_columns,
    said_order,
    unit_said,
)
from evetac_cli.formats.read.column_times import ColumnTimes
from evetac_cli.formats.read.event_validation import EventColumns, Foreign, at_index, check_lengths, choose_frame
from evetac_cli.formats.read.unpacked_size import refuse_too_much

EVIMO = ("events_t", "events_xy", "events_p")
NPY, ZIP = b"\x93NUMPY", b"PK\x03\x04"
BATCH_ROWS = 1 << 18
BATCH_BYTES = 1 << 22  # of one array
MOST_HEADER_BYTES = 1 << 14  # numpy itself accepts 10,000
MOST_ITEM_BYTES = 1 << 10
MOST_MEMBERS = 1000
HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
PIECE_BYTES = 1 << 20  # read at once
EXPECTED = "t, x, y, p: as arrays of an npz, as fields of a structured array, or as the columns of an array (N, 4)"
# The exceptions that zipfile, zlib and numpy's parser raise for damaged bytes.
DAMAGE = (
    zipfile.BadZipFile, ValueError, TypeError, KeyError, IndexError, EOFError, OSError, RuntimeError, SyntaxError,
    NotImplementedError, OverflowError, RecursionError, AttributeError, zlib.error, tokenize.TokenError,
)  # fmt: skip


class Array(NamedTuple):
    """An array in a file: a function that opens its bytes, the offset of its first byte, its type and shape."""

    open: Callable[[], AbstractContextManager[IO[bytes]]]
    start: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    columns_first: bool  # order F

    @property
    def end(self) -> int:
        """The offset after the last byte."""
        return self.start + math.prod(self.shape) * self.dtype.itemsize

    @property
    def is_column(self) -> bool:
        """Whether it is a one-dimensional list of plain numbers, also if other axes have length 1."""
        return self.dtype.kind in "iubf" and bool(self.shape) and math.prod(self.shape) == max(self.shape)

    @property
    def is_table(self) -> bool:
        """Whether it may contain all columns of events."""
        if self.dtype.names:
            plain = all(self.dtype[name].kind in "iubf" for name in self.dtype.names)
            small = len(self.shape) == 1 and self.dtype.itemsize <= MOST_ITEM_BYTES
            return small and plain and by_name(self.dtype.names) is not None
        return self.dtype.kind in "iuf" and len(self.shape) == 2 and self.shape[1] == 4

    def __str__(self) -> str:
        kind = f"fields {', '.join(self.dtype.names)}" if self.dtype.names else str(self.dtype)
        return f"{kind[:120]} of shape {self.shape}"


class StoredRun(NamedTuple):
    """Consecutive items of one type in an array's bytes."""

    array: Array
    dtype: np.dtype[Any]
    first: int
    items: int


def open_numpy(
    path: Path,
    frame_px: tuple[int, int] | None,
    stream: str | None = None,
    columns: str | None = None,
    time_unit: str | None = None,
) -> Foreign:
    """Return the events of an npy or npz file; raise FrameUnknown without frame_px, which these files do not store."""
    where = str(path)
    foreign = Foreign("numpy", (1, 1), (), may_be_empty=True)
    with _damage_in_words(where):
        with path.open("rb") as handle:
            archive = handle.read(len(ZIP)) == ZIP
        arrays = _archived(path, where) if archive else {"": _single(path, foreign, where)}
        event_arrays, order = _choose(arrays, stream, foreign, where)
        stretches = _stretches(event_arrays)
        with closing(_rows(stretches)) as rows:
            sample = next(rows)
    guessed = ""
    if order is None:
        guessed = guess_order(np.stack(sample, axis=1)) if columns is None else ""
        order = Order(places_of(guessed or said_order(str(columns), where)), None)
    else:
        refuse_columns(columns, where)
    foreign.times = ColumnTimes(where, unit_said(time_unit, order.us_per_unit, where))
    foreign.guessed_order = guessed
    foreign.frame_px = choose_frame(None, frame_px, where)
    foreign.batches = _batches(stretches, order.places, foreign.times, where)
    return foreign


def _choose(
    arrays: dict[str, Array], stream: str | None, foreign: Foreign, where: str
) -> tuple[list[Array], Order | None]:
    """Return the arrays with the events, and the order of their columns if names define it."""
    columns = [name for name, array in arrays.items() if array.is_column]
    order = by_name(columns)
    tables = sorted(name for name, array in arrays.items() if array.is_table)
    if stream is None and order is not None:
        used = [columns[place] for place in order.places]
        event_arrays = [arrays[name] for name in used]
        check_lengths([math.prod(array.shape) for array in event_arrays], where)
        order = Order((0, 1, 2, 3), order.us_per_unit)
    elif stream is None and _is_evimo(arrays):
        used = list(EVIMO)
        event_arrays = [arrays[name] for name in used]
        check_lengths([event_arrays[at].shape[0] for at in (0, 1, 1, 2)], where)
        order = Order((0, 1, 2, 3), None)
    elif tables and (stream is None or stream in tables):
        used = [tables[0] if stream is None else stream]
        event_arrays = [arrays[used[0]]]
        others = [name for name in tables if name not in used]
        if others and stream is None:
            foreign.notes.append(
                f"read the array {used[0]}; the file also has: {', '.join(others)} (choose with --stream)"
            )
        order = by_name(event_arrays[0].dtype.names) if event_arrays[0].dtype.names else None
    elif stream is not None:
        expected = " or ".join(tables) or "no --stream: the file has only one stream"
        raise InputError("the file has no such array of events", where=where, expected=expected, found=stream[:80])
    else:
        found = ", ".join(f"{name} {array}".strip() for name, array in list(arrays.items())[:8]) or "nothing"
        objects = any(array.dtype.hasobject for array in arrays.values())
        hint = "save the Python objects as numbers: evetac never loads objects, because they can run code"
        raise InputError(
            "the file has no event columns", where=where, expected=EXPECTED, found=found, hint=hint if objects else ""
        )
    if event_arrays[0].dtype.names:
        places = by_name(event_arrays[0].dtype.names)
        unused = [name for i, name in enumerate(event_arrays[0].dtype.names) if places and i not in places.places]
        foreign.left_out |= {f"values of {name}": event_arrays[0].shape[0] for name in unused}
    foreign.left_out |= {f"values of {name}": math.prod(arrays[name].shape) for name in arrays if name not in used}
    return event_arrays, order


def _is_evimo(arrays: dict[str, Array]) -> bool:
    """Whether the file has the three arrays of EVIMO."""
    if not all(name in arrays for name in EVIMO):
        return False
    t, xy, p = (arrays[name] for name in EVIMO)
    pairs = xy.dtype.kind in "iuf" and len(xy.shape) == 2 and xy.shape[1] == 2 and not xy.columns_first
    return t.is_column and pairs and p.is_column


def _stretches(event_arrays: list[Array]) -> list[StoredRun]:
    """Return the locations of the values: four columns, those of EVIMO, or one run of rows."""
    array = event_arrays[0]
    if len(event_arrays) == len(EVIMO):
        t, xy, p = event_arrays
        pairs = StoredRun(xy, np.dtype((xy.dtype, (2,))), 0, xy.shape[0])
        return [StoredRun(t, t.dtype, 0, t.shape[0]), pairs, StoredRun(p, p.dtype, 0, p.shape[0])]
    if len(event_arrays) == 4:
        return [StoredRun(one, one.dtype, 0, math.prod(one.shape)) for one in event_arrays]
    if array.dtype.names:
        return [StoredRun(array, array.dtype, 0, array.shape[0])]
    rows = array.shape[0]
    if array.columns_first:
        return [StoredRun(array, array.dtype, column * rows, rows) for column in range(4)]
    return [StoredRun(array, np.dtype((array.dtype, (4,))), 0, rows)]


def _rows(stretches: list[StoredRun]) -> Generator[list[NDArray[Any]], None, None]:
    """Yield all columns in the file's order, in batches of rows; at least one batch, which may be empty."""
    count = stretches[0].items
    at_once = min(BATCH_ROWS, BATCH_BYTES // max(stretch.dtype.itemsize for stretch in stretches))
    with ExitStack() as opened:
        files = [opened.enter_context(stretch.array.open()) for stretch in stretches]
        for file, stretch in zip(files, stretches, strict=True):
            _skip(file, stretch.array.start + stretch.first * stretch.dtype.itemsize)
        for start in range(0, max(count, 1), at_once):
            parts: list[NDArray[Any]] = []
            for file, stretch in zip(files, stretches, strict=True):
                wanted = min(at_once, count - start) * stretch.dtype.itemsize
                content = _read(file, wanted)
                if len(content) < wanted:
                    raise ValueError(f"the array ends before row {start + at_once} of {count}")
                part = np.frombuffer(content, stretch.dtype.base).reshape(-1, *stretch.dtype.shape)
                if part.dtype.names:
                    parts += [part[name] for name in part.dtype.names]
                else:
                    parts += list(part.T) if part.ndim == 2 else [part]
            yield parts


def _batches(
    stretches: list[StoredRun], places: tuple[int, int, int, int], times: ColumnTimes, where: str
) -> Iterator[EventColumns]:
    start = 0
    with _damage_in_words(where):
        for parts in _rows(stretches):
            t, x, y, p = (parts[place] for place in places)
            place = partial(at_index, start)
            yield EventColumns(times.us(t, place), x, y, p, place)
            start += len(t)


def _read(file: IO[bytes], size: int) -> bytes:
    """Read `size` bytes, fewer only at the end; one read of an archive member may return fewer than requested."""
    parts = []
    while size and (part := file.read(min(size, PIECE_BYTES))):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _skip(file: IO[bytes], size: int) -> None:
    while size and (part := file.read(min(size, PIECE_BYTES))):
        size -= len(part)


# The location of arrays in files


def _single(path: Path, foreign: Foreign, where: str) -> Array:
    with path.open("rb") as file:
        array = _array(_read(file, MOST_HEADER_BYTES), lambda: path.open("rb"), where)
    after = path.stat().st_size - array.end
    if array.dtype.hasobject:
        return array
    if after < 0:
        raise InputError(
            "the array is cut short",
            where=where,
            found=f"{-after} bytes are missing",
            hint="is the file complete? compare its size with that of the original",
        )
    if after:
        foreign.left_out["bytes after the array"] = after
    return array


def _archived(path: Path, where: str) -> dict[str, Array]:
    """Return the arrays of an npz by name; raise InputError if one does not match its header."""
    arrays: dict[str, Array] = {}
    size, announced = path.stat().st_size, 0
    with _Bounded(path) as file, zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if len(members) > MOST_MEMBERS:
            raise InputError(
                "the archive has too many arrays",
                where=where,
                expected=f"at most {MOST_MEMBERS:,}",
                found=f"{len(members):,}",
            )
        for member in members:
            if not member.filename.endswith(".npy"):
                raise InputError(
                    "the archive contains files that are not numpy arrays",
                    where=where,
                    found=member.filename[:80],
                    hint="unpack it and import the event file in it",
                )
            name = member.filename.removesuffix(".npy")
            if name in arrays:
                raise InputError("the archive has two arrays of the same name", where=where, found=name[:80])
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & 1:
                raise InputError(
                    f"{name[:80]} is compressed with a method that evetac does not read",
                    where=where,
                    expected="numpy.savez or numpy.savez_compressed",
                    found="encryption" if member.flag_bits & 1 else f"zip method {member.compress_type}",
                )
            announced += member.file_size
            refuse_too_much(announced, size, where)
            with archive.open(member) as content:
                head = _read(content, MOST_HEADER_BYTES)
            array = _array(head, partial(_member, path, member.filename), f"{where}: {name[:80]}")
            if array.end != member.file_size and not array.dtype.hasobject:
                raise InputError(
                    f"{name[:80]} does not have the length that its header states",
                    where=where,
                    expected=str(array),
                    found="another length",
                )
            arrays[name] = array
    return arrays


class _Bounded(io.FileIO):
    """A file that refuses to return more than PIECE_BYTES at once.

    zipfile reads the table of contents of an archive at once and uses a thousand bytes of memory for forty of it.
    """

    def read(self, size: int | None = -1) -> bytes:
        if size is None or size < 0:
            at = self.seek(0, io.SEEK_CUR)
            size = self.seek(0, io.SEEK_END) - at
            self.seek(at)
        if size > PIECE_BYTES:
            raise ValueError(f"the table of contents has more than {PIECE_BYTES:,} bytes")
        return super().read(size) or b""


@contextmanager
def _member(path: Path, name: str) -> Iterator[IO[bytes]]:
    with _Bounded(path) as file, zipfile.ZipFile(file) as archive, archive.open(name) as member:
        yield member


def _array(content: bytes, open_: Callable[[], Any], where: str) -> Array:
    """Parse the header of an array; `content` are its first bytes."""
    head = io.BytesIO(content)
    version = npy.read_magic(head)
    if version not in HEADERS:
        raise InputError("unknown version of numpy's format", where=where, expected="1.0 or 2.0", found=f"{version}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy warns about headers that Python 2 wrote
        shape, columns_first, dtype = HEADERS[version](head)
    if not all(0 <= length < 2**62 for length in shape):
        raise InputError(
            "the array's shape is impossible", where=where, found=f"{str(dtype)[:80]} of shape {str(shape)[:80]}"
        )
    return Array(open_, head.seek(0, io.SEEK_CUR), dtype, shape, bool(columns_first))


@contextmanager
def _damage_in_words(where: str) -> Iterator[None]:
    try:
        yield
    except DAMAGE as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise InputError(
            "the file cannot be read as npy or npz",
            where=where,
            found=reason,
            hint="is the file complete? compare its size with that of the original",
        ) from None
