"""The contract of being a camera or a gripper, run over all of them; a new device gets these tests by a row.

A real one joins with `pytest tests/devices/test_contract.py --camera dvxplorer --gripper /dev/ttyUSB0`; the gripper
then moves, with 60 mA.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from evetac_cli import testing
from evetac_cli.devices import EventCamera, Rig, cameras, grippers
from evetac_cli.devices.cameras import CameraSettings, ReplayCamera
from evetac_cli.devices.grippers import Mode
from evetac_cli.devices.opening import open_rig
from evetac_cli.devices.simulated import rig
from evetac_cli.errors import DeviceError
from evetac_cli.events import SLICE_US
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.store.recordings.read import open_recording
from tests.conftest import Made


def simulated(made: Made, mode: Mode = "current") -> Rig:
    return rig(first_plan(str(made.scene)), np.random.SeedSequence([5, 8, 0]))


def lifted(made: Made, mode: Mode = "current") -> Rig:
    return rig(first_plan("lift"), np.random.SeedSequence([5, 8, 0]), lift_s=0.1, balance_s=0.0)


def named(camera: str, gripper: str, made: Made, mode: Mode = "current") -> Rig:
    """What the command line opens for these names."""
    ramp = first_plan(str(made.scene))
    seeds = np.random.SeedSequence([5, 8, 0])
    return open_rig(
        cameras.parse(camera), grippers.parse(gripper), CameraSettings(), ramp, seeds, armed=True, mode=mode
    )


pytestmark = pytest.mark.usefixtures("words_wait")

# Cameras whose stream ends by itself, and those that go on until they are closed.
ENDING: dict[str, Callable[[Made], EventCamera]] = {
    "simulated": lambda made: simulated(made).camera,
    "replay": lambda made: ReplayCamera(made.recordings[0]),
    "replay, paced": lambda made: ReplayCamera(made.recordings[0], paced=True),
}
ENDLESS = ("virtual", "virtual:prepared=1e5", "virtual:prepared=1e5+firmware=9")
GRIPPERS: dict[str, Callable[[Made, Mode], Rig]] = {
    "simulated": simulated,
    "lifted": lifted,
    "virtual": lambda made, mode: named("virtual", "virtual", made, mode),
}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Rows of the tables, and the devices that were named on pytest's command line."""
    real_camera, real_gripper = (metafunc.config.getoption(flag) for flag in ("--camera", "--gripper"))
    if "camera_of" in metafunc.fixturenames:
        endless = [*ENDLESS, *([real_camera] if real_camera else [])]
        metafunc.parametrize("camera_of", [*ENDING, *endless], indirect=True)
    if "gripper_of" in metafunc.fixturenames:
        metafunc.parametrize("gripper_of", [*GRIPPERS, *([real_gripper] if real_gripper else [])], indirect=True)


@pytest.fixture
def camera_of(request: pytest.FixtureRequest, made: Made) -> Iterator[tuple[EventCamera, bool]]:
    """A camera that runs, and whether its stream ends by itself."""
    if request.param in ENDING:
        camera = ENDING[request.param](made)
        yield camera, True
        camera.close()
    else:
        devices = named(request.param, "none", made)
        yield devices.camera, False
        devices.close()


@pytest.fixture
def gripper_of(request: pytest.FixtureRequest, made: Made) -> Iterator[Callable[[Mode], Rig]]:
    """Opens a gripper in a mode, with what makes its time pass; a real one meets a prepared camera."""
    opened: list[Rig] = []

    def open_(mode: Mode) -> Rig:
        if request.param in GRIPPERS:
            opened.append(GRIPPERS[request.param](made, mode))
        else:
            opened.append(named("virtual:prepared=1e4", request.param, made, mode))
        return opened[-1]

    yield open_
    for devices in opened:
        devices.close()


def test_camera_hands_out_slices_in_order(camera_of: tuple[EventCamera, bool]) -> None:
    """Assert that slice k holds events of [k, k + 1) ms only, sorted, of the right dtypes, inside the frame."""
    testing.check_slices(camera_of[0])


def test_camera_ends_and_closes(camera_of: tuple[EventCamera, bool]) -> None:
    """Assert that a camera gives None after its last slice and after close, as often as asked, and closes twice."""
    camera, ends = camera_of
    testing.check_end(camera, ends=ends)
    assert not ends or camera.now_us() > 200 * SLICE_US


