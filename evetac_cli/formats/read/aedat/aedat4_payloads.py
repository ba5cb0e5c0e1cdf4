"""Decompress packets of AEDAT4 and read their flatbuffers by the schemas of dv-processing.

    uint32 size, uint32 position of the root table, four letters (the kind), tables, vectors
    EVTS   a vector of structs of 16 bytes: int64 t, int16 x, int16 y, bool on
    IMUS   a vector of tables: t, temperature, and three floats each of accelerometer, gyroscope, magnetometer
    TRIG   a vector of tables: t, int8 source
    FRME   a table: t, four more times, int8 format, int16 width and height, two offsets, a vector of bytes
    FTAB   the packet table: a vector of tables: position of the payload, (stream, size), elements, first and last t

Why not faery: it raises every time to the latest before it, so a clock that goes back stops without a message. It also
refuses a whole packet for one event outside the frame. Why not dv-processing: it loops forever on some damaged packets.
A field that a table leaves out is zero. All positions come from the file, so each is checked against its end; a
ValueError or IndexError means that a packet is damaged.
"""

import importlib
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import missing_extra
from evetac_cli.formats.read.damage import most_unpacked_bytes

MOST_BYTES = 1 << 28  # of a packet, decompressed
LEAST_TABLE_BYTES = 16  # minimum per table of a vector: two positions of 4 bytes, and its time or position
PIECE_BYTES = 1 << 20  # decompressed at once: the library allocates this much memory
PLAIN, LZ4, ZSTD = (0,), (1, 2), (3, 4)  # numbers of the compressions
EVENT = np.dtype(
    {"names": ["t", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "u1"], "offsets": [0, 8, 10, 12], "itemsize": 16}
)
AXES = tuple(f"{part}_{axis}" for part in ("accelerometer", "gyroscope", "magnetometer") for axis in "xyz")
# Fields of the tables in order: name and type; None if a field is not read as a number.
FIELDS: dict[str, tuple[tuple[str, str | None], ...]] = {
    "IMUS": (("t", "<i8"), *((name, "<f4") for name in ("temperature", *AXES))),
    "TRIG": (("t", "<i8"), ("source", "<i1")),
    "FTAB": (("byte_offset", "<i8"), ("packet", None), ("elements_count", "<i8"), ("start_t", "<i8"), ("end_t", "<i8")),
}
FORMATS = {0: ("L", 1), 16: ("RGB", 3), 24: ("RGBA", 4)}  # formats of images: name, and bytes per pixel
# Slots of a frame's table.
FRAME_T, FRAME_FORMAT, FRAME_WIDTH, FRAME_HEIGHT, FRAME_PIXELS = 0, 5, 6, 7, 10


class ImageFrame(NamedTuple):
    """An image: its time in us, L, RGB or RGBA, and pixels of shape (rows, columns) or (rows, columns, channels)."""

    t: int
    format: str
    pixels: NDArray[np.uint8]


def check_libraries(where: str) -> None:
    """Raise MissingLibrary if a library that decompresses packets is not installed."""
    try:
        importlib.import_module("lz4.frame")
        importlib.import_module("zstandard")
    except ImportError as error:
        raise missing_extra("AEDAT4 needs lz4 and zstandard", "convert", where=where, error=error) from None


def content(kind: str, compression: int, payload: bytes) -> Any:
    """Return the events, samples or rows of a packet as a structured array, or its frame; ValueError if damaged."""
    try:
        body = _decompressed(compression, payload)
        if body[8:12] != kind.encode():
            raise ValueError(f"a packet does not contain {kind}")
        tables = _Tables(body)
        root = 4 + tables.number("I", 4)
        if kind == "FRME":
            return _frame(tables, root)
        start, count = tables.vector(root, 0)
        if kind == "EVTS":
            return np.frombuffer(body, EVENT, count, start) if count else np.empty(0, EVENT)
        return _rows(tables, start, count, FIELDS[kind])
    except (IndexError, struct.error, OverflowError) as error:
        raise ValueError(f"a position outside the packet ({error})") from None


def _decompressed(compression: int, payload: bytes) -> bytes:
    """Return the decompressed bytes of a packet; raise ValueError if that fails or they are too many."""
    import lz4.frame
    import zstandard

    if compression in PLAIN:
        return payload
    most = min(MOST_BYTES, most_unpacked_bytes(len(payload)))
    try:
        if compression in LZ4:
            decompressor = lz4.frame.LZ4FrameDecompressor()
            parts = [decompressor.decompress(payload, max_length=PIECE_BYTES)]
            while parts[-1] and not decompressor.eof and len(parts) * PIECE_BYTES < most:
                parts.append(decompressor.decompress(b"", max_length=PIECE_BYTES))
            if not decompressor.eof:
                raise ValueError("a compressed packet does not end, or is too large")
            return b"".join(parts) if len(parts) > 1 else bytes(parts[0])
        body = zstandard.ZstdDecompressor().stream_reader(payload).read(most + 1)
    except (RuntimeError, zstandard.ZstdError, MemoryError) as error:
        raise ValueError(str(error)) from None
    if len(body) > most:
        raise ValueError("a compressed packet is too large")
    return body


