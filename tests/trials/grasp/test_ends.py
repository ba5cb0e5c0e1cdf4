"""Whatever ends or stops a process of a grasp: torque goes off, and the user reads what it is.

The gripper is virtual, in a process of the test, so that it outlives the grasp; the grasp opens it as a port.
"""

import json
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.devices.virtual.servo_plant import Obstacle
from evetac_cli.inspect import validate
from evetac_cli.resources import PACKAGE
from evetac_cli.store.recordings.read import open_recording

PATIENCE_S = 60.0  # of the test with a busy machine; none of it is a bound of the program
STARTS = 5  # on a machine so busy that the watchdog ends a command before the test does
WATCHDOG_MS = 500  # the most there is: a busy machine ends no grasp by itself

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")]


def until(done: Callable[[], bool], what: str) -> None:
    """Wait for something that is to happen."""
    end_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end_s, what
        time.sleep(0.01)


def children_of(process: int) -> list[int]:
    """Detector and controller, in the order in which they were started."""
    children: list[str] = []
    for task in os.listdir(f"/proc/{process}/task"):
        children += Path(f"/proc/{process}/task/{task}/children").read_text().split()
    return sorted(int(pid) for pid in children if "multiprocessing-fork" in Path(f"/proc/{pid}/cmdline").read_text())


class RunningCommand:
    """`grasp` or `record` as a command of its own, that moves a gripper, at a pseudo terminal if asked for."""

    def __init__(
        self, folder: Path, gripper: VirtualGripper, command: str = "grasp", *, terminal: bool = False
    ) -> None:
        self.out, self.gripper = folder / "a.recording.h5", gripper
        self.terminal: tuple[int, int] = pty.openpty() if terminal else (-1, -1)
        x, y = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
        grid = {"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": np.stack([x, y], axis=-1).tolist()}
        (folder / "grid.json").write_text(json.dumps(grid))
        devices = ["--camera", "virtual:prepared=10000", "--gripper", gripper.port, "--arm"]
        own = ["--controller", "fixed:5"] if command == "grasp" else ["--hold-s", "100", "--expected-event-rate", "1e5"]
        more = ["--calibration", str(folder / "grid.json"), "--watchdog-ms", str(WATCHDOG_MS), "-o", str(self.out)]
        run = [sys.executable, "-m", "evetac_cli", command, "-q", *own, *devices, *more]
        self._line = [*(["setsid", "--ctty", "--wait"] if terminal else []), *run]
        for _ in range(STARTS):
            self.run = self._started()
            until(lambda: self.run.poll() is not None or (self._saved() and bool(self.torque)), "motion")
            if self.run.poll() is None:
                return
            self.run.communicate()
            self.out.unlink(missing_ok=True)
        raise AssertionError("the machine is too busy for a grasp with a watchdog")

    def _started(self) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            self._line,
            stdin=self.terminal[1] if self.terminal[1] >= 0 else subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True, cwd=PACKAGE.parent,
        )  # fmt: skip

    def _saved(self) -> bool:
        return bool(list(self.out.with_suffix(".part").glob("[0-9]*.h5")))

    @property
    def torque(self) -> int:
        return self.gripper.read_register("Torque Enable")

    @property
    def processes(self) -> dict[str, int]:
        detector, controller = children_of(self.run.pid)
        return {"recorder": self.run.pid, "detector": detector, "controller": controller}

    def words(self) -> str:
        """What the command said, once it has ended."""
        return self.run.communicate(timeout=PATIENCE_S)[1]

    def close(self) -> None:
        if self.run.poll() is None:
            self.run.kill()
        self.run.communicate()
        for end in self.terminal:
            if end >= 0:
                os.close(end)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[RunningCommand]:
    with VirtualGripper() as gripper:
        grasp = RunningCommand(tmp_path, gripper)
        try:
            yield grasp
        finally:
            grasp.close()


def test_m2_the_controllers_death_is_told_in_words(running: RunningCommand) -> None:
    """Assert that a killed controller ends the command with exit code 3, a valid file, and torque off in words."""
    os.kill(running.processes["controller"], signal.SIGKILL)
    said = running.words()
    assert running.run.returncode == 3, said
    assert "the controller died" in said
    assert "torque is off" in said
    assert running.torque == 0
    assert validate.run([running.out]).rows[0]["faults"] is None
    with open_recording(running.out) as file:
        assert "the controller died" in file.read("capture/ended")


