"""The contract of being a camera or a gripper, run over all of them; a new device gets these tests by a row."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Made

from evetac_cli.devices import EventCamera, Gripper, Rig
from evetac_cli.devices.replay import ReplayCamera
from evetac_cli.devices.simulated import rig
from evetac_cli.events import SLICE_US, Events
from evetac_cli.sim.scene import plan
from evetac_cli.store.read import open_recording


def simulated(made: Made) -> Rig:
    return rig(plan(str(made.scene), "8", "evetac", ("ramp",))[0], np.random.SeedSequence([5, 8, 0]))


def lifted(made: Made) -> Rig:
    return rig(plan("lift", "8", "evetac", ("lift",))[0], np.random.SeedSequence([5, 8, 0]), lift_s=0.1, balance_s=0.0)


CAMERAS: dict[str, Callable[[Made], EventCamera]] = {
    "simulated": lambda made: simulated(made).camera,
    "replay": lambda made: ReplayCamera(made.recordings[0]),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_camera_hands_out_slices_in_order(name: str, made: Made) -> None:
    """Assert that slice k holds events of [k, k + 1) ms only, sorted, of the right dtypes, inside the frame."""
    camera = CAMERAS[name](made)
    width, height = camera.sensor["sensor/frame_px"]
    for index in range(200):
        events = camera.read()
        assert isinstance(events, Events)
        assert [column.dtype for column in events] == [np.int64, np.uint16, np.uint16, np.uint8]
        assert len({len(column) for column in events}) == 1
        assert ((events.t // SLICE_US) == index).all()
        assert (np.diff(events.t) >= 0).all()
        assert (events.x < width).all()
        assert (events.y < height).all()
        assert (events.p <= 1).all()
    camera.close()


@pytest.mark.parametrize("name", CAMERAS)
def test_camera_ends_and_closes(name: str, made: Made) -> None:
    """Assert that a camera gives None after its last slice and after close, as often as asked, and closes twice."""
    camera = CAMERAS[name](made)
    slices = 0
    while camera.read() is not None:
        slices += 1
    assert slices > 200
    assert camera.read() is None
    camera.close()
    camera.close()
    assert camera.read() is None


def test_replay_is_the_recording(made: Made) -> None:
    """Assert that a replayed recording gives every slice of it, the empty ones included."""
    camera = ReplayCamera(made.recordings[0])
    with open_recording(made.recordings[0]) as recording:
        for expected in recording:
            events = camera.read()
            assert events is not None
            assert all((one == other).all() for one, other in zip(events, expected, strict=True))
        assert camera.now_us() == len(recording) * SLICE_US
    camera.close()


@pytest.mark.parametrize("make", [simulated, lifted])
def test_gripper_obeys_the_last_command(make: Callable[[Made], Rig], made: Made) -> None:
    """Assert that a command holds until the next, that closing raises the position, and that readings are whole."""
    devices = make(made)
    gripper: Gripper | None = devices.gripper
    assert gripper is not None
    start = gripper.read()
    assert isinstance(start.position_ticks, int)
    gripper.write_current(60)
    for _ in range(50):
        devices.camera.read()
    assert gripper.read().current_ma == 60
    assert gripper.read().position_ticks >= start.position_ticks
    gripper.write_position(start.position_ticks - 20)
    for _ in range(90):
        devices.camera.read()
    assert gripper.read().position_ticks < start.position_ticks
    gripper.close()
    gripper.close()


def test_clock_counts_slices(made: Made) -> None:
    """Assert that the clock of a simulation is the end of the slice read last."""
    devices = simulated(made)
    assert devices.clock.now_us() == 0
    devices.camera.read()
    assert devices.clock.now_us() == SLICE_US
    devices.close()


def test_replay_of_another_kind_is_refused(made: Made, tmp_path: Path) -> None:
    """Assert that only recordings are replayed."""
    from evetac_cli.errors import InputError

    with pytest.raises(InputError, match="wrong kind"):
        ReplayCamera(made.model)
