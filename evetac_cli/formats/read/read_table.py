"""Read another program's table, CSV or Parquet, as a stream of samples: a column of times, and columns of numbers.

pyarrow reads both, batch by batch. The rows are stored on disk temporarily, so a table of hours takes no more memory
than a short one. The column of times is found by its name; its unit by the name, the type, or the size of its numbers.
`clock` states which. Columns that are not numbers are left out, and a note names them.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, missing_extra
from evetac_cli.formats.arrow_columns import is_known, to_numpy
from evetac_cli.formats.read.parquet_pages import MAGIC, RowGroup, footer_bytes, row_groups, unpacked_bytes
from evetac_cli.formats.read.unpacked_size import refuse_too_much
from evetac_cli.store.hdf5.disk import joined_on_disk, utf8_path
from evetac_cli.store.recordings.streams import Stream, free_name
from evetac_cli.text_files import open_regular

BATCH_ROWS = 1 << 16
BLOCK_BYTES = 1 << 22  # of CSV that are parsed together
MOST_COLUMNS = 512
MOST_GROUP_BYTES = 1 << 29  # unpacked size of a row group of a Parquet file
MOST_GROUPS = 50_000  # row groups of a Parquet file: this many alone take 400 MB and seconds
MOST_FOOTER_BYTES = 1 << 23  # of a Parquet file; reading it takes seconds. 500 columns and 100 groups need less
NUMBER_BYTES = 8  # of a number or a time in the temporary file
MOST_HEAD_BYTES = 1 << 16  # of the line of names
MOST_US = 1 << 60  # 36,000 years: the sum of two such times does not overflow
MOST_S = MOST_US // 10**6
NAMED_LEFT_OUT = 5

TIME = re.compile(
    r"(?:(?:field[._])?header[._]|_+|ros(?:bag)?|log_?|msg_?)?(?:t|time|timestamp|stamp)(?:_(?P<unit>s|ms|us|ns))?"
)
PARTS = re.compile(r"(?:.*[._])?stamp[._](?P<part>secs?|nanosecs?|nsecs?)")
BRACKETS = re.compile(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\])]{1,20})[\])]")
TICKS_S = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}  # ticks per second of each unit of time
YEARS_S = (946_684_800, 4_102_444_800)  # the years 2000 to 2100 in Unix time
# Units that a name may end in, for example `force_n`.
ENDINGS = {"m": "m", "mm": "mm", "rad": "rad", "deg": "deg", "n": "N", "nm": "N m", "ma": "mA", "hz": "Hz", "pa": "Pa"}
NAMES = "t_us, t_ms, t_s, t_ns, timestamp, time, stamp or header.stamp"


Batches = Callable[[Sequence[int], str], Iterator[Any]]  # arguments: indices of the columns, in order; the file's path


class _Times(NamedTuple):
    """The columns of a table's times: one, or two for seconds and nanoseconds; and the unit, if it is known."""

    columns: tuple[int, ...]
    unit: str
    clock: str


def is_parquet(path: Path) -> bool:
    """Whether a file begins with Parquet's mark."""
    with open_regular(path) as file:
        return file.read(len(MAGIC)) == MAGIC


