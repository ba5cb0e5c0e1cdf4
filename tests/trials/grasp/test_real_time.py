"""A grasp in real time: what is refused beforehand, and one short grasp with virtual devices."""

import json
import os
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices import GripperReading
from evetac_cli.errors import DeviceError, InputError, attached_outcome
from evetac_cli.inspect import validate
from evetac_cli.kernels.grip.control import Control, SlipSignal
from evetac_cli.kernels.grip.paper import PAPER, GraspPhase
from evetac_cli.kernels.slip.alarms import alarming
from evetac_cli.resources import PACKAGE
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.trials import grasp
from evetac_cli.trials.grasp import real_time
from evetac_cli.trials.grasp.controller_process import ControllerEnded, GripperReady
from evetac_cli.trials.grasp.detector_process import CameraReady, DetectorEnded, SliceBatch, joined, noise
from evetac_cli.trials.grasp.loop import control_row
from evetac_cli.trials.grasp.recorded_grasp import RecordedGrasp
from evetac_cli.trials.grasp.recorder import GraspRecorder
from evetac_cli.trials.session import LET_GO
from evetac_cli.trials.trial import DeviceTrial
from tests.make import assert_explained
from tests.trials.grasp.bench import goals_by_law
from tests.trials.live_view.fake_view import FakeView

PORT = "/dev/ttyNothing"
# Long enough for a machine that runs many tests at once; nothing here is about time.
PATIENT = {"watchdog_ms": 500, "lift_s": 1.0, "balance_s": 0.2}


def grid_of(folder: Path, columns: int = 8) -> Path:
    """A calibration of 7 rows of dots."""
    path = folder / "grid.json"
    x, y = np.meshgrid(60.0 * np.arange(columns) + 60.0, 60.0 * np.arange(7) + 50.0)
    dots = np.stack([x, y], axis=-1).tolist()
    path.write_text(json.dumps({"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": dots}))
    return path


def jobs(out: Path, **flags: Any) -> Any:
    return grasp.jobs([], Grasp(**flags), out)


def test_not_armed_shows_the_plan(tmp_path: Path) -> None:
    """Assert that without --arm one reads what would be done, with which current, and that objects fall."""
    with pytest.raises(InputError, match="--arm") as refused:
        jobs(tmp_path, camera="dvxplorer", gripper=PORT, max_current_ma=77)
    said = str(refused.value)
    assert "77 mA" in said
    assert "31.5 s" in said
    assert "falls" in said


