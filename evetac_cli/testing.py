"""Contract tests for what other packages add: each function raises AssertionError where a contract is not kept.

    from evetac_cli import testing

    def test_my_camera():
        testing.check_camera("mine:7")

evetac's own cameras, grippers, formats, controllers, networks and files pass the same functions.
"""

import json
import pickle
from collections.abc import Callable
from contextlib import closing

import numpy as np

from evetac_cli.devices import EventCamera, Gripper, GripperReading, cameras, grippers
from evetac_cli.devices.cameras import CameraSettings
from evetac_cli.devices.grippers import Mode
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.events import SLICE_US, Events
from evetac_cli.names import Capability

# Cameras


def check_camera(text: str) -> None:
    """A camera by its name, as `--camera` takes it; it is opened four times and read for half a second."""
    named = cameras.parse(text)
    assert text.partition(":")[0] == named.name, f"it is called {named.name}, and {text} asks for it"
    assert cameras.parse(str(named)) == named, f"{named}, which stands for it in errors, does not name it"
    assert pickle.loads(pickle.dumps(named)) == named, "it is not the same in another process"
    assert named.capabilities <= set(Capability), f"not all of {named.capabilities} are Capability"
    assert named.has(Capability.DEVICE), "a camera of a plug-in is a device: it has Capability.DEVICE"
    assert named.file_stem and "/" not in named.file_stem, "names of recordings begin with file_stem"
    checks: tuple[Callable[[EventCamera], None], ...] = (check_slices, check_losses, check_clock, check_end)
    for check in checks:
        camera, setup, _ = named.open(CameraSettings(), None, np.random.SeedSequence(0))
        with closing(camera):
            json.dumps(setup, allow_nan=False)
            width, height = named.frame_px()
            assert tuple(camera.sensor["sensor/frame_px"]) == (width, height), "frame_px is that of the open camera"
            assert all(isinstance(note, str) for note in camera.notes)
            check(camera)


def check_slices(camera: EventCamera, slices: int = 200) -> None:
    """Slice k holds events of [k, k + 1) ms only, in order, of the right dtypes, inside the frame."""
    width, height = camera.sensor["sensor/frame_px"]
    for index in range(slices):
        events = camera.read()
        assert isinstance(events, Events), f"slice {index} is no Events"
        assert [column.dtype for column in events] == [np.int64, np.uint16, np.uint16, np.uint8]
        assert len({len(column) for column in events}) == 1
        assert ((events.t // SLICE_US) == index).all(), f"slice {index} has events of another"
        assert (np.diff(events.t) >= 0).all(), f"slice {index} is not in order"
        assert (events.x < width).all()
        assert (events.y < height).all()
        assert (events.p <= 1).all()


def check_end(camera: EventCamera, *, ends: bool = False, slices: int = 210) -> None:
    """After its last slice, and once it is closed, a camera gives None as often as it is asked; it closes twice.

    ends: whether its stream ends by itself; slices: that are read at least, if it goes on.
    """
    count = 0
    while count < slices or ends:
        if camera.read() is None:
            break
        count += 1
    assert count > 0
    assert ends == (camera.read() is None)
    camera.close()
    camera.close()
    assert camera.read() is None
    assert camera.read() is None


def check_losses(camera: EventCamera) -> None:
    """Losses are whole numbers by name, before, while and after it runs."""
    for _ in range(3):
        assert all(isinstance(name, str) and isinstance(count, int) for name, count in camera.counted.items())
        camera.read()
    camera.close()
    assert all(count >= 0 for count in camera.counted.values())


def check_clock(camera: EventCamera, *, ends: bool = False) -> None:
    """Device time never goes back, and is about the end of the slice read last; to the us where the stream ends."""
    previous, slack_us = -1, 0 if ends else SLICE_US
    for index in range(50):
        camera.read()
        now_us = camera.now_us()
        assert now_us >= previous - slack_us
        assert now_us >= (index + 1) * SLICE_US - slack_us, f"after slice {index} it is {now_us} us"
        previous = now_us


# Grippers


def check_gripper(text: str) -> None:
    """A gripper by its name, as `--gripper` takes it; it is opened in both modes and commanded. A real one moves."""
    named = grippers.parse(text)
    assert text.partition(":")[0] == named.name, f"it is called {named.name}, and {text} asks for it"
    assert grippers.parse(str(named)) == named, f"{named}, which stands for it in errors, does not name it"
    assert pickle.loads(pickle.dumps(named)) == named, "it is not the same in another process"
    assert named.capabilities <= set(Capability)
    assert named.has(Capability.MOVED), "a gripper is moved: it has Capability.MOVED"
    ways: tuple[tuple[Mode, RhP12RnSettings | None], ...] = (
        ("current", None),
        ("position", named.settings(max_current_ma=60, watchdog_ms=60)),
    )
    for mode, settings in ways:
        gripper, setup = named.open(mode, named.port, settings)
        assert gripper is not None
        assert setup["name"] == named.name
        json.dumps(setup, allow_nan=False)
        with closing(gripper):
            check_commands(gripper, mode)


def check_commands(gripper: Gripper, mode: Mode) -> None:
    """An open gripper takes commands of its mode, reads whole ticks, says what torque is, and closes twice."""
    start = gripper.read()
    assert isinstance(start, GripperReading)
    for _ in range(5):
        if mode == "current":
            gripper.write_current(10)
        else:
            gripper.write_position(start.position_ticks)
        reading = gripper.read()
        assert isinstance(reading.position_ticks, int)
        assert np.isfinite(reading.current_ma)
    assert all(isinstance(name, str) and isinstance(count, int) for name, count in gripper.counted.items())
    gripper.close()
    gripper.close()
    assert isinstance(gripper.release_words, str)