def read_table(path: Path, folder: Path | None) -> tuple[Stream, list[str]]:
    """Return a table as an unnamed stream in its own clock, and notes; raise InputError if it cannot be read.

    folder: where the numbers are stored temporarily; by default the folder for temporary files.
    """
    where = str(path)
    try:
        import pyarrow
    except ImportError as error:
        raise missing_extra("CSV and Parquet need pyarrow", "convert", where=where, error=error) from None
    with _in_words(where, pyarrow.ArrowException), utf8_path(path) as place:
        names, types, batches_of = _parquet(place) if is_parquet(path) else _csv(place, where)
        if len(names) > MOST_COLUMNS:
            width = f"{len(names)} columns"
            raise InputError(
                "the table has too many columns", where=where, expected=f"at most {MOST_COLUMNS} columns", found=width
            )
        times = _find_times(names, where)
        for at in times.columns:
            if not _is_time(types[at]):
                what = f"{times.clock} of type {types[at]}"
                raise InputError("the times are not numbers", where=where, found=what)
        numbers = [
            at
            for at, kind in enumerate(types)
            if at not in times.columns
            and (pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind) or pyarrow.types.is_boolean(kind))
        ]
        if not numbers:
            raise InputError(
                "the table has no column of numbers other than the times", where=where, found=", ".join(names)[:200]
            )
        # Only these are read: a packed text column of a few bytes may unpack to gigabytes of rows.
        batches = batches_of([*times.columns, *numbers], where)
        read = _Rows(times, numbers, names, where)
        t_us, *values = joined_on_disk(folder, map(read.batch, batches)) or (np.empty(0, np.int64),)
    if not len(t_us):
        raise InputError("the table has no rows", where=where)
    columns: dict[str, NDArray[np.float64]] = {}
    units = {}
    for at, column in zip(numbers, values, strict=True):
        plain, unit = _unit(names[at])
        name = free_name(plain, columns)
        columns[name], units[name] = column, unit
    others = [names[at] for at in range(len(names)) if at not in (*times.columns, *numbers)]
    notes = [f"left out: {_some(others)}, which {'are' if len(others) > 1 else 'is'} not numeric"] if others else []
    return Stream("", t_us, columns, units=units, source=path.name, clock=read.clock), notes


