"""Layouts of messages, told by their definitions: the checksum, and bags whose makers call a known layout otherwise."""

from pathlib import Path
from typing import Any

import pytest

from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.bags import read_rosbag
from evetac_cli.formats.read.bags.bag_readers import checksum
from tests.formats.read.bags.bag_writing import (
    BAGS,
    DEFINITIONS,
    Types,
    Write,
    drawn,
    listed,
    mono,
    shifted,
)
from tests.importing import event_rows, refusal

EVENTS = drawn(300)
ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\n{}/Event[] events\n"
EVENT = "uint16 x\nuint16 y\n{time} ts\nbool polarity\n"
PACKET = DEFINITIONS["event_camera_msgs/msg/EventPacket"]
# Of other makers: iniVation's drivers for ROS 1 and ROS 2, and one that nobody knows.
MAKERS = ("dv_ros_msgs", "dv_ros2_msgs", "esvo_msgs")


def array(types: Types, package: str, rows: list[tuple[int, ...]]) -> Any:
    """An EventArray of a package."""
    event = types.store.types[f"{package}/msg/Event"]
    events = [event(x, y, types.time(t), bool(p)) for t, x, y, p in rows]
    return types.make(f"{package}/msg/EventArray", types.header(7), 480, 640, events)


@pytest.mark.parametrize("bag", BAGS)
@pytest.mark.parametrize("package", MAKERS)
def test_a_layout_is_known_whatever_its_package_is_called(write: Write, bag: str, package: str) -> None:
    """Assert that event arrays of every maker come, as each bag says by its checksum or definition what they are."""
    types = Types(bag, **{f"{package}/msg/Event": EVENT, f"{package}/msg/EventArray": ARRAY.format(package)})
    rows = listed(EVENTS)
    path = write(bag, types, {"/events": [array(types, package, rows[:200]), array(types, package, rows[200:])]})
    imported = read_events(path)
    assert event_rows(imported) == shifted(EVENTS)
    assert (imported.frame_px, imported.notes) == ((640, 480), [])


@pytest.mark.parametrize("bag", BAGS)
def test_packets_of_another_package_come(write: Write, bag: str) -> None:
    """Assert that packets are known by their layout, too."""
    name = "my_camera/msg/Packet"
    types = Types(bag, **{name: PACKET})
    base_ns = 1000 * int(EVENTS.t[0])
    packet = types.packet(mono(EVENTS, base_ns), "mono", 0, base_ns)
    values = [getattr(packet, field) for field in packet.__dataclass_fields__ if not field.startswith("__")]
    path = write(bag, types, {"/events": [types.make(name, *values)]})
    assert event_rows(read_events(path)) == shifted(EVENTS)


@pytest.mark.parametrize("bag", ["ros1", "mcap"])
@pytest.mark.parametrize(
    "fields",
    [
        "uint16 y\nuint16 x\n{time} ts\nbool polarity\n",
        "uint16 x\nuint16 y\nbool polarity\n{time} ts\n",
        "uint32 x\nuint32 y\n{time} ts\nbool polarity\n",
        "uint16 x\nuint16 y\nuint64 ts\nbool polarity\n",
        "uint16 x\nuint16 y\n{time} ts\nint8 polarity\n",
    ],
)
def test_another_layout_is_no_event_array(write: Write, bag: str, fields: str) -> None:
    """Assert that other fields, or the same in another order, are never read as events, under no name."""
    for package in ("other_msgs", "dvs_msgs"):
        types = Types(bag, **{f"{package}/msg/Event": fields, f"{package}/msg/EventArray": ARRAY.format(package)})
        plain = "uint64" in fields
        event = types.store.types[f"{package}/msg/Event"]
        order = [line.split()[1] for line in fields.split("\n") if line]
        values = {"x": 1, "y": 2, "ts": 5 if plain else types.time(5), "polarity": "bool" in fields or 1}
        message = types.make(
            f"{package}/msg/EventArray", types.header(7), 480, 640, [event(*(values[name] for name in order))]
        )
        words = refusal(write(bag, types, {"/e": [message]}, package))
        expected = "unknown definition of " if package == "dvs_msgs" else "the bag has no events"
        assert expected in words


def test_names_decide_where_there_is_no_definition(write: Write, tmp_path: Path) -> None:
    """Assert that databases of ROS 2 that are too old to have definitions are read by the name of the type."""
    import sqlite3

    for package in ("dvs_msgs", "dv_ros2_msgs", "prophesee_event_msgs", "esvo_msgs"):
        types = Types("db3", **{f"{package}/msg/Event": EVENT, f"{package}/msg/EventArray": ARRAY.format(package)})
        (path,) = write("db3", types, {"/e": [array(types, package, listed(EVENTS))]}, package).glob("*.db3")
        database = sqlite3.connect(path)
        database.execute("DROP TABLE message_definitions")
        database.commit()
        database.close()
        if package in ("esvo_msgs",):
            assert "the bag has no events" in refusal(path)
        else:
            assert event_rows(read_events(path)) == shifted(EVENTS)


def test_both_ros_have_one_checksum() -> None:
    """Assert that the definitions of ROS 2 give the checksums of ROS 1, times and headers being written otherwise."""
    ros1, ros2 = Types("ros1").store, Types("mcap").store
    names = ["dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket", "geometry_msgs/msg/PoseStamped"]
    names += ["sensor_msgs/msg/Image", "geometry_msgs/msg/TransformStamped", "evetac_software/msg/EvetacMsg"]
    for name in names:
        assert checksum(name, ros2.generate_msgdef(name, ros_version=2)[0]) == ros1.generate_msgdef(name)[1], name
    assert {read_rosbag.TYPES[name] for name in names if name in read_rosbag.TYPES} == set(read_rosbag.LAYOUTS)
