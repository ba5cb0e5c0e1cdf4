"""Write a recording, and the data computed from it, as an MCAP file of ROS 2 messages.

    /evetac/events            event_camera_msgs/EventPacket, encoding `mono`: one per slice, also for empty slices
    /evetac/note              std_msgs/String: the note (formats/note.py), on a topic because tools for bags keep topics
    /evetac/dots              sensor_msgs/PointCloud2 of the tracks: x, y, dx, dy in px, events, lost; z is 0
    /evetac/force             geometry_msgs/WrenchStamped of the estimated touch, in N and N m, about the centre of
                              pressure: x right, y down, z into the gel, and the torsion; force/sd: their standard
                              deviations
    /evetac/touch/centre      geometry_msgs/PointStamped: the centre of pressure, in m from the middle of the frame
    /evetac/touch/map         sensor_msgs/PointCloud2 of each touch map, one point per cell, in m: patch, and pressure,
                              shear_x, shear_y with their standard deviations in Pa
    /evetac/touch/sticking_share    std_msgs/Float32: the share of the contact that sticks
    /evetac/label             std_msgs/Int8 of the labels: 1 slip, 0 no slip, -1 not examined
    /evetac/gripper           sensor_msgs/JointState: position in rad; effort is the measured current in mA
    /evetac/gripper/goal      sensor_msgs/JointState: the goal position of a grasp, in rad
    /evetac/marks             std_msgs/String: marks that a robot's program set during recording
    /evetac/streams/NAME      std_msgs/Float64MultiArray of another stream: its columns, named with their units in the
                              layout; NAME/about std_msgs/String, NAME/image sensor_msgs/Image
    /evetac/gripper/*, control/*, truth/*      numbers of std_msgs; truth, which only simulated recordings have, also
                                               has dots and force

All messages except EventPacket are part of every ROS 2 installation, so RViz, Foxglove and PlotJuggler draw them. Of
these, only a point cloud can store several named numbers for each of many dots or cells. No wrench message has a
covariance, so standard deviations are a separate wrench. Tracks, touch and labels are read from the files next to the
recording that belong to it. Times are on the source's clock. A packet of events is stamped with the begin of its slice
and logged at its end; values computed from a slice have the time of its end. The frame id of a simulated recording's
messages is `evetac_simulated`; messages in m on the gel, not in px, use `evetac_gel` or `evetac_gel_simulated`.

The library mcap writes the file. rosbags builds messages and definitions: it copies arrays as a whole, while
mcap-ros2-support packs them byte by byte. rosbags' own writer produces folders, not files.
"""

import heapq
from collections.abc import Callable
from itertools import repeat
from pathlib import Path
from typing import Any

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.events import SLICE_US
from evetac_cli.formats.read.bags.read_rosbag import EVENTS_TOPIC, NOTE_TOPIC
from evetac_cli.formats.write.event_files import note_for, t_offset_us
from evetac_cli.formats.write.mcap_messages import NUMBERS, PACKET, US_NS, Messages, TopicMessages
from evetac_cli.formats.write.slice_columns import TrialFiles
from evetac_cli.jobs import Progress
from evetac_cli.store.recordings.read import Recording

DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""
MOST_S = 2**31  # the seconds of a time of ROS are an int32
MOST_ROWS_PX = 2**15  # `mono` has 15 bits for y
# Groups and datasets of a recording that the file contains in addition to its events.
HOLDS = (
    "marks",
    "sensor/dot_xy_px",
    "gripper/t_us",
    "gripper/current_ma",
    "gripper/position_ticks",
    "control/t_us",
    "control/goal_ticks",
    "truth/dot_xy_px",
    "truth/normal_force_n",
    "truth/shear_force_n",
    "streams",
    *NUMBERS,
)


def write(files: TrialFiles, path: Path, progress: Progress) -> list[str]:
    """Write all topics in time order; return which files of the trial were left out.

    Raises InputError if times or frame do not fit into the messages.
    """
    Writer, types, definition_of, serialise = _libraries(str(path.parent))
    recording = files.recording
    offset_us = t_offset_us(recording)
    _check(recording, offset_us)
    frame_id = "evetac_simulated" if recording.header["simulated"] else "evetac"
    make = TopicMessages(types, frame_id, offset_us)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="evetac")
        note = note_for(recording, offset_us).text()
        topics: list[tuple[str, str, Messages]] = [
            (NOTE_TOPIC, "std_msgs/msg/String", iter([(0, make("std_msgs/msg/String", data=note))])),
            (EVENTS_TOPIC, PACKET, make.packets(recording, progress)),
            *make.of_recording(recording),
            *make.of_streams(recording),
            *make.of_files(files),
        ]
        schemas: dict[str, int] = {}
        queues = []
        for topic, kind, messages in topics:
            if kind not in schemas:
                schemas[kind] = writer.register_schema(kind, "ros2msg", definition_of(kind).encode())
            channel = writer.register_channel(topic, "cdr", schemas[kind])
            queues.append(zip(repeat((channel, kind)), messages))
        for (channel, kind), (t_us, message) in heapq.merge(*queues, key=lambda one: one[1][0]):
            time_ns = (offset_us + t_us) * US_NS
            writer.add_message(channel, time_ns, serialise(message, kind), time_ns)
        writer.finish()
    return list(files.notes)


def _libraries(where: str) -> tuple[Any, Any, Callable[[str], str], Callable[[Any, str], bytes]]:
    """Return mcap's writer; of rosbags the types by name, a function for definitions, and the serializer."""
    with needs_extra("MCAP needs mcap and rosbags", "convert", where):
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(DEFINITION, PACKET))

    def definition_of(kind: str) -> str:
        return str(store.generate_msgdef(kind, ros_version=2)[0])

    def serialise(message: Any, kind: str) -> bytes:
        return bytes(store.serialize_cdr(message, kind))

    return Writer, store.types, definition_of, serialise


def _check(recording: Recording, offset_us: int) -> None:
    """Raise InputError if a time or a row cannot be represented in the messages."""
    first_s, last_s = offset_us / 1e6, (offset_us + len(recording) * SLICE_US) / 1e6
    where, hint = str(recording.path), "export the recording as text or dsec"
    if first_s < 0 or last_s >= MOST_S:
        message, expected = "the recording's times do not fit into ROS messages", f"0 to {MOST_S - 1} s"
        raise InputError(message, where=where, expected=expected, found=f"{first_s:.6f} to {last_s:.6f} s", hint=hint)
    if recording.frame_px[1] > MOST_ROWS_PX:
        message, found = "the frame has too many rows for an EventPacket", str(recording.frame_px[1])
        raise InputError(message, where=where, expected=f"at most {MOST_ROWS_PX}", found=found, hint=hint)
