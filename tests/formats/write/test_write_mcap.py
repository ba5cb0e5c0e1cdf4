"""MCAP as we write it: every topic as the libraries of MCAP and of bags read it, and the way back."""

import re
import sys
import types
from array import array
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.commands.export import Export
from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.bags import read_rosbag
from evetac_cli.formats.read.bags.ros_messages import Packet, mono
from evetac_cli.formats.write import write_mcap
from evetac_cli.inspect.export import run as run_export
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.streams import Stream, mark_row
from tests import small_files
from tests.formats.test_exports import drawn, write
from tests.importing import same
from tests.pages.view.trials import REST, SLICES, moving, write_labels, write_recording, write_tracks

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

MESSAGES = {
    "/evetac/note": (1, "std_msgs/msg/String"),
    "/evetac/events": (SLICES, "event_camera_msgs/msg/EventPacket"),
    "/evetac/dots": (SLICES, "sensor_msgs/msg/PointCloud2"),
    "/evetac/label": (SLICES, "std_msgs/msg/Int8"),
    "/evetac/gripper": (SLICES // 2, "sensor_msgs/msg/JointState"),
    "/evetac/gripper/goal": (SLICES // 2, "sensor_msgs/msg/JointState"),
    "/evetac/gripper/current_target_ma": (SLICES // 2, "std_msgs/msg/Float64"),
    "/evetac/control/slip": (SLICES // 2, "std_msgs/msg/Bool"),
    "/evetac/control/phase": (SLICES // 2, "std_msgs/msg/UInt8"),
    "/evetac/control/u_ff_ticks": (SLICES // 2, "std_msgs/msg/Float32"),
    "/evetac/control/x_ref_ticks": (SLICES // 2, "std_msgs/msg/Float32"),
    "/evetac/control/probability": (SLICES, "std_msgs/msg/Float32"),
    "/evetac/truth/slip": (SLICES, "std_msgs/msg/Bool"),
    "/evetac/truth/slip_share": (SLICES, "std_msgs/msg/Float32"),
    "/evetac/truth/visible_slip_share": (SLICES, "std_msgs/msg/Float32"),
    "/evetac/truth/force": (SLICES, "geometry_msgs/msg/WrenchStamped"),
    "/evetac/truth/dots": (SLICES, "sensor_msgs/msg/PointCloud2"),
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated grasp with tracks and labels, and its export beside them."""
    path = tmp_path_factory.mktemp("mcap") / "a.recording.h5"
    header = write_recording(path, grasp=True)
    write_tracks(path.with_name("a.tracks.h5"), header, moving())
    write_labels(path.with_name("a.labels.h5"), header)
    assert set(exported(path)["left_out"].split("; ")) == {
        "gripper/current_written_ma",
        "truth/object_xy_px",
        "truth/slid_px",
        "truth/every_node_slid_px",
        "truth/sampled_parameters",
        "truth/table_gap_mm",
        "control/outcome",
        "sensor/window_px",
    }
    return path


def exported(path: Path) -> dict[str, Any]:
    """The export of a recording with the files beside it, as the command makes it."""
    (row,) = run_export([path], Export(format="mcap"), path.with_name("a.mcap"), force=True).rows
    return row


def test_the_library_of_mcap_reads_every_topic(recording: Path) -> None:
    """Assert counts, types, times and values of all messages, as mcap-ros2-support decodes them."""
    decoder = pytest.importorskip("mcap_ros2.decoder")
    from mcap.reader import make_reader

    read: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    kinds: dict[str, str] = {}
    with recording.with_name("a.mcap").open("rb") as file:
        order = 0
        for schema, channel, message, decoded in make_reader(
            file, validate_crcs=True, decoder_factories=[decoder.DecoderFactory()]
        ).iter_decoded_messages(log_time_order=False):
            assert message.log_time >= order and schema is not None
            order = message.log_time
            kinds[channel.topic] = schema.name
            read[channel.topic].append((message.log_time // 1000, decoded))
    assert {topic: (len(messages), kinds[topic]) for topic, messages in read.items()} == MESSAGES
    ends = [1000 * (k + 1) for k in range(SLICES)]
    with open_recording(recording) as ours:
        for (at, packet), events, end in zip(read["/evetac/events"], ours, ends, strict=True):
            assert (at, packet.encoding, packet.width, packet.height) == (end, "mono", *ours.frame_px)
            assert packet.header.stamp.nanosec == packet.time_base == (end - 1000) * 1000
            content = Packet(ours.frame_px, packet.seq, packet.time_base, "mono", memoryview(packet.events))
            for theirs, column in zip(mono(content), events, strict=True):
                np.testing.assert_array_equal(theirs, column)
        gripper = [(at, m.name, m.position[0] / np.radians(0.088), m.effort[0]) for at, m in read["/evetac/gripper"]]
        assert gripper == [
            (int(t_us), ["rh_p12_rn"], pytest.approx(float(ticks)), float(current))
            for t_us, ticks, current in zip(
                *(ours.read(f"gripper/{name}") for name in ("t_us", "position_ticks", "current_ma")), strict=True
            )
        ]
        goal = [m.position[0] / np.radians(0.088) for _, m in read["/evetac/gripper/goal"]]
        assert goal == pytest.approx(ours.read("control/goal_ticks").tolist())
        forces = [[m.wrench.force.x, m.wrench.force.y, m.wrench.force.z] for _, m in read["/evetac/truth/force"]]
        np.testing.assert_array_equal(np.array(forces)[:, :2], ours.read("truth/shear_force_n"))
        np.testing.assert_array_equal(np.array(forces)[:, 2], ours.read("truth/normal_force_n"))
        for path in ("control/slip", "control/phase", "control/x_ref_ticks", "control/probability", "truth/slip"):
            np.testing.assert_array_equal([m.data for _, m in read[f"/evetac/{path}"]], ours.read(path))
        assert [at for at, _ in read["/evetac/control/slip"]] == ours.read("control/t_us").tolist()
        for (_, cloud), places in zip(read["/evetac/truth/dots"], ours.read("truth/dot_xy_px"), strict=True):
            np.testing.assert_array_equal(np.stack([points(cloud)["x"], points(cloud)["y"]], axis=-1)[0], places)
    dots = [points(cloud) for _, cloud in read["/evetac/dots"]]
    assert [at for at, _ in read["/evetac/dots"]] == ends
    places = np.stack([np.stack([one["x"], one["y"]], axis=-1) for one in dots])
    moved = np.stack([np.stack([one["dx"], one["dy"]], axis=-1) for one in dots])
    np.testing.assert_array_equal(places, moving().reshape(SLICES, *REST.shape).astype(np.float32))
    np.testing.assert_allclose(moved, places - REST, atol=1e-5)
    with StageFile(recording.with_name("a.labels.h5"), "labels") as labels:
        np.testing.assert_array_equal([m.data for _, m in read["/evetac/label"]], labels.read("label"))
    frames = {m.header.frame_id for messages in read.values() for _, m in messages if hasattr(m, "header")}
    assert frames == {"evetac_simulated"}
    assert '"simulated": true' in read["/evetac/note"][0][1].data


def points(cloud: Any) -> Any:
    """The points of a cloud, by its own description of them."""
    kinds = {2: "u1", 5: "<i4", 7: "<f4"}
    dtype = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert cloud.row_step == cloud.point_step * cloud.width and not cloud.is_bigendian
    return np.frombuffer(cloud.data, dtype).reshape(cloud.height, cloud.width)


def test_our_import_reads_it_and_names_the_rest(recording: Path) -> None:
    """Assert equal events, slices and mark, and that the other topics are counted as left out."""
    imported = read_events(recording.with_name("a.mcap"))
    with open_recording(recording) as ours:
        assert same(imported.events, ours.between(0, SLICES))
    assert (imported.slices, imported.simulated, imported.frame_px) == (SLICES, True, (64, 48))
    (note,) = imported.notes
    assert note.startswith("left out: messages on /evetac/")
    assert imported.left_out == {
        f"messages on {topic} ({kind})": count
        for topic, (count, kind) in MESSAGES.items()
        if topic not in ("/evetac/note", "/evetac/events")
    }


def test_the_packet_is_the_published_one() -> None:
    """Assert that our definition of EventPacket has the checksum by which ROS 1 knows it."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(write_mcap.DEFINITION, write_mcap.PACKET))
    assert store.generate_msgdef(write_mcap.PACKET)[1] == read_rosbag.PACKET


def test_touch_beside_it_is_taken_along(tmp_path: Path) -> None:
    """Assert that a reader of mcap finds wrench, deviations, centre, sticking share and maps in SI units, on time."""
    decoder = pytest.importorskip("mcap_ros2.decoder")
    from mcap.reader import make_reader

    files = small_files.every_kind(tmp_path)
    shear = np.stack([np.linspace(-1, 1, small_files.SLICES), np.full(small_files.SLICES, 0.5)], axis=1)
    with h5py.File(files["touch"], "r+") as h5:
        h5["shear_n"][...] = shear
        h5["centre_mm"][0] = np.nan
        h5["map/pressure_pa"][...] = np.arange(40).reshape(2, 4, 5)
        h5["map/shear_pa"][1, 1, 3, 4] = -7
    exported(files["recording"])
    read: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    with (tmp_path / "a.mcap").open("rb") as file:
        for _, channel, message, decoded in make_reader(
            file, decoder_factories=[decoder.DecoderFactory()]
        ).iter_decoded_messages():
            read[channel.topic].append((message.log_time // 10**6, decoded))
    forces = [m.wrench for _, m in read["/evetac/force"]]
    assert [at for at, _ in read["/evetac/force"]] == list(range(1, small_files.SLICES + 1))
    np.testing.assert_allclose([[one.force.x, one.force.y] for one in forces], shear, rtol=1e-6)
    assert {(one.force.z, round(one.torque.z, 9)) for one in forces} == {(2.0, 0.5e-3)}
    sd = read["/evetac/force/sd"][5][1].wrench
    assert [sd.force.x, sd.force.y, sd.force.z, sd.torque.z] == pytest.approx([0.1, 0.1, 0.2, 0.2e-3])
    assert [at for at, _ in read["/evetac/touch/centre"]] == list(range(2, small_files.SLICES + 1))  # not where NaN
    _, centre = read["/evetac/touch/centre"][0]
    assert (centre.point.x, centre.point.y, centre.header.frame_id) == (0.001, 0.001, "evetac_gel_simulated")
    assert {m.data for _, m in read["/evetac/touch/sticking_share"]} == {0.75}
    maps = read["/evetac/touch/map"]
    assert [at for at, _ in maps] == [1, small_files.SLICES]
    cells = points(maps[1][1])
    assert (maps[1][1].height, maps[1][1].width) == cells.shape == (4, 5)
    np.testing.assert_array_equal(cells["pressure"], np.arange(20, 40).reshape(4, 5))
    np.testing.assert_allclose(cells["x"][0], np.arange(5) * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(cells["y"][:, 0], np.arange(4) * 1e-3, rtol=1e-6)
    assert (cells["shear_y"][3, 4], cells["shear_x"][3, 4], cells["shear_sd_y"][3, 4]) == (-7, 5e4, 1e3)
    assert (cells["patch"] == 1).all()


def test_other_streams_of_the_trial(tmp_path: Path) -> None:
    """Assert that columns, units, images, what a stream is, and marks are there, without times that ROS has not."""
    from rosbags.highlevel import AnyReader

    images = np.arange(3 * 4 * 5 * 3, dtype=np.uint8).reshape(3, 4, 5, 3)
    t_us = np.array([-2_000_000, -500, 7000])
    columns = {"x": np.array([0.5, np.nan, 2.0]), "count": np.arange(3.0)}
    arm = Stream("arm-left", t_us, columns, images, {"x": "m"}, what="an arm")
    marked = {name: np.array([value]) for name, value in mark_row(3000, "lifted").items()}
    source = write(tmp_path / "a.recording.h5", drawn(5), 9, 10**6, more=arm.datasets() | marked)
    assert exported(source)["left_out"] is None
    topics: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        for connection, time_ns, content in reader.messages():
            topics[connection.topic].append((time_ns // 1000, reader.deserialize(content, connection.msgtype)))
    assert [(at, mark.data) for at, mark in topics["/evetac/marks"]] == [(10**6 + 3000, "lifted")]
    times = [10**6 - 500, 10**6 + 7000]
    rows = topics["/evetac/streams/arm_left"]
    assert [at for at, _ in rows] == times
    np.testing.assert_array_equal([m.data for _, m in rows], [[1.0, np.nan], [2.0, 2.0]])
    assert rows[0][1].layout.dim[0].label == "count, x [m]"
    pictures = topics["/evetac/streams/arm_left/image"]
    assert [(at, m.encoding, m.height, m.width, m.step) for at, m in pictures] == [
        (at, "rgb8", 4, 5, 15) for at in times
    ]
    np.testing.assert_array_equal([m.data.reshape(4, 5, 3) for _, m in pictures], images[1:])
    assert '"what": "an arm"' in topics["/evetac/streams/arm_left/about"][0][1].data


def test_the_node_of_the_docs_publishes_what_we_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the node, run with stand-ins for ROS 2 and a camera, publishes packets that decode to its slices."""
    page = (Path(__file__).resolve().parents[3] / "docs" / "ros2.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    events = drawn(200)
    slices = [events.part(*np.searchsorted(events.t, [1000 * k, 1000 * (k + 1)]).tolist()) for k in range(90)]
    published: list[Any] = []

    class EventPacket(SimpleNamespace):
        def __init__(self) -> None:
            super().__init__(header=SimpleNamespace(stamp=SimpleNamespace()))

    node = SimpleNamespace(
        create_publisher=lambda kind, topic, qos: SimpleNamespace(publish=published.append),
        get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=5_000_000_007)),
    )
    for name, content in {
        "rclpy": {
            "init": lambda: None,
            "ok": lambda: True,
            "try_shutdown": lambda: None,
            "create_node": lambda _: node,
        },
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "event_camera_msgs": {},
        "event_camera_msgs.msg": {"EventPacket": EventPacket},
    }.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    from evetac_cli.devices import cameras

    waiting: list[Events | None] = [*slices, None]
    camera = SimpleNamespace(read=lambda: waiting.pop(0), close=lambda: waiting.append(None))
    monkeypatch.setattr(cameras.Virtual, "open", lambda *_: SimpleNamespace(camera=camera))
    monkeypatch.setattr(sys, "argv", ["evetac_node.py", "virtual"])
    exec(compile(code, "docs/ros2.md", "exec"), {})
    assert waiting == [None]  # closed
    assert [packet.seq for packet in published] == list(range(90))
    for packet, one in zip(published, slices, strict=True):
        assert isinstance(packet.events, array) and packet.header.frame_id == "evetac_simulated"
        part = mono(
            Packet((packet.width, packet.height), packet.seq, packet.time_base, "mono", memoryview(packet.events))
        )
        np.testing.assert_array_equal(part.t.astype(np.int64) - 5_000_000, one.t)
        for theirs, ours in zip(part[1:], one[1:], strict=True):
            np.testing.assert_array_equal(theirs, ours)
