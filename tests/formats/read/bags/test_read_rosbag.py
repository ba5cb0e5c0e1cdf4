"""ROS bags: every layout of messages with events, in bags of ROS 1 and ROS 2, whole, odd and damaged."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.bags.bag_files import zstd_module
from evetac_cli.formats.read.bags.ros_messages import Fields, LibcaerCompressed, Packet, event_array
from evetac_cli.formats.read.time_order import OrderOptions
from tests.formats.read.bags.bag_writing import (
    BAGS,
    ENCODERS,
    FRAME,
    START_S,
    TYPES,
    Types,
    Write,
    drawn,
    listed,
    mono,
    shifted,
)
from tests.importing import event_rows, refusal


@pytest.mark.parametrize("bag", BAGS)
def test_event_arrays_are_read(write: Write, bag: str) -> None:
    """Assert that dvs_msgs/EventArray gives every event, with empty messages and messages of one event between."""
    types = Types(bag)
    events = drawn(300)
    rows = listed(events)
    parts = [rows[:100], [], rows[100:101], rows[101:300]]
    messages = [types.array(part, frame="x" * length) for length, part in enumerate(parts)]
    topics = {"/dvs/events": messages, "/n": [types.make("other_msgs/msg/Number", 5)]}
    imported = read_events(write(bag, types, topics))
    assert event_rows(imported) == shifted(events)
    assert (imported.format, imported.frame_px, imported.notes) == (
        "rosbag",
        FRAME,
        ["left out: messages on /n (other_msgs/msg/Number) 1"],
    )
    assert imported.t_offset_us == events.t[0]


@settings(max_examples=60)
@given(
    rows=st.lists(
        st.tuples(st.integers(0, 2**31 - 1), st.integers(0, 65535), st.integers(0, 65535), st.integers(0, 1)),
        max_size=9,
    ),
    frame=st.text("ab/", max_size=9),
    ros2=st.booleans(),
)
def test_event_arrays_decode_as_the_libraries_serialise_them(
    rows: list[tuple[int, ...]], frame: str, ros2: bool
) -> None:
    """Assert that any events, behind a header of any length, come out of the bytes of ROS 1 and of CDR."""
    types = TYPES[ros2]
    found_frame, part = event_array(Fields(types.raw(types.array(rows, frame)), ros2=ros2))
    assert found_frame == FRAME
    assert [tuple(int(value) for value in row) for row in zip(*part, strict=True)] == rows


@pytest.mark.parametrize("bag", BAGS)
def test_topics_are_chosen_by_name(write: Write, bag: str) -> None:
    """Assert that of several topics the first by name is read, the others are noted, and each can be had."""
    types = Types(bag)
    left, right = drawn(5, 1), drawn(7, 2)
    path = write(bag, types, {"/b": [types.array(listed(left))], "/a": [types.array(listed(right))]})
    first = read_events(path)
    assert event_rows(first) == shifted(right)
    assert first.notes[:1] == ["read the topic /a; the file also has: /b (choose with --stream)"]
    assert event_rows(read_events(path, stream="/b")) == shifted(left)
    assert "expected: /a or /b" in refusal(path, stream="/c")


def crowded() -> Events:
    """Many events of a column at one time, as a scanned sensor gives them, each pixel once."""
    rng = np.random.default_rng(5)
    rows = sorted(
        {
            (START_S * 10**6 + 200 * int(k), int(x), int(y), int(p))
            for k, x, y, p in zip(
                rng.integers(0, 60, 4000),
                rng.integers(0, 3, 4000),
                rng.integers(0, 90, 4000),
                rng.integers(0, 2, 4000),
                strict=True,
            )
        },
        key=lambda row: (row[0], row[1], row[3], row[2]),
    )
    t, x, y, p = (np.array(column) for column in zip(*rows, strict=True))
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


@pytest.mark.parametrize("bag", ["ros1", "mcap"])
@pytest.mark.parametrize("encoding", ENCODERS)
def test_event_packets_are_read(write: Write, bag: str, encoding: str) -> None:
    """Assert that event_camera_msgs/EventPacket gives every event, in packets of any size, the empty one included."""
    types = Types(bag)
    events = crowded()
    assert events.size > 2000
    cuts = [0, 1, 900, 900, events.size]
    messages = []
    for number, (first, last) in enumerate(zip(cuts, cuts[1:], strict=False)):
        part = events.part(first, last)
        base_ns = 1000 * int(part.t[0] if part.size else START_S * 10**6)
        content = ENCODERS[encoding](part, base_ns) if part.size else b""
        messages.append(types.packet(content, encoding, number + 1, base_ns))
    imported = read_events(write(bag, types, {"/events": messages}))
    assert sorted(event_rows(imported)) == sorted(shifted(events))
    assert imported.t_offset_us == events.t[0]
    assert imported.notes == []


def test_lost_packets_are_noted(write: Write) -> None:
    """Assert that gaps in the sequence numbers are counted."""
    types = Types("db3")
    part = drawn(3)
    base_ns = 1000 * int(part.t[0])
    messages = [types.packet(mono(part, base_ns), "mono", seq, base_ns + 10**6 * seq) for seq in (4, 5, 9, 11)]
    assert read_events(write("db3", types, {"/events": messages})).notes == [
        "4 messages are missing: they were lost before they were recorded"
    ]


def test_several_eights_share_a_base() -> None:
    """Assert that masks that follow each other climb by eight rows, also from one packet to the next."""
    decode = LibcaerCompressed()
    words = np.array([2 << 12 | 9, 4 << 12 | 1 << 11 | 16, 5 << 12 | 0b101, 1 << 12 | 7, 5 << 12 | 0b10], "<u2")
    part = decode(Packet(FRAME, 0, 10**6, "libcaer_cmp", memoryview(words.tobytes())))
    assert list(zip(*(column.tolist() for column in part), strict=True)) == [
        (1000, 9, 16, 1),
        (1000, 9, 18, 1),
        (1007, 9, 25, 1),
    ]
    later = decode(Packet(FRAME, 1, 0, "libcaer_cmp", memoryview(np.array([3 << 12 | 5], "<u2").tobytes())))
    assert (later.x.tolist(), later.y.tolist(), later.p.tolist()) == ([9], [5], [0])


@pytest.mark.parametrize("encoding", ["evt2", "evt3"])
def test_packets_of_prophesee_are_read(write: Write, tmp_path: Path, encoding: str) -> None:
    """Assert that packets in the words of Prophesee are decoded as one stream, as faery wrote it."""
    faery = pytest.importorskip("faery")
    from faery.file_encoder import events_to_file

    events = drawn(3000, gap_us=200)
    array = np.zeros(events.size, faery.EVENTS_DTYPE)
    for ours, theirs in zip(events, ("t", "x", "y", "on"), strict=True):
        array[theirs] = ours - (events.t[0] if theirs == "t" else 0)
    raw = tmp_path / "a.raw"
    events_to_file([array], raw, FRAME, version=encoding, zero_t0=False)
    words = raw.read_bytes().partition(b"% geometry 640x480\n")[2]
    types = Types("mcap")
    cuts = [0, 1000, 1004, len(words)]
    messages = [
        types.packet(words[a:b], encoding, number) for number, (a, b) in enumerate(zip(cuts, cuts[1:], strict=False))
    ]
    imported = read_events(write("mcap", types, {"/events": messages}))
    assert event_rows(imported) == shifted(events)


@pytest.mark.parametrize("bag", ["ros1", "db3"])
def test_official_messages_are_read(write: Write, bag: str) -> None:
    """Assert that the images of EvetacMsg give one event for every step of grey, at the time of the message."""
    types = Types(bag)
    first = np.full((640, 480), 127, np.uint8)
    second = first.copy()
    first[5, 7] += 15
    first[639, 479] -= 30
    second[100, 200] += 60
    at = START_S * 10**6
    messages = [types.image(at + 500, first), types.image(at + 20_500, second)]
    imported = read_events(write(bag, types, {"/evetac_msg0": messages}))
    assert event_rows(imported) == [(0, 5, 7, 1), *[(0, 639, 479, 0)] * 2, *[(20_000, 100, 200, 1)] * 4]
    assert (imported.frame_px, imported.t_offset_us) == (FRAME, at + 500)
    assert "every 20 ms" in imported.notes[0] and "images, not events" in imported.notes[0]
    second[0, 0] = 130
    assert "grey levels other than 127 + 15 n" in refusal(
        write(bag, types, {"/e": [types.image(at, first), types.image(at, second)]}, "other")
    )


@pytest.mark.parametrize(
    ("packets", "words"),
    [
        ([(bytes(8), "trigger")], "not supported"),
        ([(bytes(8), "evt4")], "expected: mono, libcaer, libcaer_cmp, evt2, evt3"),
        ([(bytes(8), "mono"), (bytes(8), "libcaer")], "message 1 on /e: the encoding changes"),
        ([(bytes(9), "mono")], "message 0 on /e: a message is damaged\n  found:    9 bytes"),
        ([(bytes(8), "libcaer"), (bytes(12), "libcaer")], "message 1 on /e: a message is damaged"),
        ([(bytes(3), "libcaer_cmp")], "3 bytes"),
        ([(b"\0\xf0", "libcaer_cmp")], "code 15"),
    ],
)
def test_odd_packets_are_refused(write: Write, packets: list[tuple[bytes, str]], words: str) -> None:
    """Assert that a packet that is not what it says is refused by its number."""
    types = Types("db3")
    messages = [types.packet(content, encoding, number) for number, (content, encoding) in enumerate(packets)]
    assert words in refusal(write("db3", types, {"/e": messages}))


def test_odd_bags_are_refused(write: Write) -> None:
    """Assert that other layouts under a known name, bags without events, and silent topics are told apart."""
    types = Types("ros1")
    array = types.array([(START_S * 10**6, 1, 2, 1)])
    number = types.make("other_msgs/msg/Number", 5)
    assert "found:    other_msgs/msg/Number" in refusal(write("ros1", types, {"/n": [number]}, "none"))
    assert "found:    nothing" in refusal(write("ros1", types, {}, "empty"))
    assert "the topic /e has no messages" in refusal(write("ros1", types, {"/e": [], "/n": [number]}, "silent"))
    assert "leave out --frame-size" in refusal(write("ros1", types, {"/e": [array]}, "framed"), frame_px=(10, 10))
    big = types.packet(bytes(8), "mono", big=True)
    assert "big-endian" in refusal(write("ros1", types, {"/e": [big]}, "big"))
    old = Types("ros1", **{"dvs_msgs/msg/Event": "uint16 x\nuint16 y\nuint64 time\nbool polarity\n"})
    event = old.make("dvs_msgs/msg/Event", 1, 2, 3, True)
    past = old.make("dvs_msgs/msg/EventArray", old.header(0), 480, 640, [event])
    assert "definition of " in refusal(write("ros1", old, {"/e": [past]}, "old"))


def test_time_that_goes_backwards_is_placed(write: Write) -> None:
    """Assert that a refusal names message and event, and that each way out keeps what it says."""
    types = Types("db3")
    at = START_S * 10**6
    path = write(
        "db3", types, {"/e": [types.array([(at, 1, 2, 1)]), types.array([(at + 5000, 1, 2, 1), (at + 4000, 3, 2, 1)])]}
    )
    assert f"in message 1, event 1 from {START_S}.005000 s to {START_S}.004000 s" in refusal(path)
    assert [row[0] for row in event_rows(read_events(path, order=OrderOptions(sort=True)))] == [0, 4000, 5000]
    assert [row[0] for row in event_rows(read_events(path, order=OrderOptions(drop_late=True)))] == [0, 5000]
    assert [row[0] for row in event_rows(read_events(path, order=OrderOptions(from_restart=1)))] == [0]


PACKED = [("ros1", "MESSAGE"), ("db3", "MESSAGE"), ("db3", "FILE"), ("mcap", "MESSAGE"), ("mcap", "STORAGE")]


@pytest.mark.parametrize(("bag", "mode"), PACKED)
def test_a_compressed_part_that_swells_is_refused(write: Write, bag: str, mode: str) -> None:
    """Assert that a compressed message, chunk or file that unpacks to a thousand times its size is not unpacked."""
    types = Types(bag)
    messages = [types.array(listed(drawn(10)), frame="x" * (10 if mode == "FILE" else 70 << 20))]
    path = write(bag, types, {"/e": messages}, compress=True, mode=mode)
    for file in path.glob("*.zstd"):
        file.write_bytes(zstd_module().compress(bytes(200 << 20)))
    assert "would unpack to too much" in refusal(path)


@pytest.mark.parametrize(("bag", "mode"), PACKED)
def test_compressed_bags_are_read(write: Write, bag: str, mode: str) -> None:
    """Assert that what is compressed in any of the ways that bags know gives every event."""
    types = Types(bag)
    events = drawn(3000)
    path = write(bag, types, {"/e": [types.array(listed(events))]}, compress=True, mode=mode)
    assert event_rows(read_events(path)) == shifted(events)


@pytest.mark.parametrize("bag", BAGS)
def test_imu_and_images_beside_events_are_kept(write: Write, bag: str) -> None:
    """Assert that IMU topics come in as streams, images if asked for, and samples outside the recording are counted."""
    types = Types(bag)
    events = drawn(300)
    nine, zero = np.zeros(9), types.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    turned = types.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    samples, images = [], []
    for us in (-500, 0, 1500, 3000, 10**9):
        gravity = types.make("geometry_msgs/msg/Vector3", 0.0, us / 10, -9.81)
        header = types.header(int(events.t[0]) + us)
        samples.append(types.make("sensor_msgs/msg/Imu", header, turned, nine, zero, nine, gravity, nine))
        image = np.full(12, 7, np.uint8)
        images.append(types.make("sensor_msgs/msg/Image", header, 3, 4, "mono8", 0, 4, image))
    topics = {"/dvs/events": [types.array(listed(events))], "/dvs/imu": samples, "/dvs/image_raw": images}
    path = write(bag, types, topics)
    imported = read_events(path)
    (imu,) = imported.streams
    assert (imu.name, imu.t_us.tolist()) == ("dvs_imu", [0, 1500, 3000])
    assert imu.columns["linear_acceleration.y"].tolist() == [0.0, 150.0, 300.0]
    assert imu.units["linear_acceleration.y"] == "m/s2"
    outside = "messages on /dvs/imu (sensor_msgs/msg/Imu) outside the recording"
    assert imported.left_out == {"messages on /dvs/image_raw (sensor_msgs/msg/Image)": 5, outside: 2}
    kept = {stream.name: stream for stream in read_events(path, frames=True).streams}
    assert kept["dvs_image_raw"].frames.shape == (3, 3, 4, 1)
