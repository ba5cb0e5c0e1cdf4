"""How many bytes the pages of a Parquet file unpack to, from the headers that stand before them.

Why so: the footer says it too, but says whatever its author wrote, and pyarrow takes the memory that a page announces.
The header of a page cannot lie about it: what unpacks to anything else than it says is refused.

Source: Apache Parquet's thrift file, PageHeader, in Thrift's compact protocol.
"""

from collections.abc import Iterator
from typing import BinaryIO

MOST_HEADER_BYTES = 1 << 16  # with the least and the greatest value of the page; of numbers they take 100
MOST_DEPTH = 8
TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)
UNPACKED, PACKED = 2, 3  # fields of a PageHeader, in bytes


def unpacked_bytes(file: BinaryIO, first: int, packed: int) -> Iterator[int]:
    """What each page unpacks to, of those in `packed` bytes from byte `first` on; ValueError for other bytes."""
    at, end = first, first + packed
    while at < end:
        file.seek(at)
        sizes, header = _page_header(file.read(MOST_HEADER_BYTES))
        unpacked, taken = sizes.get(UNPACKED, -1), sizes.get(PACKED, -1)
        if unpacked < 0 or taken < 0 or at + header + taken > end:
            raise ValueError(f"no page at byte {at}")
        yield unpacked
        at += header + taken


def _page_header(data: bytes) -> tuple[dict[int, int], int]:
    """Whole numbers of the header that data begins with, by their fields, and how many bytes it takes."""
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


def _field(data: bytes, at: int, before: int) -> tuple[int, int, int]:
    """Where the value of the next field begins, its number, and its kind; 0 where there is none."""
    head, at = _byte(data, at)
    kind, step = head & 15, head >> 4
    if not kind or step:
        return at, before + step, kind
    number, at = _varint(data, at)
    return at, (number >> 1) ^ -(number & 1), kind


def _skip(data: bytes, at: int, kind: int, depth: int) -> int:
    """Where a value ends."""
    if not depth:
        raise ValueError("a header that is nested too deeply")
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
        head, at = _byte(data, at)
        count, inner = head >> 4, head & 15
        if count == 15:
            count, at = _varint(data, at)
        for _ in range(_within(data, count)):
            at = _skip(data, at, BYTE if inner in (TRUE, FALSE) else inner, depth - 1)
        return at
    raise ValueError(f"a value of kind {kind}")  # a page header has no map


def _varint(data: bytes, at: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte, at = _byte(data, at)
        number |= (byte & 127) << shift
        if byte < 128:
            return number, at
        shift += 7
        if shift > 63:
            raise ValueError("a number of more than 64 bits")


def _byte(data: bytes, at: int) -> tuple[int, int]:
    return data[_within(data, at + 1) - 1], at + 1


def _within(data: bytes, at: int) -> int:
    if at > len(data):
        raise ValueError("a header that does not end")
    return at
