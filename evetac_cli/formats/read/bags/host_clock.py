"""Align the two clocks of a bag: the sensor's clock of its events, and the host's clock of its message headers.

A driver may leave the times of events on the sensor's own clock, which started when it was plugged in, while IMU
samples, images and poses of the same bag are on the host's. Packets of events have both: the host's time in their
header, the sensor's in their first event. The offset is the median of the difference, computed over pieces of the
recording because the clocks drift. The spread of the differences shows how precise it is. A header's time is the time
at which the driver had received the packet. So all headers are late by the transfer time of some ms, which is not
corrected.

Not every bag has two clocks: if the headers agree with the events, nothing is moved.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.read.bags.bag_files import open_bag
from evetac_cli.formats.read.bags.bag_readers import Connection
from evetac_cli.formats.read.bags.read_rosbag import IMAGE, LAYOUTS, PROPHESEE, layout, topics_of_events
from evetac_cli.formats.read.bags.ros_messages import Fields, Packet, decoder
from evetac_cli.formats.read.prophesee.read_prophesee import PropheseeDecoder
from evetac_cli.store.recordings.streams import Stream

SAME_CLOCK_US = 1_000_000  # largest difference of a header and its events if both are on one clock
ALIKE_US = 10_000  # largest difference of the clocks of two synchronized cameras
MOST_PACKETS = 2000  # packets whose times are compared
PIECE_US, PIECE_PACKETS = 10_000_000, 20  # minimum size of a piece of the recording


class Pair(NamedTuple):
    """The times of a packet: its reception on the host's clock, and its first event on the sensor's."""

    host_us: int
    sensor_us: int


@dataclass(frozen=True)
class HostClock:
    """The offset of the host's clock from the sensor's (positive: host ahead), at some times of the host."""

    topic: str
    host_us: NDArray[np.float64]
    ahead_us: NDArray[np.float64]
    sensor_span_us: tuple[int, int]
    packets: int
    spread_us: float  # nine of ten packets are within this distance of the median

    def to_sensor(self, t_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert times of the host to the sensor's clock."""
        more_us = np.interp(t_us.astype(np.float64), self.host_us, self.ahead_us - self.ahead_us[0])
        moved: NDArray[np.int64] = t_us - round(self.ahead_us[0]) - np.rint(more_us).astype(np.int64)
        return moved

    @property
    def ahead_s(self) -> float:
        """The median offset over the recording."""
        return float(np.median(self.ahead_us)) / 1e6

    def text(self) -> str:
        """Return a text on the offset and how it was measured."""
        drift_ms = (self.ahead_us.max() - self.ahead_us.min()) / 1000
        return (
            f"the host's clock is {self.ahead_s:.6f} s ahead of the sensor's on {self.topic}, by the times of"
            f" {self.packets:,} packets (nine of ten within {self.spread_us / 1000:.2g} ms, drift {drift_ms:.2g} ms)"
        )


