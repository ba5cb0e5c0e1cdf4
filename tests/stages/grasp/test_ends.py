"""Whatever ends or stops a process of a grasp: torque goes off, and the user reads what it is.

The gripper is virtual, in a process of the test, so that it outlives the grasp; the grasp opens it as a port.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.inspect import validate
from evetac_cli.resources import PACKAGE
from evetac_cli.store.read import open_recording

PATIENCE_S = 60.0  # of the test with a busy machine; none of it is a bound of the program
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


class RunningGrasp:
    """A grasp as a command of its own, that moves, and its gripper."""

    def __init__(self, folder: Path, gripper: VirtualGripper) -> None:
        self.out, self.gripper = folder / "a.recording.h5", gripper
        x, y = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
        grid = {"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": np.stack([x, y], axis=-1).tolist()}
        (folder / "grid.json").write_text(json.dumps(grid))
        devices = ["--camera", "virtual:prepared=10000", "--gripper", gripper.port, "--arm"]
        more = ["--calibration", str(folder / "grid.json"), "--watchdog-ms", str(WATCHDOG_MS), "-o", str(self.out)]
        command = [sys.executable, "-m", "evetac_cli", "grasp", "-q", "--controller", "fixed:5", *devices, *more]
        self.run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=PACKAGE.parent)
        until(lambda: self.run.poll() is not None or self._saved(), "a first segment")
        assert self.run.poll() is None, self.words()
        assert self.torque

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


@pytest.fixture
def running(tmp_path: Path) -> Iterator[RunningGrasp]:
    with VirtualGripper() as gripper:
        grasp = RunningGrasp(tmp_path, gripper)
        try:
            yield grasp
        finally:
            grasp.close()


def test_m2_the_controllers_death_is_told_in_words(running: RunningGrasp) -> None:
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


def test_low_a_stopped_recorder_ends_the_grasp(running: RunningGrasp) -> None:
    """Assert that torque goes off while the recorder is stopped, and that the recorder says so once it goes on."""
    os.kill(running.run.pid, signal.SIGSTOP)
    until(lambda: running.torque == 0, "torque off while the recorder is stopped")
    os.kill(running.run.pid, signal.SIGCONT)
    said = running.words()
    assert running.run.returncode == 3, said
    assert "the recorder hangs" in said
    assert "torque is off" in said
    assert validate.run([running.out]).rows[0]["faults"] is None


@pytest.mark.parametrize("name", ["SIGHUP", "SIGQUIT", "SIGABRT", "SIGUSR1"])
def test_low_signals_to_the_recorder_end_in_words(name: str, running: RunningGrasp) -> None:
    """Assert that a lost terminal and the like end as Ctrl-C does: torque off in words, a valid file."""
    os.kill(running.run.pid, getattr(signal, name))
    said = running.words()
    assert running.run.returncode == 130, said
    assert "torque is off" in said
    assert running.torque == 0
    assert validate.run([running.out]).rows[0]["faults"] is None
