"""Read events from AEDAT4 files (iniVation) with dv-processing, the extra `camera`.

The container is simple, so its frame is read here: which streams there are, and where their packets begin and end. That
tells a whole file from a broken one and lets the intact packets of a broken one be kept. Only the packets themselves
(compressed flatbuffers) need the library.

    "#!AER-DAT4.0\\r\\n", uint32 size, header: a flatbuffer of compression, place of the packet table, XML of streams
    packets, each: int32 stream, int32 size, payload
    packet table, only in files that were closed
"""

import signal
import struct
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.note import NAME, read_note
from evetac_cli.formats.read import read_aedat4_child
from evetac_cli.formats.read.event_validation import Columns, Foreign, at_index, frame_of
from evetac_cli.formats.read.read_aedat4_child import EVENT

MAGIC = b"#!AER-DAT4.0\r\n"
HEADER_LIMIT_BYTES = 1 << 24
PACKET_CPU_S = 3  # a packet takes milliseconds
SCAN_BYTES_PER_S = 10_000_000  # without a packet table the library reads the whole file first, 40 times as fast
KINDS = {"EVTS": "events", "FRME": "frames", "IMUS": "IMU samples", "TRIG": "triggers"}


@dataclass(frozen=True)
class Stream:
    """One stream as the header describes it."""

    number: int
    kind: str  # four letters, EVTS for events
    name: str
    camera: str
    frame_px: tuple[int, int] | None
    note: str  # what evetac wrote there, if it did


@dataclass(frozen=True)
class Header:
    """Streams, and where the packet table is: `table` its position (-1: never written), kept at byte `table_at`."""

    size: int
    table: int
    table_at: int | None
    streams: list[Stream]


@dataclass(frozen=True)
class Packets:
    """The complete packets of one stream as (start, stop) in bytes, and where the walk over all packets ended."""

    spans: list[tuple[int, int]]
    end: int
    whole: bool  # the walk ended where the packets of the file end


def open_aedat4(path: Path, frame_px: tuple[int, int] | None, stream: str | None) -> Foreign:
    """Events of the stream with this name, or of the first by name; frame_px only for files that do not say theirs."""
    where = str(path)
    with path.open("rb") as handle:
        header = _header(handle, where)
        label, chosen, others = _choose(header, stream, where)
        packets = _walk(handle, header, chosen.number)
    foreign = Foreign("aedat4", frame_of(chosen.frame_px, frame_px, where), ())
    foreign.note = read_note(chosen.note, where) if chosen.note else None
    if others:
        foreign.notes.append(f"took the event stream {label}; also there: {', '.join(others)} (choose with --stream)")
    if packets.spans or not packets.whole or header.table < 0:
        foreign.batches = _columns(_decode(path, header, chosen, packets, foreign))
    return foreign


def is_whole(path: Path) -> bool:
    """Whether a file was closed and all its packets are complete, as far as its frame tells (nothing is decoded)."""
    with path.open("rb") as handle:
        header = _header(handle, str(path))
        return header.table >= 0 and all(_walk(handle, header, stream.number).whole for stream in header.streams)


def _columns(packets: "deque[NDArray[np.void]]") -> Iterator[Columns]:
    """Hand the packets over one by one, letting go of each."""
    start = 0
    while packets:
        packet = packets.popleft()
        yield Columns(packet["t"], packet["x"], packet["y"], packet["p"], partial(at_index, start))
        start += len(packet)


def _choose(header: Header, wanted: str | None, where: str) -> tuple[str, Stream, list[str]]:
    """Label of the stream, the stream, and the labels of the other event streams.

    A label is the stream's name, with the camera before it (`camera/name`) where the file has several cameras.
    """
    found = [stream for stream in header.streams if stream.kind == "EVTS"]
    if not found:
        kinds = dict.fromkeys(KINDS.get(stream.kind, stream.kind) for stream in header.streams)
        raise InputError(f"holds {' and '.join(kinds) or 'no stream at all'} but no event stream", where=where)
    several = len({stream.camera for stream in found}) > 1
    labels = {f"{stream.camera}/{stream.name}" if several else stream.name: stream for stream in found}
    label = min(labels) if wanted is None else wanted
    if label not in labels:
        raise InputError("no such event stream", where=where, expected=" or ".join(sorted(labels)), found=label)
    return label, labels[label], sorted(set(labels) - {label})


def _header(handle: BinaryIO, where: str) -> Header:
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
        table = _unpack("<q", body, root + offsets[1]) if offsets[1] else -1
        text = root + offsets[2] + _unpack("<I", body, root + offsets[2])
        xml = body[text + 4 : text + 4 + _unpack("<I", body, text)].decode()
        streams = list(_streams(xml)) if offsets[2] else []
    except (struct.error, ValueError, ElementTree.ParseError) as error:
        raise InputError("the header of the AEDAT4 file is damaged", where=where, found=str(error)) from error
    return Header(len(start) + size, table, len(start) + root + offsets[1] if offsets[1] else None, streams)


def _unpack(code: str, body: bytes, at: int) -> int:
    if at < 0:
        raise ValueError("a position before the start of the header")
    return int(struct.unpack_from(code, body, at)[0])