def host_clock(path: Path, topic: str) -> HostClock | None:
    """Compare the clocks of a topic's events and of their headers; None if they are the same or not comparable."""
    pairs = list(_pairs(path, topic))
    if not pairs:
        return None
    host_us, sensor_us = (np.array(times, np.int64) for times in zip(*pairs, strict=True))
    ahead_us = host_us - sensor_us
    if abs(float(np.median(ahead_us))) <= SAME_CLOCK_US:
        return None
    order = np.argsort(host_us, kind="stable")
    span_us = int(host_us[order[-1]] - host_us[order[0]])
    pieces = np.array_split(order, max(1, min(span_us // PIECE_US, len(order) // PIECE_PACKETS)))
    knots_us = np.array([np.median(host_us[piece]) for piece in pieces])
    medians_us = np.array([np.median(ahead_us[piece]) for piece in pieces])
    off_us = ahead_us - np.interp(host_us.astype(np.float64), knots_us, medians_us)
    return HostClock(
        topic,
        knots_us,
        medians_us,
        (int(sensor_us.min()), int(sensor_us.max())),
        len(pairs),
        float(np.quantile(np.abs(off_us), 0.9)),
    )


def clock_of_bag(path: Path, span_us: tuple[int, int]) -> HostClock | None:
    """Return the clock offset of a bag's event topic that overlaps a recording.

    span_us: begin and end of the recording on the clock of its events. None if the bag has only one clock, or if
    several topics overlap and their offsets differ.
    """
    try:
        topics = topics_of_events(open_bag(path), str(path))
    except InputError:  # the message type of the events has an unknown definition
        return None
    clocks = [clock for topic in topics if (clock := host_clock(path, topic)) is not None]
    fitting = [clock for clock in clocks if _overlap(clock.sensor_span_us, span_us)]
    ahead_us = [clock.ahead_s * 1e6 for clock in fitting]
    return fitting[0] if fitting and max(ahead_us) - min(ahead_us) <= ALIKE_US else None


def on_sensor_clock(stream: Stream, clock: HostClock, span_us: tuple[int, int]) -> tuple[Stream, str]:
    """Convert a stream from the host's to the sensor's clock if it is on the host's; return it with a note.

    span_us: begin and end of the recording on the clock of its events; it shows which clock the stream is on. A stream
    that does not overlap is returned unchanged.
    """
    if not len(stream.t_us) or not _overlap(clock.sensor_span_us, span_us):
        return stream, ""
    moved_us = clock.to_sensor(stream.t_us)
    if not _overlap((int(moved_us[0]), int(moved_us[-1])), span_us):
        return stream, ""
    if _overlap((int(stream.t_us[0]), int(stream.t_us[-1])), span_us):
        return (
            stream,
            f"{clock.text()}; it is unclear which of the two clocks {stream.name or 'the stream'} uses: left unchanged",
        )
    brought = f"{stream.clock}, converted to the sensor's clock"
    moved = replace(stream, t_us=moved_us, clock=brought, offset_s=-clock.ahead_s)
    return moved, f"{clock.text()}: converted {stream.name} to the sensor's clock"


def _overlap(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]


def _pairs(path: Path, topic: str) -> Iterator[Pair]:
    """Yield the times of some packets, evenly spread over the bag; none if the first shows that there is one clock."""
    bag = open_bag(path)
    connections = [one for one in bag.connections if one.topic == topic and layout(one) not in ("", IMAGE)]
    every = max(1, sum(one.msgcount for one in connections) // MOST_PACKETS)
    first: Pair | None = None
    for number, (connection, received_ns, message) in enumerate(bag.messages(connections)):
        if number % every and first is not None:
            continue
        pair_and_turn = _pair(connection, received_ns, message)
        if pair_and_turn is None:
            continue
        pair, turn_us = pair_and_turn
        if first is None:
            if abs(pair.host_us - pair.sensor_us) <= SAME_CLOCK_US:
                return
            first = pair
        if turn_us:
            ahead_us = (pair.host_us - first.host_us) - (pair.sensor_us - first.sensor_us)
            pair = pair._replace(sensor_us=pair.sensor_us + turn_us * round(ahead_us / turn_us))
        yield pair


def _pair(connection: Connection, received_ns: int, message: bytes) -> tuple[Pair, int] | None:
    """Return the times of a packet and the range of the sensor's clock (0: no wrap); None if it cannot be read."""
    turn_us = 0
    try:
        stamp_us = Fields(message, ros2=connection.ros2).header() or received_ns // 1000
        content = LAYOUTS[layout(connection)](Fields(message, ros2=connection.ros2))
        if not isinstance(content, Packet):
            times = content[1].t
        elif content.encoding in PROPHESEE:
            words = PropheseeDecoder(content.encoding)
            size = np.dtype(words.encoding.dtype).itemsize
            whole = content.content[: len(content.content) // size * size]
            times = words.part(np.frombuffer(whole, words.encoding.dtype), str)[0][0]
            turn_us = words.encoding.tick_us << words.encoding.high_bits
        else:
            decode = decoder(content.encoding)
            times = decode(content).t if decode is not None else np.empty(0, np.int64)
    except ValueError:
        return None
    times = times[times != 0]  # 0: never set
    return (Pair(stamp_us, int(times[0])), turn_us) if len(times) else None
