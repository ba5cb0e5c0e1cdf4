"""Read a topic of a ROS bag as a stream of samples: images, or the numbers of any message that ROS itself defines.

rosbags decodes the messages with its own definitions, never with those in a bag, which would be turned into code.
Columns have the names of the fields, such as `pose.position.x`, and the units that the definitions state (REP 103).
Parts with names, such as the joints of a JointState, are identified by name, because their place may change.

Samples are sorted by their own stamps, because neither the order of a file nor the recorder's clock is reliable. A
stamp of 0 among others was never set. Images and numbers are stored on disk temporarily, so a bag of hours takes no
more memory than a short one.

External triggers of iniVation's driver, dv_ros_msgs/Trigger, are streams too, although ROS does not define their type:
int8 source, numbered as in AEDAT4, and time. Triggers among the words of evt2 and evt3 are read with the events.
"""

import io
import math
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.formats.read.bags.bag_files import Bag, open_bag
from evetac_cli.formats.read.bags.bag_readers import Connection, checksum
from evetac_cli.formats.read.bags.read_rosbag import layout
from evetac_cli.formats.read.bags.ros_messages import NS, Fields
from evetac_cli.formats.read.damage import read_in_words
from evetac_cli.store.hdf5.disk import joined_on_disk
from evetac_cli.store.recordings.streams import BLOCK_VALUES, LARGEST_FRAME_PX, Stream, free_name

