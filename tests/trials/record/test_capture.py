"""Recording from devices: whatever ends it, the file is valid and says what happened."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli import console
from evetac_cli.commands.record import Record
from evetac_cli.devices import GripperReading, Rig
from evetac_cli.devices.opening import open_rig
from evetac_cli.errors import DeviceError, InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.inspect import validate
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile, header_of
from evetac_cli.store.recordings import segments
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import record, session
from evetac_cli.trials.record import camera_recording, capture
from tests.conftest import Made
from tests.devices.stand_ins import StillCamera, StillGripper
from tests.patience import PATIENCE_S, until
from tests.small_files import recording_of
from tests.trials.live_view.fake_view import FakeView

ARMED = {"gripper": "/dev/ttyUSB0", "arm": True}


class Camera(StillCamera):
    """A camera that makes ten events in every slice, and fails or ends after a number of slices."""

    SLICE_S = 2e-4  # that it takes at least

    def __init__(self, slices: int = 10**9, fails_at: int = 10**9) -> None:
        self.sensor: Mapping[str, Any] = {
            "sensor/frame_px": np.array([640, 480], np.int32),
            "sensor/name": "dvxplorer:T1",
        }
        self.counted = {"late_events": 3, "usb_errors": 0}
        self._slices, self._fails_at = slices, fails_at
        self.closed = False
        self.k = 0

    def read(self) -> Events | None:
        if self.k >= self._fails_at:
            raise DeviceError("is no longer on the bus", where="camera T1")
        if self.k >= self._slices:
            return None
        time.sleep(self.SLICE_S)
        self.k += 1
        t = (self.k - 1) * SLICE_US + np.arange(10, dtype=np.int64)
        return Events(t, np.arange(10, dtype=np.uint16), np.arange(10, dtype=np.uint16), np.ones(10, np.uint8))

    def now_us(self) -> int:
        return self.k * SLICE_US

    def host_us(self, device_us: float) -> float:
        return time.monotonic() * 1e6 - self.k * SLICE_US + device_us - 40.0

    def close(self) -> None:
        self.closed = True


class Hand(StillGripper):
    """A gripper that stands still, and fails after a number of commands, and once a camera has made some slices."""

    def __init__(self, fails_at: int = 10**9, beside: Camera | None = None, slices: int = 0) -> None:
        self.counted = {"answers_lost": 2}
        self.written: list[int] = []
        self._fails_at, self._beside, self._slices = fails_at, beside, slices
        self.closed = False

    def read(self) -> GripperReading:
        if len(self.written) >= self._fails_at:
            assert until(lambda: self._beside is None or self._beside.k >= self._slices, every_s=1e-4)
            raise DeviceError("no answer", where="gripper")
        return GripperReading(5.0, 400)

    def write_current(self, current_ma: int) -> None:
        self.written.append(current_ma)

    def write_position(self, goal_ticks: int) -> None:
        raise AssertionError("the current is commanded")

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def rig_is(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Rig]:
    """Let these devices stand for what is opened by name."""

    def put(camera: Camera, hand: Hand | None = None, serial: str = "T1", holding_ma: float = 0.0) -> Rig:
        setup = {"camera": {"serial": serial}, "gripper": "none"}
        rig = Rig(camera, hand, holding_ma=holding_ma, setup=setup, simulated=False)
        monkeypatch.setattr(capture, "open_rig", lambda *named, **more: rig)
        return rig

    return put


def recording(out: Path, **flags: Any) -> tuple[Path, Any]:
    """Record with `--camera dvxplorer` and these flags; returns the file and the outcome."""
    params = Record(camera="dvxplorer", expected_event_rate=1e4, **flags)
    jobs = record.jobs([], params, out)
    for job in jobs:
        made = record.run(job, params)
    return jobs[-1].output, made


def faults(path: Path) -> Any:
    return validate.run([path]).rows[0]["faults"]


def test_after_the_seconds(rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that it is as long as asked for, valid, not simulated, and carries rate, lateness and every loss."""
    rig = rig_is(Camera())
    began_s = time.monotonic()
    path, made = recording(tmp_path, seconds=0.5)
    took_s = time.monotonic() - began_s
    assert faults(path) is None
    with open_recording(path) as file:
        assert [events.size for events in file] == [10] * 500
        assert file.read("capture/ended") == "after the seconds asked for"
        assert int(file.read("capture/lost/camera.late_events")) == 3
        assert float(file.read("capture/slices_per_s")) >= 499 / took_s
        late_us = file.read("capture/slice_late_us")
        assert late_us[0] <= late_us[1] <= late_us[2] <= 40.0
        assert not file.has("gripper")
        header = file.header
    assert not header["simulated"]
    assert header["content"] is not None
    assert header["parameters"]["setup"] == rig.setup
    row = made.rows[0]
    assert (row["slices"], row["events"], row["lost"], row["lost_why"]) == (500, 5000, 3, "camera.late_events 3")
    assert (row["late_slices"], row["too_slow"]) == (0, None)
    json.dumps(made.rows)
    assert rig.camera.closed