def _streams(xml: str) -> Iterator[Stream]:
    """Streams from the tree of settings that the recorder left in the header."""
    for node in ElementTree.fromstring(xml).iter("node"):
        said = {attr.get("key", ""): attr.text or "" for attr in node.findall("attr")}
        if "typeIdentifier" not in said:
            continue
        info = {attr.get("key", ""): attr.text or "" for attr in node.findall("node[@name='info']/attr")}
        frame = (int(info["sizeX"]), int(info["sizeY"])) if "sizeX" in info and "sizeY" in info else None
        name = said.get("originalOutputName", "events")
        number, note = int(node.get("name", "")), info.get(NAME, "")
        yield Stream(number, said["typeIdentifier"], name, info.get("source", ""), frame, note)


def _walk(handle: BinaryIO, header: Header, number: int) -> Packets:
    """Go from packet to packet until one is not complete or makes no sense."""
    size = handle.seek(0, 2)
    stop = header.table if header.table >= 0 else size
    known = {stream.number for stream in header.streams}
    spans: list[tuple[int, int]] = []
    at = header.size
    while at < min(stop, size):
        handle.seek(at)
        head = handle.read(8)
        if len(head) < 8:
            break
        stream, length = struct.unpack("<ii", head)
        if stream not in known or length <= 0 or at + 8 + length > min(stop, size):
            break
        if stream == number:
            spans.append((at, at + 8 + length))
        at += 8 + length
    return Packets(spans, at, whole=at == stop)


def _decode(
    path: Path, header: Header, chosen: Stream, packets: Packets, foreign: Foreign
) -> "deque[NDArray[np.void]]":
    """Decode as much of the stream as there is; `foreign` is told what is missing, nothing at all is an InputError.

    A closed file is read as it is. Where that does not give every packet, the packets that are complete are copied into
    a file without a packet table, which the library then has to go through one by one.
    """
    where = str(path)
    notes = foreign.notes
    size = path.stat().st_size
    count = len(packets.spans)
    events: deque[NDArray[np.void]] = deque()
    trouble = "its packet table is missing"
    if 0 <= header.table < size:
        events, trouble = _run(path, header, chosen, where)
        if not trouble and (len(events) == count if packets.whole else len(events) > count):
            if not packets.whole:
                notes.append(f"a packet at byte {packets.end} is damaged; the packet table led past it")
            return events
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "intact.aedat4"
        _copy_intact(path, copy, header, packets)
        again, trouble_again = _run(copy, header, chosen, where) if count else (deque(), "no packet")
    complete = not trouble_again and len(again) == count
    if complete or len(again) > len(events):
        events, trouble = again, trouble_again
    kept = sum(map(len, events))
    if not events:
        found = f"{size - packets.end} bytes after byte {packets.end}" if not packets.whole else trouble
        raise InputError("no packet of events can be read: the file is broken", where=where, found=found)
    foreign.cut_short = not complete or not packets.whole or header.table < 0
    if not complete:
        end = trouble or "there the decoder stopped"
        notes.append(f"broken file: kept {kept} events of {len(events)} of {count} packets; {end}")
    if not packets.whole:
        lost = min(size, header.table if header.table >= 0 else size) - packets.end
        word = "damaged" if 0 <= header.table < size else "truncated"
        notes.append(f"{word} file: kept {kept} events of {len(events)} complete packets; {lost} bytes are lost")
    elif header.table < 0:
        notes.append(f"the recorder never closed the file: kept {kept} events of {len(events)} packets")
    elif complete:
        notes.append(f"the packet table is damaged: read all {len(events)} packets without it")
    return events


def _copy_intact(path: Path, copy: Path, header: Header, packets: Packets) -> None:
    """Header without packet table, and the complete packets of one stream."""
    with path.open("rb") as source, copy.open("wb") as target:
        target.write(source.read(header.size))
        for start, stop in packets.spans:
            source.seek(start)
            target.write(source.read(stop - start))
        if header.table_at is not None:
            target.seek(header.table_at)
            target.write(struct.pack("<q", -1))


def _run(path: Path, header: Header, chosen: Stream, where: str) -> tuple["deque[NDArray[np.void]]", str]:
    """Packets decoded by the child process, and what ended it too early ("" if nothing did)."""
    cameras = {stream.camera for stream in header.streams}
    seconds = PACKET_CPU_S + path.stat().st_size // SCAN_BYTES_PER_S
    call = [sys.executable, "-P", read_aedat4_child.__file__, str(path)]
    call += [chosen.camera if len(cameras) > 1 else "", chosen.name, str(seconds)]
    packets: deque[NDArray[np.void]] = deque()
    with (
        tempfile.TemporaryFile() as complaints,
        subprocess.Popen(call, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=complaints) as child,
    ):
        assert child.stdout is not None
        try:
            while len(head := child.stdout.read(8)) == 8:
                length = int.from_bytes(head, "little", signed=True)
                if length < 0:
                    return packets, ""
                data = child.stdout.read(length * EVENT.itemsize)
                if len(data) < length * EVENT.itemsize:
                    break
                packets.append(np.frombuffer(data, EVENT))
        except BaseException:
            child.kill()
            raise
        code = child.wait()
        complaints.seek(0)
        said = complaints.read().decode(errors="replace").strip().split("\n")[-1][:200]
    if code == read_aedat4_child.NOT_INSTALLED:
        hint = 'pip install "evetac[camera]"'
        raise InputError("AEDAT4 needs dv-processing", where=where, found=said, hint=hint)
    if code == read_aedat4_child.REFUSED:
        return packets, said
    if code == -signal.SIGXCPU:
        return packets, f"decoding the next one did not end in {seconds + 2} s"
    return packets, f"the decoder crashed (exit code {code})"
