"""Read other data of event files as streams of the recording: IMU samples, triggers, and frames if requested.

aedat4_payloads reads them from AEDAT4, aedat3_streams from AEDAT 3.1, read_bag_stream from bags. They are converted to
the recording's clock. Samples before its start or after its end, and data that cannot be read, are left out; the caller
counts them.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.read.aedat.aedat3_streams import TRIGGERS as AEDAT3_TRIGGERS
from evetac_cli.formats.read.aedat.aedat3_streams import UNITS, read_samples
from evetac_cli.formats.read.aedat.aedat4_packets import (
    KINDS,
    Header,
    decoded,
    listed_spans,
    read_header,
    walk,
)
from evetac_cli.formats.read.aedat.aedat4_payloads import FIELDS
from evetac_cli.formats.read.bags.host_clock import host_clock, on_sensor_clock
from evetac_cli.formats.read.bags.open_bag import open_bag
from evetac_cli.formats.read.bags.read_bag_stream import (
    COMPRESSED,
    IMAGE,
    TRIGGERS_OF_DV,
    read_triggers,
    stream_of_topic,
    trigger_topics,
)
from evetac_cli.formats.read.bags.read_rosbag import RECEPTION, topics_of_events
from evetac_cli.formats.read.prophesee.read_prophesee import TRIGGERS as EDGES
from evetac_cli.store.hdf5.disk import joined_on_disk
from evetac_cli.store.recordings.streams import Stream, free_name

IMU = "sensor_msgs/msg/Imu"
NAMES = {"IMUS": "imu", "TRIG": "triggers", "FRME": "frames"}
TRIGGERS = "triggers; source 1 to 3: external signal rises, falls, pulses; 6 to 9: start and end of frame and exposure"
IMU_OF_CAMERA, CAMERAS = "inertial measurement unit of the camera", "the camera's, same as the events"
CHANNELS = {"L": 1, "RGB": 3, "RGBA": 3}  # channels of an image that are kept


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
    taken: list[str] = []
    for stream in header.streams:
        if stream.kind not in NAMES or (stream.kind == "FRME" and not frames):
            continue
        contents = _Contents(path, header, stream)
        t_us, *values = joined_on_disk(folder, contents.parts()) or (np.empty(0, np.int64),)
        if not len(t_us):
            if contents.unreadable:
                yield Other(Stream(NAMES[stream.kind], t_us), KINDS[stream.kind], contents.unreadable)
            continue
        taken.append(free_name(NAMES[stream.kind], taken) if NAMES[stream.kind] in taken else NAMES[stream.kind])
        kept_stream = Stream(taken[-1], t_us, source=f"{path.name}: {stream.name}", clock=CAMERAS)
        if stream.kind == "FRME":
            kept_stream = replace(kept_stream, frames=values[0], what="frames of the camera")
        else:
            columns = dict(zip(_columns(stream.kind), values, strict=True))
            units = {name: UNITS.get(name.partition("_")[0], "") for name in columns}
            what = TRIGGERS if stream.kind == "TRIG" else IMU_OF_CAMERA
            kept_stream = replace(kept_stream, columns=columns, units=units, what=what)
        yield Other(_in_order(kept_stream), KINDS[stream.kind], contents.unreadable)


def aedat3_streams(path: Path, *, folder: Path | None, **_: Any) -> Iterator[Other]:
    """Yield IMU samples and triggers of an AEDAT 3.1 file, on the file's clock."""
    for stream, counted_as, others in read_samples(path, folder):
        what = AEDAT3_TRIGGERS if stream.name == "triggers" else IMU_OF_CAMERA
        kept_stream = replace(_in_order(stream), what=what, clock=CAMERAS)
        note = f"{others:,} {counted_as} were left out: they are marked as invalid or are not {stream.name}"
        yield Other(kept_stream, counted_as, note=note if others else "")


def bag_streams(
    path: Path, *, frames: bool, folder: Path | None, topic: str | None = None, span_us: tuple[int, int] = (0, 0)
) -> Iterator[Other]:
    """Yield the triggers and IMU topics of a bag, and its images if requested, on the clock of its events.

    Topics that cannot be read are skipped. topic: of the events; by default the first one. span_us: begin and end of
    the events.
    """
    kinds = {IMU, IMAGE, COMPRESSED} if frames else {IMU}
    bag = open_bag(path)
    triggers = trigger_topics(bag)
    topics = {one.topic: one.msgtype for one in bag.connections if one.msgtype in kinds and one.msgcount} | triggers
    of_events = topic or next(iter(topics_of_events(bag, str(path))), "")
    clock = host_clock(path, of_events) if topics else None
    taken: list[str] = []
    for name, kind in sorted(topics.items()):
        notes: list[str] = []
        try:
            if name in triggers:
                what = TRIGGERS if kind in TRIGGERS_OF_DV else EDGES
                stream = replace(_in_order(read_triggers(path, name, folder)), what=what)
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
    return tuple(name for name, _ in FIELDS[kind][1:])


class _Contents:
    """The contents of a stream's packets, part by part; `unreadable` counts packets that could not be read."""

    def __init__(self, path: Path, header: Header, stream: Any) -> None:
        self._path, self._header, self._stream = path, header, stream
        self.unreadable = 0

    def parts(self) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield times and columns, or times and images."""
        return self._images() if self._stream.kind == "FRME" else self._rows()

    def _packets(self) -> Iterator[Any]:
        header, number = self._header, self._stream.number
        with self._path.open("rb") as handle:
            spans, listed = walk(handle, header, number).spans, listed_spans(handle, header, number)
            used_spans = listed if listed is not None and len(listed) > len(spans) else spans
            for content in decoded(handle, used_spans, self._stream.kind, header.compression):
                if isinstance(content, str):
                    self.unreadable += 1
                else:
                    yield content

    def _rows(self) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield samples; values that are not finite are NaN."""
        for rows in self._packets():
            columns = [rows[name].astype(np.float64) for name in _columns(self._stream.kind)]
            finite = [np.where(np.isfinite(column), column, np.nan) for column in columns]
            if len(rows):
                yield (np.ascontiguousarray(rows["t"]), *finite)

    def _images(self) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield frames of 8 bits that have the size of the first one."""
        first = None
        for frame in self._packets():
            image = np.asarray(frame.pixels)
            channels = CHANNELS.get(frame.format, 0)
            image = image[:, :, :channels] if image.ndim == 3 else image[:, :, None]
            first = first or image.shape
            if image.shape == first and image.dtype == np.uint8 and image.size:
                yield np.array([frame.t], np.int64), image[None]
            else:
                self.unreadable += 1
