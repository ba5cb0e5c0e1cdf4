"""Read events from AEDAT 3.1 files of cAER: lines that begin with `#`, then packets, little-endian.

    int16 type, int16 source, int32 size of an event, offset of its time, overflows of the clock, capacity, events,
    valid
    type 1    polarity: uint32 (bit 0 valid, 1 polarity, 2-16 row, 17-31 column), int32 time in us of 31 bits

(0, 0) is at the top left. The frame is that of the chip named in the line `#Source N:`. From a cut or damaged file, the
events of the packets before the damaged bytes are read.
"""

import re
import struct
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.formats.read.source import NOT_RECORDED, EventColumns, EventSource, at_index, choose_frame

SIGN = b"#!AER-DAT3"
END = b"#!END-HEADER"
LINE_LIMIT_BYTES = 1 << 16
HEAD_LIMIT_BYTES = 1 << 20
HEADER = struct.Struct("<hhiiiiii")
EVENT = np.dtype([("data", "<u4"), ("t", "<u4")])
BATCH_EVENTS = 1 << 18
SPECIAL, POLARITY, FRAME, IMU6, IMU9 = range(5)
NAMES = {SPECIAL: "special events", FRAME: "frames", IMU6: "IMU samples", IMU9: "IMU samples"}
LARGEST_TYPE = 200  # cAER's own types are below 20, those of users start at 100
OVERFLOW_BITS = 31
FRAMES_PX = (
    ("DVS128", (128, 128)),
    ("EDVS", (128, 128)),
    ("DAVIS128", (128, 128)),
    ("DAVIS208", (208, 192)),
    ("DAVIS240", (240, 180)),
    ("DAVIS346", (346, 260)),
    ("DAVIS640", (640, 480)),
)


class PacketHead(NamedTuple):
    """The head of a packet, and the position of its events in the file."""

    kind: int
    camera: int
    event_bytes: int
    overflows: int
    events: int
    at: int
    end: int


def open_aedat3(path: Path, frame_px: tuple[int, int] | None) -> EventSource:
    """Return the events of the first camera that has some; frame_px is only for files that name no known chip."""
    where = str(path)
    with path.open("rb") as handle:
        sources, start = _head(handle, where)
        counts: Counter[tuple[int, int]] = Counter()
        end = start
        for packet in _packets(handle, start):
            counts[packet.camera, packet.kind] += packet.events
            end = packet.end
    camera = min((camera for camera, kind in counts if kind == POLARITY), default=None)
    if camera is None:
        contents = ", ".join(
            f"{count} {NAMES.get(kind, f'events of type {kind}')}" for (_, kind), count in counts.items()
        )
        holds, hint = (contents, NOT_RECORDED) if contents else ("no readable packet", "")
        raise InputError("the file has no event stream", where=where, found=holds, hint=hint)
    own_px = next((px for name, px in FRAMES_PX if sources.get(camera, "").upper().startswith(name)), None)
    source = EventSource("aedat3", choose_frame(own_px, frame_px, where), ())
    source.assumed = "rows from the top, polarity bit 1 brighter, time in microseconds"
    for (of, kind), count in sorted(counts.items()):
        if (of, kind) != (camera, POLARITY) and count:
            name = "events" if kind == POLARITY else NAMES.get(kind, f"events of type {kind}")
            name += f" of source {of}" if of != camera else ""
            source.left_out[name] = source.left_out.get(name, 0) + count
    lost = path.stat().st_size - end
    if lost:
        source.notes.append(f"damaged or cut short: {lost} bytes after byte {end} are lost")
        source.cut_short = True
    source.batches = _batches(path, start, camera, source)
    return source


def packets_beside(handle: BinaryIO, where: str) -> Iterator[PacketHead]:
    """Return the packets without events of the camera whose events are read."""
    _, start = _head(handle, where)
    of_source = list(_packets(handle, start))
    camera = min((packet.camera for packet in of_source if packet.kind == POLARITY), default=None)
    return (packet for packet in of_source if packet.camera == camera and packet.kind != POLARITY)


def _head(handle: BinaryIO, where: str) -> tuple[dict[int, str], int]:
    """Return the sources by number, and the position of the first packet."""
    sources: dict[int, str] = {}
    end = 0
    while end <= HEAD_LIMIT_BYTES:
        line = handle.readline(LINE_LIMIT_BYTES)
        end += len(line)
        if not line.startswith(b"#"):
            break
        if line.startswith(END):
            return sources, end
        text = line.decode("latin-1").strip()
        if camera := re.match(r"#Source ([0-9]{1,4}): *(\S+)", text):
            sources[int(camera[1])] = camera[2]
        if (coding := re.match(r"#Format: *(.+)", text)) and coding[1] != "RAW":
            raise InputError(
                "this format of AEDAT 3 is not supported", where=where, expected="RAW", found=coding[1][:60]
            )
        if (version := re.match(r"#!AER-DAT(\S+)", text)) and version[1] != "3.1":
            raise InputError(
                "this version of AEDAT 3 is not supported", where=where, expected="3.1", found=version[1][:20]
            )
    raise InputError("the header of the file does not end", where=where, expected=f"a line {END.decode()}")


def _packets(handle: BinaryIO, start: int) -> Iterator[PacketHead]:
    """Yield packet after packet until one is incomplete or invalid."""
    size = handle.seek(0, 2)
    at = start
    while at < size:
        handle.seek(at)
        head = handle.read(HEADER.size)
        if len(head) < HEADER.size:
            return
        kind, camera, event_bytes, t_at, overflows, capacity, count, valid = HEADER.unpack(head)
        begin = at + HEADER.size
        end = begin + event_bytes * capacity
        whole = 0 <= kind <= LARGEST_TYPE and camera >= 0 and event_bytes > 0 and 0 <= valid <= count <= capacity
        if not whole or not 0 <= t_at < event_bytes or overflows < 0 or end > size:
            return
        if kind == POLARITY and (event_bytes, t_at) != (EVENT.itemsize, 4):
            return
        yield PacketHead(kind, camera, event_bytes, overflows, count, begin, end)
        at = end


def _batches(path: Path, start: int, camera: int, source: EventSource) -> Iterator[EventColumns]:
    """Yield the events of each packet; at the end count those marked as invalid in `source.left_out`."""
    done = invalid = 0
    with path.open("rb") as handle:
        for packet in _packets(handle, start):
            if (packet.camera, packet.kind) != (camera, POLARITY):
                continue
            handle.seek(packet.at)
            for first in range(0, packet.events, BATCH_EVENTS):
                rows = np.frombuffer(handle.read(min(BATCH_EVENTS, packet.events - first) * EVENT.itemsize), EVENT)
                data = rows["data"]
                valid = (data & 1) == 1
                invalid += len(rows) - int(np.count_nonzero(valid))
                t = (packet.overflows << OVERFLOW_BITS) + rows["t"].astype(np.int64)
                x, y, p = data >> 17, (data >> 2) & 0x7FFF, (data >> 1) & 1
                t, x, y, p = (column[valid] for column in (t, x, y, p))
                yield EventColumns(t, x, y, p, partial(at_index, done))
                done += len(t)
    if invalid:
        source.left_out["events marked as not valid"] = invalid
