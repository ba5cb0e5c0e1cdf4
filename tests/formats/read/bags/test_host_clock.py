"""Bags with two clocks: streams on the host's are brought to the sensor's, as each packet of events holds both."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.attach import Attach
from evetac_cli.commands.record import Record
from evetac_cli.events import Events
from evetac_cli.formats.imports import Imported, read_events
from evetac_cli.formats.read.bags.host_clock import SAME_CLOCK_US
from evetac_cli.stages import attach
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import record
from tests.formats.read.bags.bag_writing import ENCODERS, START_S, Types, Write, drawn
from tests.make import run_stage
from tests.quick import few

HOST_US = 1_700_000_123_456_789  # what the host's clock says when the sensor's is 0
BEGIN_US = 5_000_000  # of the events, on the sensor's clock


def events_of(seconds: float, begin_us: int = BEGIN_US, seed: int = 3) -> Events:
    """Some thousand events a second, on the sensor's clock."""
    drawn_ = drawn(round(seconds * 2000), seed, 1001)
    return drawn_._replace(t=drawn_.t - START_S * 10**6 + begin_us)


def latencies(count: int) -> Any:
    """How late packets arrive, in us: 1 to 3 ms, some of them far later."""
    rng = np.random.default_rng(8)
    return rng.integers(1000, 3000, count) + (rng.random(count) < 0.05) * 20_000


def packets(
    types: Types, events: Events, encoding: str = "mono", drift: float = 0.0, late: bool = True, host_us: int = HOST_US
) -> list[Any]:
    """Packets of 10 ms, stamped by the host when they arrive. drift: of the host's clock, as a share."""
    made = []
    edges = np.arange(int(events.t[0]), int(events.t[-1]) + 10_001, 10_000)
    cuts = np.searchsorted(events.t, edges).tolist()
    delays = latencies(len(cuts)) if late else np.zeros(len(cuts), np.int64)
    for number, (first, last) in enumerate(zip(cuts, cuts[1:], strict=False)):
        part = events.part(first, last)
        if not part.size:
            continue
        base_ns = 1000 * int(part.t[0])
        stamp_us = host_us + round(int(part.t[0]) * (1 + drift)) + int(delays[number])
        content = evt(part, encoding) if encoding.startswith("evt") else ENCODERS[encoding](part, base_ns)
        made.append(types.packet(content, encoding, number, base_ns, stamp_us=stamp_us))
    return made


def evt(events: Events, encoding: str) -> bytes:
    """Words of EVT2 or EVT3: the time in full before each event."""
    words: list[int] = []
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        if encoding == "evt2":
            words += [0x8 << 28 | (t >> 6) & 0xFFFFFFF, p << 28 | (t & 63) << 22 | x << 11 | y]
        else:
            words += [0x8 << 12 | (t >> 12) & 0xFFF, 0x6 << 12 | t & 0xFFF, y, 0x2 << 12 | p << 11 | x]
    return np.array(words, "<u4" if encoding == "evt2" else "<u2").tobytes()


def imu(types: Types, t_us: Any) -> list[Any]:
    """IMU samples with their own times, numbered."""
    nine, zero = np.zeros(9), types.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    turned = types.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    made = []
    for number, us in enumerate(np.asarray(t_us).tolist()):
        gravity = types.make("geometry_msgs/msg/Vector3", float(number), 0.0, -9.81)
        made.append(types.make("sensor_msgs/msg/Imu", types.header(int(us)), turned, nine, zero, nine, gravity, nine))
    return made


def errors_us(imported: Imported, wanted_us: Any) -> Any:
    """By how much the times of the IMU's samples differ from where they were taken, on the sensor's clock."""
    (stream,) = imported.streams
    numbers = stream.columns["linear_acceleration.x"].astype(int)
    return stream.t_us + imported.t_offset_us - np.asarray(wanted_us)[numbers]


@pytest.mark.parametrize(
    ("bag", "encoding"),
    [("ros1", "mono"), ("db3", "libcaer"), ("mcap", "libcaer_cmp"), ("ros1", "evt2"), ("db3", "evt3")],
)
def test_imu_samples_of_the_host_land_in_the_recording(write: Write, bag: str, encoding: str) -> None:
    """Assert that every sample comes, off by no more than the usual latency of packets, and that it is said."""
    types = Types(bag)
    wanted = np.arange(BEGIN_US + 100_000, BEGIN_US + 900_000, 10_000)
    topics = {"/cam/events": packets(types, events_of(1), encoding), "/cam/imu": imu(types, wanted + HOST_US)}
    imported = read_events(write(bag, types, topics))
    assert len(imported.streams[0].t_us) == len(wanted) and not imported.left_out
    errors = errors_us(imported, wanted)
    assert (errors > -3000).all() and (errors < -1000).all()  # headers are late, so samples come that much too early
    (note, kept) = imported.notes
    assert "s ahead of the sensor's on /cam/events" in note and "converted cam_imu to the sensor's clock" in note
    assert f"is {HOST_US / 1e6:.2f}"[:-1] in note and "nine of ten within" in note
    assert kept == "kept: 80 samples of cam_imu"
    assert "converted to the sensor's clock" in imported.streams[0].clock
    assert imported.streams[0].offset_s == pytest.approx(-HOST_US / 1e6, abs=0.01)


