"""Read events from bags of ROS 1 (`.bag`) and ROS 2 (a folder, `.db3`, `.mcap`) with rosbags, the extra `convert`.

rosbags finds the messages; what is in them is decoded in ros_messages, from their bytes. So a bag needs no
definitions of its messages, and those of other topics do not matter. Where a ROS 1 bag says by the checksum of a
definition that its messages have another layout under the same name, it is refused. An export of ours has its note on
a topic.
"""

from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, install_hint
from evetac_cli.formats.note import Note, read_note
from evetac_cli.formats.read.bags.ros_messages import (
    Fields,
    Packet,
    Part,
    decoder,
    event_array,
    event_packet,
    evetac_image,
)
from evetac_cli.formats.read.bags.rosbag_unpacking import limit_unpacking
from evetac_cli.formats.read.event_validation import Columns, Foreign, choose_frame
from evetac_cli.formats.read.prophesee_words import ENCODINGS
from evetac_cli.formats.read.read_prophesee import decoded
from evetac_cli.text_files import open_regular, read_bytes

SQLITE = b"SQLite format 3\x00"
MCAP = b"\x89MCAP0\r\n"
ROS1 = b"#ROSBAG V2.0\n"
METADATA = "metadata.yaml"
MOST_METADATA_BYTES = 1 << 20  # a topic takes a few hundred
ZSTD = b"\x28\xb5\x2f\xfd"
EVENTS_TOPIC, NOTE_TOPIC = "/evetac/events", "/evetac/note"  # of exports of ours
NOTE_TYPE = "std_msgs/msg/String"
PROPHESEE = ("evt2", "evt3")
KNOWN_ENCODINGS = ("mono", "libcaer", "libcaer_cmp", *PROPHESEE)

ARRAY = "5e8beee5a6c107e504c2e78903c224b8"
PACKET = "8a6101b351a64529ac77bd8b71074e52"
IMAGE = "2818627cc6bda2f17fa76bbb89741632"
# Types of messages: how they are decoded, and the checksum of their definition in ROS 1.
TYPES: dict[str, tuple[Callable[[Fields], Any], str]] = {
    "dvs_msgs/msg/EventArray": (event_array, ARRAY),
    "prophesee_event_msgs/msg/EventArray": (event_array, ARRAY),
    "event_camera_msgs/msg/EventPacket": (event_packet, PACKET),
    "event_array_msgs/msg/EventArray": (event_packet, PACKET),
    "evetac_software/msg/EvetacMsg": (evetac_image, IMAGE),
}


def is_bag_folder(path: Path) -> bool:
    """Whether this folder is a bag of ROS 2."""
    return (path / METADATA).is_file()


def open_rosbag(path: Path, frame_px: tuple[int, int] | None, stream: str | None = None) -> Foreign:
    """Events of one topic: the one named, or the first by name that holds events."""
    where = str(path)
    foreign = Foreign("rosbag", (1, 1), ())
    with open_bag(path) as (reader, ros2):
        topic, kind, others = _choose(reader.connections, ros2, stream, where)
        if others:
            foreign.notes.append(f"took the topic {topic}; also there: {', '.join(others)} (choose with --stream)")
        if topic == EVENTS_TOPIC and ros2:
            foreign.note = _note(reader, where)
        foreign.left_out |= _left_out(reader.connections, topic)
        first = next(_messages(reader, topic, kind, where), None)
        if first is None and foreign.note is not None and not foreign.note.slices:
            foreign.frame_px = choose_frame(foreign.note.frame_px, frame_px, where)
            return foreign
        if first is None:
            raise InputError(f"no message on the topic {topic}", where=where, hint="a recorder that saw no camera?")
        frame, content = _read(kind, first, ros2, f"{where}: message 0")
    encoding = content.encoding if isinstance(content, Packet) else ""
    foreign.frame_px = choose_frame(frame, frame_px, where)
    if encoding in PROPHESEE:
        foreign.batches = _prophesee(path, topic, kind, foreign, encoding)
    elif not isinstance(content, Packet) or decoder(encoding) is not None:
        foreign.batches = _batches(path, topic, kind, foreign, encoding)
    else:
        raise InputError(
            f"messages on {topic} are in an encoding that is not read here",
            where=where,
            expected=", ".join(KNOWN_ENCODINGS),
            found=encoding[:40] or "none",
        )
    return foreign