def test_low_a_stopped_recorder_ends_the_grasp(running: RunningCommand) -> None:
    """Assert that torque goes off while the recorder is stopped, and that the recorder says so once it goes on."""
    os.kill(running.run.pid, signal.SIGSTOP)
    until(lambda: running.torque == 0, "torque off while the recorder is stopped")
    os.kill(running.run.pid, signal.SIGCONT)
    said = running.words()
    assert running.run.returncode == 3, said
    assert "the recorder hangs" in said
    assert "torque is off" in said
    assert validate.run([running.out]).rows[0]["faults"] is None


def test_a_killed_recorder_is_told_by_the_controller(running: RunningCommand) -> None:
    """Assert that torque goes off where the recorder is killed, and that somebody still says so."""
    os.kill(running.run.pid, signal.SIGKILL)
    said = running.words()
    assert "error: the recorder " in said  # died, or hangs: a large process takes a while to die
    assert "torque is off (read back)" in said
    assert running.torque == 0


@pytest.mark.parametrize("name", ["SIGHUP", "SIGQUIT", "SIGABRT", "SIGUSR1"])
def test_low_signals_to_the_recorder_end_in_words(name: str, running: RunningCommand) -> None:
    """Assert that a lost terminal and the like end as Ctrl-C does: torque off in words, a valid file."""
    os.kill(running.run.pid, getattr(signal, name))
    said = running.words()
    assert running.run.returncode == 130, said
    assert "torque is off" in said
    assert running.torque == 0
    assert validate.run([running.out]).rows[0]["faults"] is None


@pytest.mark.parametrize("name", ["SIGTERM", "SIGQUIT", "SIGABRT", "SIGUSR1"])
@pytest.mark.parametrize("part", ["detector", "controller"])
def test_signals_to_one_process_end_in_words(part: str, name: str, running: RunningCommand) -> None:
    """Assert that a signal to one of the processes alone ends all, with its name, torque off, a valid file."""
    os.kill(running.processes[part], getattr(signal, name))
    said = running.words()
    assert running.run.returncode == 3, said
    assert f"the {part} was ended by {name}" in said or f"the {part} died" in said
    assert "torque is off (read back)" in said
    assert running.torque == 0
    assert validate.run([running.out]).rows[0]["faults"] is None


def test_a_stopped_controller_is_ended_and_never_grips_again(running: RunningCommand) -> None:
    """Assert that the recorder ends a controller that is stopped, reads torque back, and says so."""
    controller = running.processes["controller"]
    os.kill(controller, signal.SIGSTOP)
    said = running.words()
    assert running.run.returncode == 3, said
    assert "the controller hangs" in said
    assert "torque is off (read back)" in said
    assert running.torque == 0
    assert validate.run([running.out]).rows[0]["faults"] is None
    with pytest.raises(ProcessLookupError):
        os.kill(controller, signal.SIGCONT)


def test_a_recording_that_was_stopped_does_not_grip_again(tmp_path: Path) -> None:
    """Assert that the watchdog takes the current while `record` is stopped, and that it then lets go, in words."""
    with VirtualGripper() as gripper:
        running = RunningCommand(tmp_path, gripper, "record")
        os.kill(running.run.pid, signal.SIGSTOP)
        until(lambda: gripper.read_register("Bus Watchdog") == -1, "the watchdog")
        os.kill(running.run.pid, signal.SIGCONT)
        said = running.words()
        assert running.run.returncode == 3, said
        assert "torque is off (read back)" in said
        assert running.torque == 0
        assert validate.run([running.out]).rows[0]["faults"] is None
        running.close()


@pytest.mark.parametrize("command", ["grasp", "record"])
def test_the_emergency_key_at_a_terminal(command: str, tmp_path: Path) -> None:
    """Assert that the space bar opens the gripper, ends with its own word, keeps the file, restores the terminal."""
    with VirtualGripper(Obstacle(at_ticks=420)) as gripper:
        running = RunningCommand(tmp_path, gripper, command, terminal=True)
        ours, theirs = running.terminal
        before = termios.tcgetattr(theirs)
        until(lambda: gripper.read_register("Present Position") >= 415, "fingers that close")
        assert not termios.tcgetattr(theirs)[3] & termios.ICANON
        os.write(ours, b" ")
        said = running.words()
        assert "space opens the gripper" in said
        assert "opened by the emergency key; torque is off (read back)" in said
        assert running.run.returncode == 130, said
        assert gripper.read_register("Present Position") < 400
        assert running.torque == 0
        after = termios.tcgetattr(theirs)
        assert after[3] & termios.ICANON
        assert after[3] & termios.ECHO
        assert before[3] & termios.ISIG == after[3] & termios.ISIG
        assert validate.run([running.out]).rows[0]["faults"] is None
        with open_recording(running.out) as file:
            assert file.read("capture/ended") == "opened by the emergency key"
        running.close()
