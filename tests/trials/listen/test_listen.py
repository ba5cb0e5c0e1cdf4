"""record --listen from the first start to Ctrl-C: what a robot's program asks for lies in files, of one open camera."""

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.devices import cameras
from evetac_cli.devices.cameras import CameraSettings, NamedCamera, OpenedCamera
from evetac_cli.errors import DeviceError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.inspect import info, validate
from evetac_cli.names import Capability
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.store.recordings.streams import Mark, mark_row
from evetac_cli.trials import grasp, record
from evetac_cli.trials.listen import Listening
from evetac_cli.trials.record import capture
from tests.devices.stand_ins import StillCamera
from tests.make import run_stage
from tests.patience import PATIENCE_S, until
from tests.store.recordings.test_recovery import STATIC, events_of

ROOT = Path(__file__).resolve().parents[3]


class HostCamera(StillCamera):
    """One event a slice, at the column of its number, by the clock of this computer."""

    def __init__(self) -> None:
        self.sensor = {"sensor/frame_px": np.array([640, 480], np.int32), "sensor/name": "host"}
        self.began_s = time.monotonic()
        self.fails = ""

    def read(self) -> Events | None:
        fails = self.fails  # another thread sets it
        if fails == "no longer on the bus":
            raise DeviceError("is no longer on the bus")
        time.sleep(max(0.0, self.began_s + (self.slices + 1) * 1e-3 - time.monotonic()))
        self.slices += 1
        number = np.array([self.slices - 1 - bool(fails)])  # an event of the slice before
        x, y = (number % 640).astype(np.uint16), (number // 640).astype(np.uint16)
        return Events(number * SLICE_US, x, y, np.ones(1, np.uint8))

    def host_us(self, device_us: float) -> float:
        return self.began_s * 1e6 + device_us


opened: list[HostCamera] = []


@dataclass(frozen=True)
class Host(NamedCamera):
    """`host`, of which each that is opened is in `opened`."""

    name = "host"

    @property
    def capabilities(self) -> frozenset[Capability]:
        return frozenset({Capability.DEVICE, Capability.HARDWARE})

    def open(self, settings: CameraSettings, world: Any, seeds: Any) -> OpenedCamera:
        opened.append(HostCamera())
        return OpenedCamera(opened[-1], {"name": self.name})


arms: list["Arm"] = []  # that have to hang up


class Arm:
    """A robot's program, on one connection."""

    def __init__(self, folder: Path) -> None:
        host, port, self.token = (folder / "evetac.listen").read_text().split()
        self.socket = socket.create_connection((host, int(port)), timeout=PATIENCE_S)
        self._lines = self.socket.makefile("rw")
        arms.append(self)

    def ask(self, command: str, **fields: Any) -> dict[str, Any]:
        """The answer to a request."""
        print(json.dumps({"token": self.token, "command": command, **fields}), file=self._lines, flush=True)
        answer: dict[str, Any] = json.loads(self._lines.readline())
        return answer

    def drop(self) -> None:
        """Break off, as a program that dies does."""
        self._lines.close()
        self.socket.close()


@pytest.fixture
def listened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., KeyboardInterrupt]:
    """Let a robot's program run beside `record --listen`, which Ctrl-C ends once it has come to its end."""
    monkeypatch.setitem(cameras.KINDS, Host.name, Host)
    opened.clear()

    def run(program: Callable[[Path], None], **flags: Any) -> KeyboardInterrupt:
        params = Record(camera=Host.name, listen=True, expected_event_rate=1e4, **flags)
        (job,) = record.jobs([], params, tmp_path)
        failed: list[BaseException] = []

        def robot() -> None:
            try:
                assert until((tmp_path / "evetac.listen").exists)
                program(tmp_path)
            except BaseException as error:
                failed.append(error)
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

        thread = threading.Thread(target=robot)
        thread.start()
        with pytest.raises(KeyboardInterrupt) as ended:
            record.run(job, params)
        thread.join()
        for arm in arms:
            arm.drop()
        arms.clear()
        if failed:
            raise failed[0]
        assert not (tmp_path / "evetac.listen").exists()
        return ended.value

    return run


