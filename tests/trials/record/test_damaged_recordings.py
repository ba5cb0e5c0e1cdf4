"""Recordings from cameras whose streams are damaged, stop, or never begin: what the user hears of them, and when."""

import os
import resource
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.commands.record import Record
from evetac_cli.inspect import validate
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import record, session
from tests.patience import PATIENCE_S
from tests.trials.record.test_capture import evetac

EVENTS_S = 100_000
MEMORY_BYTES = 8 << 30  # of addresses; a recording that grows without bound is stopped by it


def recorded(fault: str, seconds: float, out: Path) -> dict[str, Any]:
    """The row of a recording of prepared words with a fault, whose file is valid."""
    camera = f"virtual:prepared={EVENTS_S}+{fault}"
    params = Record(camera=camera, gripper="none", seconds=seconds, expected_event_rate=EVENTS_S)
    (job,) = record.jobs([], params, out)
    (row,) = record.run(job, params).rows
    assert validate.run([job.output]).rows[0]["faults"] is None
    return row


def number(lost: str) -> int:
    """N of `unknown, at least N`."""
    text, _, least = lost.partition(" at least ")
    assert text == "unknown,"
    return int(least.replace(",", ""))


@pytest.mark.usefixtures("words_wait")
def test_m8_a_silent_camera_is_news(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Assert that a stream that stops is said while it lasts, and that what it cost is unknown, not nothing."""
    row = recorded("silence@0.2:60", 1.5, tmp_path)
    assert row["lost"] == "unknown, at least 0"
    assert "camera.ms_without_time" in row["lost_why"]
    said = capfd.readouterr().err
    assert "sends nothing, not even timestamps" in said


@pytest.mark.usefixtures("words_wait")
def test_m8_damage_is_accounted_for(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Assert that damage is said while it happens, and that its count comes near the virtual camera's, not above."""
    row = recorded("damage@0:3", 1.0, tmp_path)
    lost = EVENTS_S - row["events"]
    assert 0.8 * lost <= number(row["lost"]) <= lost
    assert "damaged" in capfd.readouterr().err


def bounded() -> None:
    """Bound the addresses of the process."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    [
        "random@0:600",
        *(pytest.param(each, marks=pytest.mark.slow) for each in ("torn@0.1:600", "silence@0:600")),
    ],
)
def test_h2_ctrl_c_ends_a_recording_of_a_damaged_stream(fault: str, tmp_path: Path) -> None:
    """Assert that the first Ctrl-C ends it with what was recorded as a valid file, and that memory is bounded."""
    output = tmp_path / "a.recording.h5"
    words = ["record", "--camera", f"virtual:prepared+{fault}", "--gripper", "none", "-o", str(output)]
    run = evetac(*words, "--expected-event-rate", "1e5", preexec_fn=bounded)
    try:
        while not (output.with_suffix(".part") / "000001.h5").exists():
            assert run.poll() is None, run.stderr and run.stderr.read()
            time.sleep(0.01)
        os.kill(run.pid, signal.SIGINT)
        _, said = run.communicate(timeout=PATIENCE_S)
    finally:
        run.kill()
    assert run.returncode == 130, said
    assert f"slices in {output}" in said
    assert validate.run([output]).rows[0]["faults"] is None
    with open_recording(output) as file:
        assert file.read("capture/ended") == session.INTERRUPTED