def test_every_command_is_in_the_file(rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that what was written to the gripper is in the file, one row a command, target and whole number."""
    hand = Hand()
    rig_is(Camera(), hand)
    path, made = recording(tmp_path, gripper="/dev/ttyUSB0", arm=True, hold_s=0.0, holding_ma=3.0, lowest_ma=2.5)
    assert faults(path) is None
    with open_recording(path) as file:
        assert file.read("gripper/current_written_ma").tolist() == hand.written
        target = file.read("gripper/current_target_ma")
        assert file.read("capture/ended") == "the current reached its lower limit"
        assert (np.diff(file.read("gripper/t_us")) >= 0).all()
        assert int(file.read("capture/lost/gripper.answers_lost")) == 2
    assert [round(value) for value in target] == hand.written
    assert target[-1] <= 2.5 < target[-2]
    assert made.rows[0]["commands"] == len(hand.written)
    assert hand.closed


@pytest.mark.parametrize("part", ["camera", "gripper"])
def test_failing_device_leaves_a_valid_file(part: str, rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that an unplugged device ends with its error, which names the file with all that came before."""
    camera = Camera(fails_at=300 if part == "camera" else 10**9)
    rig = rig_is(camera, Hand() if part == "camera" else Hand(20, camera, slices=30))
    with pytest.raises(DeviceError, match="no longer on the bus" if part == "camera" else "no answer") as failed:
        recording(tmp_path, **ARMED)
    (path,) = tmp_path.iterdir()
    assert str(path) in str(failed.value)
    assert faults(path) is None
    with open_recording(path) as file:
        assert len(file) == 300 if part == "camera" else len(file) >= 29
        assert file.read("capture/ended") == str(failed.value).splitlines()[0]
        if part == "gripper":
            assert file.length("gripper/t_us") == 20
    assert rig.camera.closed
    assert rig.gripper.closed


def test_device_that_fails_at_once_leaves_nothing(rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that without a single slice there is no file, no folder, and the error says so."""
    rig_is(Camera(fails_at=0))
    with pytest.raises(DeviceError, match="nothing was recorded"):
        recording(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_gripper_is_let_go_of_before_the_file_is_joined(
    rig_is: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that torque does not wait for the disk, and that a gripper that will not let go is an error afterwards."""
    hand = Hand()
    join = segments.join

    def joined(*given: Any, **more: Any) -> Any:
        assert hand.closed
        return join(*given, **more)

    def refuse() -> None:
        hand.closed = True
        raise DeviceError("torque could not be switched off")

    monkeypatch.setattr(segments, "join", joined)
    rig_is(Camera(), hand)
    recording(tmp_path / "one", seconds=0.05, **ARMED)
    hand = Hand()
    monkeypatch.setattr(hand, "close", refuse)
    rig_is(Camera(), hand)
    with pytest.raises(DeviceError, match="torque could not"):
        recording(tmp_path / "two", seconds=0.05, **ARMED)
    assert [faults(path) for path in (tmp_path / "two").iterdir()] == [None]


@pytest.mark.parametrize("failure", [InputError("cannot be written: No space left"), KeyboardInterrupt()])
def test_failing_end_keeps_the_segments(
    failure: BaseException, rig_is: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that where the segments cannot be joined they stay, which is said, and repair joins them."""

    def fail(*given: Any, **more: Any) -> None:
        raise failure

    rig_is(Camera())
    with monkeypatch.context() as broken:
        broken.setattr(segments, "join", fail)
        with pytest.raises(type(failure), match="for `evetac validate --repair`"):
            recording(tmp_path, seconds=0.1)
    assert validate.repair([tmp_path]).rows[0]["slices_kept"] == 100


def test_calibration_is_stored(rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that --calibration gives a recording its dots, as part of its set-up; another frame is refused."""
    dots = [[[100.0 + 60 * column, 100.0 + 60 * row] for column in range(4)] for row in range(3)]
    path = tmp_path / "gel.json"
    path.write_text(json.dumps({"frame_px": [640, 480], "radius_px": 6.0, "dot_xy_px": dots}))
    rig_is(Camera())
    made, _ = recording(tmp_path / "a", seconds=0.05, calibration=path)
    with open_recording(made) as file:
        np.testing.assert_array_equal(file.dot_xy_px, dots)
        assert file.header["parameters"]["sensor"]["sensor/dot_xy_px"] == dots
    path.write_text(json.dumps({"frame_px": [320, 240], "radius_px": 6.0, "dot_xy_px": [[[9, 9], [99, 9]]]}))
    rig_is(Camera())
    with pytest.raises(InputError):
        recording(tmp_path / "b", seconds=0.05, calibration=path)
    assert not (tmp_path / "b").exists()


def test_series_goes_on(rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that a resumed series keeps what there is and adds the rest, with trial numbers of their own."""
    rig_is(Camera())
    recording(tmp_path, seconds=0.05, count=2)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    rig_is(Camera())
    recording(tmp_path, seconds=0.05, count=3, resume=True)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [f"dvxplorer-s0-00{trial}.recording.h5" for trial in range(3)]
    assert all(path.read_bytes() == data for path, data in before.items())
    for trial, name in enumerate(names):
        with StageFile(tmp_path / name) as file:
            assert file.header["parameters"]["trial"] == trial


@pytest.mark.parametrize("flags", [{}, {"resume": True}, ARMED, {**ARMED, "resume": True}])
def test_nothing_moves_before_a_person_has_put_the_object_in_place(
    flags: dict[str, Any], rig_is: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that every trial after the first is asked for, in a series that goes on too."""
    asked: list[str] = []
    monkeypatch.setattr(console, "wait_for_enter", asked.append)
    rig_is(Camera(), Hand() if "arm" in flags else None)
    recording(tmp_path, seconds=0.02, count=3, **flags)
    assert [text.partition(":")[0] for text in asked] == ["trial 1", "trial 2"]


@pytest.mark.parametrize(
    ("change", "said"),
    [({"serial": "T2"}, "serial"), ({"seed": 5}, "current_ramp_seed"), ({"hold_s": 3.0}, "hold_s")],
)
def test_changed_setup_is_refused(
    change: dict[str, Any], said: str, rig_is: Callable[..., Rig], tmp_path: Path
) -> None:
    """Assert that a series is not continued with another camera or other settings, and the difference is named."""
    rig_is(Camera(), Hand())
    params = Record(
        camera="dvxplorer", expected_event_rate=1e4, seconds=0.05, count=1, gripper="/dev/ttyUSB0", arm=True
    )
    (job,) = record.jobs([], params, tmp_path)
    record.run(job, params)
    rig = rig_is(Camera(), Hand(), change.pop("serial", "T1"))
    params = dataclasses.replace(params, count=2, resume=True, **change)
    jobs = record.jobs([], params, tmp_path)
    if "seed" in change:  # it names other files: of this series by hand
        series = ((job.output,), (tmp_path / "b.recording.h5",))
        jobs = [
            dataclasses.replace(trial, output=files[0], files=files, series=series)
            for trial, files in zip(jobs, series, strict=True)
        ]
    with pytest.raises(InputError, match="different setup") as refused:
        record.run(jobs[1], params)
    assert said in str(refused.value)
    assert not jobs[1].output.exists()
    assert rig.camera.closed
    assert rig.gripper.closed


def test_drawn_current_is_the_trials(rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that a series goes on whose world draws another holding current, and not where one was asked for."""

    def trials(count: int, drawn_ma: float, **flags: Any) -> list[Path]:
        rig_is(Camera(), Hand(), holding_ma=drawn_ma)
        params = Record(camera="virtual", expected_event_rate=1e4, seconds=0.05, count=count, **flags)
        jobs = record.jobs([], params, tmp_path)
        for job in jobs:
            record.run(job, params)
        return [job.output for job in jobs]

    trials(1, 10.0)
    paths = trials(2, 19.0, resume=True)
    headers = [header_of(path, "recording")["parameters"] for path in paths]
    assert [header["sampled_holding_ma"] for header in headers] == [10.0, 19.0]
    assert [header["current_ramp"]["holding_ma"] for header in headers] == [None, None]
    with pytest.raises(InputError, match="different setup(.|\n)*holding_ma"):
        trials(3, 19.0, resume=True, holding_ma=19.0)


@pytest.mark.parametrize("taken", ["dvxplorer-s0-000.recording.h5", "dvxplorer-s0-001.recording.part/000000.h5"])
def test_series_is_not_begun_in_part(taken: str, rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that where outputs of a series exist, or wait for repair, no other trial of it is recorded."""
    (tmp_path / taken).parent.mkdir(exist_ok=True)
    (tmp_path / taken).touch()
    rig = rig_is(Camera())
    params = Record(camera="dvxplorer", expected_event_rate=1e4, seconds=0.05, count=3)
    job = record.jobs([], params, tmp_path)[2]
    with pytest.raises(InputError, match=f"-002.*others of the series(.|\n)*{taken[:16]}(.|\n)*--resume"):
        record.run(job, params)
    assert rig.camera.k == 0
    assert not job.output.exists()
    assert record.run(job, params, force=True).made


@pytest.mark.parametrize(
    ("flags", "out", "said"),
    [
        ({"camera": "replay:nope.h5"}, "", "nope.h5: no such file"),
        ({"camera": "dvxplorer", "calibration": Path("nope.json")}, "", "nope.json: cannot be read"),
        ({"camera": "dvxplorer"}, "there.recording.h5", "the output exists"),
        ({"camera": "dvxplorer"}, "there.recording.h5/new.recording.h5", "the output folder is a file"),
        ({"camera": "dvxplorer", "expected_event_rate": 1e9, "seconds": 80000.0}, "", "not enough space"),
        ({"camera": "dvxplorer", **ARMED, "lowest_ma": 50.0}, "", "--lowest-ma: .*would not fall"),
        ({"camera": "virtual", "lowest_ma": 500.0, "holding_ma": 50.0}, "", "--lowest-ma: .*would not fall"),
        ({"camera": "dvxplorer", "calibration": Path("nope.json"), "live": False}, "", "nope.json: cannot be read"),
        ({}, "there.recording.h5", "not a valid evetac file"),
    ],
)
def test_dry_run_refuses_what_a_run_does(
    flags: dict[str, Any], out: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a dry run and a run refuse in the same words what can be known before a device is opened."""
    monkeypatch.setattr(capture, "open_rig", lambda *named, **more: pytest.fail("opened"))
    (tmp_path / "there.recording.h5").touch()
    params = Record(**{"expected_event_rate": 1e4, **flags} if flags else {})
    words = []
    for act in (record.dry_run, lambda jobs, params: record.run(jobs[0], params)):
        with pytest.raises(InputError, match=said) as refused:
            act(record.jobs([], params, tmp_path / out), params)
        words.append(str(refused.value))
    assert words[0] == words[1]


def test_drawn_current_below_the_lowest(rig_is: Callable[..., Rig], tmp_path: Path) -> None:
    """Assert that a current that a world draws has to have somewhere to fall, too."""
    rig_is(Camera(), Hand(), holding_ma=10.0)
    params = Record(camera="virtual", expected_event_rate=1e4, lowest_ma=12.0)
    (job,) = record.jobs([], params, tmp_path)
    record.dry_run([job], params)
    with pytest.raises(InputError, match="--lowest-ma: .*(.|\n)*less than the holding current, 10 mA"):
        record.run(job, params)
    assert not list(tmp_path.iterdir())


def test_replay_is_recorded_as_it_was(made: Made, tmp_path: Path) -> None:
    """Assert that a replayed recording is recorded event by event, knows its dots, its parent, and is simulated too."""
    params = Record(camera=f"replay:{made.recordings[0]}", expected_event_rate=1e4)
    (job,) = record.jobs([], params, tmp_path)
    assert job.inputs == (made.recordings[0],)
    result = record.run(job, params)
    assert result.simulated
    with open_recording(job.output) as one, open_recording(made.recordings[0]) as other:
        assert len(one) == len(other)
        for ours, theirs in zip(one.between(0, len(one)), other.between(0, len(other)), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(one.dot_xy_px, other.dot_xy_px)
        assert one.header["parents"] == [other.header["id"]]
        assert not one.has("truth")
    assert faults(job.output) is None


WRITES = (0x03, 0x83)  # instructions that write registers: with an answer, and without


@pytest.mark.usefixtures("words_wait")
def test_virtual_devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the real drivers record from virtual devices every slice, event, and command that the servo got."""
    counts: list[int] = []
    opened: list[Rig] = []

    def count_writes() -> None:
        (servo,) = opened[0].peers
        given = servo.instructions()  # type: ignore[attr-defined]  # of a virtual gripper
        counts.append(sum(given.get(code, 0) for code in WRITES))

    def open_and_count(*named: Any, **more: Any) -> Rig:
        opened.append(open_rig(*named, **more))
        count_writes()
        return opened[0]

    def release_and_count(recordings: Any) -> None:
        count_writes()
        release(recordings)

    release = capture._release
    monkeypatch.setattr(capture, "open_rig", open_and_count)
    monkeypatch.setattr(capture, "_release", release_and_count)
    camera = "virtual:prepared=1e5"
    params = Record(
        camera=camera, gripper="virtual", seconds=0.7, hold_s=0.05, holding_ma=30.0, expected_event_rate=1e5
    )
    (job,) = record.jobs([], params, tmp_path)
    shown = record.run(job, params)
    assert shown.simulated
    assert faults(job.output) is None
    with open_recording(job.output) as file:
        assert [events.size for events in file] == [100] * 700
        rows = file.length("gripper/t_us")
        written = file.read("gripper/current_written_ma")
        lost = {name: int(file.read(name)) for name in file.contents() if name.startswith(session.LOST)}
        assert (np.diff(file.read("gripper/t_us")) > 0).all()
        assert file.header["parameters"]["setup"]["gripper"]["model"] == "RH-P12-RN(A)"
    assert not any(count for name, count in lost.items() if "camera" in name)
    repeated = 2 * lost["capture/lost/gripper.answers_lost"]
    assert rows <= counts[1] - counts[0] <= rows + 3 + repeated  # and once goal current, watchdog and torque
    assert written[0] == 10


def test_two_cameras_of_one_trial(made: Made, tmp_path: Path) -> None:
    """Assert that each camera fills a file, with its own events, one trajectory id, and how their clocks lie."""
    both = made.recordings[:2]
    camera = ",".join(f"replay:{path}" for path in both)
    params = Record(camera=camera, expected_event_rate=1e4, seconds=0.4, count=2)
    jobs = record.jobs([], params, tmp_path)
    assert jobs[0].inputs == tuple(both)
    began_s = time.monotonic()
    first = record.run(jobs[0], params)
    record.run(jobs[1], dataclasses.replace(params, resume=True))
    took_us = 1e6 * (time.monotonic() - began_s)
    assert [row["output"] for row in first.rows] == [str(path) for path in jobs[0].outputs]
    ids = []
    for job in jobs:
        with open_recording(job.outputs[0]) as one, open_recording(job.outputs[1]) as other:
            assert len(one) == 400
            assert len(other) > 0  # as many as came meanwhile
            for recorded, path in ((one, both[0]), (other, both[1])):
                with open_recording(path) as played:
                    ours, theirs = recorded.between(0, len(recorded)), played.between(0, len(recorded))
                    assert all((a == b).all() for a, b in zip(ours, theirs, strict=True))
            assert not one.has("capture/clock_offset_us")
            assert abs(float(other.read("capture/clock_offset_us"))) < took_us
            headers = one.header["parameters"], other.header["parameters"]
            assert headers[0]["trajectory"] == headers[1]["trajectory"]
            ids.append(headers[0]["trajectory"])
    assert ids[0] != ids[1]
    assert [validate.run([path]).summary["invalid"] for path in tmp_path.iterdir()] == [0] * 4


def test_two_cameras_end_together(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Assert that when the second camera is unplugged, both files are valid, and the gripper is let go of."""
    hand = Hand()
    rigs = [Rig(Camera(), hand), Rig(Camera(fails_at=50), None)]
    monkeypatch.setattr(capture, "open_rig", lambda *named, **more: rigs.pop(0))
    opened = list(rigs)
    params = Record(camera="dvxplorer:A,dvxplorer:B", gripper="/dev/ttyUSB0", arm=True, expected_event_rate=1e4)
    (job,) = record.jobs([], params, tmp_path)
    assert [path.name for path in job.outputs] == [
        "dvxplorer-A-s0-000.recording.h5",
        "dvxplorer-B-s0-000.recording.h5",
    ]
    with pytest.raises(DeviceError, match="no longer on the bus"):
        record.run(job, params)
    assert all(faults(path) is None for path in job.outputs)
    with open_recording(job.outputs[1]) as file:
        assert len(file) == 50
    assert hand.closed
    assert all(rig.camera.closed for rig in opened)


def evetac(*arguments: str, **more: Any) -> "subprocess.Popen[str]":
    """The program in a process of its own."""
    run = [sys.executable, "-m", "evetac_cli", *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(run, cwd=PACKAGE.parent, **pipes, **more)


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_interrupted_recording_is_complete(number: int, long_recording: Path, tmp_path: Path) -> None:
    """Assert that Ctrl-C ends a recording with exit code 130, a valid file of what there is, and no folder."""
    output = tmp_path / "a.recording.h5"
    run = evetac("record", "--camera", f"replay:{long_recording}", "--expected-event-rate", "1e5", "-o", str(output))
    assert until(lambda: (output.with_suffix(".part") / "000000.h5").exists() or run.poll() is not None)
    os.kill(run.pid, number)
    _, said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130
    assert f"slices in {output}" in said
    assert [path.name for path in tmp_path.iterdir()] == ["a.recording.h5"]
    assert faults(output) is None
    with open_recording(output) as file:
        assert file.read("capture/ended") == session.INTERRUPTED


SMALL_DISK = """
import resource
from evetac_cli.cli.main import main
from evetac_cli.store.recordings import segments
from tests.devices.stand_ins import StillCamera, StillGripper
segments.SEGMENT_S, segments.SEGMENT_EVENTS = 1e9, 4000
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
main()
"""


def test_full_disk(tmp_path: Path) -> None:
    """Assert that a disk that fills up is an error in words that says where the rest is, and repair makes it a file.

    A limit on the size of files stands in for the full disk, which a segment of a single slice does not fit.
    """
    played = recording_of(tmp_path / "played.recording.h5", [20] * 500 + [100_000])
    output = tmp_path / "a.recording.h5"
    words = ["record", "--camera", f"replay:{played}", "--expected-event-rate", "1e5", "-o", str(output)]
    run = subprocess.run(
        [sys.executable, "-c", SMALL_DISK, *words],
        cwd=PACKAGE.parent,
        stderr=subprocess.PIPE,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    said = run.stderr
    assert run.returncode == 2, said
    assert "File too large" in said
    assert f"{output.with_suffix('.part')}, for `evetac validate --repair`" in said
    assert not output.exists()
    (row,) = validate.repair([tmp_path]).rows
    assert row["status"] == "repaired"
    assert row["slices_kept"] == 400
    assert faults(output) is None


def test_h2_ctrl_c_while_the_file_is_joined_keeps_the_segments(
    rig_is: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that the first Ctrl-C works, too, once the recording is over, and repair makes its file."""

    def interrupted(*given: Any, **more: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10)
        pytest.fail("Ctrl-C was only counted")

    rig = rig_is(Camera())
    with monkeypatch.context() as joining:
        joining.setattr(segments, "join", interrupted)
        with pytest.raises(KeyboardInterrupt, match="for `evetac validate --repair`"):
            recording(tmp_path, seconds=0.1)
    assert rig.camera.closed
    assert validate.repair([tmp_path]).rows[0]["slices_kept"] == 100


def test_the_button_of_a_live_view_lets_go(
    rig_is: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that it ends a recording as Ctrl-C does, and that the view was handed over all that was recorded."""
    view, hand = FakeView(after=300), Hand()
    view.put_in_place(monkeypatch)
    rig_is(Camera(), hand)
    with pytest.raises(KeyboardInterrupt, match=f"{session.LET_GO}: 300 slices in .*[.]recording[.]h5$"):
        recording(tmp_path, live=True, **ARMED)
    assert hand.closed
    assert view.ended == session.LET_GO
    assert view.sensor["sensor/name"] == "dvxplorer:T1"
    assert [size for size, _, _ in view.slices] == [10] * 300
    assert all(np.isfinite(late_us) for _, late_us, _ in view.slices)  # known; how late depends on the machine
    assert view.counts["camera.late_events"] == 3
    assert view.said == ["events lost so far: 3 (camera.late_events 3)"]
    (output,) = tmp_path.iterdir()
    with open_recording(output) as file:
        assert file.read("capture/ended") == session.LET_GO
        assert len(file) == 300
        commanded = [row["gripper/t_us"] for row in view.commands]
        assert commanded == file.read("gripper/t_us").tolist()


class InterruptedCamera(Camera):
    """A camera at whose 100th slice somebody presses Ctrl-C."""

    def read(self) -> Events | None:
        if self.k == 99:
            signal.raise_signal(signal.SIGINT)
        return super().read()


def test_h2_ctrl_c_leaves_a_long_recording_to_repair_with_all_that_is_known_of_it(
    rig_is: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that what takes long to join stays as segments, and that repair makes the file that joining had made."""
    rig_is(InterruptedCamera())
    with monkeypatch.context() as long, pytest.raises(KeyboardInterrupt, match="100 slices in .*for `evetac validate"):
        long.setattr(session, "JOINED_AT_ONCE_EVENTS", 999)
        recording(tmp_path)
    (folder,) = tmp_path.iterdir()
    assert folder.name.endswith(".recording.part")
    (row,) = validate.repair([tmp_path]).rows
    assert (row["status"], row["slices_kept"], row["slices_lost"], row["fault"]) == ("repaired", 100, 0, None)
    (output,) = tmp_path.iterdir()
    assert faults(output) is None
    with open_recording(output) as file:
        assert file.read("capture/ended") == session.INTERRUPTED
        assert file.read("capture/lost/camera.late_events") == 3
        assert file.read("capture/slices_per_s") > 0


def test_thousands_of_slices_behind_schedule_and_a_full_disk(
    rig_is: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that what was written before a disk was full is kept, and no more waits in memory than a segment holds."""
    waiting: list[int] = []
    write = segments.RecordingWriter._write

    def until_full(path: Path, arrays: Mapping[str, Any], about: Mapping[str, Any]) -> None:
        if path.name == "000003.h5":
            raise InputError("a segment cannot be written: No space left on device", where=str(path.parent))
        waiting.append(len(arrays.get("events/t", ())))
        write(path, arrays, about)

    monkeypatch.setattr(segments.RecordingWriter, "_write", staticmethod(until_full))
    monkeypatch.setattr(segments, "SEGMENT_EVENTS", 20_000)
    monkeypatch.setattr(segments, "SEGMENT_S", 1e9)
    camera = Camera()
    monkeypatch.setattr(time, "sleep", lambda seconds: None)  # its slices come at once, as after a stop
    rig_is(camera)
    with pytest.raises(InputError, match="No space left(.|\n)*for `evetac validate --repair`"):
        recording(tmp_path, seconds=9.0)
    assert waiting == [0, 20_000, 20_000, 20_000]
    assert camera.closed
    assert validate.repair([tmp_path]).rows[0]["slices_kept"] == 6000


def test_slices_of_another_camera_wait_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a camera is not read while too many of its slices wait, and is again once they are taken."""
    monkeypatch.setattr(camera_recording, "WAITING_SLICES", 20)
    thread = camera_recording.SliceThread(Camera(slices=100))
    thread.start()
    taken = 0
    while taken < 100:
        got = thread.take()
        assert len(got) <= 21
        taken += len(got)
        time.sleep(1e-3)
    thread.stop()
    assert thread.error is None
