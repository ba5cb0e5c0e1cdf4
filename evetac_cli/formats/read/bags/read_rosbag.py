"""Read events from bags of ROS 1 (`.bag`) and ROS 2 (a folder, `.db3`, `.mcap`), the extra `convert`.

bag_files finds the messages; ros_messages decodes them from their bytes. So a bag needs no definitions of its messages,
and the definitions of other topics do not matter. A layout is identified by the checksum of its definition, also in ROS
2 bags that have the definition, independently of the package's name: several makers publish the same layout under their
own names. Without a definition, the name of the type decides. A known name with another layout is refused. An export of
evetac has its note on a topic.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.note import Note, read_note
from evetac_cli.formats.read.bags.bag_files import BAGS, Bag, Message, open_bag
from evetac_cli.formats.read.bags.bag_readers import Connection, checksum
from evetac_cli.formats.read.bags.ros_messages import (
    Fields,
    MessageEvents,
    Packet,
    decoder,
    event_array,
    event_packet,
    evetac_image,
)
from evetac_cli.formats.read.prophesee.encodings import ENCODINGS
from evetac_cli.formats.read.prophesee.read_prophesee import decoded
from evetac_cli.formats.read.source import NOT_RECORDED, EventColumns, EventSource, ImportFormat, choose_frame

EVENTS_TOPIC, NOTE_TOPIC = "/evetac/events", "/evetac/note"  # in exports of evetac
NOTE_TYPE = "std_msgs/msg/String"
UNSET = "events whose time is 0, so never set"
PROPHESEE = ("evt2", "evt3")
Content = tuple[str, Any]  # a text on where a message is, and its events or packet
KNOWN_ENCODINGS = ("mono", "libcaer", "libcaer_cmp", *PROPHESEE)

ARRAY = "5e8beee5a6c107e504c2e78903c224b8"
PACKET = "8a6101b351a64529ac77bd8b71074e52"
IMAGE = "2818627cc6bda2f17fa76bbb89741632"
# The decoder of each layout, by the checksum of its definition.
LAYOUTS: dict[str, Callable[[Fields], Any]] = {ARRAY: event_array, PACKET: event_packet, IMAGE: evetac_image}
# Names under which the layouts are published: for bags without definitions, and to detect a layout that has changed.
TYPES = {
    "dvs_msgs/msg/EventArray": ARRAY,
    "dv_ros_msgs/msg/EventArray": ARRAY,
    "dv_ros2_msgs/msg/EventArray": ARRAY,
    "prophesee_event_msgs/msg/EventArray": ARRAY,
    "event_camera_msgs/msg/EventPacket": PACKET,
    "event_array_msgs/msg/EventArray": PACKET,
    "evetac_software/msg/EvetacMsg": IMAGE,
}


@lru_cache(maxsize=1024)
def layout(connection: Connection) -> str:
    """Return the checksum of the layout of a connection's messages if it is one of events; empty otherwise."""
    if connection.encoding not in ("cdr", "ros1"):
        return ""
    digest = connection.digest or checksum(connection.msgtype, connection.definition)
    if digest in ("", "*"):
        return TYPES.get(connection.msgtype, "")
    return digest if digest in LAYOUTS else ""


def open_rosbag(path: Path, frame_px: tuple[int, int] | None, stream: str | None = None) -> EventSource:
    """Return the events of one topic: the requested one, or the first by name that has events."""
    where = str(path)
    source = EventSource("rosbag", (1, 1), ())
    bag = open_bag(path)
    source.cut_short = bag.cut_short
    topics = topics_of_events(bag, where)
    topic = _choose(topics, bag, stream, where)
    kind, others = topics[topic], sorted(set(topics) - {topic})
    if others:
        source.notes.append(f"read the topic {topic}; the file also has: {', '.join(others)} (choose with --stream)")
    source.notes += bag.notes
    if topic == EVENTS_TOPIC:
        source.note = _note(bag, where)
    source.left_out |= _left_out(bag.connections, topic)
    first = next(_messages(bag, topic), None)
    if first is None:
        if source.note is None or source.note.slices:
            raise InputError(f"the topic {topic} has no messages", where=where, hint="was the camera running?")
        source.frame_px = choose_frame(source.note.frame_px, frame_px, where)
        return source
    frame, content = _read(first[0], first[2], f"{where}: message 0")
    encoding = content.encoding if isinstance(content, Packet) else ""
    source.frame_px = choose_frame(frame, frame_px, where)
    contents = _contents(bag, topic, kind, source, encoding)
    if encoding in PROPHESEE:
        source.batches = decoded(encoding, _blocks(contents, source, encoding), source, f"{path}: {topic}")
    elif not isinstance(content, Packet) or decoder(encoding) is not None:
        source.batches = _batches(contents, kind, source, encoding)
    else:
        message, expected = f"the encoding of the messages on {topic} is not supported", ", ".join(KNOWN_ENCODINGS)
        raise InputError(message, where=where, expected=expected, found=encoding[:40] or "none")
    return source


def topics_of_events(bag: Bag, where: str) -> dict[str, str]:
    """Return the layout of each topic with events, the default first; raise InputError for a changed known type."""
    topics: dict[str, str] = {}
    for connection in bag.connections:
        if digest := layout(connection):
            topics[connection.topic] = digest
        elif connection.msgtype in TYPES:
            found = connection.digest or checksum(connection.msgtype, connection.definition)
            message, expected = f"unknown definition of {connection.msgtype}", f"checksum {TYPES[connection.msgtype]}"
            raise InputError(message, where=f"{where}: {connection.topic}", expected=expected, found=found[:40])
    by_name = sorted(topics, key=lambda topic: (topics[topic] == IMAGE, topic))  # prefer events to images
    return {topic: topics[topic] for topic in by_name}