class _Tables:
    """Reads numbers at any offset of a flatbuffer, one or many at once; IndexError or struct.error outside it."""

    def __init__(self, body: bytes) -> None:
        self.body = body

    def number(self, code: str, at: int) -> int:
        """Return the number at an offset, given its struct code."""
        if at < 0:
            raise IndexError("before the start")
        return int(struct.unpack_from(f"<{code}", self.body, at)[0])

    def place(self, table: int, slot: int) -> int:
        """Return the offset of a table's field; 0 if the table leaves it out."""
        shared = table - self.number("i", table)
        offset = self.number("H", shared + 4 + 2 * slot) if 4 + 2 * slot < self.number("H", shared) else 0
        return table + offset if offset else 0

    def vector(self, table: int, slot: int) -> tuple[int, int]:
        """Return the offset of a vector's first element, and the number of elements."""
        at = self.place(table, slot)
        if not at:
            return 0, 0
        start = at + self.number("I", at)
        return start + 4, self.number("I", start)

    def numbers(self, dtype: str, at: NDArray[np.int64]) -> NDArray[Any]:
        """Return the numbers at many offsets."""
        size = np.dtype(dtype).itemsize
        if len(at) and int(at.min()) < 0:
            raise IndexError("before the start")
        return np.ndarray((max(0, len(self.body) - size + 1),), dtype, self.body, strides=(1,))[at]

    def places(self, tables: NDArray[np.int64], slot: int) -> NDArray[np.int64]:
        """Return the offset of a field in each of many tables; 0 if a table leaves it out."""
        shared = tables - self.numbers("<i4", tables)
        has = np.flatnonzero(4 + 2 * slot < self.numbers("<u2", shared))
        offsets = np.zeros(len(tables), np.int64)
        offsets[has] = self.numbers("<u2", shared[has] + 4 + 2 * slot)
        return np.where(offsets > 0, tables + offsets, 0)

    def values(self, tables: NDArray[np.int64], slot: int, dtype: str) -> NDArray[Any]:
        """Return a number of each of many tables; 0 if a table leaves it out."""
        at = self.places(tables, slot)
        values = np.zeros(len(tables), dtype)
        values[at > 0] = self.numbers(dtype, at[at > 0])
        return values


def _rows(tables: _Tables, start: int, count: int, fields: Sequence[tuple[str, str | None]]) -> Any:
    """Return a vector of tables as a structured array; raise ValueError if the packet is too small for them."""
    if count * LEAST_TABLE_BYTES > len(tables.body):
        raise ValueError(f"{count:,} tables do not fit into {len(tables.body):,} bytes")
    at = (
        np.frombuffer(tables.body, "<u4", count, start) + start + 4 * np.arange(count)
        if count
        else np.empty(0, np.int64)
    )
    columns: dict[str, Any] = {}
    for slot, (name, dtype) in enumerate(fields):
        if dtype is not None:
            columns[name] = tables.values(at, slot, dtype)
        else:  # a struct of two int32 inside the table
            places = tables.places(at, slot)
            columns["track_id"], columns["size"] = (tables.numbers("<i4", places + 4 * part) for part in (0, 1))
            columns["track_id"] = np.where(places > 0, columns["track_id"], -1)
    rows = np.empty(count, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def _frame(tables: _Tables, root: int) -> ImageFrame:
    t, format_, width, height = (
        tables.number(code, at) if (at := tables.place(root, slot)) else 0
        for code, slot in (("q", FRAME_T), ("b", FRAME_FORMAT), ("h", FRAME_WIDTH), ("h", FRAME_HEIGHT))
    )
    if format_ not in FORMATS or width < 0 or height < 0:
        raise ValueError(f"a frame has the impossible size or format {width} x {height} px, {format_}")
    name, channels = FORMATS[format_]
    start, count = tables.vector(root, FRAME_PIXELS)
    if count != width * height * channels:
        raise ValueError(f"a frame of {width} x {height} px of {channels} bytes has {count} bytes")
    pixels = np.frombuffer(tables.body, np.uint8, count, start) if count else np.empty(0, np.uint8)
    if channels == 1:
        return ImageFrame(t, name, pixels.reshape(height, width))
    shown = [2, 1, 0, 3][:channels]  # they are stored as blue, green, red
    return ImageFrame(t, name, np.ascontiguousarray(pixels.reshape(height, width, channels)[:, :, shown]))
