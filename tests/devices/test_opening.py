"""The one door to motion: whatever moves real fingers asks for --arm, whichever camera is named with it."""

from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.devices import cameras, grippers
from evetac_cli.devices.cameras import CameraSettings
from evetac_cli.devices.opening import open_peers, open_rig
from evetac_cli.devices.virtual import world as virtual_world
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.errors import InputError
from evetac_cli.resources import PACKAGE
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.trials import grasp, record

CAMERAS = ("virtual:prepared=1e5", "virtual", "dvxplorer", "dv", "virtual:prepared=1e5,virtual:prepared=1e5")


@pytest.mark.parametrize("camera", CAMERAS)
def test_m1_record_moves_no_real_gripper_without_arm(gripper: VirtualGripper, tmp_path: Path, camera: str) -> None:
    """Assert that a named port is refused without --arm before anything is opened, and the gripper hears nothing."""
    before = gripper.instructions()
    flags: dict[str, Any] = {"camera": camera, "gripper": gripper.port, "seconds": 0.1, "expected_event_rate": 1e3}
    with pytest.raises(InputError, match="--arm"):
        for job in record.jobs([], Record(**flags), tmp_path):
            record.run(job, Record(**flags))
    assert gripper.instructions() == before
    assert not list(tmp_path.iterdir())


def test_an_armed_recording_moves_it(gripper: VirtualGripper, tmp_path: Path) -> None:
    """Assert that with --arm the same recording is made, and that torque is off again after it."""
    params = Record(
        camera="virtual:prepared=1e5", gripper=gripper.port, arm=True, seconds=0.3, expected_event_rate=1e3, hold_s=0.1
    )
    (job,) = record.jobs([], params, tmp_path)
    assert (record.run(job, params).rows[0]["commands"] or 0) > 0
    assert gripper.read_register("Torque Enable") == 0


def test_what_moves_nothing_needs_no_arm(tmp_path: Path) -> None:
    """Assert that --dry-run and --preview of a named port, and virtual grippers, are not refused."""
    port: dict[str, Any] = {"camera": "dvxplorer", "gripper": "/dev/ttyNothing"}
    for flags in ({**port, "dry_run": True}, {**port, "preview": True}, {"camera": "virtual", "gripper": "virtual"}):
        assert record.jobs([], Record(**flags), tmp_path)
    assert grasp.jobs([], Grasp(**port, dry_run=True), tmp_path)


def test_both_ways_to_a_gripper_ask(gripper: VirtualGripper) -> None:
    """Assert that opening by itself asks too, so that no command can forget it."""
    before = gripper.instructions()
    camera, named = cameras.parse("virtual:prepared=1e5"), grippers.parse(gripper.port)
    with pytest.raises(InputError, match="--arm"):
        open_rig(camera, named, CameraSettings(), None, np.random.SeedSequence(0))
    with pytest.raises(InputError, match="--arm"), ExitStack() as opened:
        open_peers(camera, named, None, np.random.SeedSequence(0), opened, armed=False, sends_truth=False)
    assert gripper.instructions() == before


@pytest.mark.parametrize(("port", "waits"), [("none", True), ("/dev/ttyNothing", False)])
def test_time_waits_for_no_real_gripper(port: str, waits: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the time of a virtual world waits for a busy machine, but not where a real gripper moves."""
    asked: list[bool] = []

    def world(*_: Any, waits: bool, **__: Any) -> Any:
        asked.append(waits)
        return SimpleNamespace(plant=None, close=lambda: None)

    monkeypatch.setattr(virtual_world, "VirtualWorld", world)
    seeds = np.random.SeedSequence(0)
    with ExitStack() as opened:
        gripper = grippers.parse(port)
        open_peers(cameras.parse("virtual"), gripper, first_plan("lift"), seeds, opened, armed=True, sends_truth=False)
    assert asked == [waits]


def test_there_is_no_other_way_to_a_gripper() -> None:
    """Assert that the driver is made only where a gripper was let through the door before."""

    def using(text: str) -> set[str]:
        return {
            path.relative_to(PACKAGE).as_posix()
            for path in PACKAGE.rglob("*.py")
            if any(text in line and "class " not in line for line in path.read_text().splitlines())
        }

    assert using("RhP12Rn(") == {
        "devices/grippers.py",  # opened by open_rig, or in a process that is started after open_peers
        "devices/virtual/gripper.py",  # an example in its docstring
    }
    assert using(".switch_on(") == {"devices/rh_p12_rn/driver.py", "inspect/doctor/hardware_check.py"}
    assert using("require_arm(") >= {"inspect/doctor/hardware_check.py", "trials/record/__init__.py"}
