"""External triggers on topics of their own beside the events of a bag."""

from typing import Any

import pytest

from evetac_cli.formats.imports import read_events
from tests.formats.read.bags.bag_writing import BAGS, Types, Write, drawn, mono

EVENTS = drawn(300)
TRIGGER = "int8 type\n{time} timestamp\nint8 TRIGGER_TYPE_TIMESTAMP_RESET=0\n"


def events(types: Types) -> list[Any]:
    """All events in one packet."""
    base_ns = 1000 * int(EVENTS.t[0])
    return [types.packet(mono(EVENTS, base_ns), "mono", 0, base_ns)]


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