def numbers(path: Path) -> list[int]:
    """Which slices of its camera a recording holds, by their events."""
    assert validate.run([path]).rows[0]["faults"] is None
    with open_recording(path) as recording:
        assert [events.size for events in recording] == [1] * len(recording)
        return [int(events.x[0]) + 640 * int(events.y[0]) for events in recording]


def test_trials_of_one_camera(listened: Callable[..., KeyboardInterrupt], tmp_path: Path) -> None:
    """Assert names, marks to the ms, whole trials through a lost connection, an abort without a trace, and Ctrl-C.

    A mark that says its time lies there within 1 ms; one that does not, between its sending and its answer.
    """
    times: dict[str, float] = {}

    def program(folder: Path) -> None:
        arm = Arm(folder)
        assert arm.ask("status")["state"] == "idle"
        started = arm.ask("start", name="cup-01")
        times["started"] = time.monotonic()
        assert (started["ok"], started["state"], started["name"]) == (True, "recording", "cup-01")
        assert not arm.ask("start", name="cup-02")["ok"]
        arm.drop()
        time.sleep(0.05)
        arm = Arm(folder)
        status = arm.ask("status")
        assert (status["state"], status["name"]) == ("recording", "cup-01")
        times["told"] = time.monotonic()
        assert arm.ask("mark", text="told", at_s=times["told"])["ok"]
        times["sent"] = time.monotonic()
        assert arm.ask("mark", text="sent")["ok"]
        times["answered"] = time.monotonic()
        times["stopped"] = time.monotonic()
        answer = arm.ask("stop")
        assert answer["file"] == str(folder / "cup-01.recording.h5")
        assert answer["trials"] == 1
        assert arm.ask("start", name="cup-02")["ok"]
        assert arm.ask("abort")["file"] is None
        assert sorted(path.name for path in folder.iterdir()) == ["cup-01.recording.h5", "evetac.listen"]
        refused = arm.ask("start", name="cup-01")
        assert not refused["ok"]
        assert "exists" in refused["error"]
        assert arm.ask("start", name="cup-03")["ok"]
        times["last"] = arm.ask("status")["slices"]

    ended = listened(program)
    assert "2 recordings" in str(ended)
    (camera,) = opened
    first = numbers(tmp_path / "cup-01.recording.h5")
    assert first == list(range(first[0], first[0] + len(first)))
    assert camera.began_s + 1e-3 * first[0] < times["started"]
    assert camera.began_s + 1e-3 * (first[-1] + 1) > times["stopped"]
    with open_recording(tmp_path / "cup-01.recording.h5") as recording:
        assert recording.read("capture/ended") == "stopped by the robot's program"
        assert int(recording.read("t_offset")) == first[0] * SLICE_US
        told, sent = recording.marks
    began_s = camera.began_s + 1e-3 * first[0]
    assert (told.text, sent.text) == ("told", "sent")
    assert abs(began_s + 1e-6 * told.t_us - times["told"]) < 1e-3
    assert times["sent"] - 1e-3 < began_s + 1e-6 * sent.t_us < times["answered"] + 1e-3
    assert told.slice == told.t_us // SLICE_US
    assert (info.run([tmp_path / "cup-01.recording.h5"]).rows[0]["marks"]).startswith("told at 0.")
    last = numbers(tmp_path / "cup-03.recording.h5")
    assert len(last) >= times["last"]
    assert last[0] > first[-1]
    with open_recording(tmp_path / "cup-03.recording.h5") as recording:
        assert recording.read("capture/ended") == "interrupted"
        assert recording.marks == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cup-01.recording.h5", "cup-03.recording.h5"]