@pytest.mark.parametrize("encoding", few(["mono", "evt3"], "evt3"))
def test_a_drift_between_the_clocks_is_followed(write: Write, encoding: str) -> None:
    """Assert that at 100 ppm samples are off by latency alone, over seven turns of EVT3's time."""
    types = Types("mcap")
    events = events_of(120, 16_000_000)
    thinned = Events(*(column[::2] for column in events))
    wanted = np.arange(17_000_000, 134_000_000, 500_000)
    host = np.rint(wanted * 1.0001).astype(np.int64) + HOST_US
    topics = {"/e": packets(types, thinned, encoding, drift=1e-4), "/imu": imu(types, host)}
    imported = read_events(write("mcap", types, topics))
    errors = errors_us(imported, wanted)
    assert len(errors) == len(wanted)
    assert (np.abs(errors + 2000) < 1500).all()
    assert "drift 1" in " ".join(imported.notes)  # some 11 to 12 ms


def test_one_clock_is_left_alone(write: Write) -> None:
    """Assert that where headers and events are on one clock nothing is moved, though headers come late."""
    types = Types("db3")
    events = events_of(1, HOST_US)
    wanted = np.arange(HOST_US + 100_000, HOST_US + 900_000, 10_000)
    topics = {"/e": packets(types, events, host_us=400_000), "/imu": imu(types, wanted)}
    imported = read_events(write("db3", types, topics))
    assert (errors_us(imported, wanted) == 0).all()
    assert imported.notes == ["kept: 80 samples of imu"]
    assert SAME_CLOCK_US > 400_000


def test_what_cannot_be_told_is_said(write: Write) -> None:
    """Assert that a stream that fits on both clocks is left as it is, with a note."""
    types = Types("db3")
    wanted = np.arange(BEGIN_US, BEGIN_US + 10_000_000, 100_000)
    topics = {"/e": packets(types, events_of(10), host_us=4_000_000), "/imu": imu(types, wanted)}
    imported = read_events(write("db3", types, topics))
    assert (errors_us(imported, wanted) == 0).all()
    assert "imu uses: left unchanged" in imported.notes[0]


@pytest.fixture
def trial(write: Write, tmp_path: Path) -> tuple[Path, Path]:
    """A bag of two clocks with a pose and an image beside the events, and the recording of its events."""
    types = Types("mcap")
    poses = []
    for k in range(20):
        point = types.make("geometry_msgs/msg/Point", k / 8, 0.0, 0.0)
        turn = types.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        header = types.header(HOST_US + BEGIN_US + 50_000 * k + 10_000)
        pose = types.make("geometry_msgs/msg/Pose", point, turn)
        poses.append(types.make("geometry_msgs/msg/PoseStamped", header, pose))
    path = write("mcap", types, {"/e": packets(types, events_of(1)), "/pose": poses})
    out = tmp_path / "a.recording.h5"
    params = Record(source=path)
    run_stage(record, [], params, out)
    return path, out


def attached(recording: Path, source: str, **options: Any) -> tuple[Any, dict[str, Any]]:
    """Times of a stream that was attached, and the row of the command."""
    params = Attach(stream=[f"arm={source}"], **options)
    (job,) = attach.jobs([recording], params, None)
    (row,) = attach.run(job, params, force=True).rows
    with open_recording(job.output) as file:
        return file.read("streams/arm/t_us"), row


def test_attach_brings_poses_to_the_sensors_clock(trial: tuple[Path, Path]) -> None:
    """Assert that a stream of the same bag lands in the recording without an offset, and how is said."""
    path, recording = trial
    with open_recording(recording) as file:
        zero_us = int(file.read("t_offset"))
    t_us, row = attached(recording, f"{path}:/pose")
    errors = t_us + zero_us - (BEGIN_US + 50_000 * np.arange(20) + 10_000)
    assert (errors > -3000).all() and (errors < -1000).all()
    assert "converted arm to the sensor's clock" in row["notes"]


def test_an_offset_is_taken_at_its_word(trial: tuple[Path, Path]) -> None:
    """Assert that a stream with an offset is moved by that alone."""
    path, recording = trial
    with open_recording(recording) as file:
        zero_us = int(file.read("t_offset"))
    t_us, row = attached(recording, f"{path}:/pose", offset=[f"arm={-HOST_US / 1e6:.6f}"])
    assert (t_us + zero_us == BEGIN_US + 50_000 * np.arange(20) + 10_000).all()
    assert "sensor's clock" not in row["notes"]


def test_another_recording_does_not_count(trial: tuple[Path, Path], write: Write, tmp_path: Path) -> None:
    """Assert that poses are not moved for a recording that is on the host's clock itself."""
    path, _ = trial
    types = Types("mcap")
    events = events_of(1, HOST_US + BEGIN_US)
    other = write("mcap", types, {"/e": packets(types, events, host_us=0)}, "other")
    out = tmp_path / "b.recording.h5"
    params = Record(source=other)
    run_stage(record, [], params, out)
    with open_recording(out) as file:
        zero_us = int(file.read("t_offset"))
    t_us, row = attached(out, f"{path}:/pose")
    assert (t_us + zero_us == HOST_US + BEGIN_US + 50_000 * np.arange(20) + 10_000).all()
    assert "sensor's clock" not in row["notes"]
