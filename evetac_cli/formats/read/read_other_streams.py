"""Read other data of event files as streams of the recording: IMU samples, triggers, and frames if requested.

aedat4_packets reads them from AEDAT4, read_bag_stream from bags. They are converted to the recording's clock. Samples
before its start or after its end, and data that cannot be read, are left out; the caller counts them.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.read.aedat4_packets import FIELDS, KINDS, Header, PacketStream, decoded, read_header, walk
from evetac_cli.formats.read.bags.bag_files import open_bag
from evetac_cli.formats.read.bags.host_clock import host_clock, on_sensor_clock
from evetac_cli.formats.read.bags.read_bag_stream import (
    COMPRESSED,
    IMAGE,
    RECEPTION,
    TRIGGERS_OF_DV,
    read_triggers,
    stream_of_topic,
)
from evetac_cli.formats.read.bags.read_rosbag import topics_of_events
from evetac_cli.store.hdf5.disk import joined_on_disk
from evetac_cli.store.recordings.streams import Stream, free_name

IMU = "sensor_msgs/msg/Imu"
TRIGGERS = "triggers; source 1 to 3: external signal rises, falls, pulses; 6 to 9: start and end of frame and exposure"
# Names and descriptions of the streams of AEDAT4.
STREAMS = {
    "IMUS": ("imu", "inertial measurement unit of the camera"),
    "TRIG": ("triggers", TRIGGERS),
    "FRME": ("frames", "frames of the camera"),
}
CAMERAS = "the camera's, same as the events"
UNITS = {"temperature": "degC", "accelerometer": "g", "gyroscope": "deg/s", "magnetometer": "uT"}


class Other(NamedTuple):
    """A stream other than events, the name under which its samples are counted, and its unreadable packets.

    note: on its samples and the conversion to the clock of the events.
    """

    stream: Stream
    counted_as: str
    unreadable: int = 0
    note: str = ""


def aedat4_streams(path: Path, *, frames: bool, folder: Path | None, **_: Any) -> Iterator[Other]:
    """Yield IMU samples and triggers of an AEDAT4 file, and its frames if requested, on the file's clock."""
    with path.open("rb") as handle:
        header = read_header(handle, str(path))
    for stream in header.streams:
        if stream.kind not in STREAMS or (stream.kind == "FRME" and not frames):
            continue
        unreadable: list[str] = []
        packets = _packets(path, header, stream, unreadable)
        parts = _images(packets, unreadable) if stream.kind == "FRME" else _rows(packets, _columns(stream.kind))
        t_us, *values = joined_on_disk(folder, parts) or (np.empty(0, np.int64),)
        name, what = STREAMS[stream.kind]
        kept_stream = Stream(name, t_us, source=f"{path.name}: {stream.name}", clock=CAMERAS, what=what)
        if len(t_us) and stream.kind == "FRME":
            kept_stream = replace(kept_stream, frames=values[0])
        elif len(t_us):
            columns = dict(zip(_columns(stream.kind), values, strict=True))
            units = {column: UNITS.get(column.partition("_")[0], "") for column in columns}
            kept_stream = replace(kept_stream, columns=columns, units=units)
        if len(t_us) or unreadable:
            yield Other(_in_order(kept_stream), KINDS[stream.kind], len(unreadable))


def bag_streams(
    path: Path, *, frames: bool, folder: Path | None, topic: str | None = None, span_us: tuple[int, int] = (0, 0)
) -> Iterator[Other]:
    """Yield the triggers and IMU topics of a bag, and its images if requested, on the clock of its events.

    Topics that cannot be read are skipped. topic: of the events; by default the first one. span_us: begin and end of
    the events.
    """
    kinds = (*TRIGGERS_OF_DV, IMU, *((IMAGE, COMPRESSED) if frames else ()))
    bag = open_bag(path)
    topics = {one.topic: one.msgtype for one in bag.connections if one.msgtype in kinds and one.msgcount}
    of_events = topic or next(iter(topics_of_events(bag, str(path))), "")
    clock = host_clock(path, of_events) if topics else None
    taken: list[str] = []
    for name, kind in sorted(topics.items()):
        notes: list[str] = []
        try:
            if kind in TRIGGERS_OF_DV:
                stream = replace(_in_order(read_triggers(bag, name, folder)), what=TRIGGERS)
            else:
                stream, notes = stream_of_topic(bag, name, folder)
        except InputError:
            continue
        taken.append(free_name(name.strip("/"), taken))
        stream = replace(stream, name=taken[-1])
        notes = [f"times by {RECEPTION}", *notes] if stream.clock == RECEPTION else notes
        notes = [f"{stream.name}: {note}" for note in notes]
        if clock is not None:
            stream, note = on_sensor_clock(stream, clock, span_us)
            notes += [note] if note else []
        yield Other(stream, f"messages on {name} ({kind})", note="; ".join(notes))


def _in_order(stream: Stream) -> Stream:
    """Return the stream sorted by time; samples with the same time keep their order."""
    if (stream.t_us[1:] >= stream.t_us[:-1]).all():
        return stream
    order = np.argsort(stream.t_us, kind="stable")
    return replace(
        stream,
        t_us=stream.t_us[order],
        columns={name: column[order] for name, column in stream.columns.items()},
        frames=None if stream.frames is None else stream.frames[order],
    )


def _columns(kind: str) -> tuple[str, ...]:
    """Return the column names of a kind of AEDAT4 stream."""
    return (FIELDS[kind].names or ())[1:]


def _packets(path: Path, header: Header, stream: PacketStream, unreadable: list[str]) -> Iterator[Any]:
    """Yield the contents of a stream's packets; add a text for each that cannot be read to `unreadable`."""
    with path.open("rb") as handle:
        for content in decoded(handle, walk(handle, header, stream.number).spans, stream.kind, header.compression):
            if isinstance(content, str):
                unreadable.append(content)
            else:
                yield content


def _rows(packets: Iterator[Any], names: tuple[str, ...]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield times and columns of samples; values that are not finite are NaN."""
    for rows in packets:
        columns = [rows[name].astype(np.float64) for name in names]
        finite = [np.where(np.isfinite(column), column, np.nan) for column in columns]
        if len(rows):
            yield (np.ascontiguousarray(rows["t"]), *finite)


def _images(packets: Iterator[Any], unreadable: list[str]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time and image of frames that have the size of the first one."""
    first = None
    for t_us, image in packets:
        first = first or image.shape
        if image.shape == first and image.size:
            yield np.array([t_us], np.int64), image[None]
        else:
            unreadable.append("a frame of another size")
