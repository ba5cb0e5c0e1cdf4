"""What is kept beside events: IMU samples, triggers and frames of AEDAT4 and of bags, as other libraries read them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.formats.imports import Imported, read_events
from evetac_cli.formats.read.aedat4_packets import read_header, walk
from evetac_cli.inspect import info
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import record
from tests.formats.read.test_read_aedat4 import store
from tests.make import run_stage

START_US = 1_600_000_000_000_000
FRAME = (40, 30)


@pytest.fixture(scope="module")
def aedat4(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of dv-processing: events of 10 ms, IMU samples and triggers before, in and after that, and four frames."""
    dv = pytest.importorskip("dv_processing")
    pytest.importorskip("faery")
    path = tmp_path_factory.mktemp("streams") / "a.aedat4"
    config = dv.io.MonoCameraWriter.Config("DAVIS")
    config.addEventStream(FRAME)
    config.addImuStream()
    config.addTriggerStream()
    config.addFrameStream(FRAME)
    writer = dv.io.MonoCameraWriter(str(path), config)
    for k in range(-2, 14):
        t = START_US + 1000 * k
        if 0 <= k < 10:
            writer.writeEventPacket(store(dv, [t, t + 999], [k, 39], [1, 29], [1, 0]).toPacket())
        writer.writeImu(dv.IMU(t + 500, 20.0 + k, *(k + axis / 10 for axis in range(9))))
        if k in (-1, 3, 4):
            writer.writeTrigger(dv.Trigger(t + 7, dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE))
        if k % 4 == 0:
            writer.writeFrame(dv.Frame(t + 100, np.full((30, 40), 10 * (k + 1) % 256, np.uint8)))
    del writer
    return path


def streams_of(imported: Imported) -> dict[str, Any]:
    return {stream.name: stream for stream in imported.streams}


def test_imu_samples_and_triggers_are_kept(aedat4: Path) -> None:
    """Assert times in the recording's clock, values and units, and that what lies outside is counted."""
    imported = read_events(aedat4)
    streams = streams_of(imported)
    assert list(streams) == ["imu", "triggers"]
    imu = streams["imu"]
    assert imu.t_us.tolist() == [1000 * k + 500 for k in range(10)]
    assert imu.columns["temperature"].tolist() == [20.0 + k for k in range(10)]
    assert np.allclose(imu.columns["gyroscope_x"], [k + 0.3 for k in range(10)], atol=1e-6)
    assert (imu.units["accelerometer_z"], imu.units["gyroscope_x"], imu.units["magnetometer_y"]) == ("g", "deg/s", "uT")
    assert streams["triggers"].t_us.tolist() == [3007, 4007]
    assert streams["triggers"].columns["source"].tolist() == [1.0, 1.0]
    assert imported.left_out == {
        "frames": 4,
        "IMU samples outside the recording": 6,
        "triggers outside the recording": 1,
    }
    assert imported.notes == [
        "kept: 10 samples of imu, 2 samples of triggers",
        "left out: frames 4, IMU samples outside the recording 6, triggers outside the recording 1",
    ]


def test_frames_are_kept_if_asked_for(aedat4: Path) -> None:
    """Assert that frames come in as images of one channel, at their times."""
    imported = read_events(aedat4, frames=True)
    frames = streams_of(imported)["frames"]
    assert frames.frames.shape == (3, 30, 40, 1)
    assert frames.frames[:, 0, 0, 0].tolist() == [10, 50, 90]
    assert frames.t_us.tolist() == [100, 4100, 8100]
    assert imported.left_out["frames outside the recording"] == 1


