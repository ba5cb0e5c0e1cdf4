"""External triggers on topics of their own beside the events of a bag."""

from typing import Any

import numpy as np
import pytest

from evetac_cli.formats.imports import read_events
from tests.formats.read.bags.bag_writing import BAGS, START_S, Types, Write, drawn, listed, mono, shifted
from tests.importing import event_rows, refusal

EVENTS = drawn(300)
ZERO_US = START_S * 10**6
TRIGGER = "int8 type\n{time} timestamp\nint8 TRIGGER_TYPE_TIMESTAMP_RESET=0\n"


def words(times_us: list[int], ids: list[int], edges: list[int], base_ns: int) -> bytes:
    """Triggers as the encoding `trigger` packs them."""
    rows = zip(times_us, ids, edges, strict=True)
    return np.array([edge << 63 | number << 48 | us * 1000 - base_ns for us, number, edge in rows], "<u8").tobytes()


def events(types: Types) -> list[Any]:
    """All events in one packet."""
    base_ns = 1000 * int(EVENTS.t[0])
    return [types.packet(mono(EVENTS, base_ns), "mono", 0, base_ns)]


@pytest.mark.parametrize("bag", BAGS)
def test_packets_of_triggers_are_kept(write: Write, bag: str) -> None:
    """Assert times, inputs and edges of triggers that have a topic of their own, which is not taken for events."""
    types = Types(bag)
    inside = (EVENTS.t[[3, 40, 41, 200]]).tolist()
    outside = [ZERO_US - 5]
    base_ns = 1000 * outside[0]
    packets = [
        types.packet(words([*outside, *inside[:2]], [0, 0, 1], [1, 1, 0], base_ns), "trigger", 0, base_ns),
        types.packet(b"", "trigger", 1, base_ns),
        types.packet(words(inside[2:], [6, 6], [1, 0], base_ns), "trigger", 2, base_ns),
    ]
    path = write(bag, types, {"/a/triggers": packets, "/b/events": events(types)})
    imported = read_events(path)
    assert event_rows(imported) == shifted(EVENTS)
    (stream,) = imported.streams
    assert stream.name == "a_triggers"
    assert (stream.t_us + imported.t_offset_us).tolist() == inside
    assert stream.columns["id"].tolist() == [0, 1, 6, 6] and stream.columns["edge"].tolist() == [1, 0, 1, 0]
    kind = "event_camera_msgs/msg/EventPacket"
    assert imported.left_out == {f"messages on /a/triggers ({kind}) outside the recording": 1}
    assert not any("the file also has" in note for note in imported.notes)
    assert "has no events" in refusal(path, stream="/a/triggers")


@pytest.mark.parametrize("bag", BAGS)
@pytest.mark.parametrize("package", ["dv_ros_msgs", "dv_ros2_msgs"])
def test_triggers_of_inivations_driver_are_kept(write: Write, bag: str, package: str) -> None:
    """Assert times and kinds of the triggers of iniVation's drivers for ROS."""
    name = f"{package}/msg/Trigger"
    types = Types(bag, **{name: TRIGGER})
    times = EVENTS.t[[3, 40, 200]].tolist()
    made = [types.make(name, kind, types.time(us)) for kind, us in zip((1, 2, 3), times, strict=True)]
    imported = read_events(write(bag, types, {"/e": events(types), "/capture/trigger": made}))
    (stream,) = imported.streams
    assert (stream.t_us + imported.t_offset_us).tolist() == times
    assert stream.columns["source"].tolist() == [1, 2, 3]
    assert imported.left_out == {}
    assert "1 to 3: external signal rises" in stream.what


def test_triggers_that_are_damaged_are_counted(write: Write) -> None:
    """Assert that messages that hold no triggers stay among what was left out."""
    types = Types("db3", **{"dv_ros_msgs/msg/Trigger": "int8 type\n"})
    odd = [types.make("dv_ros_msgs/msg/Trigger", 1)]
    half = [types.packet(bytes(9), "trigger", 0, 0)]
    imported = read_events(write("db3", types, {"/e": events(types), "/t": odd, "/u": half}))
    assert imported.streams == []
    assert imported.left_out == {
        "messages on /t (dv_ros_msgs/msg/Trigger)": 1,
        "messages on /u (event_camera_msgs/msg/EventPacket)": 1,
    }


def test_a_bag_of_triggers_alone_holds_no_events(write: Write) -> None:
    """Assert that a bag whose only packets are triggers says so."""
    types = Types("db3")
    path = write("db3", types, {"/t": [types.packet(words([ZERO_US], [0], [1], 0)[:0], "trigger", 0, 0)]})
    assert "not supported" in refusal(path)
    rows = listed(EVENTS)
    path = write("db3", types, {"/t": [types.packet(b"", "trigger", 0, 0)], "/e": [types.array(rows)]}, "both")
    assert event_rows(read_events(path)) == shifted(EVENTS)
