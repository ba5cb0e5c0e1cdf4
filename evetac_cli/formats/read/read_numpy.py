"""Read events from numpy's files: `.npy` with a structured array or a table (N, 4), `.npz` with one or with columns.

    structured    fields t, x, y, p by the names in column_order; what tonic, expelliarmus and faery make
    (N, 4)        four columns, in the order that is said or fits (column_order)
    columns       arrays t, x, y, p of one length in an npz; or of EVIMO, where x and y are one array (N, 2)

The bytes are read here in blocks and never given to numpy.load: objects, which a pickle would make, are refused, and
of an archive no more is unpacked than a recording of its size can hold.
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
MOST_HEADER_BYTES = 1 << 14  # numpy itself takes 10,000
MOST_ITEM_BYTES = 1 << 10
MOST_MEMBERS = 1000
HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
PIECE_BYTES = 1 << 20  # read at once
EXPECTED = "t, x, y, p: as arrays of an npz, as fields of a structured array, or as the columns of an array (N, 4)"
# What zipfile, zlib and numpy's parser raise on damaged bytes.
DAMAGE = (
    zipfile.BadZipFile, ValueError, TypeError, KeyError, IndexError, EOFError, OSError, RuntimeError, SyntaxError,
    NotImplementedError, OverflowError, RecursionError, AttributeError, zlib.error, tokenize.TokenError,
)  # fmt: skip


class Array(NamedTuple):
    """An array as it lies in a file: how to open its bytes, at which of them it begins, and what they are."""

    open: Callable[[], AbstractContextManager[IO[bytes]]]
    start: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    columns_first: bool  # order F

    @property
    def end(self) -> int:
        """The byte after the last one."""
        return self.start + math.prod(self.shape) * self.dtype.itemsize

    @property
    def is_column(self) -> bool:
        """Whether it is one row of plain numbers."""
        return self.dtype.kind in "iubf" and bool(self.shape) and math.prod(self.shape) == max(self.shape)

    @property
    def is_table(self) -> bool:
        """Whether it may hold all columns of events."""
        if self.dtype.names:
            plain = all(self.dtype[name].kind in "iubf" for name in self.dtype.names)
            small = len(self.shape) == 1 and self.dtype.itemsize <= MOST_ITEM_BYTES
            return small and plain and by_name(self.dtype.names) is not None
        return self.dtype.kind in "iuf" and len(self.shape) == 2 and self.shape[1] == 4

    def __str__(self) -> str:
        kind = f"fields {', '.join(self.dtype.names)}" if self.dtype.names else str(self.dtype)
        return f"{kind[:120]} of shape {self.shape}"


class StoredRun(NamedTuple):
    """Items of one type that follow each other in an array's bytes."""

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
    """Events of an npy or npz file; FrameUnknown without frame_px, as neither says it."""
    where = str(path)
    foreign = Foreign("numpy", (1, 1), (), may_be_empty=True)
    with _damage_in_words(where):
        with path.open("rb") as handle:
            archive = handle.read(len(ZIP)) == ZIP
        arrays = _archived(path, where) if archive else {"": _single(path, foreign, where)}
        chosen, order = _choose(arrays, stream, foreign, where)
        stretches = _stretches(chosen)
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
    """The arrays that hold the events, and the order of their columns where names tell it."""
    columns = [name for name, array in arrays.items() if array.is_column]
    order = by_name(columns)
    tables = sorted(name for name, array in arrays.items() if array.is_table)
    if stream is None and order is not None:
        used = [columns[place] for place in order.places]
        chosen = [arrays[name] for name in used]
        check_lengths([math.prod(array.shape) for array in chosen], where)
        order = Order((0, 1, 2, 3), order.us_per_unit)
    elif stream is None and _is_evimo(arrays):
        used = list(EVIMO)
        chosen = [arrays[name] for name in used]
        check_lengths([chosen[at].shape[0] for at in (0, 1, 1, 2)], where)
        order = Order((0, 1, 2, 3), None)
    elif tables and (stream is None or stream in tables):
        used = [tables[0] if stream is None else stream]
        chosen = [arrays[used[0]]]
        others = [name for name in tables if name not in used]
        if others and stream is None:
            foreign.notes.append(f"took the array {used[0]}; also there: {', '.join(others)} (choose with --stream)")
        order = by_name(chosen[0].dtype.names) if chosen[0].dtype.names else None
    elif stream is not None:
        expected = " or ".join(tables) or "no --stream: the file holds one stream"
        raise InputError("no such array of events", where=where, expected=expected, found=stream[:80])
    else:
        held = ", ".join(f"{name} {array}".strip() for name, array in list(arrays.items())[:8]) or "nothing"
        objects = any(array.dtype.hasobject for array in arrays.values())
        hint = "write Python objects again as numbers: they are never loaded, as they can run code" if objects else ""
        raise InputError("holds no columns of events", where=where, expected=EXPECTED, found=held, hint=hint)
    if chosen[0].dtype.names:
        places = by_name(chosen[0].dtype.names)
        unused = [name for i, name in enumerate(chosen[0].dtype.names) if places and i not in places.places]
        foreign.left_out |= {f"values of {name}": chosen[0].shape[0] for name in unused}
    foreign.left_out |= {f"values of {name}": math.prod(arrays[name].shape) for name in arrays if name not in used}
    return chosen, order


