"""Cameras and grippers of plug-ins are checked while they run; `evetac record` ends in words that name the plug-in."""

import math
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest

from evetac_cli import plugins, testing
from evetac_cli.cli import main
from evetac_cli.devices import GripperReading
from evetac_cli.devices.cameras import CameraSettings, NamedCamera, OpenedCamera
from evetac_cli.devices.grippers import Mode, NamedGripper
from evetac_cli.devices.plugin_devices import open_camera, open_gripper, release_gripper, slice_fault
from evetac_cli.errors import DeviceError, InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.names import Capability
from evetac_cli.store.files import StageFile
from tests.conftest import Add
from tests.devices.stand_ins import StillCamera, StillGripper

GOOD = 30  # slices, or readings, before the fault
FRAME_PX = 64, 48


def events(index: int, **columns: Any) -> Events:
    """A valid slice of three events, with other columns."""
    valid = Events(
        t=index * SLICE_US + np.array([0, 5, 999]),
        x=np.array([0, 5, 63], np.uint16),
        y=np.array([0, 5, 47], np.uint16),
        p=np.array([0, 1, 1], np.uint8),
    )
    return valid._replace(**columns)


def start_us(index: int) -> int:
    return index * SLICE_US


# What a camera returns in place of slice k, and the words on it.
SLICES: dict[str, tuple[Callable[[int], Any], str]] = {
    "order": (lambda k: events(k, t=start_us(k) + np.array([5, 0, 9])), "after a later event t = 30000"),
    "past": (lambda k: events(k, t=start_us(k) + np.array([-1, 0, 9])), "t = 29999"),
    "end": (lambda k: events(k, t=start_us(k) + np.array([0, 1, 1000])), "t = 31000"),
    "negative": (lambda k: events(k, t=np.array([-5, 0, 1])), "t = -5"),
    "right": (lambda k: events(k, x=np.array([0, 64, 1], np.uint16)), "x = 64"),
    "below": (lambda k: events(k, y=np.array([0, 1, 48], np.uint16)), "y = 48"),
    "polarity": (lambda k: events(k, p=np.array([0, 1, 2], np.uint8)), "p = 2"),
    "signed": (lambda k: events(k, p=np.array([0, 1, -1], np.int8)), "int64, uint16, uint16, int8"),
    "float": (lambda k: events(k, t=start_us(k) + np.array([0.0, 1.0, 2.0])), "float64, uint16"),
    "swapped": (lambda k: events(k, x=np.array([0, 1, 2], ">u2")), "int64, >u2"),
    "short": (lambda k: events(k, p=np.array([0, 1], np.uint8)), "3, 3, 3, 2 events"),
    "flat": (lambda k: events(k, t=start_us(k) + np.zeros((3, 1), np.int64)), "arrays of one dimension"),
    "list": (lambda k: events(k, x=[1, 2, 3]), "arrays of one dimension"),
    "str": (lambda k: "no events", "str instead of"),
    "tuple": (lambda k: tuple(events(k)), "tuple instead of"),
    "raises": (lambda k: [][k], "IndexError: list index out of range"),
}


class BadCamera(StillCamera):
    """A camera of valid slices in a frame of 64 x 48 px, with one fault."""

    sensor: Mapping[str, Any] = {"sensor/frame_px": np.array(FRAME_PX, np.int32), "sensor/name": "bad"}

    def __init__(self, fault: str) -> None:
        self.fault = fault
        self.is_open = True

    def read(self) -> Any:
        if not self.is_open or self.fault == "empty":
            return None
        time.sleep(1e-3)  # in about real time, so that the gripper is commanded meanwhile
        index, self.slices = self.slices, self.slices + 1
        return SLICES[self.fault][0](index) if index == GOOD and self.fault in SLICES else events(index)

    def close(self) -> None:
        self.is_open = False
        if self.fault == "close":
            raise OSError("the camera is gone")