def _choose(topics: dict[str, str], bag: Bag, wanted: str | None, where: str) -> str:
    """Return the topic to read: the requested one, or the first."""
    if not topics:
        kinds = ", ".join(sorted({connection.msgtype for connection in bag.connections}))[:300]
        expected, hint = f"{', '.join(TYPES)}, or a type of the same layout", NOT_RECORDED if kinds else ""
        raise InputError("the bag has no events", where=where, expected=expected, found=kinds or "nothing", hint=hint)
    topic = next(iter(topics)) if wanted is None else wanted
    if topic not in topics:
        expected = " or ".join(sorted(topics))
        raise InputError("this topic does not exist or has no events", where=where, expected=expected, found=topic)
    return topic


def _note(bag: Bag, where: str) -> Note | None:
    """Return the note of an evetac export; None if there is none."""
    message = next(_messages(bag, NOTE_TOPIC, of_type=NOTE_TYPE), None)
    if message is None:
        return None
    with _layout_in_words(f"{where}: {NOTE_TOPIC}"):
        text = Fields(message[2], ros2=message[0].ros2).text()
    return read_note(text, where)


def _left_out(connections: list[Connection], topic: str) -> dict[str, int]:
    """Return the number of messages of each other topic."""
    counts: Counter[str] = Counter()
    for one in connections:
        if one.topic not in (topic, NOTE_TOPIC) and one.msgcount:
            counts[f"messages on {one.topic} ({one.msgtype})"] += one.msgcount
    return dict(counts)


def _batches(contents: Iterator[Content], kind: str, source: EventSource, encoding: str) -> Iterator[EventColumns]:
    """Yield the events of each message of a topic as one batch; at the end add a note on images to `source`."""
    decode = decoder(encoding)
    stamps = []
    for number, (where, content) in enumerate(contents):
        part: MessageEvents = content
        if decode is not None:
            with _layout_in_words(where):
                part = decode(content)
        if kind == IMAGE and len(part.t):
            stamps.append(int(part.t[0]))
        yield EventColumns(*part, partial("in message {}, event {}".format, number))
    if kind == IMAGE:
        apart = f"every {(stamps[-1] - stamps[0]) / (len(stamps) - 1) / 1000:.3g} ms" if len(stamps) > 1 else "once"
        source.notes.append(
            f"EvetacMsg contains images, not events: per-pixel sums, {apart}, after the official software's noise"
            " filter; all events of an image get its time"
        )


def _blocks(
    contents: Iterator[Content], source: EventSource, encoding: str
) -> Iterator[tuple[NDArray[Any], Callable[[int], str]]]:
    """Yield the words of each message; a word split over two messages belongs to the second."""
    dtype = np.dtype(ENCODINGS[encoding].dtype)
    rest = b""
    for number, (_, packet) in enumerate(contents):
        content = rest + bytes(packet.content)
        whole = len(content) // dtype.itemsize * dtype.itemsize
        rest = content[whole:]
        yield np.frombuffer(content[:whole], dtype), partial("in message {}, word {}".format, number)
    if rest:
        source.notes.append(f"cut short: the last {len(rest)} bytes are an incomplete word")


def _contents(bag: Bag, topic: str, kind: str, source: EventSource, encoding: str) -> Iterator[Content]:
    """Yield the content of each message of a topic; add a note on lost messages to `source`.

    Raises InputError if layout, frame size or encoding change.
    """
    lost, unset, timed, expected = 0, 0, False, None
    for number, (connection, _, message) in enumerate(_messages(bag, topic)):
        where = f"{bag.path}: message {number} on {topic}"
        if layout(connection) != kind:
            raise InputError("the layout of the messages changes", where=where, found=connection.msgtype)
        frame, content = _read(connection, message, where)
        if frame != source.frame_px:
            sizes = ("{}x{}".format(*size) for size in (source.frame_px, frame))
            raise InputError("the frame size changes", where=where, expected=next(sizes), found=next(sizes))
        if isinstance(content, Packet):
            if content.encoding != encoding:
                raise InputError("the encoding changes", where=where, expected=encoding, found=content.encoding[:40])
            lost += expected is not None and content.sequence > expected and content.sequence - expected
            expected = content.sequence + 1
        else:
            known = content.t != 0
            timed |= bool(known.any())
            unset += len(known) - int(np.count_nonzero(known))
            content = MessageEvents(*(column[known] for column in content))
        yield where, content
    if unset and not timed:
        raise InputError("no event of the topic has a time", where=f"{bag.path}: {topic}", found="0 in all of them")
    if unset:
        source.left_out[UNSET] = unset
    if lost:
        source.notes.append(f"{lost} messages are missing: they were lost before they were recorded")


def _read(connection: Connection, message: bytes, where: str) -> tuple[tuple[int, int], Any]:
    """Return frame (width, height) and content of a message: its events, or a packet that is still encoded."""
    with _layout_in_words(where):
        content = LAYOUTS[layout(connection)](Fields(message, ros2=connection.ros2))
        return (content.frame_px, content) if isinstance(content, Packet) else content


@contextmanager
def _layout_in_words(where: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise InputError("a message is damaged", where=where, found=str(error)) from None


def _messages(bag: Bag, topic: str, *, of_type: str = "") -> Iterator[Message]:
    """Yield the messages of a topic that have events, or a given type."""
    of_topic = (one for one in bag.connections if one.topic == topic)
    return bag.messages([one for one in of_topic if (one.msgtype == of_type if of_type else layout(one))])


FORMAT = ImportFormat(tuple(BAGS), open_rosbag, ("stream",))
