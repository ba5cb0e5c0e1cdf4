"""The packets of AEDAT4 files (iniVation): where they lie, and what faery, the extra `convert`, makes of them.

    "#!AER-DAT4.0\\r\\n", uint32 size, header: a flatbuffer of compression, position of the packet table, XML of streams
    packets, each: int32 stream, int32 size, payload (a compressed flatbuffer)
    packet table, only in files that were closed

Why the frame of the file is read here, and faery gets a few packets at a time, in a file of their own:

- faery reads as far as the packet table, so of a file that lost its table (a recorder that was killed, a copy that was
  cut) it gives nothing, and it ends at the first damaged packet;
- it refuses a whole packet where one event lies outside the frame, so it is given the largest frame;
- where time goes backwards in a stream it repeats the latest time without a word: so each packet is a stream of its
  own, and this happens only inside a packet.

Where the headers of packets are damaged, the packet table leads past them.

Why in this process: faery 0.7.1 read or refused every one of 84,000 damaged packets (plain, LZ4, zstd), none in more
than 0.5 s; dv-processing 2.0.4 loops for ever on some. Cameras' packets carry no checksum: a damaged one may decode to
other events, and where their times are impossible the whole file is refused.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.formats.note import NAME
from evetac_cli.formats.read.faery_library import refusal_text, scratch_file

EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])  # as faery reads and writes them
MAGIC = b"#!AER-DAT4.0\r\n"
NO_TABLE = struct.pack("<q", -1)
HEADER_LIMIT_BYTES = 1 << 24
TABLE_LIMIT_BYTES = 1 << 28  # 40 bytes a packet before compression, some 100 packets a second
LARGEST_FRAME_PX = (32767, 32767)  # what faery takes
COMPRESSIONS = {0: None, 1: ("lz4", 1), 2: ("lz4", 1), 3: ("zstd", 3), 4: ("zstd", 3)}  # 2, 4: slower to write
PACKETS_AT_ONCE = 32
EMPTY_PACKET = "empty events packet"  # what faery says of a packet without events, which is not damage
KINDS = {"EVTS": "events", "FRME": "frames", "IMUS": "IMU samples", "TRIG": "triggers"}


@dataclass(frozen=True)
class Stream:
    """One stream as the header describes it."""

    number: int
    kind: str  # four letters, EVTS for events
    name: str
    camera: str
    frame_px: tuple[int, int] | None
    note: str  # what evetac wrote into it, empty in files of other programs


@dataclass(frozen=True)
class Header:
    """Streams, how packets are compressed, and the position of the packet table (-1: never written)."""

    size: int
    compression: int
    table: int
    streams: list[Stream]


class Span(NamedTuple):
    """A packet's payload: its bytes [start, stop) in the file."""

    start: int
    stop: int


@dataclass(frozen=True)
class Packets:
    """The complete packets of one stream, and where the walk over all packets ended."""

    spans: list[Span]
    end: int
    whole: bool  # the walk ended where the packets of the file end
    counts: dict[int, int]  # packets of every stream, by its number


def read_header(handle: BinaryIO, where: str) -> Header:
    """Read the header; anything odd in it means that the file is damaged or no AEDAT4 file."""
    start = handle.read(len(MAGIC) + 4)
    size = int.from_bytes(start[len(MAGIC) :], "little")
    body = handle.read(min(size, HEADER_LIMIT_BYTES))
    if len(start) < len(MAGIC) + 4 or len(body) < size:
        raise InputError("the AEDAT4 file ends inside its header", where=where, hint="copy it again")
    try:
        root = _unpack("<I", body, 0)
        fields = root - _unpack("<i", body, root)
        slots = (_unpack("<H", body, fields) - 4) // 2
        offsets = [_unpack("<H", body, fields + 4 + 2 * slot) for slot in range(min(slots, 3))] + [0, 0, 0]
        compression = _unpack("<i", body, root + offsets[0]) if offsets[0] else 0
        if compression not in COMPRESSIONS:
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
        raise ValueError("a position before the start of the header")
    return int(struct.unpack_from(code, body, at)[0])


def _streams(xml: str) -> Iterator[Stream]:
    """Streams from the tree of settings that the recorder left in the header."""
    for node in ElementTree.fromstring(xml).iter("node"):
        settings = {attr.get("key", ""): attr.text or "" for attr in node.findall("attr")}
        if "typeIdentifier" not in settings:
            continue
        info = {attr.get("key", ""): attr.text or "" for attr in node.findall("node[@name='info']/attr")}
        frame = (int(info["sizeX"]), int(info["sizeY"])) if "sizeX" in info and "sizeY" in info else None
        name = settings.get("originalOutputName", "events")
        number, note = int(node.get("name", "")), info.get(NAME, "")
        yield Stream(number, settings["typeIdentifier"], name, info.get("source", ""), frame, note)


def walk(handle: BinaryIO, header: Header, number: int) -> Packets:
    """Go from packet to packet until one is not complete or makes no sense."""
    size = handle.seek(0, 2)
    stop = header.table if header.table >= 0 else size
    known = {stream.number for stream in header.streams}
    spans: list[Span] = []
    counts = dict.fromkeys(known, 0)
    at = header.size
    while at < min(stop, size):
        handle.seek(at)
        head = handle.read(8)
        if len(head) < 8:
            break
        stream, length = struct.unpack("<ii", head)
        if stream not in known or length <= 0 or at + 8 + length > min(stop, size):
            break
        counts[stream] += 1
        if stream == number:
            spans.append(Span(at + 8, at + 8 + length))
        at += 8 + length
    return Packets(spans, at, whole=at == stop, counts=counts)