@dataclass(frozen=True)
class Bad(NamedCamera):
    """`bad:FAULT`."""

    name = "bad"
    fault: str = ""

    @classmethod
    def parse(cls, text: str) -> Self:
        return cls(text)

    @property
    def capabilities(self) -> frozenset[Capability]:
        return frozenset({Capability.DEVICE, Capability.SIMULATED})

    def frame_px(self) -> tuple[int, int]:
        return (32, 48) if self.fault == "frame" else FRAME_PX

    def open(self, settings: CameraSettings, world: Any, seeds: np.random.SeedSequence) -> OpenedCamera:
        if self.fault == "wrong flag":
            raise InputError("no such option")
        setup = {"name": self.name, "offset": math.nan if self.fault == "setup" else 0.0}
        return OpenedCamera(BadCamera(self.fault), setup)


# What a gripper returns in place of its GOOD-th reading, and the words on it.
READINGS: dict[str, tuple[Any, str]] = {
    "nan": (GripperReading(math.nan, 400), "a current of nan mA"),
    "text": (GripperReading("12", 400), "a current of '12' mA"),  # type: ignore[arg-type]
    "far": (GripperReading(0.0, 5000), "a position of 5000 ticks"),
    "half": (GripperReading(0.0, 400.5), "a position of 400.5 ticks"),  # type: ignore[arg-type]
    "none": (None, "NoneType instead of GripperReading"),
}


class BadGripper(StillGripper):
    """A gripper that does not move, with one fault."""

    release_words = "torque is on"

    def __init__(self, fault: str, good: int = GOOD) -> None:
        self.fault, self.good = fault, good
        self.readings = 0

    def read(self) -> Any:
        self.readings += 1
        if self.readings <= self.good or self.fault in ("", "close"):
            return GripperReading(0.0, 400)
        if self.fault == "raises":
            raise ValueError("no checksum")
        return READINGS[self.fault][0]

    def close(self) -> None:
        if self.fault == "close":
            raise OSError("the bus is gone")
        self.release_words = "torque is off (read back)"


@dataclass(frozen=True)
class BadHand(NamedGripper):
    """`hand:FAULT`."""

    name = "hand"
    capabilities = frozenset({Capability.MOVED})
    fault: str = ""

    @classmethod
    def parse(cls, text: str) -> Self:
        return cls(text)

    def open(self, mode: Mode, port: str, settings: Any = None) -> tuple[Any, Any]:
        return None if self.fault == "no gripper" else BadGripper(self.fault), {"name": self.name}

    def release(self, port: str, settings: Any) -> str:
        raise OSError("no such bus")


@pytest.fixture
def bad(add: Add) -> None:
    """Both are plug-ins of a package `lab`."""
    add(plugins.CAMERAS, bad=Bad)
    add(plugins.GRIPPERS, hand=BadHand)


def record(path: Path, camera: str, capsys: pytest.CaptureFixture[str], *flags: str) -> tuple[Any, str]:
    """Record 0.2 s; return the exit code and the words on stderr."""
    with pytest.raises(SystemExit) as ended:
        main.app(["record", "--camera", camera, *flags, "--seconds", "0.2", "-o", str(path)])
    return ended.value.code, capsys.readouterr().err


@pytest.mark.parametrize("fault", ["order", "float", "raises"])
def test_record_names_the_camera(bad: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str) -> None:
    """Assert that an invalid slice ends a recording, which keeps the valid slices before it."""
    path = tmp_path / "a.recording.h5"
    code, said = record(path, f"bad:{fault}", capsys, "--gripper", "none")
    assert code == 3
    assert "the plug-in camera bad of lab " in said
    assert SLICES[fault][1] in said
    assert "authors of lab" in said
    assert "internal error" not in said
    with StageFile(path, "recording") as file:
        file.check()
        assert file.length("ms_to_idx") == GOOD + 1
        assert file.length("events/t") == 3 * GOOD