def test_a_recording_holds_them(aedat4: Path, tmp_path: Path) -> None:
    """Assert that the file of a recording holds the streams, `info` shows them, and --json tells what was left out."""
    out = tmp_path / "a.recording.h5"
    params = Record(source=aedat4, frames=True)
    (row,) = run_stage(record, [], params, out)[1].rows
    assert row["streams"] == "frames imu triggers"
    assert "IMU samples outside the recording 6" in row["left_out"]
    with open_recording(out) as recording:
        assert recording.read("streams/imu/t_us").tolist() == [1000 * k + 500 for k in range(10)]
        assert recording.read("streams/frames/frames").shape == (3, 30, 40, 1)
        about = json.loads(recording.read("streams/imu/about"))
    assert about["units"]["accelerometer_x"] == "g"
    (shown,) = info.run([out]).rows
    assert "10 samples of 10 columns" in shown["stream_imu"]
    assert "3 frames of 40 x 30 px" in shown["stream_frames"]


def test_damage_costs_the_samples_it_hits(aedat4: Path, tmp_path: Path) -> None:
    """Assert that packets of samples that cannot be decoded are counted, and the others kept."""
    data = bytearray(aedat4.read_bytes())
    with aedat4.open("rb") as handle:
        header = read_header(handle, "")
        number = next(stream.number for stream in header.streams if stream.kind == "IMUS")
        spans = walk(handle, header, number).spans
    span = spans[len(spans) // 2]
    data[span[0] : span[1]] = bytes(span[1] - span[0])
    path = tmp_path / "a.aedat4"
    path.write_bytes(data)
    imported = read_events(path)
    assert imported.events.size == 20
    assert imported.left_out["unreadable packets of IMU samples"] == 1
    assert len(spans) == 1 and list(streams_of(imported)) == ["triggers"]  # dv-processing packs them together


REAL = {"dvxplorer_static_noise": (2188, 0, 0), "davis346": (2363, 236, 59), "multistream": (3836, 101, 25)}


@pytest.mark.parametrize("name", REAL)
def test_real_files_drop_nothing_unsaid(name: str, outside_file: Callable[[str], Path]) -> None:
    """Assert that every sample of the makers' files is kept or counted."""
    pytest.importorskip("faery")
    imported = read_events(outside_file(f"{name}.aedat4"), frames=True)
    kept = {one.name: len(one.t_us) for one in imported.streams}
    names = {"imu": "IMU samples", "triggers": "triggers", "frames": "frames"}
    for (stream, spoken), count in zip(names.items(), REAL[name], strict=True):
        assert kept.get(stream, 0) + imported.left_out.get(f"{spoken} outside the recording", 0) == count
    assert set(imported.left_out) <= {f"{spoken} outside the recording" for spoken in names.values()}


def test_as_dv_processing_reads_them(outside_file: Callable[[str], Path]) -> None:
    """Assert equal times, values and images with dv-processing on the file of a DAVIS346."""
    dv: Any = pytest.importorskip("dv_processing")
    path = outside_file("davis346.aedat4")
    imported = read_events(path, frames=True)
    streams = streams_of(imported)
    reader = dv.io.MonoCameraRecording(str(path))
    samples, images, sources = [], [], []
    while (batch := reader.getNextImuBatch()) is not None:
        samples += [(one.timestamp, one.accelerometerX, one.gyroscopeZ, one.temperature) for one in batch]
    while (frame := reader.getNextFrame()) is not None:
        images.append(frame.image)
    while (triggers := reader.getNextTriggerBatch()) is not None:
        sources += [(one.timestamp, int(one.type.value)) for one in triggers]

    def inside(rows: list[tuple[float, ...]], stream: Any) -> Any:
        table = np.array(rows, np.float64)
        t_us = table[:, 0].astype(np.int64) - imported.t_offset_us
        within = (t_us >= 0) & (t_us < imported.slices * 1000)
        assert np.array_equal(t_us[within], stream.t_us)
        return table[within, 1:]

    imu = streams["imu"].columns
    theirs = inside(samples, streams["imu"])
    ours = np.stack([imu[name] for name in ("accelerometer_x", "gyroscope_z", "temperature")], axis=1)
    assert np.array_equal(ours, theirs)
    assert np.array_equal(inside(sources, streams["triggers"])[:, 0], streams["triggers"].columns["source"])
    frames = streams["frames"].frames[..., 0]
    assert any(np.array_equal(frames, images[first : first + len(frames)]) for first in range(len(images)))
