"""External triggers that bags keep apart from the events, as streams of samples.

    event_camera_msgs/EventPacket, encoding `trigger`   8 bytes each: 32 bits ns after time_base, 15 bits id, edge
    dv_ros_msgs/Trigger (dv_ros2_msgs/Trigger)          int8 type, as AEDAT4 counts them, and time

Triggers among the words of evt2 and evt3 come with the events.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.formats.read.bags.open_bag import Bag, bag_in_words, open_bag
from evetac_cli.formats.read.bags.read_rosbag import PACKET, TRIGGER, is_of_triggers, layout
from evetac_cli.formats.read.bags.ros_messages import NS, Fields, event_packet
from evetac_cli.store.disk import joined_on_disk
from evetac_cli.store.streams import Stream

OF_DV = ("dv_ros_msgs/msg/Trigger", "dv_ros2_msgs/msg/Trigger")
WORD_BYTES = 8


def trigger_topics(bag: Bag) -> dict[str, str]:
    """The topics of a bag that hold triggers, with the type of their messages."""
    topics = {one.topic: one.msgtype for one in bag.connections if one.msgtype in OF_DV and one.msgcount}
    packets = {one.topic: one.msgtype for one in bag.connections if layout(one) == PACKET and one.msgcount}
    return topics | {topic: kind for topic, kind in packets.items() if is_of_triggers(bag, topic)}


def read_triggers(path: Path, topic: str, folder: Path | None) -> Stream:
    """The triggers of a topic on the bag's clock; InputError for messages that are damaged."""
    t_us, *values = joined_on_disk(folder, _parts(path, topic)) or (np.empty(0, np.int64),)
    names = ("source",) if len(values) == 1 else ("id", "edge")
    columns = dict(zip(names, values, strict=False))
    return Stream("", t_us, columns, source=f"{path.name}: {topic}", clock="the camera's, as of the events")


def _parts(path: Path, topic: str) -> Iterator[tuple[NDArray[Any], ...]]:
    bag = open_bag(path)
    connections = [one for one in bag.connections if one.topic == topic]
    for number, (connection, _, message) in enumerate(bag.messages(connections)):
        with bag_in_words(f"{path}: message {number} on {topic}", "a trigger"):
            fields = Fields(message, ros2=connection.ros2)
            if connection.msgtype in OF_DV:
                source, (seconds, nanoseconds) = fields.number("b"), (fields.number("I"), fields.number("I"))
                yield np.array([seconds * 10**6 + nanoseconds // NS], np.int64), np.array([float(source)])
                continue
            packet = event_packet(fields)
            if packet.encoding != TRIGGER or len(packet.content) % WORD_BYTES:
                raise ValueError(f"{len(packet.content)} bytes of {packet.encoding[:20]!r}")
            words = np.frombuffer(packet.content, "<u8")
            t_us = (packet.time_base_ns + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)) // NS
            number_of = (words >> np.uint64(48) & np.uint64(0x7FFF)).astype(np.float64)
            if len(words):
                yield t_us, number_of, (words >> np.uint64(63)).astype(np.float64)