def _choose(connections: list[Any], ros2: bool, wanted: str | None, where: str) -> tuple[str, str, list[str]]:
    """Topic, type of its messages, and the other topics with events."""
    topics: dict[str, str] = {}
    for connection in connections:
        if connection.msgtype in TYPES:
            topics[connection.topic] = connection.msgtype
            checksum = TYPES[connection.msgtype][1]
            if not ros2 and connection.digest not in (checksum, "*"):
                raise InputError(
                    f"{connection.msgtype} has another definition here",
                    where=f"{where}: {connection.topic}",
                    expected=f"checksum {checksum}",
                    found=connection.digest[:40],
                )
    if not topics:
        kinds = sorted({connection.msgtype for connection in connections})
        raise InputError(
            "the bag holds no events", where=where, expected=", ".join(TYPES), found=", ".join(kinds)[:300] or "nothing"
        )
    first = min(topics, key=lambda topic: (TYPES[topics[topic]][1] == IMAGE, topic))  # rather events than images
    topic = first if wanted is None else wanted
    if topic not in topics:
        raise InputError("no events on this topic", where=where, expected=" or ".join(sorted(topics)), found=topic)
    return topic, topics[topic], sorted(set(topics) - {topic})


def _note(reader: Any, where: str) -> Note | None:
    """The note of an export of ours; None where there is none."""
    message = next(_messages(reader, NOTE_TOPIC, NOTE_TYPE, where), None)
    if message is None:
        return None
    with _layout_in_words(f"{where}: {NOTE_TOPIC}"):
        text = Fields(message, ros2=True).text()
    return read_note(text, where)


def _left_out(connections: list[Any], topic: str) -> dict[str, int]:
    """How many messages there are of each other topic."""
    counts: Counter[str] = Counter()
    for one in connections:
        if one.topic not in (topic, NOTE_TOPIC) and one.msgcount:
            counts[f"messages on {one.topic} ({one.msgtype})"] += one.msgcount
    return dict(counts)


def _batches(path: Path, topic: str, kind: str, foreign: Foreign, encoding: str) -> Iterator[Columns]:
    """The events of each message of a topic as one batch; at the end `foreign` says what is missing."""
    decode = decoder(encoding)
    stamps = []
    with closing(_contents(path, topic, kind, foreign, encoding)) as contents:
        for number, (where, content) in enumerate(contents):
            if isinstance(content, Packet):
                assert decode is not None
                with _layout_in_words(where):
                    part: Part = decode(content)
            else:
                part = content
            if kind.startswith("evetac") and len(part.t):
                stamps.append(int(part.t[0]))
            yield Columns(*part, partial(_place, number))
    if kind.startswith("evetac"):
        apart = f"every {(stamps[-1] - stamps[0]) / (len(stamps) - 1) / 1000:.3g} ms" if len(stamps) > 1 else "once"
        foreign.notes.append(
            f"EvetacMsg holds images, not events: summed by pixel, {apart}, after the official software's noise filter;"
            " all events of an image have its time"
        )


def _place(number: int, row: int) -> str:
    return f"in message {number}, event {row}"


def _prophesee(path: Path, topic: str, kind: str, foreign: Foreign, encoding: str) -> Iterator[Columns]:
    """The words of all messages as those of one RAW file."""
    yield from decoded(encoding, _blocks(path, topic, kind, foreign, encoding), foreign, f"{path}: {topic}")


def _blocks(
    path: Path, topic: str, kind: str, foreign: Foreign, encoding: str
) -> Iterator[tuple[NDArray[Any], Callable[[int], str]]]:
    """The words of each message; a word that two messages share is counted to the second."""
    dtype = np.dtype(ENCODINGS[encoding].dtype)
    rest = b""
    with closing(_contents(path, topic, kind, foreign, encoding)) as packets:
        for number, (_, packet) in enumerate(packets):
            content = rest + bytes(packet.content)
            whole = len(content) // dtype.itemsize * dtype.itemsize
            rest = content[whole:]
            yield np.frombuffer(content[:whole], dtype), partial(_word_place, number)
    if rest:
        foreign.notes.append(f"cut short: the last {len(rest)} bytes are no whole word")