@pytest.mark.parametrize("fault", [fault for fault in SLICES if fault != "raises"])
def test_the_contract_test_asks_the_same(fault: str) -> None:
    """Assert that `check_slices` fails for the same slices, in the same words."""
    with pytest.raises(AssertionError, match=f"slice {GOOD}: .*{re.escape(SLICES[fault][1])}"):
        testing.check_slices(BadCamera(fault))


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("frame", "reports an invalid sensor"),
        ("setup", "describes itself wrongly"),
        ("empty", "returned no slice"),
    ],
)
def test_nothing_is_recorded(
    bad: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str, said: str
) -> None:
    """Assert that no file is left of a camera that describes itself wrongly, or returns no slice."""
    code, words = record(tmp_path / "a.recording.h5", f"bad:{fault}", capsys, "--gripper", "none")
    assert (code, said in words) == (3, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("close", "OSError: the camera is gone"),
    ],
)
def test_close(bad: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str, said: str) -> None:
    """Assert that a camera that cannot be closed names the plug-in, with exit code 3."""
    code, words = record(tmp_path / "a.recording.h5", f"bad:{fault}", capsys, "--gripper", "none")
    assert code == 3
    assert "the plug-in camera bad of lab " in words
    assert said in words


WORDS = {fault: words for fault, (_, words) in READINGS.items()} | {
    "raises": "no checksum",
}


@pytest.mark.parametrize(("fault", "words"), WORDS.items(), ids=WORDS)
def test_record_names_the_gripper(
    bad: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str, words: str
) -> None:
    """Assert that an invalid reading ends a recording, with torque off and no row of it in the file."""
    path = tmp_path / "a.recording.h5"
    code, said = record(path, "bad", capsys, "--gripper", f"hand:{fault}")
    assert code == 3
    assert "the plug-in gripper hand of lab " in said
    assert words in said
    assert "torque is off (read back)" in said
    with StageFile(path, "recording") as file:
        file.check()
        assert file.length("gripper/t_us") <= GOOD
    with pytest.raises((AssertionError, ValueError), match=re.escape(words)):
        testing.check_commands(BadGripper(fault, good=2), "current")


def test_a_gripper_that_cannot_let_go(bad: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that an error of any kind in `close` is reported as torque that is not known to be off, with exit code 3.

    Nothing else of the recording is lost.
    """
    path = tmp_path / "a.recording.h5"
    code, said = record(path, "bad", capsys, "--gripper", "hand:close")
    assert code == 3
    assert "the plug-in gripper hand of lab failed to let go: torque could not be read back as off: OSError" in said
    with StageFile(path, "recording") as file:
        file.check()
        assert file.length("gripper/t_us") > 0
    gripper, _ = open_gripper(BadHand("close"), "current", "")
    assert gripper is not None
    assert gripper.release_words == "torque is on"
    for let_go in (gripper.emergency_open, gripper.close):
        with pytest.raises(DeviceError, match="the bus is gone"):
            let_go()
    gripper.close()  # tried again, and reported once
    assert gripper.release_words == "torque could not be read back as off: OSError: the bus is gone"
    words = release_gripper(BadHand(), "", BadHand().settings())
    assert words == "torque could not be read back as off: OSError: no such bus"


def test_opening(bad: None) -> None:
    """Assert that a camera or gripper that does not open names the plug-in, except for errors for the user."""
    with pytest.raises(DeviceError, match="the plug-in gripper hand of lab failed: open"):
        open_gripper(BadHand("no gripper"), "current", "")
    with pytest.raises(InputError, match="no such option"):
        open_camera(Bad("wrong flag"), CameraSettings(), None, np.random.SeedSequence(0))


def test_valid_slices_pass() -> None:
    """Assert that slices of any layout in memory pass, also empty ones and views that cannot be written to."""
    valid = events(3)
    every_other = Events(*(np.repeat(column, 2)[::2] for column in valid))
    fixed = Events(*(np.frombuffer(column.tobytes(), column.dtype) for column in valid))
    for each in (valid, every_other, fixed, valid.part(1, 1)):
        assert slice_fault(each, 3, FRAME_PX) == ""
