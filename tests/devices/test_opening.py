"""The one door to motion: whatever moves real fingers asks for --arm, whichever camera is named with it."""

from pathlib import Path
from typing import Any

import pytest

from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.errors import InputError
from evetac_cli.params import Record
from evetac_cli.stages import record

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