def listed_spans(handle: BinaryIO, header: Header, number: int) -> list[Span] | None:
    """The packets of one stream as the packet table lists them, None where there is no table or it is damaged."""
    rows = packet_table(handle, header)
    if rows is None:
        return None
    spans: list[Span] = []
    end = header.size
    for row in rows:
        if row.track_id == number:
            if row.byte_offset - 8 < end or row.byte_offset + row.size > header.table or row.size <= 0:
                return None
            end = row.byte_offset + row.size
            spans.append(Span(row.byte_offset, end))
    return spans


def packet_table(handle: BinaryIO, header: Header) -> list[Any] | None:
    """The rows of the packet table, None where there is no table or it is damaged."""
    size = handle.seek(0, 2)
    if not header.size <= header.table < size:
        return None
    handle.seek(header.table)
    table = handle.read(min(size - header.table, TABLE_LIMIT_BYTES))
    with scratch_file(".aedat4") as (copy, file):
        start = first_bytes(copy, header.compression)
        position = len(start).to_bytes(8, "little")
        _replace(file, start.replace(NO_TABLE, position, 1) + table)
        try:
            with _aedat().Decoder(copy) as decoder:
                return list(decoder.file_data_definitions())
        except BaseException as error:
            refusal_text(error)
            return None


def is_whole(path: Path) -> bool:
    """Whether a file was closed, its packets are complete and its packet table lists them all (nothing is decoded)."""
    with path.open("rb") as handle:
        header = read_header(handle, str(path))
        if header.table < 0:
            return False
        walks = {stream.number: walk(handle, header, stream.number) for stream in header.streams}
        return all(walk.whole and listed_spans(handle, header, number) == walk.spans for number, walk in walks.items())


def _replace(file: IO[bytes], content: bytes) -> None:
    """Write a file anew."""
    file.seek(0)
    file.write(content)
    file.truncate()
    file.flush()


def decoded(handle: BinaryIO, spans: list[Span], start: bytes, copy: Path, file: IO[bytes]) -> Iterator[Any]:
    """What each packet holds, an array or a frame, or a text why it cannot be decoded.

    `copy` is the `file` that faery reads them from, and `start` its first bytes.

    Some packets together, because a file for each takes longer than decoding it; each alone where one is damaged.
    """
    for begin in range(0, len(spans), PACKETS_AT_ONCE):
        payloads = []
        for span in spans[begin : begin + PACKETS_AT_ONCE]:
            handle.seek(span.start)
            payloads.append(handle.read(span.stop - span.start))
        try:
            together = _decode(start, payloads, copy, file)
        except BaseException as error:
            refusal_text(error)
            together = []
        if len(together) == len(payloads):
            yield from together
        else:
            yield from (_decode_alone(start, payload, copy, file) for payload in payloads)


def _decode(start: bytes, payloads: list[bytes], copy: Path, file: IO[bytes]) -> list[Any]:
    """What at most PACKETS_AT_ONCE packets hold, each in a stream of its own; or whatever faery raises."""
    packets = (struct.pack("<ii", stream, len(payload)) + payload for stream, payload in enumerate(payloads))
    _replace(file, start + b"".join(packets))
    with _aedat().Decoder(copy) as decoder:
        return [content for _, content in decoder]


def _decode_alone(start: bytes, payload: bytes, copy: Path, file: IO[bytes]) -> Any:
    """What a packet holds, or why it cannot be decoded."""
    try:
        decoded = _decode(start, [payload], copy, file)
        return decoded[0] if decoded else "the decoder stopped"
    except BaseException as error:
        trouble = refusal_text(error)
    return np.empty(0, EVENT) if trouble == EMPTY_PACKET else trouble


def first_bytes(path: Path, compression: int, kind: str = "EVTS") -> bytes:
    """The bytes before the packets of a file of PACKETS_AT_ONCE streams of a kind, without a packet table.

    faery writes them to `path`.
    """
    said = description(LARGEST_FRAME_PX, streams=PACKETS_AT_ONCE, kind=kind)
    with _aedat().Encoder(path, said, COMPRESSIONS[compression]):
        pass
    with path.open("rb") as handle:
        header = read_header(handle, str(path))
        handle.seek(0)
        return handle.read(header.size).replace(struct.pack("<q", header.table), NO_TABLE, 1)


def description(frame_px: tuple[int, int], note: str = "", streams: int = 1, kind: str = "EVTS") -> list[Any]:
    """What the header of a file with streams of a kind says, as faery takes it (which writes texts as they are)."""
    aedat = _aedat()

    def node(path: str, attributes: dict[str, int | str], *nodes: Any) -> Any:
        types = {int: "int", str: "string"}
        values = {
            key: aedat.DescriptionAttribute(types[type(value)], escape(value) if isinstance(value, str) else value)
            for key, value in attributes.items()
        }
        return aedat.DescriptionNode(path.rstrip("/").rpartition("/")[2], path, values, list(nodes))

    top = "/mainloop/Recorder/outInfo/"
    info: dict[str, int | str] = {"sizeX": frame_px[0], "sizeY": frame_px[1], "source": "evetac"}
    stream: dict[str, int | str] = {"originalOutputName": "events", "typeIdentifier": kind}
    noted = info | ({NAME: note} if note else {})
    nodes = [node(f"{top}{number}/", stream, node(f"{top}{number}/info/", noted)) for number in range(streams)]
    return [node(top, {}, *nodes)]


def _aedat() -> Any:
    """The part of faery that reads and writes AEDAT4."""
    from faery.extension import aedat

    return aedat
