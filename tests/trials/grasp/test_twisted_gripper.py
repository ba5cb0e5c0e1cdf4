"""`record` and `grasp` with a gripper that restarts, or reports what cannot be: they end in words, with a file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.errors import DeviceError
from evetac_cli.inspect import validate
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import grasp, record
from tests.trials.grasp.test_real_time import grid_of

CAMERA = "virtual:prepared=1e4"
AT_S = "0.3"  # after torque was first on: some rows are there by then

SAYS = {
    "restart": "lost torque",
    "false-position": "reports an impossible position: 2,147,483,647 ticks",
    "false-current": "reports an impossible current: -32,768 mA",
    "false-voltage": "reports an impossible supply: 0 V",
    "false-temperature": "reports an impossible temperature: 255 C",
}


def recorded(folder: Path, gripper: str) -> Any:
    """Run `record` with this gripper; returns the stage, its job and its parameters."""
    params = Record(camera=CAMERA, gripper=gripper, seconds=60.0, hold_s=100.0, expected_event_rate=1e4)
    return record, record.jobs([], params, folder)[0], params


def grasped(folder: Path, gripper: str) -> Any:
    """Run `grasp` with this gripper."""
    more: dict[str, Any] = {"controller": "fixed:5", "watchdog_ms": 500, "calibration": grid_of(folder)}
    params = Grasp(camera=CAMERA, gripper=gripper, **more)
    return grasp, grasp.jobs([], params, folder)[0], params


COMMANDS: dict[str, Callable[[Path, str], Any]] = {"record": recorded, "grasp": grasped}
QUICK = {("record", "restart"), ("record", "false-position"), ("grasp", "restart")}


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        pytest.param(command, fault, marks=() if (command, fault) in QUICK else pytest.mark.slow)
        for command in COMMANDS
        for fault in SAYS
    ],
)
def test_it_ends_in_words_and_the_file_keeps_them(command: str, fault: str, tmp_path: Path) -> None:
    """Assert a DeviceError, torque off as read back, a valid file that says why, and no impossible row in it."""
    stage, job, params = COMMANDS[command](tmp_path, f"virtual:{fault}@{AT_S}")
    with pytest.raises(DeviceError) as ended:
        stage.run(job, params)
    said = str(ended.value)
    assert ended.value.exit_code == 3
    assert SAYS[fault] in said
    assert "torque is off (read back)" in said
    assert validate.run([job.output]).rows[0]["faults"] is None
    with open_recording(job.output) as file:
        assert SAYS[fault] in file.read("capture/ended")
        assert file.length("gripper/t_us") > 0
        assert abs(file.read("gripper/position_ticks")).max() < 1214
        assert abs(file.read("gripper/current_ma")).max() < 4000
        lost = int(file.read("capture/lost/gripper.readings_impossible"))
    assert lost == (fault != "restart")
