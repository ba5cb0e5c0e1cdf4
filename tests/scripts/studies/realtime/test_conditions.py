"""The measurement of grasps in real time: whose processor time is whose."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from scripts.studies.realtime import conditions


@pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
def test_processes_are_told_by_what_they_are(tmp_path: Path) -> None:
    """Assert that the servo is known by its line, and the others by the order in which they were started."""
    script = (
        "import subprocess, sys\n"
        "sleep = 'import sys; print(flush=True); sys.stdin.read()'\n"
        "pipes = {'stdin': subprocess.PIPE, 'stdout': subprocess.PIPE}\n"
        "started = [subprocess.Popen([sys.executable, '-c', sleep, name], **pipes)"
        " for name in ('resource_tracker', 'devices.virtual.gripper', *['--multiprocessing-fork'] * 2)]\n"
        "[each.stdout.readline() for each in started]\n"
        "print(*(each.pid for each in started), flush=True)\n"
        "sys.stdin.read()\n"
        "[each.kill() for each in started]\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as run:
        assert run.stdout is not None
        _, servo, detector, controller = map(int, run.stdout.readline().split())
        found = conditions.processes_of(run.pid)
        recording = tmp_path / "a.recording.part"
        watched = conditions.Watched(run, recording)
        assert watched.shares() == {}  # nothing is recorded
        recording.mkdir()
        watched = conditions.Watched(run, recording)
        os.kill(detector, signal.SIGKILL)
        while conditions.processes_of(run.pid).get("detector") == detector:
            time.sleep(0.01)
        time.sleep(3 * conditions.POLL_S)
        assert set(watched.shares()) <= {"recorder", "servo", "detector", "controller"}
        assert watched.names == {
            **{run.pid: "recorder", servo: "servo"},
            **{detector: "detector", controller: "controller"},
        }
        state = conditions.state_of(run.pid)
        run.communicate("")
    assert found == {"recorder": run.pid, "servo": servo, "detector": detector, "controller": controller}
    assert state is not None
    assert state.cpu_s >= 0.0
    assert conditions.state_of(run.pid) is None
