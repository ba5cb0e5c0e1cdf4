"""Read another program's table, CSV or Parquet, as a stream of samples: a column of times, and columns of numbers.

pyarrow reads both, batch by batch. The rows are stored on disk temporarily, so a table of hours takes no more memory
than a short one. The column of times is found by its name; its unit by the name, the type, or the size of its numbers.
`clock` states which, and a note names other columns of times. A column of lists, such as LeRobot's `observation.state`,
becomes a column per element. Columns that are not numbers are left out, and a note names them.

Text of CSV is UTF-8, UTF-16 with its mark, or else Latin-1. The separator is the one by which the first rows have as
many cells as the line of names. A separator at the end of each line adds a column without a name; it may be missing in
the line of names. With another separator than the comma, the decimal sign is a comma if the first part of the file has
numbers with commas and none with points.
"""

import codecs
import csv
import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.formats.read.damage import read_in_words, refuse_too_much
from evetac_cli.formats.read.table_names import TICKS_S, Times, find_times, has_unit, is_time, name_and_unit
from evetac_cli.store.hdf5.disk import joined_on_disk
from evetac_cli.store.recordings.streams import Stream, free_name
from evetac_cli.text_files import open_regular

MAGIC = b"PAR1"  # of Parquet
BATCH_ROWS = 1 << 16
BLOCK_BYTES = 1 << 22  # of CSV that are parsed together
MOST_COLUMNS = 512
NUMBER_BYTES = 8  # of a number or a time in the temporary file
MOST_US = 1 << 60  # 36,000 years: the sum of two such times does not overflow
MOST_S = MOST_US // 10**6
NAMED_LEFT_OUT = 5
YEARS_S = (946_684_800, 4_102_444_800)  # the years 2000 to 2100 in Unix time
SHORT_STEP = 0.05  # of times with fractions whose unit is not stated: in seconds, a rate that a device has
MOST_LENGTHS = 30  # a table is at most this many times as long as the recording
EPISODES = "episode_index"  # of LeRobot
MOST_HEAD_BYTES = 1 << 16  # of the line of names
SAMPLE_BYTES = 1 << 18  # of CSV, read to find how it is written
SEPARATORS = ";\t, "  # in this order: names and decimal numbers have commas and blanks, hardly ever semicolons
NUMBER = re.compile(r"\s*[-+]?[.\d][\d.eE+-]*\s*")

Batches = Callable[[Sequence[int], str], Iterator[Any]]  # arguments: indices of the columns, in order; the file's path


def is_parquet(path: Path) -> bool:
    """Whether a file begins with Parquet's mark."""
    with open_regular(path) as file:
        return file.read(len(MAGIC)) == MAGIC


def read_table(path: Path, folder: Path | None, length_s: float = math.inf) -> tuple[Stream, list[str]]:
    """Return a table as an unnamed stream in its own clock, and notes; raise InputError if it cannot be read.

    folder: where the numbers are stored temporarily; by default the folder for temporary files. length_s: length of
    the recording, which an assumed unit of time has to fit.
    """
    where = str(path)
    with needs_extra("CSV and Parquet need pyarrow", "convert", where):
        import pyarrow  # noqa: F401
    with read_in_words(where, "the table cannot be read"):
        names, types, batches_of, notes = _parquet(path) if is_parquet(path) else _csv(path, where)
        if len(names) > MOST_COLUMNS:
            raise _too_wide(len(names), where)
        times = find_times(names, types, where)
        for at in times.columns:
            if not is_time(types[at]):
                what = f"{times.clock} of type {types[at]}"
                raise InputError("the times are not numbers", where=where, found=what)
        numbers = [
            at
            for at, kind in enumerate(types)
            if at not in times.columns and (_is_number(kind) or _is_list(kind) and _is_number(kind.value_type))
        ]
        if not numbers:
            raise InputError(
                "the table has no column of numbers other than the times", where=where, found=", ".join(names)[:200]
            )
        # Only these are read: a packed text column of a few bytes may unpack to gigabytes of rows.
        batches = (batch for batch in batches_of([*times.columns, *numbers], where) if batch.num_rows)
        read = _Rows(times, numbers, names, length_s, where)
        t_us, *values = joined_on_disk(folder, map(read.batch, batches)) or (np.empty(0, np.int64),)
    if not len(t_us):
        raise InputError("the table has no rows", where=where)
    others = [names[at] for at in times.others]
    if others and len(t_us) > 1 and (t_us == 0).all():
        hint = f"remove this column to use {_some(others)}"
        raise InputError("the times are all 0, so never set", where=where, found=times.clock, hint=hint)
    columns: dict[str, NDArray[np.float64]] = {}
    units = {}
    for stated, column in zip(read.columns, values, strict=True):
        plain, unit = name_and_unit(stated)
        name = free_name(plain, columns)
        columns[name], units[name] = column, unit
    if EPISODES in columns:
        _refuse_episodes(t_us, columns[EPISODES], where)
    notes += [f"other times, which were not used: {_some(others)}"] if others else []
    others = [
        name
        for at, name in enumerate(names)
        if at not in (*times.columns, *numbers, *times.others) and (name.strip() or str(types[at]) != "null")
    ]
    notes += [f"left out: {_some(others)}, which {'are' if len(others) > 1 else 'is'} not numeric"] if others else []
    return Stream("", t_us, columns, units=units, source=path.name, clock=read.clock), notes