def test_the_clients_of_the_documentation(listened: Callable[..., KeyboardInterrupt], tmp_path: Path) -> None:
    """Assert that the Python and the bash of the page, and the example, record trials as they are written."""
    page = (ROOT / "docs" / "hardware.md").read_text().partition("## From a robot's program")[2]
    python = page.partition("```python\n")[2].partition("```")[0]
    bash = page.partition("In bash:\n\n")[2].partition("\n\n")[0]
    example = [sys.executable, str(ROOT / "examples" / "robot_trials.py"), str(tmp_path), "1"]

    def program(folder: Path) -> None:
        exec(compile(python.replace("data/", f"{folder}/"), "docs/hardware.md", "exec"), found)
        found["lines"].close()
        found["server"].close()
        named = bash.replace("data/", f"{folder}/").replace("cup-01", "cup-02")
        answer = subprocess.run(["bash", "-c", named], capture_output=True, text=True, check=True).stdout
        assert json.loads(answer)["state"] == "recording"
        Arm(folder).ask("stop")
        subprocess.run(example, capture_output=True, check=True)

    found: dict[str, Any] = {}
    listened(program)
    first, second, third = sorted(tmp_path.iterdir())
    assert (first.name, second.name) == ("cup-01.recording.h5", "cup-02.recording.h5")
    for path, texts in ((first, ["lifted"]), (third, ["touched"])):
        with open_recording(path) as recording:
            assert [mark.text for mark in recording.marks] == texts


@pytest.mark.parametrize("fault", ["no longer on the bus", "returned an invalid slice"])
def test_a_camera_that_fails_ends_no_series(
    listened: Callable[..., KeyboardInterrupt], tmp_path: Path, fault: str
) -> None:
    """Assert that what was recorded is kept, that `stop` says what failed, and that the next start opens a camera."""

    def program(folder: Path) -> None:
        arm = Arm(folder)
        arm.ask("start", name="a")
        opened[0].fails = fault
        assert until(lambda: arm.ask("status")["state"] == "idle")  # a stop before the next slice would find no fault
        answer = arm.ask("stop")
        assert not answer["ok"]
        assert fault in answer["error"]
        assert answer["file"] == str(folder / "a.recording.h5")
        assert arm.ask("start", name="b")["ok"]
        assert arm.ask("stop")["ok"]

    listened(program)
    assert len(opened) == 2
    assert numbers(tmp_path / "a.recording.h5")
    assert numbers(tmp_path / "b.recording.h5")


def test_marks_survive_a_kill_of_the_recorder(tmp_path: Path) -> None:
    """Assert that marks of closed segments are in the repaired file, also those that came after the last slice."""
    path = tmp_path / "a.recording.h5"
    writer = RecordingWriter(path, STATIC, recipe=Recipe("recording", 1, {}))
    writer.append(events_of(0, 2))
    writer.append_rows(mark_row(400, "first"))
    writer.close_segment()
    writer.append_rows(mark_row(1200, "late"))
    writer.close_segment()
    writer.leave()
    validate.repair([writer.folder])
    assert validate.run([path]).rows[0]["faults"] is None
    with open_recording(path) as recording:
        assert recording.marks == [Mark(0, 400, "first"), Mark(1, 1200, "late")]
        assert len(recording) == 1


def test_rows_after_the_last_slice_are_in_the_file(tmp_path: Path) -> None:
    """Assert that a row that comes when all slices are in segments is not lost."""
    path = tmp_path / "a.recording.h5"
    writer = RecordingWriter(path, STATIC)
    writer.append(events_of(0, 2))
    writer.close_segment()
    writer.append_rows(mark_row(900, "at the end"))
    writer.finish(Recipe("recording", 1, {}), {"capture/ended": "x"})
    with open_recording(path) as recording:
        assert [mark.text for mark in recording.marks] == ["at the end"]


def test_marks_are_cut_with_their_slices(tmp_path: Path) -> None:
    """Assert that a piece has the marks of its slices, in its own time, and a copy with a stream has all of them."""
    from evetac_cli.commands.attach import Attach
    from evetac_cli.commands.trim import Trim
    from evetac_cli.stages import attach, trim

    path = tmp_path / "a.recording.h5"
    writer = RecordingWriter(path, STATIC)
    for k in range(10):
        writer.append(events_of(k, 2))
    for t_us, text in ((500, "before"), (3200, "within"), (9000, "after")):
        writer.append_rows(mark_row(t_us, text))
    writer.finish(Recipe("recording", 1, {}), {"capture/ended": "x"})
    (tmp_path / "arm.csv").write_text("t_s,x_m\n0.001,1\n0.002,2\n")
    piece, _ = run_stage(trim, [path], Trim(from_ms=3, to_ms=6), tmp_path)
    copy, _ = run_stage(attach, [path], Attach(stream=[f"arm={tmp_path / 'arm.csv'}"]), tmp_path)
    with open_recording(piece) as part, open_recording(copy) as whole:
        assert part.marks == [Mark(0, 200, "within")]
        assert [mark.text for mark in whole.marks] == ["before", "within", "after"]
    assert validate.run([piece]).rows[0]["faults"] is None


