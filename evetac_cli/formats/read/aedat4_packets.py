"""Read the packets of AEDAT4 files (iniVation): locate, decompress and decode them by the schemas of dv-processing.

    "#!AER-DAT4.0\\r\\n", uint32 size, header: a flatbuffer of compression, position of the packet table, XML of streams
    packets, each: int32 stream, int32 size, payload, a compressed flatbuffer
    packet table, only in files that were closed; it is not read

    payload: uint32 size, uint32 position of the root table, four letters (the kind), tables, vectors
    EVTS   a vector of structs of 16 bytes: int64 t, int16 x, int16 y, bool on
    IMUS   a vector of tables: t, temperature, and three floats each of accelerometer, gyroscope, magnetometer
    TRIG   a vector of tables: t, int8 source
    FRME   a table: t, four more times, int8 format, int16 width and height, two offsets, a vector of bytes

If a file was never closed or its end is missing, all complete packets are read. The packets have no checksum: a damaged
one may decode to other events, and if their times are impossible the whole file is refused. A field that a table leaves
out is zero. All positions come from the file, so each is checked against its end.

Why not faery: it raises every time to the latest before it, so a clock that goes back stops without a message. It also
refuses a whole packet for one event outside the frame. Why not dv-processing: it loops forever on some damaged packets.
"""

import importlib
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.formats.note import NAME
from evetac_cli.formats.read.damage import most_unpacked_bytes, refuse_too_much

MAGIC = b"#!AER-DAT4.0\r\n"
HEADER_LIMIT_BYTES = 1 << 24
KINDS = {"EVTS": "events", "FRME": "frames", "IMUS": "IMU samples", "TRIG": "triggers"}
MOST_BYTES = 1 << 28  # of a packet, decompressed
LEAST_TABLE_BYTES = 16  # minimum per table of a vector: two positions of 4 bytes, and its time
PIECE_BYTES = 1 << 20  # decompressed at once: the library allocates this much memory
PLAIN, LZ4, ZSTD = (0,), (1, 2), (3, 4)  # numbers of the compressions
EVENT = np.dtype(
    {"names": ["t", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "u1"], "offsets": [0, 8, 10, 12], "itemsize": 16}
)
AXES = tuple(f"{part}_{axis}" for part in ("accelerometer", "gyroscope", "magnetometer") for axis in "xyz")
# Fields of the tables in order.
FIELDS = {
    "IMUS": np.dtype([("t", "<i8"), *((name, "<f4") for name in ("temperature", *AXES))]),
    "TRIG": np.dtype([("t", "<i8"), ("source", "<i1")]),
}
CHANNELS = {0: 1, 16: 3, 24: 4}  # bytes per pixel of the formats of images: grey; blue, green, red; and with opacity
FRAME_SLOTS, FRAME_PIXELS = (("q", 0), ("b", 5), ("h", 6), ("h", 7)), 10  # t, format, width, height in a frame's table


@dataclass(frozen=True)
class PacketStream:
    """One stream as the header describes it."""

    number: int
    kind: str  # four letters, EVTS for events
    name: str
    camera: str
    frame_px: tuple[int, int] | None
    note: str  # evetac's note, empty in files of other programs


@dataclass(frozen=True)
class Header:
    """Streams, the compression of packets, and the position of the packet table (-1: never written)."""

    size: int
    compression: int
    table: int
    streams: list[PacketStream]


@dataclass(frozen=True)
class Packets:
    """The complete packets of one stream, and the end of the walk over all packets."""

    spans: list[tuple[int, int]]  # the bytes [start, stop) of each packet's payload
    end: int
    whole: bool  # the walk ended at the end of the file's packets, and their table follows, if it was written
    counts: dict[int, int]  # packets of every stream, by its number


def check_libraries(where: str) -> None:
    """Raise MissingLibrary if a library that decompresses packets is not installed."""
    with needs_extra("AEDAT4 needs lz4 and zstandard", "convert", where):
        importlib.import_module("lz4.frame")
        importlib.import_module("zstandard")


def read_header(handle: BinaryIO, where: str) -> Header:
    """Read the header; raise InputError if it is damaged or not that of an AEDAT4 file."""
    start = handle.read(len(MAGIC) + 4)
    size = int.from_bytes(start[len(MAGIC) :], "little")
    body = handle.read(min(size, HEADER_LIMIT_BYTES))
    if len(start) < len(MAGIC) + 4 or len(body) < size:
        raise InputError("the AEDAT4 file ends inside its header", where=where, hint="copy it again from the original")
    try:
        tables = _Tables(body)
        root = tables.number("I", 0)
        compression, table = (tables.field(root, slot, code) for slot, code in ((0, "i"), (1, "q")))
        if compression not in (*PLAIN, *LZ4, *ZSTD):
            raise ValueError(f"unknown compression {compression}")
        text, length = tables.vector(root, 2)
        streams = list(_streams(body[text : text + length].decode())) if text else []
    except (struct.error, IndexError, ValueError, ElementTree.ParseError) as error:
        raise InputError("the header of the AEDAT4 file is damaged", where=where, found=str(error)) from error
    return Header(len(start) + size, compression, table if tables.place(root, 1) else -1, streams)


def _streams(xml: str) -> Iterator[PacketStream]:
    """Yield the streams from the tree of settings that the recorder wrote into the header."""
    for node in ElementTree.fromstring(xml).iter("node"):
        settings = {attr.get("key", ""): attr.text or "" for attr in node.findall("attr")}
        if "typeIdentifier" not in settings:
            continue
        info = {attr.get("key", ""): attr.text or "" for attr in node.findall("node[@name='info']/attr")}
        frame = (int(info["sizeX"]), int(info["sizeY"])) if "sizeX" in info and "sizeY" in info else None
        name = settings.get("originalOutputName", "events")
        number, note = int(node.get("name", "")), info.get(NAME, "")
        yield PacketStream(number, settings["typeIdentifier"], name, info.get("source", ""), frame, note)