def test_camera_counts_losses(camera_of: tuple[EventCamera, bool]) -> None:
    """Assert that losses are whole numbers by name, before, while and after it runs."""
    testing.check_losses(camera_of[0])


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


def pass_ms(devices: Rig, duration: int, current_ma: int | None = None) -> None:
    """Let time pass; where a command is given, again every 2 ms, as a gripper's watchdog wants it."""
    for index in range(duration):
        devices.camera.read()
        if index % 2 == 0 and current_ma is not None and devices.gripper is not None:
            devices.gripper.write_current(current_ma)


def test_gripper_obeys_currents(gripper_of: Callable[[Mode], Rig]) -> None:
    """Assert that a current holds until the next, closes where it is positive, and that readings are whole."""
    devices = gripper_of("current")
    gripper = devices.gripper
    assert gripper is not None
    start = gripper.read()
    assert isinstance(start.position_ticks, int)
    for _ in range(40):  # a virtual one may be kept waiting on a busy computer
        pass_ms(devices, 100, 60)
        reading = gripper.read()
        if reading.current_ma == pytest.approx(60, abs=10):
            break
    assert reading.current_ma == pytest.approx(60, abs=10)
    assert reading.position_ticks >= start.position_ticks
    assert all(isinstance(count, int) for count in gripper.counted.values())
    gripper.close()
    gripper.close()
    devices.close()


@pytest.mark.slow
def test_gripper_obeys_positions(gripper_of: Callable[[Mode], Rig]) -> None:
    """Assert that a goal position holds until it is reached: lower numbers open."""
    devices = gripper_of("position")
    gripper = devices.gripper
    assert gripper is not None
    start = gripper.read().position_ticks
    for _ in range(1000):
        gripper.write_position(start - 20)
        pass_ms(devices, 2)
        if gripper.read().position_ticks < start:
            break
    assert gripper.read().position_ticks < start
    devices.close()
    devices.close()


def test_clock_of_a_device_goes_on(camera_of: tuple[EventCamera, bool]) -> None:
    """Assert that device time never goes back, and is about the end of the slice read last."""
    camera, ends = camera_of
    testing.check_clock(camera, ends=ends)


@pytest.mark.parametrize("mode", ["current", "position"])
def test_virtual_gripper_takes_commands(mode: Mode, made: Made) -> None:
    """Assert that the virtual gripper passes what grippers of plug-ins have to pass."""
    devices = named("virtual:prepared=1e4", "virtual", made, mode)
    assert devices.gripper is not None
    testing.check_commands(devices.gripper, mode)
    devices.close()


def test_clock_counts_slices(made: Made) -> None:
    """Assert that the clock of a simulation is the end of the slice read last."""
    devices = simulated(made)
    assert devices.camera.now_us() == 0
    devices.camera.read()
    assert devices.camera.now_us() == SLICE_US
    devices.close()


def test_replay_of_another_kind_is_refused(made: Made, tmp_path: Path) -> None:
    """Assert that only recordings are replayed."""
    from evetac_cli.errors import InputError

    with pytest.raises(InputError, match="wrong kind"):
        ReplayCamera(made.model)


class Device:
    """A device that logs when it is closed, or cannot be."""

    def __init__(self, name: str, log: list[str], counted: dict[str, int] | None = None, fails: bool = False) -> None:
        self.name, self.log, self.fails = name, log, fails
        self.counted = counted or {}

    def close(self) -> None:
        self.log.append(self.name)
        if self.fails:
            raise DeviceError(f"{self.name} will not close")


def test_rig_closes_everything_in_order() -> None:
    """Assert that the gripper is let go of first and what is behind the devices last, whatever fails on the way."""
    log: list[str] = []
    camera, gripper = Device("camera", log, {"late": 2}), Device("gripper", log, {"lost": 1}, fails=True)
    peers = Device("servo", log), Device("world", log, {"slices_late": 3})
    devices = Rig(camera, gripper, peers=peers)  # type: ignore[arg-type]  # only what is asked of them here
    assert devices.counted() == {"camera.late": 2, "gripper.lost": 1, "world.slices_late": 3}
    with pytest.raises(DeviceError, match="gripper will not close"):
        devices.close()
    assert log == ["gripper", "camera", "servo", "world"]
