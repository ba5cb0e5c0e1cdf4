"""Read the unpacked sizes of a Parquet file's pages from the pages' own headers; the footer gives their positions.

Reason: sizes in the footer may be wrong, and pyarrow allocates the size in a page's header. That header cannot be
wrong unnoticed: a page that unpacks to another size is refused. The footer is read here too, because pyarrow terminates
the process (`terminate called`) if the metadata of a requested column are invalid.

Source: Apache Parquet's thrift file, FileMetaData and PageHeader, in Thrift's compact protocol.
"""

from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO, NamedTuple

MAGIC = b"PAR1"
MOST_HEADER_BYTES = 1 << 16  # includes the page's minimum and maximum; with numbers a header has some 100 bytes
MOST_DEPTH = 20
TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)
UNPACKED, PACKED = 2, 3  # fields of a PageHeader: sizes in bytes
# Fields: rows of FileMetaData and RowGroup; groups of FileMetaData; columns of RowGroup; metadata of ColumnChunk.
ROWS, GROUPS, COLUMNS, CHUNK = 3, 4, 1, 3
VALUES, CHUNK_PACKED, DATA_AT, DICTIONARY_AT = 5, 7, 9, 11  # fields of ColumnMetaData
NUMBER: Mapping[int, Any] = {}
WANTED = {
    ROWS: NUMBER,
    GROUPS: {ROWS: NUMBER, COLUMNS: {CHUNK: dict.fromkeys((VALUES, CHUNK_PACKED, DATA_AT, DICTIONARY_AT), NUMBER)}},
}


class ColumnChunk(NamedTuple):
    """A column of a row group: its number of values, the offset of its pages, and their size in bytes."""

    values: int
    first: int
    packed: int


class RowGroup(NamedTuple):
    """A row group: its number of rows, and its columns."""

    rows: int
    chunks: tuple[ColumnChunk, ...]


def footer_bytes(file: BinaryIO) -> int:
    """Return the size of the footer, which the end of the file states; 0 if the file does not end like Parquet."""
    file.seek(max(0, file.seek(0, 2) - 8))
    end = file.read(8)
    return int.from_bytes(end[:4], "little") if end[4:] == MAGIC else 0


def row_groups(file: BinaryIO) -> list[RowGroup]:
    """Return the row groups that the footer lists; raise ValueError if there is no valid footer."""
    size = footer_bytes(file)
    if not size or file.seek(0, 2) < size + 8:
        raise ValueError("the file has no footer")
    file.seek(-size - 8, 2)
    try:
        listed, _ = _read(file.read(size), 0, STRUCT, WANTED, MOST_DEPTH)
        return [_group(group) for group in listed.get(GROUPS, [])]
    except (KeyError, TypeError) as error:
        raise ValueError("the footer lacks required fields") from error


def _group(group: Mapping[int, Any]) -> RowGroup:
    return RowGroup(group[ROWS], tuple(_chunk(column[CHUNK]) for column in group[COLUMNS]))


def _chunk(numbers: Mapping[int, int]) -> ColumnChunk:
    """Return a column's chunk; its first page is its dictionary, if it has one."""
    first = min(filter(None, (numbers.get(DICTIONARY_AT), numbers[DATA_AT])), default=0)
    return ColumnChunk(numbers[VALUES], first, numbers[CHUNK_PACKED])


def unpacked_bytes(file: BinaryIO, first: int, packed: int) -> Iterator[int]:
    """Yield the unpacked size of each page in `packed` bytes from offset `first`; raise ValueError for other bytes."""
    at, end = first, first + packed
    while at < end:
        file.seek(at)
        sizes, header = _page_header(file.read(MOST_HEADER_BYTES))
        unpacked, taken = sizes.get(UNPACKED, -1), sizes.get(PACKED, -1)
        if unpacked < 0 or taken < 0 or at + header + taken > end:
            raise ValueError(f"there is no valid page at byte {at}")
        yield unpacked
        at += header + taken


def _page_header(data: bytes) -> tuple[dict[int, int], int]:
    """Return the integers of the page header at the beginning of data, by field, and the header's size."""
    fields: dict[int, int] = {}
    at = field = 0
    while True:
        at, field, kind = _field(data, at, field)
        if not kind:
            return fields, at
        if kind == I32:
            number, at = _varint(data, at)
            fields[field] = (number >> 1) ^ -(number & 1)
        else:
            at = _skip(data, at, kind, MOST_DEPTH)


def _read(data: bytes, at: int, kind: int, wanted: Mapping[int, Any] | None, depth: int) -> tuple[Any, int]:
    """Return a value (a number, a list, or the wanted fields of a struct; None if not wanted) and its end offset."""
    if wanted is None:
        return None, _skip(data, at, kind, depth)
    if not depth:
        raise ValueError("the footer is nested too deeply")
    if kind in (I16, I32, I64):
        number, at = _varint(data, at)
        return (number >> 1) ^ -(number & 1), at
    if kind == STRUCT:
        fields: dict[int, Any] = {}
        field = 0
        while True:
            at, field, inner = _field(data, at, field)
            if not inner:
                return fields, at
            value, at = _read(data, at, inner, wanted.get(field), depth - 1)
            if value is not None:
                fields[field] = value
    if kind in (LIST, SET):
        count, inner, at = _list(data, at)
        values = []
        for _ in range(count):
            value, at = _read(data, at, inner, wanted, depth - 1)
            values.append(value)
        return values, at
    raise ValueError(f"unknown type {kind} of a value")


def _list(data: bytes, at: int) -> tuple[int, int, int]:
    """Return the number of values of a list, their type, and their offset."""
    head, at = _byte(data, at)
    count, kind = head >> 4, head & 15
    if count == 15:
        count, at = _varint(data, at)
    return _within(data, count), kind, at


def _field(data: bytes, at: int, before: int) -> tuple[int, int, int]:
    """Return the offset of the next field's value, the field's number, and its type; type 0 if there is none."""
    head, at = _byte(data, at)
    kind, step = head & 15, head >> 4
    if not kind or step:
        return at, before + step, kind
    number, at = _varint(data, at)
    return at, (number >> 1) ^ -(number & 1), kind


def _skip(data: bytes, at: int, kind: int, depth: int) -> int:
    """Return the end offset of a value."""
    if not depth:
        raise ValueError("a header is nested too deeply")
    if kind in (TRUE, FALSE):
        return at
    if kind in (I16, I32, I64):
        return _varint(data, at)[1]
    if kind in (BYTE, DOUBLE):
        return _within(data, at + (1 if kind == BYTE else 8))
    if kind == BINARY:
        length, at = _varint(data, at)
        return _within(data, at + length)
    if kind == STRUCT:
        field = 0
        while True:
            at, field, inner = _field(data, at, field)
            if not inner:
                return at
            at = _skip(data, at, inner, depth - 1)
    if kind in (LIST, SET):
        count, inner, at = _list(data, at)
        for _ in range(count):
            at = _skip(data, at, BYTE if inner in (TRUE, FALSE) else inner, depth - 1)
        return at
    raise ValueError(f"unknown type {kind} of a value")  # a page header has no map


def _varint(data: bytes, at: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte, at = _byte(data, at)
        number |= (byte & 127) << shift
        if byte < 128:
            return number, at
        shift += 7
        if shift > 63:
            raise ValueError("a number has more than 64 bits")


def _byte(data: bytes, at: int) -> tuple[int, int]:
    return data[_within(data, at + 1) - 1], at + 1


def _within(data: bytes, at: int) -> int:
    if at > len(data):
        raise ValueError("a header does not end")
    return at
