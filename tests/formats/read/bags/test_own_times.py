"""Bags whose messages lie in another order than their own times or those of their reception, and parts told by name."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.time_order import OrderOptions
from evetac_cli.formats.streams import read_stream
from evetac_cli.store.recordings.streams import Stream
from tests.formats.read.bags.bag_writing import BAGS, ENCODERS, START_S, Types, Write
from tests.importing import event_rows, refusal

START_US = START_S * 10**6
EVERY_US = 10_000
MESSAGES = 100
# the recorder's clock is set back by 0.2 s half-way
STEPPED_US = [START_US + at * EVERY_US + 11_000 - (200_000 if at >= 50 else 0) for at in range(MESSAGES)]


def arrays(types: Types, times_us: list[int]) -> list[Any]:
    """A message of ten events, 1 ms apart, from each of these times on."""
    return [types.array([(us + k * 1000, at * 3 % 640, k, k % 2) for k in range(10)]) for at, us in enumerate(times_us)]


@pytest.mark.parametrize("bag", BAGS)
def test_events_are_kept_if_the_recorders_clock_goes_back(write: Write, bag: str) -> None:
    """Assert that all events come in the file's order without an option."""
    types = Types(bag)
    own_us = [START_US + at * EVERY_US for at in range(MESSAGES)]
    imported = read_events(write(bag, types, {"/e": arrays(types, own_us)}, times_us=STEPPED_US))
    assert [row[:3] for row in event_rows(imported)] == [
        (at * EVERY_US + k * 1000, at * 3 % 640, k) for at in range(MESSAGES) for k in range(10)
    ]
    assert imported.slices == 1000 and imported.sorted == 0
    assert imported.notes == []


@pytest.mark.parametrize("encoding", [*ENCODERS, "evt3"])
def test_packets_are_kept_if_the_recorders_clock_goes_back(write: Write, encoding: str) -> None:
    """Assert the same for packets, whose numbers are in the file's order."""
    from tests.formats.read.bags.test_host_clock import events_of, packets

    types, events = Types("db3"), events_of(1.0, 1000)
    made = packets(types, events, encoding)
    straight = read_events(write("db3", types, {"/e": made}, "straight"))
    stepped = read_events(write("db3", types, {"/e": made}, "stepped", times_us=STEPPED_US))
    assert event_rows(stepped) == event_rows(straight)
    assert stepped.size == events.size


@pytest.mark.parametrize("bag", BAGS)
def test_events_of_a_camera_that_was_set_back_are_refused(write: Write, bag: str) -> None:
    """Assert that own times that go back are refused in either order, and that the advice keeps all events first."""
    types = Types(bag)
    own_us = [us - 11_000 for us in STEPPED_US]
    path = write(bag, types, {"/e": arrays(types, own_us)})
    words = refusal(path)
    assert "time goes backwards" in words and "--sort keeps all events" in words and "--drop-late" in words
    assert read_events(path, order=OrderOptions(sort=True)).size == 10 * MESSAGES


@pytest.mark.parametrize("bag", BAGS)
def test_events_without_times_are_left_out(write: Write, bag: str) -> None:
    """Assert that events whose time is 0 are counted, and that a topic without any other time is refused."""
    types = Types(bag)
    made = arrays(types, [0] + [START_US + at * EVERY_US for at in range(1, MESSAGES)])
    for message in made[:1]:
        message.events = [types.make("dvs_msgs/msg/Event", one.x, one.y, types.time(0), True) for one in message.events]
    imported = read_events(write(bag, types, {"/e": made}))
    assert imported.size == 10 * (MESSAGES - 1)
    assert imported.left_out["events whose time is 0, so never set"] == 10
    assert "no event of the topic has a time" in refusal(write(bag, types, {"/e": made[:1]}, "unset"))


def joints(types: Types, us: int, names: list[str], position: list[float], velocity: list[float]) -> Any:
    parts = (np.array(values, float) for values in (position, velocity, []))
    return types.make("sensor_msgs/msg/JointState", types.header(us), names, *parts)


def stream_of(path: Path) -> tuple[Stream, list[str]]:
    return read_stream(f"{path}:/topic", "arm")


@pytest.mark.parametrize("bag", BAGS)
def test_joints_are_told_by_name(write: Write, bag: str) -> None:
    """Assert that joints in another order are in their own columns."""
    types = Types(bag)
    made = [
        joints(
            types, at * EVERY_US, *((["b", "a"], [100 + at, at]) if at % 2 == 0 else (["a", "b"], [at, 100 + at])), []
        )
        for at in range(1, 100)
    ]
    stream, notes = stream_of(write(bag, types, {"/topic": made}))
    assert {name: values.tolist() for name, values in stream.columns.items()} == {
        "position.a": list(range(1, 100)),
        "position.b": list(range(101, 200)),
    }
    assert notes == []