def test_a_grasp_listens(tmp_path: Path) -> None:
    """Assert that `grasp --listen` is one job of one grasp, planned without opening anything."""
    (job,) = grasp.jobs([], Grasp(camera="virtual", listen=True), tmp_path)
    assert isinstance(job, Listening)
    assert grasp.dry_run([job], Grasp(camera="virtual", listen=True)).rows
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["stop", "abort"])
def test_ctrl_c_after_the_end_of_a_trial_is_not_lost(
    command: str, listened: Callable[..., KeyboardInterrupt], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that one signal ends the series where it comes while a trial that is over is saved or thrown away."""
    release = capture._release

    def slow_release(recordings: Any) -> None:
        assert signals.wait(PATIENCE_S)
        time.sleep(0.05)  # for the one of the fixture
        release(recordings)

    signals = threading.Event()
    monkeypatch.setattr(capture, "_release", slow_release)

    def program(folder: Path) -> None:
        arm = Arm(folder)
        assert arm.ask("start", name="a")["ok"]
        arm.socket.sendall(json.dumps({"token": arm.token, "command": command}).encode() + b"\n")
        assert until(lambda: Arm(folder).ask("status")["state"] == "saving")
        signals.set()

    listened(program)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["stop", "abort"])
def test_a_grasp_that_is_called_off_moves_nothing(command: str, tmp_path: Path) -> None:
    """Assert that `stop` and `abort` while a grasp is prepared leave no file of it, and that `start` is refused.

    Slow: a virtual world and the processes of a grasp.
    """
    arguments = [sys.executable, "-m", "evetac_cli", "grasp", "--camera", "virtual", "--listen", "-o", str(tmp_path)]
    with subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.DEVNULL) as running:
        assert until((tmp_path / "evetac.listen").exists)
        arm, other = Arm(tmp_path), Arm(tmp_path)
        arm.socket.sendall(json.dumps({"token": arm.token, "command": "start", "name": "a"}).encode() + b"\n")
        assert until(lambda: other.ask("status")["state"] == "starting")
        answer = other.ask(command)
        assert (answer["ok"], answer["file"], answer["slices"]) == (True, None, 0)
        assert not json.loads(arm.socket.makefile().readline())["ok"]
        running.send_signal(signal.SIGTERM)
        assert running.wait(PATIENCE_S) == 130
    for each in arms:
        each.drop()
    arms.clear()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_grasps_by_name(tmp_path: Path) -> None:
    """Assert that `grasp --listen` records a grasp with its mark until `stop`, and leaves nothing of an aborted one.

    Slow: a virtual world and the processes of two grasps.
    """
    command = [sys.executable, "-m", "evetac_cli", "grasp", "--camera", "virtual", "--listen", "-o", str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as running:
        assert until((tmp_path / "evetac.listen").exists)
        arm = Arm(tmp_path)
        assert arm.ask("start", name="a")["ok"]
        assert until(lambda: arm.ask("status")["slices"] > 100)  # a grasp without a step of the controller has no file
        marked = arm.ask("mark", text="lifted")
        stopped = arm.ask("stop")
        assert arm.ask("start", name="b")["ok"]
        assert arm.ask("abort")["file"] is None
        arm.drop()
        arms.clear()
        running.send_signal(signal.SIGTERM)
        assert running.wait(PATIENCE_S) == 130
    (path,) = tmp_path.iterdir()
    assert stopped["file"] == str(path)
    assert validate.run([path]).rows[0]["faults"] is None
    with open_recording(path) as recording:
        assert recording.read("capture/ended") == "stopped by the robot's program"
        assert recording.marks == [Mark(marked["slice"], marked["t_us"], "lifted")]
        assert marked["slice"] < len(recording)
        assert recording.has("truth")
