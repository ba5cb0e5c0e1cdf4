"""Locate the packets of AEDAT4 files (iniVation).

    "#!AER-DAT4.0\\r\\n", uint32 size, header: a flatbuffer of compression, position of the packet table, XML of streams
    packets, each: int32 stream, int32 size, payload (a compressed flatbuffer, aedat4_payloads)
    packet table, only in files that were closed

If a file has lost its packet table (its recorder was killed, or a copy was cut), all packets are still read. If headers
of packets are damaged, the packet table leads past them. The packets have no checksum: a damaged one may decode to
other events, and if their times are impossible the whole file is refused.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from xml.etree import ElementTree

from evetac_cli.errors import InputError
from evetac_cli.formats.note import NAME
from evetac_cli.formats.read.aedat.aedat4_payloads import LZ4, PLAIN, ZSTD, content
from evetac_cli.formats.read.damage import refuse_too_much

MAGIC = b"#!AER-DAT4.0\r\n"
HEADER_LIMIT_BYTES = 1 << 24
TABLE_LIMIT_BYTES = 1 << 28  # 40 bytes per packet before compression, some 100 packets per second
KINDS = {"EVTS": "events", "FRME": "frames", "IMUS": "IMU samples", "TRIG": "triggers"}


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


class Span(NamedTuple):
    """A packet's payload: its bytes [start, stop) in the file."""

    start: int
    stop: int


@dataclass(frozen=True)
class Packets:
    """The complete packets of one stream, and the end of the walk over all packets."""

    spans: list[Span]
    end: int
    whole: bool  # the walk ended at the end of the file's packets
    counts: dict[int, int]  # packets of every stream, by its number


def read_header(handle: BinaryIO, where: str) -> Header:
    """Read the header; raise InputError if it is damaged or not that of an AEDAT4 file."""
    start = handle.read(len(MAGIC) + 4)
    size = int.from_bytes(start[len(MAGIC) :], "little")
    body = handle.read(min(size, HEADER_LIMIT_BYTES))
    if len(start) < len(MAGIC) + 4 or len(body) < size:
        raise InputError(
            "the AEDAT4 file ends inside its header",
            where=where,
            hint="is the file complete? compare its size with that of the original",
        )
    try:
        root = _unpack("<I", body, 0)
        fields = root - _unpack("<i", body, root)
        slots = (_unpack("<H", body, fields) - 4) // 2
        offsets = [_unpack("<H", body, fields + 4 + 2 * slot) for slot in range(min(slots, 3))] + [0, 0, 0]
        compression = _unpack("<i", body, root + offsets[0]) if offsets[0] else 0
        if compression not in (*PLAIN, *LZ4, *ZSTD):
            raise ValueError(f"unknown compression {compression}")
        table = _unpack("<q", body, root + offsets[1]) if offsets[1] else -1
        text = root + offsets[2] + _unpack("<I", body, root + offsets[2])
        xml = body[text + 4 : text + 4 + _unpack("<I", body, text)].decode()
        streams = list(_streams(xml)) if offsets[2] else []
    except (struct.error, ValueError, ElementTree.ParseError) as error:
        raise InputError("the header of the AEDAT4 file is damaged", where=where, found=str(error)) from error
    return Header(len(start) + size, compression, table, streams)


def _unpack(code: str, body: bytes, at: int) -> int:
    if at < 0:
        raise ValueError("a position is before the start of the header")
    return int(struct.unpack_from(code, body, at)[0])


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
    numbers = {stream.number for stream in header.streams}
    spans: list[Span] = []
    counts = dict.fromkeys(numbers, 0)
    at = header.size
    while at < min(stop, size):
        handle.seek(at)
        head = handle.read(8)
        if len(head) < 8:
            break
        stream, length = struct.unpack("<ii", head)
        if stream not in numbers or length <= 0 or at + 8 + length > min(stop, size):
            break
        counts[stream] += 1
        if stream == number:
            spans.append(Span(at + 8, at + 8 + length))
        at += 8 + length
    return Packets(spans, at, whole=at == stop, counts=counts)


def listed_spans(handle: BinaryIO, header: Header, number: int) -> list[Span] | None:
    """Return the packets of one stream that the packet table lists; None if the table is missing or damaged."""
    rows = packet_table(handle, header)
    if rows is None:
        return None
    spans: list[Span] = []
    end = header.size
    for start, length in rows[rows["track_id"] == number][["byte_offset", "size"]].tolist():
        if start - 8 < end or start + length > header.table or length <= 0:
            return None
        end = start + length
        spans.append(Span(start, end))
    return spans


def packet_table(handle: BinaryIO, header: Header) -> Any | None:
    """Return the rows of the packet table; None if it is missing or damaged."""
    size = handle.seek(0, 2)
    if not header.size <= header.table < size:
        return None
    handle.seek(header.table)
    try:
        rows = content("FTAB", header.compression, handle.read(min(size - header.table, TABLE_LIMIT_BYTES)))
    except ValueError:
        return None
    return rows[rows["track_id"] >= 0]


def is_whole(path: Path) -> bool:
    """Whether a file was closed, its packets are complete and its table lists all (packets are not decoded)."""
    with path.open("rb") as handle:
        header = read_header(handle, str(path))
        if header.table < 0:
            return False
        walks = {stream.number: walk(handle, header, stream.number) for stream in header.streams}
        return all(walk.whole and listed_spans(handle, header, number) == walk.spans for number, walk in walks.items())


def decoded(handle: BinaryIO, spans: Iterable[Span], kind: str, compression: int) -> Iterator[Any]:
    """Yield the content of each packet (aedat4_payloads.content), or a text on why it cannot be decoded.

    Raises InputError if events or samples unpack to more than a file of this size can contain. Images are exempt,
    because a dark image may compress that well.
    """
    size, unpacked = handle.seek(0, 2), 0
    for span in spans:
        handle.seek(span.start)
        payload = handle.read(span.stop - span.start)
        try:
            packet_content = content(kind, compression, payload)
        except ValueError as error:
            yield str(error)
            continue
        if kind != "FRME":
            unpacked += packet_content.nbytes
            refuse_too_much(unpacked, size, handle.name)
        yield packet_content
