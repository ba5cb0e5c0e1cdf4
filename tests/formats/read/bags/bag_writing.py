"""Bags for tests: rosbags' own types and writers, with the definitions of packages that publish events."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.events import Events

rosbags = pytest.importorskip("rosbags.rosbag1")
from rosbags import rosbag1, rosbag2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

FRAME = (640, 480)
START_S = 1_700_000_000
DEFINITIONS = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\n{time} ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray": "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n",
    "event_camera_msgs/msg/EventPacket": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events\n"
    ),
    "evetac_software/msg/EvetacMsg": (
        "std_msgs/Header header\nsensor_msgs/Image image\nint8 local_counter\nfloat64[] centers\n"
    ),
    "other_msgs/msg/Number": "uint32 value\n",
}
BAGS = ("ros1", "db3", "mcap")


class Types:
    """rosbags' own types and serialisers, with the definitions of the packages that publish events."""

    def __init__(self, bag: str, **others: str) -> None:
        self.ros2 = bag != "ros1"
        self.store = get_typestore(Stores.ROS2_HUMBLE if self.ros2 else Stores.ROS1_NOETIC)
        types: Any = {}
        for name, text in {**DEFINITIONS, **others}.items():
            text = text.replace("{time}", "builtin_interfaces/Time" if self.ros2 else "time")  # noqa: PLW2901
            types |= get_types_from_msg(text, name)
        self.store.register(types)

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def time(self, us: int) -> Any:
        return self.make("builtin_interfaces/msg/Time", us // 10**6, us % 10**6 * 1000)

    def header(self, us: int, frame: str = "camera") -> Any:
        sequence = [] if self.ros2 else [7]
        return self.make("std_msgs/msg/Header", *sequence, self.time(us), frame)

    def array(self, rows: Sequence[tuple[int, ...]], frame: str = "camera") -> Any:
        events = [self.make("dvs_msgs/msg/Event", x, y, self.time(t), bool(p)) for t, x, y, p in rows]
        header = self.header(START_S * 10**6, frame)
        return self.make("dvs_msgs/msg/EventArray", header, FRAME[1], FRAME[0], events)

    def packet(
        self,
        content: bytes,
        encoding: str,
        seq: int = 0,
        base_ns: int = 0,
        big: bool = False,
        stamp_us: int = START_S * 10**6,
    ) -> Any:
        words = np.frombuffer(content, np.uint8)
        header = self.header(stamp_us)
        name = "event_camera_msgs/msg/EventPacket"
        return self.make(name, header, FRAME[1], FRAME[0], seq, base_ns, encoding, big, words)

    def image(self, us: int, image: Any) -> Any:
        """As the official software fills it: rows are columns of the camera."""
        rows, columns = image.shape
        header = self.header(us)
        inner = self.make(
            "sensor_msgs/msg/Image", self.header(0, ""), rows, columns, "mono8", 0, columns, image.reshape(-1)
        )
        return self.make("evetac_software/msg/EvetacMsg", header, inner, 3, np.arange(126.0))

    def raw(self, message: Any) -> bytes:
        name = message.__msgtype__
        return bytes(self.store.serialize_cdr(message, name) if self.ros2 else self.store.serialize_ros1(message, name))


Write = Callable[..., Path]


def write_bag(folder: Path, bag: str, types: Types, topics: dict[str, Sequence[Any]], **options: Any) -> Path:
    """Write a bag of a kind: topics, each with its messages, one a second or received at `times_us`."""
    name = options.get("name", "bag")
    path = folder / (f"{name}.bag" if bag == "ros1" else name)
    if bag == "ros1":
        writer: Any = rosbag1.Writer(path)
        if options.get("compress"):
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if bag == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if options.get("compress"):
            mode = rosbag2.CompressionMode[options.get("mode", "MESSAGE")]
            writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    times_us = options.get("times_us")
    with writer:
        for topic, messages in topics.items():
            kind = messages[0].__msgtype__ if messages else "dvs_msgs/msg/EventArray"
            connection = writer.add_connection(topic, kind, typestore=types.store)
            for number, message in enumerate(messages):
                time_us = times_us[number] if times_us is not None else (START_S + number) * 10**6
                writer.write(connection, time_us * 1000, types.raw(message))
    return path


def write_mcap(path: Path, types: Types, topics: dict[str, Sequence[Any]], **options: Any) -> Path:
    """Write a file by the library mcap, with the options of its writer: messages in turns, one of each topic a second.

    times: when each round of messages was received, in s; order of the file otherwise. finish: whether it is closed.
    """
    from mcap.writer import Writer

    times, finish, coding = options.pop("times", None), options.pop("finish", True), options.pop("coding", "cdr")
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, messages in topics.items():
            kind = messages[0].__msgtype__
            text = types.store.generate_msgdef(kind, ros_version=2 if coding == "cdr" else 1)[0]
            name = kind if coding == "cdr" else kind.replace("/msg/", "/")
            schema = writer.register_schema(name, "ros2msg" if coding == "cdr" else "ros1msg", text.encode())
            channels[topic] = writer.register_channel(topic, coding, schema)
        for number in range(max(map(len, topics.values()))):
            for topic, messages in topics.items():
                if number < len(messages):
                    time_ns = (times[number] if times else START_S + number) * 10**9
                    writer.add_message(channels[topic], time_ns, types.raw(messages[number]), time_ns)
        if finish:
            writer.finish()
    return path


def drawn(count: int, seed: int = 3, gap_us: int = 40) -> Events:
    """Random events in order of time."""
    rng = np.random.default_rng(seed)
    t = START_S * 10**6 + np.cumsum(rng.integers(0, gap_us, count))
    x, y, p = (rng.integers(0, most, count) for most in (640, 480, 2))
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def listed(events: Events) -> list[tuple[int, ...]]:
    return list(zip(*(column.tolist() for column in events), strict=True))


def shifted(events: Events) -> list[tuple[int, ...]]:
    return listed(events._replace(t=events.t - events.t[0]))


TYPES = {False: Types("ros1"), True: Types("db3")}


def mono(events: Events, base_ns: int) -> bytes:
    words = (
        (events.p.astype(np.uint64) << np.uint64(63))
        | (events.y.astype(np.uint64) << np.uint64(48))
        | (events.x.astype(np.uint64) << np.uint64(32))
        | (events.t * 1000 - base_ns).astype(np.uint64)
    )
    return words.astype("<u8").tobytes()


def packets(types: Types, events: Events, size: int) -> list[Any]:
    """Events in packets of so many, each on its own time base."""
    made = []
    for number, first in enumerate(range(0, events.size, size)):
        part = events.part(first, first + size)
        base_ns = 1000 * int(part.t[0])
        made.append(types.packet(mono(part, base_ns), "mono", number, base_ns))
    return made


def libcaer(events: Events, base_ns: int) -> bytes:
    data = 1 | events.p.astype(np.uint32) << 1 | events.y.astype(np.uint32) << 2 | events.x.astype(np.uint32) << 17
    us = (events.t - base_ns // 1000) % 2**31
    return np.stack([data, us.astype(np.uint32)], axis=1).astype("<u4").tobytes()


def compressed(events: Events, base_ns: int) -> bytes:
    """As libcaer_driver packs one packet: masks of eight rows where a column has several of one polarity."""
    words: list[int] = []
    high = low = 0
    column = polarity = eight = None
    mask = last = 0

    def flush() -> None:
        nonlocal mask
        if mask.bit_count() == 1:
            words.append(3 << 12 | polarity << 11 | last)
        elif mask:
            words.extend([4 << 12 | polarity << 11 | eight, 5 << 12 | mask])
        mask = 0

    for t, x, y, p in listed(events._replace(t=events.t - base_ns // 1000)):
        if (t >> 12, t & 0xFFF, x, p, y & ~7) != (high, low, column, polarity, eight) or mask >> (y & 7) & 1:
            flush()
        if t >> 12 != high:
            high = t >> 12
            words.append(0 << 12 | high)
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(1 << 12 | low)
        if x != column:
            column = x
            words.append(2 << 12 | x)
        polarity, eight, last = p, y & ~7, y
        mask |= 1 << (y & 7)
    flush()
    return np.array(words, "<u2").tobytes()


ENCODERS = {"mono": mono, "libcaer": libcaer, "libcaer_cmp": compressed}