def _word_place(number: int, word: int) -> str:
    return f"in message {number}, word {word}"


def _contents(
    path: Path, topic: str, kind: str, foreign: Foreign, encoding: str
) -> Generator[tuple[str, Any], None, None]:
    """What is in each message of a topic; all have one frame and one encoding. Lost messages are noted."""
    lost, expected = 0, None
    with open_bag(path) as (reader, ros2):
        for number, message in enumerate(_messages(reader, topic, kind, str(path))):
            where = f"{path}: message {number} on {topic}"
            frame, content = _read(kind, message, ros2, where)
            if frame != foreign.frame_px:
                raise InputError(
                    "the frame changes",
                    where=where,
                    expected="{}x{}".format(*foreign.frame_px),
                    found="{}x{}".format(*frame),
                )
            if isinstance(content, Packet):
                if content.encoding != encoding:
                    raise InputError(
                        "the encoding changes", where=where, expected=encoding, found=content.encoding[:40]
                    )
                lost += expected is not None and content.sequence > expected and content.sequence - expected
                expected = content.sequence + 1
            yield where, content
    if lost:
        foreign.notes.append(f"{lost} messages were lost before they were recorded")


def _read(kind: str, message: bytes, ros2: bool, where: str) -> tuple[tuple[int, int], Any]:
    """Frame (width, height) and content of a message: its events, or a packet that is still encoded."""
    if ros2 and message[: len(ZSTD)] == ZSTD:  # only metadata.yaml says so
        hint = "name the folder of the bag, with its metadata.yaml"
        raise InputError("the messages of this bag are compressed one by one", where=where, hint=hint)
    with _layout_in_words(where):
        content = TYPES[kind][0](Fields(message, ros2=ros2))
        return (content.frame_px, content) if isinstance(content, Packet) else content


@contextmanager
def _layout_in_words(where: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise InputError("a message is damaged", where=where, found=str(error)) from None


def _messages(reader: Any, topic: str, kind: str, where: str) -> Iterator[bytes]:
    """The bytes of all messages of a topic, in the order of their reception."""
    chosen = [one for one in reader.connections if (one.topic, one.msgtype) == (topic, kind)]
    messages = iter(reader.messages(chosen) if chosen else ())  # rosbags takes none for all
    number = 0
    while True:
        with bag_in_words(where, f"message {number}"):
            message = next(messages, None)
        if message is None:
            return
        yield message[2]
        number += 1


@contextmanager
def open_bag(path: Path) -> Iterator[tuple[Any, bool]]:
    """The bag, open for reading, and whether it is of ROS 2."""
    where = str(path)
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        limit_unpacking()
    except (ImportError, AttributeError) as error:
        hint = install_hint("convert")
        raise InputError("ROS bags need rosbags", where=where, found=str(error), hint=hint) from None
    kind: Any = Reader2
    if path.is_dir():
        for inside in path.iterdir():
            if not inside.is_dir():
                open_regular(inside).close()
        read_bytes(path / METADATA, MOST_METADATA_BYTES)
    if path.is_file():  # rosbags goes by the name of a file, we by its content
        with path.open("rb") as file:
            head = file.read(len(SQLITE))
        kind = Reader1 if head.startswith(ROS1) else Reader2.STORAGE_PLUGINS[".mcap" if head[:8] == MCAP else ".db3"]
    with bag_in_words(where, "the bag"):
        reader = kind(path)
        reader.open()
    try:
        yield reader, kind is not Reader1
    finally:
        with suppress(Exception):
            reader.close()


@contextmanager
def bag_in_words(where: str, what: str) -> Iterator[None]:
    """Damaged bags make rosbags, and the parsers below it, raise anything."""
    try:
        yield
    except (MemoryError, InputError):
        raise
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        hint = "rosbag reindex" if "index" in reason else "the recorder may have been stopped; copy it again"
        raise InputError(f"{what} cannot be read", where=where, found=reason, hint=hint) from None