def _floats(column: Any) -> NDArray[np.float64]:
    """Return an Arrow array of numbers or booleans as floats, NaN where it has nulls."""
    floats = np.full(len(column), np.nan)
    floats[_is_known(column)] = _numpy(column.drop_null().cast("float64", safe=False))
    return floats


def _is_known(column: Any) -> NDArray[np.bool_]:
    """Return a mask (rows,) of the rows of an Arrow array that are not null."""
    return _numpy(column.is_valid().cast("uint8")).view(np.bool_)


def _numpy(column: Any) -> NDArray[Any]:
    """Return an Arrow array of numbers without nulls as an array; pyarrow's `to_numpy` would import pandas."""
    return np.from_dlpack(column)


def _is_number(kind: Any) -> bool:
    from pyarrow import types

    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind))


def _is_list(kind: Any) -> bool:
    from pyarrow import types

    return bool(types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind))


def _too_wide(columns: int, where: str) -> InputError:
    most = f"at most {MOST_COLUMNS} columns, counting each element of a list"
    return InputError("the table has too many columns", where=where, expected=most, found=f"{columns} columns")


def _refuse_episodes(t_us: NDArray[np.int64], episodes: NDArray[np.float64], where: str) -> None:
    """Raise InputError if the times begin again in another episode."""
    again = np.flatnonzero((np.diff(episodes) != 0) & (np.diff(t_us) <= 0))
    if len(again):
        row = int(again[0]) + 1
        raise InputError(
            "the table has several episodes, each with times of its own",
            where=f"{where}: row {row + 1}",
            expected=f"one {EPISODES}, {episodes[row - 1]:g}",
            found=f"{episodes[row]:g}",
            hint="save the rows of the recording's episode as a table of their own",
        )


