"""Decode ROS messages with events from their bytes, without ROS.

They are decoded here and not by a general deserializer, because building an object per event costs microseconds, and a
second of an Evetac has a million events. Layouts:

    dvs_msgs/EventArray, prophesee_event_msgs/EventArray   header, height, width, {x, y, time, polarity}[]
    event_camera_msgs/EventPacket (event_array_msgs/EventArray)   ... seq, time_base, encoding, bytes
        mono          8 bytes per event: 32 bits ns after time_base, 16 bits x, 15 bits y, polarity
        libcaer       8 bytes per event: valid, polarity, 15 bits y, 15 bits x, 32 bits us after time_base
        libcaer_cmp   16-bit words with a code of four bits: time high and low, x, y, and eight rows at once
        evt2, evt3    Prophesee's own words: see read_prophesee
    evetac_software/EvetacMsg    no events, but their sum as an image, every pixel 127 + 15 n

ROS 1 stores the fields of a message without gaps; ROS 2 (CDR) aligns each to its size and begins with the byte order.
Times are on the camera's clock, in us. ValueError is raised if the bytes do not fit the layout.
"""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.formats.read.clock import BITS_31, Clock

NS = 1000  # per us
EVENT_BYTES_ROS1 = 13  # x, y, seconds, nanoseconds, polarity
EVENT_STRIDE_CDR = 16  # the same, each aligned; x, except the first, is before the boundary of 16 bytes
EVENT_ROS1 = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
EVENT_CDR = np.dtype(
    {
        "names": ["first", "second", "s", "ns", "p", "next_x"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1", "<u2"],
        "offsets": [0, 2, 4, 8, 12, 14],
        "itemsize": EVENT_STRIDE_CDR,
    }
)
GREY = 127  # grey level of a pixel without events in an EvetacMsg
STEP = 15  # change of the grey level per event


class MessageEvents(NamedTuple):
    """Events of one message: t in us, x and y in px, p 0 or 1."""

    t: NDArray[Any]
    x: NDArray[Any]
    y: NDArray[Any]
    p: NDArray[Any]


class Packet(NamedTuple):
    """An EventPacket whose content is not decoded yet."""

    frame_px: tuple[int, int]
    sequence: int
    time_base_ns: int
    encoding: str
    content: memoryview


class Fields:
    """Reads the fields of a message, one after the other."""

    def __init__(self, content: bytes | memoryview, *, ros2: bool) -> None:
        self.ros2 = ros2
        self._bytes = memoryview(content)
        if ros2:
            if len(self._bytes) < 4 or self._bytes[1] != 1:
                raise ValueError("not little-endian CDR")
            self._bytes = self._bytes[4:]
        self.at = 0

    def number(self, code: str) -> int:
        """Read one number, given its struct code."""
        size = struct.calcsize("<" + code)
        self._align(size)
        (value,) = struct.unpack("<" + code, self._take(size))
        return int(value)

    def text(self) -> str:
        """Read a string; in ROS 2 it ends with a zero byte."""
        return bytes(self._take(self.number("I"))).rstrip(b"\0").decode(errors="replace")

    def bytes_(self) -> memoryview:
        """Read a list of uint8 as bytes."""
        return self._take(self.number("I"))

    def header(self) -> int:
        """Read a std_msgs/Header; return its stamp in us."""
        if not self.ros2:
            self.number("I")  # a sequence number, which ROS 2 does not have
        seconds, nanoseconds = self.number("i" if self.ros2 else "I"), self.number("I")
        self.text()
        return seconds * 1_000_000 + nanoseconds // NS

    def frame(self) -> tuple[int, int]:
        """Read height and width; return (width, height)."""
        height, width = self.number("I"), self.number("I")
        return width, height

    def rest(self) -> memoryview:
        """Return the bytes after the fields that have been read."""
        return self._bytes[self.at :]

    def _align(self, size: int) -> None:
        if self.ros2:
            self.at += -self.at % size

    def _take(self, size: int) -> memoryview:
        if self.at + size > len(self._bytes):
            raise ValueError(f"{len(self._bytes)} bytes, but the first fields need {self.at + size}")
        self.at += size
        return self._bytes[self.at - size : self.at]


def event_array(fields: Fields) -> tuple[tuple[int, int], MessageEvents]:
    """Decode a dvs_msgs/EventArray: frame and events."""
    fields.header()
    frame = fields.frame()
    count = fields.number("I")
    content = fields.rest()
    if not fields.ros2:
        if len(content) != count * EVENT_BYTES_ROS1:
            raise ValueError(f"{len(content)} bytes for {count} events of {EVENT_BYTES_ROS1} bytes")
        rows = np.frombuffer(content, EVENT_ROS1)
        return frame, MessageEvents(_us(rows), rows["x"], rows["y"], rows["p"])
    needed = max(0, count * EVENT_STRIDE_CDR - 3)  # the last event ends with its polarity
    if not needed <= len(content) < needed + 8:  # a few bytes of padding may follow
        raise ValueError(f"{len(content)} bytes for {count} events, not {needed}")
    rows = np.frombuffer(bytes(content[:needed]) + bytes(count * EVENT_STRIDE_CDR - needed), EVENT_CDR)
    x, y = rows["first"].copy(), rows["first"].copy()
    if count:
        x[1:] = rows["next_x"][:-1]
        y[0] = rows["second"][0]
    return frame, MessageEvents(_us(rows), x, y, rows["p"])


def _us(rows: NDArray[Any]) -> NDArray[np.int64]:
    us: NDArray[np.int64] = rows["s"].astype(np.int64) * 1_000_000 + rows["ns"] // NS
    return us


def evetac_image(fields: Fields) -> tuple[tuple[int, int], MessageEvents]:
    """Decode an evetac_software/EvetacMsg: the events per pixel that its grey level encodes, at the message's time.

    The image is transposed: its rows are the columns of the camera.
    """
    stamp_us = fields.header()
    fields.header()
    height, width = fields.frame()
    encoding = fields.text()
    fields.number("B")
    stride = fields.number("I")
    content = fields.bytes_()
    if encoding not in ("mono8", "8UC1") or stride != height or len(content) != width * height:
        raise ValueError(f"an image of {width} x {height} px, {encoding[:20]!r}, has {len(content)} bytes")
    image = np.frombuffer(content, np.uint8).reshape(width, height).astype(np.int16) - GREY
    if (image % STEP).any():
        raise ValueError(f"grey levels other than {GREY} + {STEP} n")
    x, y = np.nonzero(image)
    times = np.abs(image[x, y]) // STEP
    x, y = np.repeat(x, times), np.repeat(y, times)
    return (width, height), MessageEvents(np.full(len(x), stamp_us), x, y, (image[x, y] > 0).astype(np.uint8))


def event_packet(fields: Fields) -> Packet:
    """Read an event_camera_msgs/EventPacket; its content stays encoded."""
    fields.header()
    frame = fields.frame()
    sequence, time_base_ns = fields.number("Q"), fields.number("Q")
    encoding = fields.text()
    if fields.number("B"):
        raise ValueError("big-endian words are not supported")
    if time_base_ns >= 1 << 63:
        raise ValueError("a time is beyond 292 years")
    return Packet(frame, sequence, time_base_ns, encoding, fields.bytes_())


def mono(packet: Packet) -> MessageEvents:
    """Decode a packet in the encoding `mono`: 8 bytes per event, times in ns from the packet's time base."""
    words = _words(packet, "<u8")
    t_ns = np.uint64(packet.time_base_ns) + (words & np.uint64(0xFFFFFFFF))
    x, y = (words >> np.uint64(32)) & np.uint64(0xFFFF), (words >> np.uint64(48)) & np.uint64(0x7FFF)
    return MessageEvents(t_ns // np.uint64(NS), x, y, words >> np.uint64(63))


def libcaer(packet: Packet) -> MessageEvents:
    """Decode a packet in the encoding `libcaer`: 8 bytes per event, on a clock of 31 bits in us."""
    words = _words(packet, "<u4", 8).reshape(-1, 2)
    us = Clock((BITS_31,)).continuous(words[:, 1].view(np.int32).astype(np.int64), str)
    data = words[:, 0]
    return MessageEvents(packet.time_base_ns // NS + us, data >> 17, (data >> 2) & 0x7FFF, (data >> 1) & 1)


class LibcaerCompressed:
    """Decodes `libcaer_cmp`. Time restarts with every packet; column, row and polarity persist."""

    HIGH, LOW, X, Y, BASE_Y, EIGHT = range(6)

    def __init__(self) -> None:
        self._x = self._base = 0

    def __call__(self, packet: Packet) -> MessageEvents:
        """Decode the next packet; packets must come in the order of the recording."""
        words = np.concatenate(
            [np.array([self.X << 12 | self._x, self.BASE_Y << 12 | self._base], np.uint16), _words(packet, "<u2")]
        )
        code, value = words >> 12, (words & 0xFFF).astype(np.int64)
        if (code > self.EIGHT).any():
            raise ValueError(f"a word has the undefined code {code[np.argmax(code > self.EIGHT)]}")
        high, low, x, base = (self._latest(code == kind, value) for kind in (self.HIGH, self.LOW, self.X, self.BASE_Y))
        self._x, self._base = int(x[-1]), int(base[-1])
        # each EIGHT since the last base is eight rows further
        eights = np.cumsum(code == self.EIGHT)
        further = eights - eights[np.maximum.accumulate(np.where(code == self.BASE_Y, np.arange(len(code)), 0))] - 1
        bits = (value[:, None] >> np.arange(8)) & (code == self.EIGHT)[:, None]
        rows_of_eight = (base & 0x7FF)[:, None] + 8 * further[:, None] + np.arange(8)
        single = code == self.Y
        events = np.concatenate([single[:, None], bits.astype(bool)], axis=1)
        y = np.concatenate([(value & 0x7FF)[:, None], rows_of_eight], axis=1)[events]
        word = np.nonzero(events)[0]
        p = np.where(single[word], value[word] >> 11, base[word] >> 11)
        t = packet.time_base_ns // NS + (high[word] << 12 | low[word])
        return MessageEvents(t, x[word] & 0x7FF, y, p)

    @staticmethod
    def _latest(here: NDArray[np.bool_], value: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return for every word the last value at a marked index, 0 before the first."""
        place = np.maximum.accumulate(np.where(here, np.arange(len(here)), -1))
        return np.where(place >= 0, value[place], 0)


def _words(packet: Packet, dtype: str, size: int | None = None) -> NDArray[Any]:
    size = size or np.dtype(dtype).itemsize
    if len(packet.content) % size:
        raise ValueError(f"{len(packet.content)} bytes are not a multiple of words of {size}")
    return np.frombuffer(packet.content, dtype)


def decoder(encoding: str) -> Callable[[Packet], MessageEvents] | None:
    """Return a decoder for the packets of one stream, to be used in order; None for an unsupported encoding."""
    plain: dict[str, Callable[[Packet], MessageEvents]] = {"mono": mono, "libcaer": libcaer}
    return LibcaerCompressed() if encoding == "libcaer_cmp" else plain.get(encoding)