def walk(handle: BinaryIO, header: Header, number: int) -> Packets:
    """Walk from packet to packet until one is incomplete or invalid."""
    size = handle.seek(0, 2)
    stop = header.table if header.table >= 0 else size
    counts = {stream.number: 0 for stream in header.streams}
    spans: list[tuple[int, int]] = []
    at = header.size
    while at + 8 <= min(stop, size):
        handle.seek(at)
        stream, length = struct.unpack("<ii", handle.read(8))
        if stream not in counts or length <= 0 or at + 8 + length > min(stop, size):
            break
        counts[stream] += 1
        if stream == number:
            spans.append((at + 8, at + 8 + length))
        at += 8 + length
    return Packets(spans, at, whole=at == stop and header.table < size, counts=counts)


def decoded(handle: BinaryIO, spans: Iterable[tuple[int, int]], kind: str, compression: int) -> Iterator[Any]:
    """Yield the content of each packet, or a text on why it cannot be decoded.

    Raises InputError if events or samples unpack to more than a file of this size can contain. Images are exempt,
    because a dark image may compress that well.
    """
    size, unpacked = handle.seek(0, 2), 0
    for start, stop in spans:
        handle.seek(start)
        payload = handle.read(stop - start)
        try:
            packet_content = content(kind, compression, payload)
        except ValueError as error:
            yield str(error)
            continue
        if kind != "FRME":
            unpacked += packet_content.nbytes
            refuse_too_much(unpacked, size, handle.name)
        yield packet_content


def content(kind: str, compression: int, payload: bytes) -> Any:
    """Return the events or samples of a packet as a structured array, or time and image of a frame.

    Raises ValueError if the packet is damaged.
    """
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
        if compression in ZSTD:
            body = zstandard.ZstdDecompressor().stream_reader(payload).read(most + 1)
        else:
            decompressor = lz4.frame.LZ4FrameDecompressor()
            parts = [decompressor.decompress(payload, max_length=PIECE_BYTES)]
            while parts[-1] and not decompressor.eof and len(parts) * PIECE_BYTES <= most:
                parts.append(decompressor.decompress(b"", max_length=PIECE_BYTES))
            if not decompressor.eof and len(parts) * PIECE_BYTES <= most:
                raise ValueError("a compressed packet does not end")
            body = b"".join(parts)
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

    def field(self, table: int, slot: int, code: str) -> int:
        """Return the number in a table's field; 0 if the table leaves it out."""
        at = self.place(table, slot)
        return self.number(code, at) if at else 0

    def vector(self, table: int, slot: int) -> tuple[int, int]:
        """Return the offset of a vector's first element, and the number of elements."""
        at = self.place(table, slot)
        if not at:
            return 0, 0
        start = at + self.number("I", at)
        return start + 4, self.number("I", start)

    def numbers(self, dtype: Any, at: NDArray[np.int64]) -> NDArray[Any]:
        """Return the numbers at many offsets."""
        if len(at) and int(at.min()) < 0:
            raise IndexError("before the start")
        return np.ndarray((max(0, len(self.body) - np.dtype(dtype).itemsize + 1),), dtype, self.body, strides=(1,))[at]

    def values(self, tables: NDArray[np.int64], slot: int, dtype: Any) -> NDArray[Any]:
        """Return a number of each of many tables; 0 if a table leaves it out."""
        shared = tables - self.numbers("<i4", tables)
        has = np.flatnonzero(4 + 2 * slot < self.numbers("<u2", shared))
        offsets = self.numbers("<u2", shared[has] + 4 + 2 * slot)
        has, offsets = has[offsets > 0], offsets[offsets > 0]
        values = np.zeros(len(tables), dtype)
        values[has] = self.numbers(dtype, tables[has] + offsets)
        return values


def _rows(tables: _Tables, start: int, count: int, fields: np.dtype[Any]) -> Any:
    """Return a vector of tables as a structured array; raise ValueError if the packet is too small for them."""
    if count * LEAST_TABLE_BYTES > len(tables.body):
        raise ValueError(f"{count:,} tables do not fit into {len(tables.body):,} bytes")
    rows = np.empty(count, fields)
    if count:
        at = np.frombuffer(tables.body, "<u4", count, start) + start + 4 * np.arange(count)
        for slot, name in enumerate(fields.names or ()):
            rows[name] = tables.values(at, slot, fields[name])
    return rows


def _frame(tables: _Tables, root: int) -> tuple[int, NDArray[np.uint8]]:
    """Return the time in us and the pixels (rows, columns, 1 or 3), grey or red, green, blue, of a frame."""
    t, format_, width, height = (tables.field(root, slot, code) for code, slot in FRAME_SLOTS)
    channels = CHANNELS.get(format_, 0)
    start, count = tables.vector(root, FRAME_PIXELS)
    if not channels or width < 0 or height < 0 or count != width * height * channels:
        raise ValueError(f"a frame of {width} x {height} px of format {format_} has {count} bytes")
    pixels = np.frombuffer(tables.body, np.uint8, count, start) if count else np.empty(0, np.uint8)
    shown = [0] if channels == 1 else [2, 1, 0]
    return t, np.ascontiguousarray(pixels.reshape(height, width, channels)[:, :, shown])