SIMULATED_START_US = 1_000_000  # a first stamp of 0 is one if the next is at most this
RECEPTION = "the time at which the recorder received the message"
MESSAGES_AT_ONCE = 1000  # messages of numbers that become one part of an array
MOST_NUMBERS = 512  # of a message
MOST_NAMED = 12  # topics or columns in a message
LABELS = ("name", "joint_names")  # fields with names for the lists beside them: JointState, MultiDOFJointState
STEP = "time_from_start"  # a field of the points of a trajectory, whose lists have the names of the joints
# Fields with the name of a part of a list, by the parts' type.
LABEL_OF_PART = {"sensor_msgs/msg/ChannelFloat32": "name", "geometry_msgs/msg/TransformStamped": "child_frame_id"}
MOST_PACKED_PX = 1 << 26  # of a JPEG or PNG: some kB may unpack to four bytes per pixel, in two copies
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
# Encodings of images: the number of channels, and the indices of grey, or of red, green and blue.
ENCODINGS = {
    "mono8": (1, (0,)),
    "8UC1": (1, (0,)),
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
}
# Units of fields, by the type of their message.
UNITS = {
    "geometry_msgs/msg/Pose": {"position": "m"},
    "geometry_msgs/msg/PointStamped": {"point": "m"},
    "geometry_msgs/msg/Transform": {"translation": "m"},
    "geometry_msgs/msg/Wrench": {"force": "N", "torque": "N m"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/msg/Accel": {"linear": "m/s2", "angular": "rad/s2"},
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s2"},
}
TRIGGERS_OF_DV = ("dv_ros_msgs/msg/Trigger", "dv_ros2_msgs/msg/Trigger")
READ = "images, and messages that ROS itself defines, such as geometry_msgs/PoseStamped or geometry_msgs/WrenchStamped"


def read_bag_stream(path: Path, topic: str, folder: Path | None) -> tuple[Stream, list[str]]:
    """Return a topic as an unnamed stream in its own clock, and notes; raise InputError if it cannot be read.

    topic: if empty, the only topic without events. folder: where the samples are stored temporarily.
    """
    bag = open_bag(path)
    stream, notes = stream_of_topic(bag, topic, folder)
    return stream, [*notes, *bag.notes]


def stream_of_topic(bag: Bag, topic: str, folder: Path | None) -> tuple[Stream, list[str]]:
    """Return a topic of an open bag as read_bag_stream does, with notes on its samples alone."""
    where = f"{bag.path}: {topic}" if topic else str(bag.path)
    connections = _of_topic(bag.connections, topic, where)
    topic, kind = connections[0].topic, connections[0].msgtype
    where = f"{bag.path}: {topic}"
    decode = _decoder(kind, connections, where)

    def columns() -> tuple[NDArray[Any], ...]:
        return joined_on_disk(folder, reader_of.parts(_decoded(bag.messages(connections), decode, where)))

    reader_of = _Images(where) if kind in (IMAGE, COMPRESSED) else _Numbers(where)
    stored = columns()
    if reader_of.incomplete:
        stored = columns()
    if not stored:
        raise InputError("the topic has no messages", where=where)
    t_us, clock, rows, notes = _times(*stored[:2])
    if len(rows) == len(stored[0]) and (rows[1:] > rows[:-1]).all():
        values = list(stored[2:])
    else:
        at_once = max(1, BLOCK_VALUES // math.prod(stored[2].shape[1:]))
        some = (rows[first : first + at_once] for first in range(0, len(rows), at_once))
        moved = (tuple(np.asarray(one[part]) for one in (t_us, *stored[2:])) for part in some)
        t_us, *values = joined_on_disk(folder, moved)
    source, what = f"{bag.path.name}: {topic}", kind.replace("/msg/", "/")
    stream = Stream("", t_us, what=what, source=source, clock=clock, left_out=len(stored[0]) - len(rows))
    return reader_of.filled(stream, values), [*notes, *reader_of.notes()]


def _times(
    stamp_us: NDArray[np.int64], received_us: NDArray[np.int64]
) -> tuple[NDArray[np.int64], str, NDArray[np.intp], list[str]]:
    """Return the times of samples (their own stamps, or those of reception if no sample has one) and their clock.

    Also the indexes of the samples that are kept, in order of time, and notes.
    """
    notes: list[str] = []
    known = stamp_us != 0
    t_us, clock = (stamp_us, "header.stamp") if known.any() else (received_us, RECEPTION)
    if known.any():
        known[0] |= len(known) > 1 and 0 < stamp_us[1] <= SIMULATED_START_US  # the clock of a simulation starts at 0
        if not known.all():
            notes.append(f"left out {_samples(np.count_nonzero(~known))} whose stamp is 0, so never set")
    else:
        known[:] = True
    rows = np.flatnonzero(known)
    times = t_us[rows]
    late_us = np.maximum.accumulate(times) - times
    if late_us.any():
        most_s = int(late_us.max()) / 1e6
        notes.append(f"{_samples(np.count_nonzero(late_us))} came late, by up to {most_s:.6g} s: sorted by time")
    return t_us, clock, rows[np.argsort(times, kind="stable")], notes


def _samples(count: Any) -> str:
    return "1 sample" if count == 1 else f"{count:,} samples"


def _of_topic(connections: list[Connection], topic: str, where: str) -> list[Connection]:
    """Return the connections of a topic.

    Raises InputError if it does not exist, has several types or an unsupported encoding, or if no topic is given and
    there is not exactly one.
    """
    others = sorted({one.topic for one in connections if not layout(one)})
    topic_name = topic or (others[0] if len(others) == 1 else "")
    of_topic = [one for one in connections if one.topic == topic_name]
    if not of_topic:
        message = "the bag has no such topic" if topic else "the bag has no topic other than events, or several"
        hint = f"give it after the file, for example FILE:{others[0]}" if others else ""
        raise InputError(message, where=where, expected=", ".join(others)[:300] or "a topic", found=topic, hint=hint)
    kinds = sorted({(one.msgtype, one.encoding) for one in of_topic})
    if len(kinds) > 1 or kinds[0][1] not in ("cdr", "ros1"):
        expected, found = "one type of messages, in cdr or ros1", ", ".join(map(" in ".join, kinds))[:200]
        raise InputError("the messages of the topic cannot be read", where=where, expected=expected, found=found)
    return of_topic


def _decoder(kind: str, connections: list[Connection], where: str) -> Callable[[bytes], Any]:
    """Return a function that decodes a message; raise InputError if ROS does not define its type in this way."""
    from rosbags.typesys import Stores, get_typestore

    ros2 = connections[0].ros2
    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    if kind not in store.fielddefs:
        raise InputError("the type of these messages is not supported", where=where, expected=READ, found=kind)
    if ros2:
        return lambda message: store.deserialize_cdr(message, kind)
    ours = store.generate_msgdef(kind)[1]
    digests = {one.digest or checksum(one.msgtype, one.definition) for one in connections}
    if digests - {ours, "*"}:
        expected, found = f"checksum {ours}", ", ".join(sorted(digests))[:120]
        raise InputError(f"the definition of {kind} is not that of ROS 1", where=where, expected=expected, found=found)
    return lambda message: store.deserialize_ros1(message, kind)


def _stamped(message: Any) -> Iterator[tuple[int, Any]]:
    """Yield stamp in us and message; transforms without a common header in parts, one per stamp. 0: no stamp."""
    headed = [message] if hasattr(message, "header") else getattr(message, "transforms", [])
    stamps_us = [one.header.stamp.sec * 10**6 + one.header.stamp.nanosec // NS for one in headed]
    distinct = sorted(set(stamps_us))
    if len(distinct) <= 1:
        yield distinct[0] if distinct else 0, message
        return
    for stamp_us in distinct:
        some = [one for one, own_us in zip(headed, stamps_us, strict=True) if own_us == stamp_us]
        yield stamp_us, replace(message, transforms=some)


def _decoded(messages: Iterator[Any], decode: Callable[[bytes], Any], where: str) -> Iterator[tuple[int, Any]]:
    """Yield the time of reception in ns and the content of each message."""
    for number, (_, received_ns, message) in enumerate(messages):
        with read_in_words(where, f"message {number} cannot be read"):
            content = decode(message)
        yield received_ns, content


class _MessageReader:
    """Converts messages to parts of arrays: stamps, times of reception, and values.

    number: index of the current message.
    incomplete: whether the messages must be read once more, because a later one had what the first ones have not.
    """

    def __init__(self, where: str) -> None:
        self.where = where
        self.number = 0
        self.incomplete = False

    def samples(self, messages: Iterator[tuple[int, Any]]) -> Iterator[tuple[tuple[int, int], Any]]:
        """Yield stamp and time of reception in us, and the message or part of it that has this stamp."""
        for self.number, (received_ns, message) in enumerate(messages):
            for stamp_us, part in _stamped(message):
                yield (stamp_us, received_ns // NS), part

    def notes(self) -> list[str]:
        """Return notes on values that are missing."""
        return []

    def refuse(self, message: str, expected: str, what: str) -> None:
        """Raise InputError at the current message."""
        where = f"{self.where}: message {self.number}"
        raise InputError(message, where=where, expected=expected[:300], found=what[:300])


class _Numbers(_MessageReader):
    """All numbers of messages as columns."""

    def __init__(self, where: str) -> None:
        super().__init__(where)
        self._units: dict[str, str] = {}  # of the columns
        self._sizes: dict[str, str] = {}  # of lists, which must stay the same
        self._samples = self._lacking = 0
        self._lacked: dict[str, None] = {}  # columns, in their order

    def parts(self, messages: Iterator[tuple[int, Any]]) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield times and rows of numbers of the next messages; NaN where a message lacks a column."""
        self.incomplete, self._samples, self._lacking = False, 0, 0
        times: list[tuple[int, int]] = []
        rows: list[list[float]] = []
        for stamp_and_reception_us, message in self.samples(messages):
            times.append(stamp_and_reception_us)
            self._samples += 1
            numbers = _Found()
            numbers.collect(message, "", "", [])
            more = numbers.units.keys() - self._units.keys()
            self._units |= {name: unit for name, unit in numbers.units.items() if name in more}
            changed = [one for one, size in numbers.sizes.items() if self._sizes.setdefault(one, size) != size]
            if changed or not self._units or len(self._units) > MOST_NUMBERS:
                expected = f"1 to {MOST_NUMBERS} numbers, and lists that have the same length in each message"
                found = f"{changed[0]}: {numbers.sizes[changed[0]]}" if changed else f"{len(self._units)} numbers"
                self.refuse("the message's fields do not fit into columns", expected, found)
            infinite = next((name for name, value in numbers.values.items() if math.isinf(value)), None)
            if infinite is not None:
                self.refuse("a value is infinite", "finite values, or NaN", infinite)
            self.incomplete |= bool(more) and self._samples > 1
            if self.incomplete:
                times = []
                continue
            if len(numbers.values) < len(self._units):
                self._lacking += 1
                self._lacked |= dict.fromkeys(name for name in self._units if name not in numbers.values)
            rows.append([numbers.values.get(name, math.nan) for name in self._units])
            if len(rows) == MESSAGES_AT_ONCE:
                yield *np.array(times, np.int64).T, np.array(rows)
                times, rows = [], []
        if rows and not self.incomplete:
            yield *np.array(times, np.int64).T, np.array(rows)

    def notes(self) -> list[str]:
        """Return a note on columns that some samples lack."""
        if not self._lacking:
            return []
        lacked = [name for name in self._units if name in self._lacked]
        names = ", ".join(lacked[:MOST_NAMED]) + (" ..." if len(lacked) > MOST_NAMED else "")
        return [f"{self._lacking:,} of {self._samples:,} samples lack a part of {names}: NaN there"]

    def filled(self, stream: Stream, values: list[NDArray[Any]]) -> Stream:
        """Return the stream with the values that were read."""
        columns: dict[str, NDArray[np.float64]] = {}
        units: dict[str, str] = {}
        for at, (wanted, unit) in enumerate(self._units.items()):
            name = free_name(wanted, columns)
            columns[name], units[name] = values[0][:, at], unit
        return replace(stream, columns=columns, units=units)


class _Found:
    """The numbers of one message with their units, by path; and the sizes of the lists that they are in."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self.units: dict[str, str] = {}
        self.sizes: dict[str, str] = {}

    def collect(self, value: Any, name: str, unit: str, labels: list[str]) -> None:
        """Take the numbers in a field and its subfields; skip texts and headers.

        labels: names of the parts of lists of this length, such as the joints of a JointState.
        """
        if len(self.values) > MOST_NUMBERS:
            return
        if is_dataclass(value):
            units = UNITS.get(getattr(value, "__msgtype__", ""), {})
            here = next((_unique(getattr(value, one, None)) for one in LABELS if hasattr(value, one)), labels)
            for item in fields(value):
                if item.name != "header":
                    path = f"{name}.{item.name}" if name else item.name
                    self.collect(getattr(value, item.name), path, units.get(item.name, unit), here)
        elif isinstance(value, (bool, int, float, np.number)):
            self.values[name], self.units[name] = float(value), unit
        elif isinstance(value, (list, np.ndarray)) and len(value) and not isinstance(value[0], str):
            label = LABEL_OF_PART.get(getattr(value[0], "__msgtype__", ""), "")
            names = _unique([getattr(one, label) for one in value]) if label else []
            if not names and len(labels) == len(value) and not hasattr(value[0], STEP):
                names = labels
            self.sizes[name] = "named" if names else f"{len(value):,} without names"
            for label, one in zip(names or map(str, range(MOST_NUMBERS + 1)), value, strict=False):
                self.collect(one, f"{name}.{label}", unit, labels)


def _unique(labels: Any) -> list[str]:
    """Return the labels if they are different texts, otherwise none."""
    texts = isinstance(labels, list) and all(isinstance(one, str) and one for one in labels)
    return labels if texts and len(set(labels)) == len(labels) else []


class _Images(_MessageReader):
    """Images of one size."""

    def parts(self, messages: Iterator[tuple[int, Any]]) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield time and image of each message."""
        shape: tuple[int, ...] | None = None
        for (stamp_us, received_us), message in self.samples(messages):
            image = self._plain(message) if hasattr(message, "step") else self._unpacked(message)
            shape = shape or image.shape
            if image.shape != shape:
                self.refuse("the size of the images changes", str(shape), str(image.shape))
            yield np.array([stamp_us], np.int64), np.array([received_us], np.int64), image[None]

    def filled(self, stream: Stream, values: list[NDArray[Any]]) -> Stream:
        """Return the stream with the images that were read."""
        return replace(stream, frames=values[0])

    def _check_size(self, width: int, height: int) -> None:
        if not (0 < width <= LARGEST_FRAME_PX and 0 < height <= LARGEST_FRAME_PX):
            expected = f"1 to {LARGEST_FRAME_PX} px per side"
            self.refuse("an image has an impossible size", expected, f"{width} x {height}")

    def _plain(self, message: Any) -> NDArray[np.uint8]:
        if message.encoding not in ENCODINGS:
            self.refuse("the encoding of an image is not supported", ", ".join(ENCODINGS), str(message.encoding))
        stored, shown = ENCODINGS[message.encoding]
        width, height, step = int(message.width), int(message.height), int(message.step)
        self._check_size(width, height)
        if step < width * stored or len(message.data) != step * height:
            expected = f"{height} rows of {step} bytes"
            self.refuse("an image does not have the size that it states", expected, str(len(message.data)))
        rows = np.asarray(message.data, np.uint8).reshape(height, step)[:, : width * stored]
        return np.ascontiguousarray(rows.reshape(height, width, stored)[:, :, list(shown)])

    def _unpacked(self, message: Any) -> NDArray[np.uint8]:
        with needs_extra("compressed images need pillow", "plot", self.where):
            from PIL import Image
        with read_in_words(self.where, f"the image of message {self.number} cannot be read"):
            opened = Image.open(io.BytesIO(np.asarray(message.data, np.uint8).tobytes()), formats=("JPEG", "PNG"))
        self._check_size(*opened.size)  # before it is unpacked
        if math.prod(opened.size) > MOST_PACKED_PX:
            size = "{} x {}".format(*opened.size)
            self.refuse("a compressed image is too large", f"at most {MOST_PACKED_PX:,} px", size)
        with read_in_words(self.where, f"the image of message {self.number} cannot be read"):
            pixels = np.asarray(opened.convert("L" if opened.mode in ("L", "1") else "RGB"))
        return pixels.reshape(*pixels.shape[:2], -1)


def read_triggers(bag: Bag, topic: str, folder: Path | None) -> Stream:
    """Return the triggers of a topic on the bag's clock; raise InputError if messages are damaged."""
    connections = [one for one in bag.connections if one.topic == topic]

    def parts() -> Iterator[tuple[NDArray[Any], ...]]:
        for number, (connection, _, message) in enumerate(bag.messages(connections)):
            with read_in_words(f"{bag.path}: message {number} on {topic}", "a trigger cannot be read"):
                fields = Fields(message, ros2=connection.ros2)
                source, seconds, nanoseconds = (fields.number(code) for code in "bII")
            yield np.array([seconds * 10**6 + nanoseconds // NS], np.int64), np.array([float(source)])

    t_us, source = joined_on_disk(folder, parts())
    clock = "the camera's, same as the events"
    return Stream("", t_us, {"source": source}, source=f"{bag.path.name}: {topic}", clock=clock)
