"""Write bags of events to be damaged: ROS 1, packed and unpacked, and ROS 2 as SQLite and MCAP, by rosbags' writers."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from evetac_cli.events import Events

EVENTS = 3000
PACKET = 100  # events per message
FRAME = (640, 480)
DEFINITIONS = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\n{time} ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray": "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n",
    "event_camera_msgs/msg/EventPacket": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events\n"
    ),
}
# Name of each kind: its file, and the family of damage.
FILES = {
    "ROS 1 bag": ("arrays.bag", "bytes"),
    "ROS 1 bag, packed": ("packets.bag", "bytes"),
    "ROS 2 bag, SQLite": ("sqlite", "files"),
    "ROS 2 bag, MCAP": ("mcap", "files"),
}


def write(folder: Path, events: Events) -> None:
    """Write the same events into a bag of every kind."""
    parts = [events.part(first, first + PACKET) for first in range(0, events.size, PACKET)]
    for name, packed in (("arrays.bag", False), ("packets.bag", True)):
        writer: Any = rosbag1.Writer(folder / name)
        writer.chunk_threshold = 20_000
        if packed:
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
        _fill(writer, parts, packets=packed, ros2=False)
    for name, plugin in (("sqlite", "SQLITE3"), ("mcap", "MCAP")):
        writer = rosbag2.Writer(folder / name, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
        _fill(writer, parts, packets=name == "mcap", ros2=True)


def _fill(writer: Any, parts: list[Events], *, packets: bool, ros2: bool) -> None:
    store: Any = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    types: Any = {}
    for name, text in DEFINITIONS.items():
        types |= get_types_from_msg(text.replace("{time}", "builtin_interfaces/Time" if ros2 else "time"), name)
    store.register(types)
    serialize = store.serialize_cdr if ros2 else store.serialize_ros1
    kind = "event_camera_msgs/msg/EventPacket" if packets else "dvs_msgs/msg/EventArray"

    def stamp(us: int) -> Any:
        return store.types["builtin_interfaces/msg/Time"](1 + us // 10**6, us % 10**6 * 1000)

    with writer:
        connection = writer.add_connection("/events", kind, typestore=store)
        for number, part in enumerate(parts):
            first_us = int(part.t[0])
            header = store.types["std_msgs/msg/Header"](*([] if ros2 else [number]), stamp(first_us), "camera")
            content: tuple[Any, ...]
            if packets:
                content = (number, first_us * 1000, "mono", False, _mono(part, first_us))
            else:
                event = store.types["dvs_msgs/msg/Event"]
                rows = zip(*(column.tolist() for column in part), strict=True)
                content = ([event(x, y, stamp(t), bool(p)) for t, x, y, p in rows],)
            message = store.types[kind](header, FRAME[1], FRAME[0], *content)
            writer.write(connection, 10**9 + first_us * 1000, serialize(message, kind))


def _mono(events: Events, first_us: int) -> np.ndarray:
    """Encode events as `mono` of event_camera_msgs: 64-bit words of polarity, y, x, and ns since the packet's base."""
    t, x, y, p = (column.astype(np.uint64) for column in events)
    words = p << np.uint64(63) | y << np.uint64(48) | x << np.uint64(32) | (t - np.uint64(first_us)) * np.uint64(1000)
    return words.astype("<u8").view(np.uint8)