def test_dry_run_touches_nothing(tmp_path: Path) -> None:
    """Assert that --dry-run needs no --arm, opens no device that it names, and shows limits and files."""
    params = Grasp(camera="dvxplorer", gripper=PORT, dry_run=True, count=2, calibration=grid_of(tmp_path))
    out = tmp_path / "out"
    shown = grasp.dry_run(grasp.jobs([], params, out), params)
    rows = {row["part"]: row for row in shown.rows}
    assert "100 mA" in rows["gripper"]["detail"]
    assert "falls" in rows["end"]["detail"]
    assert shown.summary["files"] == 2
    assert not shown.simulated
    assert not out.exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ({}, "dot positions"),
        ({"calibration": Path("nope.json")}, "nope.json: cannot be read"),
        ({"camera": "virtual", "gripper": None, "calibration": Path("nope.json")}, "nope.json: cannot be read"),
        ({"calibration": "grid", "model": Path("nope.h5")}, "nope.h5: no such file"),
        ({"calibration": "other"}, "for another dot grid"),
        ({"calibration": "grid", "out": "there.recording.h5"}, "the output exists"),
        ({"camera": "replay:nope.h5", "gripper": "sim", "arm": False}, "nope.h5: no such file"),
    ],
)
def test_dry_run_refuses_what_a_run_does(
    flags: dict[str, Any], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that a dry run and a run refuse in the same words what can be known before a device is opened."""
    out = tmp_path / flags.pop("out", "new.recording.h5")
    (tmp_path / "there.recording.h5").touch()
    if flags.get("calibration") in ("grid", "other"):
        flags["calibration"] = grid_of(tmp_path, columns=8 if flags["calibration"] == "grid" else 5)
    params = Grasp(**{"camera": "dvxplorer", "gripper": PORT, "arm": True, **flags})
    words = []
    for act in (grasp.dry_run, lambda jobs, params: grasp.run(jobs[0], params)):
        with pytest.raises(InputError, match=said) as refused:
            act(grasp.jobs([], params, out), params)
        words.append(str(refused.value))
    assert words[0] == words[1]
    assert "moves now" not in capsys.readouterr().err


@pytest.fixture
def armed(tmp_path: Path) -> tuple[Grasp, DeviceTrial]:
    """A grasp with a gripper that does not exist, at a gel whose dots are known."""
    params = Grasp(camera="virtual:prepared=10000", gripper=PORT, arm=True, calibration=grid_of(tmp_path))
    (job,) = grasp.jobs([], params, tmp_path / "b.recording.h5")
    return params, job


class GraspProcesses:
    """In place of detector and controller: two that are ready, and do nothing."""

    closed = 0

    def __init__(self, *made_of: Any) -> None:
        pass

    def begin(self, signals: list[int]) -> tuple[tuple[CameraReady, ...], GripperReady]:
        print("ready", file=sys.stderr)
        sensor = {"sensor/frame_px": np.array([640, 480], np.int32), "sensor/name": "dvxplorer:T1"}
        return (CameraReady(sensor, {"serial": "T1"}, (), "as usual"),), GripperReady({"mode": "position"}, "as usual")

    def go(self) -> None:
        print("go", file=sys.stderr)

    def close(self) -> None:
        GraspProcesses.closed += 1

    def torque_words(self) -> str:
        return "torque is off (read back)"


@pytest.fixture
def recorder_is(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """Let a function stand for detector, controller and recorder."""

    def put(record: Any) -> None:
        GraspProcesses.closed = 0
        monkeypatch.setattr(real_time, "GraspProcesses", GraspProcesses)
        monkeypatch.setattr(GraspRecorder, "record", record)

    return put


def some(writer: RecordingWriter, ended: str, error: Exception | None = None, steps: int = 2) -> RecordedGrasp:
    """What is recorded of a grasp of a few slices."""
    recorded = RecordedGrasp(1000, ended=ended, error=error)
    batch = SliceBatch(joined([noise(np.random.default_rng(0), 0)]), [3000], [0.5], [1.0], [600.0])
    recorded.take_slices(batch, writer)
    control = Control(PAPER)
    row = control_row(control, GraspPhase.LIFT, SlipSignal(), GripperReading(5.0, 400), 402, 1000)
    late = {"control/late_us": 5.0, "control/missed": 1, "control/latency_us": 2500.0, "control/slices_processed": 1}
    recorded.take_steps([{**row, **late}] * steps, writer)
    cycle_us = array("d", [700.0] * steps)
    counted = {"answers_lost": 4}
    recorded.controller = ControllerEnded(
        *(ended, error, steps, 3, 0.002, cycle_us, 1e6, 1.07e6, counted, "torque is off"),
        missed_by_gripper=2,
    )
    recorded.torque = "torque is off"
    recorded.detector = DetectorEnded({"late_events": 3}, None)
    return recorded


def test_motion_is_announced_when_all_is_ready(
    armed: tuple[Grasp, DeviceTrial], recorder_is: Callable[[Any], None], capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that "moves now" is said once both processes are ready and the file is begun, and next is motion."""
    recorder_is(lambda self: some(self.writers[0], "the grasp is over"))
    grasp.run(armed[1], armed[0])
    ready, moves, go = capsys.readouterr().err.splitlines()[:3]
    assert (ready, go) == ("ready", "go")
    assert moves.startswith(f"{PORT}@2000000 moves now; torque is switched off")


def test_a_file_says_how_time_was_kept(
    armed: tuple[Grasp, DeviceTrial],
    recorder_is: Callable[[Any], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Assert that misses, latency, losses and scheduling are in file and row, and that both processes are ended.

    The legend explains each figure of the row.
    """
    recorder_is(lambda self: some(self.writers[0], "the grasp is over"))
    row = grasp.run(armed[1], armed[0]).rows[0]
    assert GraspProcesses.closed
    assert (row["command_misses"], row["command_misses_by_gripper"]) == (3, 2)
    assert (row["latency_us_median"], row["latencies"]) == (2500.0, 2)
    assert row["lost"] == 3
    assert row["lost_why"] == "camera.late_events 3; gripper.answers_lost 4"
    assert row["late_slices"] == 0
    assert row["too_slow"].startswith("this computer was too slow: 3 of 5 commands were missed")
    assert row["too_slow"] in capsys.readouterr().err.splitlines()
    assert_explained("grasp", [row])
    with open_recording(armed[1].output) as file:
        assert file.read("capture/latency_us").tolist() == [2500.0] * 3
        assert file.read("capture/slice_late_us").tolist() == [600.0] * 3
        assert not file.has("capture/released_us")
        assert "as usual" in file.read("capture/scheduling")
        assert file.header["parameters"]["setup"]["camera"] == {"serial": "T1"}


def test_a_failure_says_what_was_saved(armed: tuple[Grasp, DeviceTrial], recorder_is: Callable[[Any], None]) -> None:
    """Assert that a failure is raised with what was saved, and that the file says it and how long torque stayed on."""
    failed = DeviceError("the camera is silent; torque is off")
    recorder_is(lambda self: some(self.writers[0], "the camera is silent", failed))
    with pytest.raises(DeviceError, match="silent(.|\n)*kept: .*1 slices in"):
        grasp.run(armed[1], armed[0])
    assert validate.run([armed[1].output]).rows[0]["faults"] is None
    with open_recording(armed[1].output) as file:
        assert file.read("capture/ended") == "the camera is silent"
        assert float(file.read("capture/released_us")) == pytest.approx(70_000.0)


def test_m2_a_dead_controller_leaves_a_file_and_words(
    armed: tuple[Grasp, DeviceTrial], recorder_is: Callable[[Any], None]
) -> None:
    """Assert that a controller that died without a word ends in words of torque, and a file without its figures."""

    def dies(self: GraspRecorder) -> RecordedGrasp:
        died = DeviceError("the controller died (SIGKILL); torque is off (read back)")
        recorded = some(self.writers[0], "the controller died (SIGKILL)", died)
        recorded.controller = None
        return recorded

    recorder_is(dies)
    with pytest.raises(DeviceError, match=r"died(.|\n)*torque is off(.|\n)*kept: .*1 slices in") as failed:
        grasp.run(armed[1], armed[0])
    assert attached_outcome(failed.value).rows[0]["command_misses"] is None
    assert validate.run([armed[1].output]).rows[0]["faults"] is None


def test_interrupted(armed: tuple[Grasp, DeviceTrial], recorder_is: Callable[[Any], None]) -> None:
    """Assert that Ctrl-C goes on as such, once the file is there."""
    recorder_is(lambda self: some(self.writers[0], "interrupted"))
    with pytest.raises(KeyboardInterrupt, match="torque is off: 1 slices"):
        grasp.run(armed[1], armed[0])
    assert validate.run([armed[1].output]).rows[0]["faults"] is None


def test_nothing_happened(armed: tuple[Grasp, DeviceTrial], recorder_is: Callable[[Any], None]) -> None:
    """Assert that a grasp without a step leaves no file, and says why it ended."""
    failed = DeviceError("no answer")
    recorder_is(lambda self: some(self.writers[0], "no answer", failed, steps=0))
    with pytest.raises(DeviceError, match="no answer(.|\n)*nothing was recorded"):
        grasp.run(armed[1], armed[0])
    assert not armed[1].output.exists()
    assert not list(armed[1].output.parent.glob("*.part"))


def test_a_full_disk(armed: tuple[Grasp, DeviceTrial], recorder_is: Callable[[Any], None]) -> None:
    """Assert that what was written waits for repair, that it is said, and that no grasp is made over it."""

    def fails(self: GraspRecorder) -> None:
        some(self.writers[0], "")
        self.writers[0].close_segment()
        raise InputError("a segment cannot be written")

    recorder_is(fails)
    with pytest.raises(InputError, match="cannot be written(.|\n)*evetac validate --repair"):
        grasp.run(armed[1], armed[0])
    assert GraspProcesses.closed
    GraspProcesses.closed = 0
    with pytest.raises(InputError, match="interrupted recording"):
        grasp.run(armed[1], armed[0])
    assert not GraspProcesses.closed


def test_a_calibration_has_all_that_the_detector_needs(armed: tuple[Grasp, DeviceTrial]) -> None:
    """Assert that the detector opens with the dots of a calibration alone, for the calibration's frame."""
    trial: Any = armed[1]
    detector = trial.settings.detector.open(real_time._sensor(trial, None, 0))
    assert detector.live.tracking.record["frame_px"][0].tolist() == [640, 480]


@pytest.mark.slow
def test_a_gripper_that_is_not_there(
    armed: tuple[Grasp, DeviceTrial], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that the driver's words come through two processes, that both end, that nothing is left, nor moved."""
    params, job = armed
    with pytest.raises(DeviceError, match="there is no such port"):
        grasp.run(job, params)
    assert not job.output.exists()
    assert not list(tmp_path.glob("*.part"))
    assert "moves now" not in capsys.readouterr().err


@pytest.mark.slow
def test_a_virtual_grasp(tmp_path: Path) -> None:
    """Assert that it is whole: every slice with its truth, every step with its command and its times, valid."""
    paper: dict[str, Any] = {"controller": "paper", "model": Path("shipped")}
    params = Grasp(camera="virtual", **paper, **PATIENT)  # type: ignore[arg-type]
    (job,) = grasp.jobs([], params, tmp_path)
    assert job.output.name.startswith("virtual-lift-obj11")
    row = grasp.run(job, params).rows[0]
    assert validate.run([job.output]).rows[0]["faults"] is None
    with open_recording(job.output) as file:
        assert file.read("capture/ended") == row["ended"] == "the grasp is over"
        assert len(file) == row["slices"] == 2700
        assert len(file.read("truth/slip")) == 2700
        phase = file.read("control/phase")
        assert set(phase) == set(GraspPhase)
        assert (np.diff(file.read("control/t_us")) > 0).all()
        assert int(file.read("capture/command_misses")) >= int(file.read("control/missed").sum())
        latency, slip = file.read("control/latency_us"), file.read("control/slip")
        assert (np.isfinite(latency) == (slip > 0)).all()
        assert (latency[slip > 0] > 0).all()
        assert (np.diff(file.read("control/slices_processed")) >= 0).all()
        needed = ("goal_ticks", "slip", "phase", "slices_processed", "early_goal_ticks", "early_slices_processed")
        steps = {f"control/{name}": file.read(f"control/{name}").tolist() for name in needed}
        steps["gripper/position_ticks"] = file.read("gripper/position_ticks").tolist()
        rows = [dict(zip(steps, row, strict=True)) for row in zip(*steps.values(), strict=True)]
        slips = alarming(file.read("control/probability"), file.header["parameters"]["slip_threshold"])
        goals_by_law(rows, lambda k: bool(slips[k]))  # asserts that the file holds them
        assert "controller" in file.read("capture/scheduling")
        assert int(file.read("capture/lost/camera.late_events")) == 0
        assert json.loads(file.read("control/outcome"))["lifted"] == row["lifted"]
        header = file.header
    assert header["simulated"]
    assert header["content"] is not None
    assert header["parameters"]["setup"]["gripper"]["mode"] == "position"
    assert header["parameters"]["setup"]["gripper"]["current_limit_ma"] == 100
    with pytest.raises(InputError, match="cannot be repeated"):
        grasp.run(job, params)


@pytest.mark.slow
def test_the_button_of_a_live_view_lets_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that it ends a grasp as Ctrl-C does, and that the view sees what the detector and the controller do."""
    view = FakeView(after=500)
    view.put_in_place(monkeypatch)
    params = Grasp(camera="virtual", live=True, **(PATIENT | {"lift_s": 10.0}))  # type: ignore[arg-type]
    (job,) = grasp.jobs([], params, tmp_path)
    with pytest.raises(KeyboardInterrupt, match=f"{LET_GO}; torque is off .read back.: [0-9,]+ slices in .*[.]h5$"):
        grasp.run(job, params)
    assert validate.run([job.output]).rows[0]["faults"] is None
    assert view.ended == LET_GO
    assert view.sensor["sensor/dot_xy_px"].shape == (7, 8, 2)
    with open_recording(job.output) as file:
        assert file.read("capture/ended") == LET_GO
        assert 500 <= len(file) == len(view.slices)
        shown = np.array([probability for _, _, probability in view.slices], np.float32)
        np.testing.assert_array_equal(shown, file.read("control/probability"))
        goals = [row["control/goal_ticks"] for row in view.commands]
        assert goals == file.read("control/goal_ticks").tolist()
    assert "camera.late_events" in view.counts


def children_of(process: int) -> list[int]:
    children: list[str] = []
    for task in os.listdir(f"/proc/{process}/task"):
        children += Path(f"/proc/{process}/task/{task}/children").read_text().split()
    spawned = [int(child) for child in children if "multiprocessing-fork" in Path(f"/proc/{child}/cmdline").read_text()]
    return sorted(spawned)  # world, detector, controller: as they were started


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
@pytest.mark.parametrize(
    ("end", "exit_code", "why"), [("kill", 3, "the detector died"), ("interrupt", 130, "interrupted")]
)
def test_ended_in_mid_grasp(end: str, exit_code: int, why: str, tmp_path: Path) -> None:
    """Assert that a detector that is killed, and Ctrl-C, end with torque off, a valid file that says why, and words."""
    out = tmp_path / "a.recording.h5"
    run = [sys.executable, "-m", "evetac_cli", "grasp", "--camera", "virtual", "-q", "-o", str(out)]
    with subprocess.Popen([*run, "--watchdog-ms", "200"], stderr=subprocess.PIPE, text=True, cwd=PACKAGE.parent) as it:
        while it.poll() is None and not list(out.with_name("a.recording.part").glob("[0-9]*.h5")):
            time.sleep(0.05)
        assert it.poll() is None
        if end == "kill":
            os.kill(children_of(it.pid)[1], signal.SIGKILL)
        else:
            it.send_signal(signal.SIGINT)
        _, said = it.communicate(timeout=60)
    assert it.returncode == exit_code
    assert why in said
    assert "torque is off" in said
    assert validate.run([out]).rows[0]["faults"] is None
    with open_recording(out) as file:
        assert why in file.read("capture/ended")
        assert file.has("capture/released_us") == (end == "kill")