def test_what_a_message_lacks_is_not_a_number(write: Write) -> None:
    """Assert NaN and a note where messages lack a joint or a velocity, also if only a later message has it."""
    types = Types("db3")
    made = [
        joints(types, 10_000, ["a"], [1], []),
        joints(types, 20_000, ["b", "a"], [12, 2], [0.5, 0.25]),
        joints(types, 30_000, ["a", "b"], [3, 13], []),
    ]
    stream, notes = stream_of(write("db3", types, {"/topic": made}))
    wanted = {
        "position.a": [1, 2, 3],
        "position.b": [np.nan, 12, 13],
        "velocity.a": [np.nan, 0.25, np.nan],
        "velocity.b": [np.nan, 0.5, np.nan],
    }
    assert stream.columns.keys() == wanted.keys()
    for name, values in wanted.items():
        np.testing.assert_array_equal(stream.columns[name], values)
    assert notes == ["2 of 3 samples lack a part of position.b, velocity.b, velocity.a: NaN there"]


def test_other_parts_are_told_by_name(write: Write) -> None:
    """Assert the columns of frames of /tf, of joints with poses, of channels of points, and of a trajectory."""
    types = Types("db3")
    vector, turned = types.make("geometry_msgs/msg/Vector3", 1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)
    at_rest = types.make("geometry_msgs/msg/Transform", vector, types.make("geometry_msgs/msg/Quaternion", *turned))
    frames = [
        types.make("geometry_msgs/msg/TransformStamped", types.header(1), one, at_rest) for one in ("hand", "arm")
    ]
    none = np.empty(0)
    point = types.make(
        "trajectory_msgs/msg/JointTrajectoryPoint",
        np.array([4.0, 5.0]),
        none,
        none,
        none,
        types.make("builtin_interfaces/msg/Duration", 1, 0),
    )
    points = [types.make("geometry_msgs/msg/Point32", 1.0, 2.0, 3.0)]
    channels = [types.make("sensor_msgs/msg/ChannelFloat32", one, np.ones(1, np.float32)) for one in ("u", "v")]
    for name, fields, wanted in (
        ("tf2_msgs/msg/TFMessage", [frames], "transforms.hand.transform.translation.x"),
        (
            "sensor_msgs/msg/MultiDOFJointState",
            [types.header(1), ["hand"], [at_rest], [], []],
            "transforms.hand.translation.x",
        ),
        ("sensor_msgs/msg/PointCloud", [types.header(1), points, channels], "channels.v.values.0"),
        (
            "trajectory_msgs/msg/JointTrajectory",
            [types.header(1), ["a", "b"], [point, point]],
            "points.1.positions.b",
        ),
    ):
        path = write("db3", types, {"/topic": [types.make(name, *fields)]}, name.replace("/", "_"))
        assert wanted in stream_of(path)[0].columns


@pytest.mark.parametrize("stamped", [True, False])
def test_transforms_have_their_own_times(write: Write, stamped: bool) -> None:
    """Assert that samples of /tf have the stamps of its transforms, each its own, and of reception without stamps."""
    types = Types("db3")

    def transform(us: int, frame: str) -> Any:
        vector = types.make("geometry_msgs/msg/Vector3", us / 1e6, 0.0, 0.0)
        turned = types.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        moved = types.make("geometry_msgs/msg/Transform", vector, turned)
        return types.make("geometry_msgs/msg/TransformStamped", types.header(us * stamped), frame, moved)

    both = [transform(START_US, "hand"), transform(START_US, "arm")]
    apart = [transform(START_US + 2000, "hand"), transform(START_US + 1000, "arm")]
    made = [types.make("tf2_msgs/msg/TFMessage", one) for one in (both, apart)]
    stream, notes = stream_of(write("db3", types, {"/topic": made}))
    hand = stream.columns["transforms.hand.transform.translation.x"]
    if stamped:
        assert stream.t_us.tolist() == [START_US, START_US + 1000, START_US + 2000]
        assert stream.clock == "header.stamp"
        np.testing.assert_array_equal(hand, [START_S, np.nan, START_S + 0.002])
        assert notes[0].startswith("2 of 3 samples lack a part of transforms.hand.")
    else:
        assert len(hand) == 2 and "the recorder received" in stream.clock and notes == []


@pytest.mark.parametrize("bag", BAGS)
@pytest.mark.parametrize("base_us", [0, START_US])
def test_late_and_unset_stamps_do_not_stop_a_stream(write: Write, bag: str, base_us: int) -> None:
    """Assert that a late sample is sorted and one without a stamp left out, that both are counted, for numbers."""
    types = Types(bag)
    numbers = list(range(1, 21))
    stamps = [base_us + number * EVERY_US for number in numbers]
    stamps[9], stamps[14] = 0, base_us + 5 * EVERY_US + 1
    made = [joints(types, us, ["a"], [number], []) for us, number in zip(stamps, numbers, strict=True)]
    stream, notes = stream_of(write(bag, types, {"/topic": made}))
    assert stream.columns["position.a"].tolist() == [1, 2, 3, 4, 5, 15, 6, 7, 8, 9, 11, 12, 13, 14, *range(16, 21)]
    assert stream.t_us.tolist() == sorted(us for us in stamps if us)
    assert stream.clock == "header.stamp" and stream.left_out == 1
    assert notes == [
        "left out 1 sample whose stamp is 0, so never set",
        "1 sample came late, by up to 0.089999 s: sorted by time",
    ]