def _is_evimo(arrays: dict[str, Array]) -> bool:
    """Whether there are the three arrays of EVIMO."""
    if not all(name in arrays for name in EVIMO):
        return False
    t, xy, p = (arrays[name] for name in EVIMO)
    pairs = xy.dtype.kind in "iuf" and len(xy.shape) == 2 and xy.shape[1] == 2 and not xy.columns_first
    return t.is_column and pairs and p.is_column


def _stretches(chosen: list[Array]) -> list[StoredRun]:
    """Where the values lie: four columns, those of EVIMO, or one stretch of rows."""
    array = chosen[0]
    if len(chosen) == len(EVIMO):
        t, xy, p = chosen
        pairs = StoredRun(xy, np.dtype((xy.dtype, (2,))), 0, xy.shape[0])
        return [StoredRun(t, t.dtype, 0, t.shape[0]), pairs, StoredRun(p, p.dtype, 0, p.shape[0])]
    if len(chosen) == 4:
        return [StoredRun(one, one.dtype, 0, math.prod(one.shape)) for one in chosen]
    if array.dtype.names:
        return [StoredRun(array, array.dtype, 0, array.shape[0])]
    rows = array.shape[0]
    if array.columns_first:
        return [StoredRun(array, array.dtype, column * rows, rows) for column in range(4)]
    return [StoredRun(array, np.dtype((array.dtype, (4,))), 0, rows)]


def _rows(stretches: list[StoredRun]) -> Generator[list[NDArray[Any]], None, None]:
    """All columns as they lie in the file, some rows at a time; at least once, if only without a row."""
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
    """So many bytes, fewer only at the end: a member of an archive may give less than it was asked for."""
    parts = []
    while size and (part := file.read(min(size, PIECE_BYTES))):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _skip(file: IO[bytes], size: int) -> None:
    while size and (part := file.read(min(size, PIECE_BYTES))):
        size -= len(part)


# How arrays lie in files


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
            found=f"{-after} bytes too few",
            hint="is it complete? compare its size with that of the original",
        )
    if after:
        foreign.left_out["bytes after the array"] = after
    return array


def _archived(path: Path, where: str) -> dict[str, Array]:
    """The arrays of an npz by their names; InputError where one cannot be what it says."""
    arrays: dict[str, Array] = {}
    size, announced = path.stat().st_size, 0
    with _Bounded(path) as file, zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if len(members) > MOST_MEMBERS:
            raise InputError("an archive of too many arrays", where=where, found=f"{len(members):,}")
        for member in members:
            if not member.filename.endswith(".npy"):
                raise InputError(
                    "not an archive of numpy arrays", where=where, found=member.filename[:80], hint="unpack it"
                )
            name = member.filename.removesuffix(".npy")
            if name in arrays:
                raise InputError("an archive with two arrays of one name", where=where, found=name[:80])
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & 1:
                raise InputError(
                    f"{name[:80]} is packed in a way that is not read",
                    where=where,
                    expected="numpy.savez or numpy.savez_compressed",
                    found="a password" if member.flag_bits & 1 else f"method {member.compress_type}",
                )
            announced += member.file_size
            refuse_too_much(announced, size, where)
            with archive.open(member) as content:
                head = _read(content, MOST_HEADER_BYTES)
            array = _array(head, partial(_member, path, member.filename), f"{where}: {name[:80]}")
            if array.end != member.file_size and not array.dtype.hasobject:
                raise InputError(
                    f"{name[:80]} is not as long as it says", where=where, expected=str(array), found="another length"
                )
            arrays[name] = array
    return arrays


class _Bounded(io.FileIO):
    """A file that gives no more bytes at once than are asked for here.

    zipfile reads the table of contents of an archive at once, and takes a thousand bytes of memory for forty of it.
    """

    def read(self, size: int | None = -1) -> bytes:
        if size is None or size < 0:
            at = self.seek(0, io.SEEK_CUR)
            size = self.seek(0, io.SEEK_END) - at
            self.seek(at)
        if size > PIECE_BYTES:
            raise ValueError(f"a table of contents of more than {PIECE_BYTES:,} bytes")
        return super().read(size) or b""


@contextmanager
def _member(path: Path, name: str) -> Iterator[IO[bytes]]:
    with _Bounded(path) as file, zipfile.ZipFile(file) as archive, archive.open(name) as member:
        yield member


def _array(content: bytes, open_: Callable[[], Any], where: str) -> Array:
    """What the header of an array says; `content` are its first bytes."""
    head = io.BytesIO(content)
    version = npy.read_magic(head)
    if version not in HEADERS:
        raise InputError("an array of another version", where=where, expected="1.0 or 2.0", found=f"{version}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers that Python 2 wrote
        shape, columns_first, dtype = HEADERS[version](head)
    if not all(0 <= length < 2**62 for length in shape):
        raise InputError("no array of numbers", where=where, found=f"{str(dtype)[:80]} of shape {str(shape)[:80]}")
    return Array(open_, head.seek(0, io.SEEK_CUR), dtype, shape, bool(columns_first))


@contextmanager
def _damage_in_words(where: str) -> Iterator[None]:
    try:
        yield
    except DAMAGE as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise InputError(
            "cannot be read as numpy's",
            where=where,
            found=reason,
            hint="is it complete? compare its size with that of the original",
        ) from None