class _Rows:
    """Converts batches of a table to times and columns of floats; `clock` describes the times after the first batch."""

    def __init__(self, times: _Times, numbers: list[int], names: list[str], where: str) -> None:
        self._times, self._numbers, self._names, self._where = times, numbers, names, where
        self._unit, self.clock = times.unit, times.clock
        self._done = 0  # rows

    def batch(self, batch: Any) -> tuple[NDArray[Any], ...]:
        """Return times in us and the numbers of the next rows; the batch has the columns of times first."""
        count = len(self._times.columns)
        t_us = self._t_us([batch.column(place) for place in range(count)])
        self._refuse("impossible time", (t_us < -MOST_US) | (t_us > MOST_US), t_us)
        columns = []
        for place, at in enumerate(self._numbers, count):
            values = to_numpy(batch.column(place).cast("float64", safe=False))
            if np.isinf(values).any():
                self._refuse(f"infinite value in the column {self._names[at]}", np.isinf(values), values)
            columns.append(values)
        self._done += len(t_us)
        return t_us, *columns

    def _t_us(self, columns: list[Any]) -> NDArray[np.int64]:
        import pyarrow
        from pyarrow import compute

        for column in columns:
            if column.null_count:
                self._refuse("the row has no time", ~is_known(column), np.full(len(column), "nothing"))
        if pyarrow.types.is_timestamp(columns[0].type):
            self.clock = f"{self._times.clock}, whose type states its unit"
            us = pyarrow.timestamp("us", columns[0].type.tz)
            stamps = columns[0].cast(options=compute.CastOptions(us, allow_time_truncate=True))
            return to_numpy(stamps.cast("int64"))
        if len(columns) > 1:
            seconds, nanoseconds = (to_numpy(column.cast("int64")) for column in columns)
            self._refuse("impossible time", (seconds < -MOST_S) | (seconds > MOST_S), seconds)
            self._refuse(
                "nanoseconds outside 0 to 999,999,999", (nanoseconds < 0) | (nanoseconds >= 10**9), nanoseconds
            )
            return np.asarray(seconds * 10**6 + nanoseconds // 1000)
        values = to_numpy(columns[0])
        if values.dtype.kind == "f":
            self._refuse("the time is not a number", ~np.isfinite(values), values)
        if not self._unit and len(values):
            self._unit = _guess(values, self._where, self._times.clock)
            self.clock = f"{self._times.clock}, assumed to be in {self._unit}"
        ticks = TICKS_S[self._unit or "s"]
        self._refuse("impossible time", np.abs(values.astype(np.float64)) * (1e6 / ticks) > MOST_US, values)
        if values.dtype.kind == "f":
            return np.asarray(np.rint(values * (1e6 / ticks)).astype(np.int64))
        whole = values.astype(np.int64)
        return np.asarray(whole * (10**6 // ticks) if ticks <= 10**6 else whole // (ticks // 10**6))

    def _refuse(self, message: str, wrong: NDArray[np.bool_], values: NDArray[Any]) -> None:
        """Raise InputError for the first row that is wrong, if there is one."""
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(message, where=f"{self._where}: row {self._done + row + 1}", found=str(values[row])[:60])


def _is_time(kind: Any) -> bool:
    import pyarrow

    of = pyarrow.types
    return bool(of.is_integer(kind) or of.is_floating(kind) or of.is_timestamp(kind) or of.is_null(kind))  # no row


def _find_times(names: list[str], where: str) -> _Times:
    """Return the columns of times, found by name; a column whose name states its unit is preferred."""
    plain = [_unit(name) for name in names]
    parts = {match["part"][0]: at for at, (name, _) in enumerate(plain) if (match := PARTS.fullmatch(name.lower()))}
    candidates = []
    for at, (name, unit) in enumerate(plain):
        match = TIME.fullmatch(name.lower())
        if match:
            candidates.append((match["unit"] or (unit if unit in TICKS_S else ""), at))
    with_unit = next((pair for pair in candidates if pair[0]), None)
    if with_unit is None and len(parts) == 2:
        columns = parts["s"], parts["n"]
        return _Times(columns, "ns", " and ".join(f"column {names[at].strip()}" for at in columns))
    if not candidates:
        raise InputError(
            "the table has no column of times",
            where=where,
            expected=f"a column named {NAMES}",
            found=", ".join(names)[:200],
        )
    unit, at = with_unit or candidates[0]
    return _Times((at,), unit, f"column {plain[at][0]}" + (f", in {unit}" if unit else ""))


def _guess(values: NDArray[Any], where: str, clock: str) -> str:
    """Guess the unit of times: for dates by their size, otherwise seconds if they have fractions; else InputError."""
    first = abs(float(values[0]))
    for unit, ticks in TICKS_S.items():
        if YEARS_S[0] * ticks <= first < YEARS_S[1] * ticks:
            return unit
    if values.dtype.kind == "f" and first < YEARS_S[0] and (values != np.rint(values)).any():
        return "s"
    hint = "name the column t_s, t_ms, t_us or t_ns"
    raise InputError("the unit of time is unclear", where=where, found=f"{clock}: {values[0]}", hint=hint)


def _unit(name: str) -> tuple[str, str]:
    """Return the name of a column without a unit in brackets, and its unit, if the name states it."""
    plain = name.strip().lstrip("%#").strip()
    match = BRACKETS.fullmatch(plain)
    if match:
        return match["name"], match["unit"].strip()
    return plain, ENDINGS.get(plain.lower().rpartition("_")[2], "") if "_" in plain else ""


def _csv(path: Path, where: str) -> tuple[list[str], list[Any], Batches]:
    """Return names and types of the columns, and a function that reads some of them in batches."""
    import pyarrow
    from pyarrow import csv

    with open_regular(path) as file:
        head = file.readline(MOST_HEAD_BYTES)
    try:
        line = head.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        line = ""
    delimiter = max(",;\t", key=line.count)
    delimiter = delimiter if delimiter in line else " "
    names = line.split(delimiter)
    if not line or len(head) == MOST_HEAD_BYTES or not line.isprintable() and "\t" not in line:
        raise InputError(
            "the file is neither a table nor a bag", where=where, expected="CSV, Parquet, or a bag of ROS 1 or ROS 2"
        )
    if any(re.fullmatch(r"\s*[-+]?[.\d][\d.eE+-]*\s*", name) for name in names):
        raise InputError(
            "the first line does not name the columns", where=where, found=line[:80], hint="add a line with their names"
        )
    how = csv.ReadOptions(use_threads=False, block_size=BLOCK_BYTES), csv.ParseOptions(delimiter=delimiter)
    with csv.open_csv(path, *how) as first:
        columns = first.schema
    times = _find_times(columns.names, where).columns
    # A column may begin with whole numbers and continue with fractions, so all except the times are read as floats.
    as_floats = {
        name: pyarrow.float64()
        for at, (name, kind) in enumerate(zip(columns.names, columns.types, strict=True))
        if at not in times and (pyarrow.types.is_integer(kind) or pyarrow.types.is_null(kind))
    }
    types = [as_floats.get(name, kind) for name, kind in zip(columns.names, columns.types, strict=True)]

    def batches(wanted: Sequence[int], where: str) -> Iterator[Any]:
        with csv.open_csv(path, *how, csv.ConvertOptions(column_types=as_floats)) as reader:
            for batch in reader:
                yield batch.select(list(wanted))

    return list(columns.names), types, batches


def _parquet(path: Path) -> tuple[list[str], list[Any], Batches]:
    """Return names and types of the columns, and a function that reads some (no lists, no structs) in batches."""
    with _parquet_file(path, str(path)) as file:
        schema = file.schema_arrow
    first = list(accumulate(map(_leaves, schema.types), initial=0))  # index in the file of each column of the schema

    def batches(wanted: Sequence[int], where: str) -> Iterator[Any]:
        columns = [first[at] for at in wanted]
        with _parquet_file(path, where) as file:
            _check_size(path, columns, where)
            place = {at: number for number, at in enumerate(sorted(columns))}  # a batch has them in the file's order
            groups = range(file.metadata.num_row_groups)
            for batch in file.reader.iter_batches(BATCH_ROWS, groups, columns, use_threads=False):
                yield batch.select([place[at] for at in columns])

    return list(schema.names), list(schema.types), batches


def _parquet_file(path: Path, where: str) -> Any:
    """Open the file and read its footer; raise InputError if the footer alone would fill the memory."""
    from pyarrow import parquet

    hint = "save the file again with larger row groups and fewer columns"
    with open_regular(path) as opened:
        footer = footer_bytes(opened)
    if footer > MOST_FOOTER_BYTES:
        expected, size_mb = f"a footer of at most {MOST_FOOTER_BYTES / 1e6:.0f} MB", f"{footer / 1e6:,.0f} MB"
        raise InputError(
            "the file has too many row groups and columns", where=where, expected=expected, found=size_mb, hint=hint
        )
    try:
        return parquet.ParquetFile(path, thrift_container_size_limit=MOST_GROUPS)
    except OSError as error:
        if "size limit" not in str(error):
            raise
        expected = f"at most {MOST_GROUPS:,} row groups, and as many columns"
        raise InputError("the file has too many row groups", where=where, expected=expected, hint=hint) from None


def _leaves(kind: Any) -> int:
    """Return how many columns of the file a column of the schema has; a struct has several."""
    return sum(_leaves(kind.field(at).type) for at in range(kind.num_fields)) if kind.num_fields else 1


def _check_size(path: Path, columns: Sequence[int], where: str) -> None:
    """Raise InputError if columns of a Parquet file unpack to more than fits in memory, or than its size allows."""
    with open_regular(path) as file:
        try:
            groups = row_groups(file)
            rows = sum(max(group.rows, *(group.chunks[at].values for at in columns)) for group in groups)
            refuse_too_much(rows * len(columns) * NUMBER_BYTES, path.stat().st_size, where)
            pages = max((_unpacked(file, group, columns) for group in groups), default=0)
        except (ValueError, IndexError) as error:
            raise InputError("the table cannot be read", where=where, found=str(error)) from None
    if pages > MOST_GROUP_BYTES:
        expected, size_mb = f"row groups of at most {MOST_GROUP_BYTES / 1e6:,.0f} MB", f"{pages / 1e6:,.0f} MB"
        raise InputError(
            "the row groups are too large",
            where=where,
            expected=expected,
            found=size_mb,
            hint="save the file again with smaller row groups",
        )


def _unpacked(file: BinaryIO, group: RowGroup, columns: Sequence[int]) -> int:
    """Return the unpacked size, in bytes, of some columns of a row group."""
    return sum(sum(unpacked_bytes(file, group.chunks[at].first, group.chunks[at].packed)) for at in columns)


def _some(names: list[str]) -> str:
    more = f" and {len(names) - NAMED_LEFT_OUT} more" if len(names) > NAMED_LEFT_OUT else ""
    return f"column{'s' * (len(names) > 1)} {', '.join(name.strip()[:60] for name in names[:NAMED_LEFT_OUT])}{more}"


@contextmanager
def _in_words(where: str, of_pyarrow: type[Exception]) -> Iterator[None]:
    try:
        yield
    except (of_pyarrow, OSError, OverflowError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise InputError("the table cannot be read", where=where, found=reason) from None
