"""The measurement of grasps in real time: what it runs, what it need not run again, and what it makes of its rows."""

import os
import signal
import subprocess
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest

from scripts.studies.realtime import conditions, grasps

CHOSEN = {"condition": ["quiet", "half"], "events_per_s": [100, 300], "runs": 2, "seconds": 9.0, "slip_threshold": 0.2}


def planned(**changed: Any) -> list[dict[str, Any]]:
    chosen = Namespace(**{**CHOSEN, "no_doctor": False, **changed})
    return grasps.plans(chosen, [Path("/a/ours"), Path("/b/theirs")])


def test_what_is_run() -> None:
    """Assert that doctor is asked first under each condition, and that checkouts take turns."""
    plans = planned()
    assert len(plans) == 2 * (2 + 2 * 2 * 2)
    assert [plan["what"] for plan in plans[:3]] == ["doctor", "doctor", "grasp"]
    assert [plan["checkout"] for plan in plans] == ["ours", "theirs"] * 10
    assert all(plan["what"] == "grasp" for plan in planned(no_doctor=True))


def test_the_table_is_of_medians_and_says_what_lasted() -> None:
    """Assert a row for each case, without what an older checkout does not know."""
    rows = [
        {**plan, "lasted": plan["run"] == 0, "missed": 2 * plan["run"], "doctor": "fine in every line"}
        | ({"missed_by_us": plan["run"], "doctor_events_per_s": 300} if plan["checkout"] == "ours" else {})
        for plan in planned(no_doctor=True, condition=["quiet"])
    ]
    table = grasps.summary(rows)
    assert [(row["events_per_s"], row["checkout"]) for row in table] == [
        *((100, "ours"), (100, "theirs"), (300, "ours"), (300, "theirs"))
    ]
    for row in table:
        assert (row["condition"], row["lasted"], row["missed"]) == ("quiet", "1 of 2", 1.0)
    assert (table[0]["missed_by_us"], table[0]["doctor"]) == (0.5, 300)
    assert ("missed_by_us" in table[1], table[1]["doctor"]) == (False, "fine in every line")


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