class _Rows:
    """Converts batches of a table to times and columns of floats; `clock` describes the times after the first batch."""

    def __init__(self, times: Times, numbers: list[int], names: list[str], length_s: float, where: str) -> None:
        self._times, self._numbers, self._names, self._where = times, numbers, names, where
        self._unit, self._length_s, self.clock = times.unit, length_s, times.clock
        self._widths: dict[int, int] = {}  # numbers in each list, by the column's index
        self._done = 0  # rows

    @property
    def columns(self) -> list[str]:
        """Names of the columns of numbers; an element of a list has its index in brackets."""
        widths = ((self._names[at], self._widths.get(at)) for at in self._numbers)
        return [
            label
            for name, width in widths
            for label in ([name] if width is None else [f"{name}[{element}]" for element in range(width)])
        ]

    def batch(self, batch: Any) -> tuple[NDArray[Any], ...]:
        """Return times in us and the numbers of the next rows; the batch has the columns of times first."""
        count = len(self._times.columns)
        t_us = self._t_us([batch.column(place) for place in range(count)])
        self._refuse("impossible time", (t_us < -MOST_US) | (t_us > MOST_US), t_us)
        columns: list[NDArray[np.float64]] = []
        for place, at in enumerate(self._numbers, count):
            column = batch.column(place)
            if _is_list(column.type):
                columns.extend(self._elements(column, at))
            else:
                columns.append(_floats(column))
            if len(columns) > MOST_COLUMNS:
                raise _too_wide(len(columns), self._where)
        for name, values in zip(self.columns, columns, strict=True):
            if np.isinf(values).any():
                self._refuse(f"infinite value in the column {name}", np.isinf(values), values)
        self._done += len(t_us)
        return t_us, *columns

    def _elements(self, column: Any, at: int) -> NDArray[np.float64]:
        """Return the numbers of a column of lists, shape (elements, rows); NaN where there is no list."""
        from pyarrow import compute

        known = _is_known(column)
        lengths = _floats(compute.list_value_length(column))
        width = self._widths.setdefault(at, int(lengths[known][0]) if known.any() else 0)
        message = f"lists of different lengths in the column {self._names[at]}: the first has {width} numbers"
        self._refuse(message, known & (lengths != width), lengths)
        if width > MOST_COLUMNS:
            raise _too_wide(width, self._where)
        rows = np.full((len(column), width), np.nan)
        rows[known] = _floats(column.flatten()).reshape(-1, width) if width else 0
        return rows.T

    def _t_us(self, columns: list[Any]) -> NDArray[np.int64]:
        for column in columns:
            if column.null_count:
                self._refuse("the row has no time", ~_is_known(column), np.full(len(column), "nothing"))
        kind = columns[0].type
        if has_unit(kind):
            self._unit, self.clock = kind.unit, f"{self._times.clock}, whose type states its unit"
            columns = [columns[0].view(f"int{kind.bit_width}")]
        if len(columns) > 1:
            seconds, nanoseconds = (_numpy(column.cast("int64")) for column in columns)
            self._refuse("impossible time", (seconds < -MOST_S) | (seconds > MOST_S), seconds)
            self._refuse(
                "nanoseconds outside 0 to 999,999,999", (nanoseconds < 0) | (nanoseconds >= 10**9), nanoseconds
            )
            return np.asarray(seconds * 10**6 + nanoseconds // 1000)
        values = _numpy(columns[0])
        if values.dtype.kind == "f":
            self._refuse("the time is not a number", ~np.isfinite(values), values)
        if not self._unit and len(values):
            self._unit = _guess(values, self._length_s, self._where, self._times.clock)
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


def _guess(values: NDArray[Any], length_s: float, where: str, clock: str) -> str:
    """Guess the unit of times: of dates by their size; fractions are seconds if these fit the recording."""
    first = abs(float(values[0]))
    for unit, ticks in TICKS_S.items():
        if YEARS_S[0] * ticks <= first < YEARS_S[1] * ticks:
            return unit
    if values.dtype.kind == "f" and first < YEARS_S[0] and (values != np.rint(values)).any():
        steps = np.diff(values)
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        if step <= SHORT_STEP or float(values[-1] - values[0]) <= MOST_LENGTHS * length_s:
            return "s"
    hint = "name the column t_s, t_ms, t_us or t_ns"
    raise InputError("the unit of time is unclear", where=where, found=f"{clock}: {values[0]}", hint=hint)


def _csv(path: Path, where: str) -> tuple[list[str], list[Any], Batches, list[str]]:
    """Return names and types of the columns, a function that reads some of them in batches, and notes."""
    import pyarrow
    from pyarrow import csv

    # Columns are read by their place as text: two may have the same name.
    encoding, separator, decimal_sign, names = _dialect(path, where)
    places = list(map(str, range(len(names))))
    lines = {"skip_rows": 1, "column_names": places, "encoding": encoding}
    options = csv.ReadOptions(use_threads=False, block_size=BLOCK_BYTES, **lines)
    how = options, csv.ParseOptions(delimiter=separator)
    with csv.open_csv(path, *how, csv.ConvertOptions(decimal_point=decimal_sign)) as first:
        types = list(first.schema.types)
    times = find_times(names, types, where).columns
    # A column may begin with whole numbers and continue with fractions, so all except the times are read as floats.
    types = [
        pyarrow.float64()
        if at not in times and (pyarrow.types.is_integer(kind) or pyarrow.types.is_null(kind) and names[at].strip())
        else kind
        for at, kind in enumerate(types)
    ]

    def batches(wanted: Sequence[int], where: str) -> Iterator[Any]:
        floats = {str(at): kind for at, kind in enumerate(types) if kind == pyarrow.float64()}
        included = [str(at) for at in wanted]
        convert = csv.ConvertOptions(column_types=floats, include_columns=included, decimal_point=decimal_sign)
        with csv.open_csv(path, *how, convert) as reader:
            yield from reader

    notes = ["the text is not UTF-8; assumed to be Latin-1"] if encoding == "latin-1" else []
    return names, types, batches, notes


def _dialect(path: Path, where: str) -> tuple[str, str, str, list[str]]:
    """Return encoding, separator, decimal sign and names of the columns of a CSV file.

    Raises InputError if it is no table, or if its first line does not name the columns.
    """
    with open_regular(path) as file:
        sample = file.read(SAMPLE_BYTES)
    encoding = _encoding(sample)
    text = codecs.getincrementaldecoder(encoding)("replace").decode(sample)
    head, *lines = re.split(r"\r\n?|\n", text.removeprefix("\ufeff"))
    if len(sample) == SAMPLE_BYTES:  # the last line may be cut
        lines = lines[:-1]
    head = head.strip("\r\n ")
    if not head or len(head) >= MOST_HEAD_BYTES or not head.replace("\t", "").isprintable():
        expected = "CSV, Parquet, or a bag of ROS 1 or ROS 2"
        raise InputError("the file is neither a table nor a bag", where=where, expected=expected)
    lines = [line for line in lines if line.strip()]
    separator = next((sign for sign in SEPARATORS if _fits(head, lines[:20], sign)), None)
    separator = separator or max(",;\t", key=head.count)
    separator = separator if separator in head else " "
    names = _cells(head, separator)
    if any(NUMBER.fullmatch(name) for name in names):
        raise InputError("the first line does not name the columns", where=where, found=head[:80])
    if lines:
        more = len(_cells(lines[0], separator)) - len(names)
        names = [*names, ""] if more == 1 and lines[0].endswith(separator) else names
        names = names[:-1] if more == -1 and not names[-1].strip() else names
    return encoding, separator, _decimal_sign(lines, separator), names


def _decimal_sign(lines: list[str], separator: str) -> str:
    """Return the decimal sign of numbers in rows; a point if both or none occur."""
    cells = [cell.strip() for line in lines for cell in line.split(separator)]
    is_found = {
        sign: any(re.fullmatch(rf"[-+]?\d*\{sign}\d+(?:[eE][-+]?\d+)?", cell) for cell in cells) for sign in ".,"
    }
    return "," if is_found[","] and not is_found["."] else "."


def _encoding(sample: bytes) -> str:
    if sample.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(sample)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf8"


def _cells(line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:  # a field of more than 131,072 characters
        return [line]


def _fits(head: str, lines: list[str], separator: str) -> bool:
    """Whether rows have as many cells as the line of names, and more than one; one more or less if it is empty."""
    names = _cells(head, separator)
    rows = [_cells(line, separator) for line in lines]
    same = (abs(len(row) - len(names)) < 1 + (not max(row, names, key=len)[-1].strip()) for row in rows)
    return len(names) > 1 and all(same)


def _parquet(path: Path) -> tuple[list[str], list[Any], Batches, list[str]]:
    """Return names and types of the columns, a function that reads some (no structs) in batches, and no notes."""
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        schema = file.schema_arrow

    def batches(wanted: Sequence[int], where: str) -> Iterator[Any]:
        columns = [schema.names[at] for at in wanted]
        with parquet.ParquetFile(path) as file:
            _check_size(path, file.metadata, len(columns), where)
            for batch in file.iter_batches(BATCH_ROWS, columns=columns, use_threads=False):
                yield batch.select(columns)  # in this order: pyarrow keeps that of the file

    return list(schema.names), list(schema.types), batches, []


def _check_size(path: Path, metadata: Any, columns: int, where: str) -> None:
    """Raise InputError if columns of a Parquet file unpack to more than its size allows.

    Only groups are asked: pyarrow ends the process (`terminate called`) if the metadata of a column are damaged.
    """
    groups = [metadata.row_group(at) for at in range(metadata.num_row_groups)]
    numbers = columns * sum(group.num_rows for group in groups)
    pages = sum(group.total_byte_size for group in groups)
    refuse_too_much(max(numbers * NUMBER_BYTES, pages), path.stat().st_size, where)


def _some(names: list[str]) -> str:
    more = f" and {len(names) - NAMED_LEFT_OUT} more" if len(names) > NAMED_LEFT_OUT else ""
    return f"column{'s' * (len(names) > 1)} {', '.join(name.strip()[:60] for name in names[:NAMED_LEFT_OUT])}{more}"
