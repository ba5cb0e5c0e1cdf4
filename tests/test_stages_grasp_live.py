"""A grasp in real time: what is refused beforehand, and one short grasp with virtual devices."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import DeviceError, InputError
from evetac_cli.inspect import validate
from evetac_cli.kernels.grip import Phase
from evetac_cli.params import Grasp
from evetac_cli.resources import PACKAGE
from evetac_cli.stages import grasp
from evetac_cli.store.read import open_recording

PORT = "/dev/ttyNothing"
# Long enough for a machine that runs many tests at once; nothing here is about time.
PATIENT = {"watchdog_ms": 500, "lift_s": 1.0, "balance_s": 0.2}


def jobs(out: Path, **flags: Any) -> Any:
    return grasp.jobs([], Grasp(**flags), out)


@pytest.mark.parametrize(
    ("flags", "what"),
    [
        ({"camera": "dvxplorer"}, "belong together"),
        ({"camera": "dvxplorer", "gripper": "none"}, "belong together"),
        ({"camera": "virtual", "gripper": "sim"}, "belong together"),
        ({"camera": "sim", "gripper": "virtual"}, "belong together"),
        ({"camera": "webcam"}, "no such camera"),
        ({"camera": "virtual", "gripper": "hand"}, "no such gripper"),
        ({"camera": "virtual", "latency_ms": 3}, "--latency-ms"),
        ({"camera": "virtual", "control_hz": 50.0}, "--control-hz"),
        ({"camera": "virtual", "control_hz": 300.0}, "--control-hz"),
        ({"camera": "virtual", "max_seconds": 20.0}, "--max-seconds"),
        ({"camera": "dvxplorer", "gripper": PORT, "arm": True, "watchdog_ms": 70}, "--watchdog-ms"),
        ({"camera": "virtual", "gripper": PORT}, "--arm"),
        ({"camera": "dvxplorer:DXM00042", "gripper": f"{PORT}@1000000"}, "--arm"),
    ],
)
def test_refused_before_anything_is_opened(flags: dict[str, Any], what: str, tmp_path: Path) -> None:
    """Assert that what cannot be done, or must not be without --arm, is refused by name."""
    with pytest.raises(InputError, match=what):
        jobs(tmp_path, **flags)
    assert not list(tmp_path.iterdir())


def test_not_armed_shows_the_plan(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Assert that without --arm one reads what would be done, with which current, and that objects fall."""
    with pytest.raises(InputError, match="--arm"):
        jobs(tmp_path, camera="dvxplorer", gripper=PORT, max_current_ma=77)
    said = capsys.readouterr().err
    assert "77 mA" in said
    assert "31.5 s" in said
    assert "falls" in said


def test_dry_run_touches_nothing(tmp_path: Path) -> None:
    """Assert that --dry-run needs no --arm, opens nothing that it names, and shows limits and files."""
    params = Grasp(camera="dvxplorer", gripper=PORT, dry_run=True, count=2)
    shown = grasp.dry_run(grasp.jobs([], params, tmp_path), params)
    told = {row["part"]: row for row in shown.rows}
    assert "100 mA" in told["gripper"]["detail"]
    assert "falls" in told["end"]["detail"]
    assert shown.summary["files"] == 2
    assert not shown.simulated
    assert not list(tmp_path.iterdir())


def test_no_dot_grid(tmp_path: Path) -> None:
    """Assert that a camera whose gel nobody knows is refused before a gripper moves."""
    params = Grasp(camera="dvxplorer", gripper=PORT, arm=True)
    (job,) = grasp.jobs([], params, tmp_path / "a.recording.h5")
    with pytest.raises(InputError, match="--calibration"):
        grasp.run(job, params)
    assert not list(tmp_path.iterdir())


def test_a_gripper_that_is_not_there(tmp_path: Path) -> None:
    """Assert that the driver's words come through two processes, that both end, and that nothing is left."""
    source = tmp_path / "grid.json"
    columns, rows = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
    grid = np.stack([columns, rows], axis=-1)
    source.write_text(json.dumps({"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": grid.tolist()}))
    params = Grasp(camera="virtual:prepared=10000", gripper=PORT, arm=True, calibration=source)
    (job,) = grasp.jobs([], params, tmp_path / "b.recording.h5")
    with pytest.raises(DeviceError, match="there is no such port"):
        grasp.run(job, params)
    assert not job.output.exists()
    assert not list(tmp_path.glob("*.part"))


def test_a_virtual_grasp(tmp_path: Path) -> None:
    """Assert that it is whole: every slice with its truth, every step with its command and its times, valid."""
    params = Grasp(camera="virtual", **PATIENT)  # type: ignore[arg-type]
    (job,) = grasp.jobs([], params, tmp_path)
    assert job.output.name.startswith("virtual-lift-obj11")
    row = grasp.run(job, params).rows[0]
    assert validate.run([job.output]).rows[0]["faults"] is None
    with open_recording(job.output) as file:
        assert file.read("capture/ended") == row["ended"] == "the grasp is over"
        assert len(file) == row["slices"] == 2700
        assert len(file.read("truth/slip")) == 2700
        phase = file.read("control/phase")
        assert set(phase) == set(Phase)
        assert (np.diff(file.read("control/t_us")) > 0).all()
        assert int(file.read("capture/command_misses")) >= int(file.read("control/missed").sum())
        latency, slip = file.read("control/latency_us"), file.read("control/slip")
        assert (np.isfinite(latency) == (slip > 0)).all()
        assert (latency[slip > 0] > 0).all()
        assert (np.diff(file.read("control/slices_felt")) >= 0).all()
        assert "controller" in file.read("capture/urgency")
        assert int(file.read("capture/lost/camera.late_events")) == 0
        assert json.loads(file.read("control/outcome"))["lifted"] == row["lifted"]
        header = file.header
    assert header["simulated"]
    assert header["content"] is not None
    assert header["parameters"]["setup"]["gripper"]["mode"] == "position"
    assert header["parameters"]["setup"]["gripper"]["current_limit_ma"] == 100
    with pytest.raises(InputError, match="cannot be made again"):
        grasp.run(job, params)


def children_of(process: int) -> list[int]:
    found = []
    for task in os.listdir(f"/proc/{process}/task"):
        found += Path(f"/proc/{process}/task/{task}/children").read_text().split()
    spawned = [int(child) for child in found if "multiprocessing-fork" in Path(f"/proc/{child}/cmdline").read_text()]
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
