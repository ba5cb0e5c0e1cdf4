"""Devices by name: what each name means, and that nonsense is refused before anything is touched."""

from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.devices import naming
from evetac_cli.devices.naming import BAUD, CameraName, CameraSettings, GripperName, camera_name, gripper_name
from evetac_cli.errors import EvetacError, InputError

CAMERAS = {
    "sim": CameraName("sim"),
    "virtual": CameraName("virtual"),
    "virtual:unplug@2": CameraName("virtual", faults=("unplug@2",)),
    "virtual:odd@1+unplug@2": CameraName("virtual", faults=("odd@1", "unplug@2")),
    "virtual:prepared": CameraName("virtual", prepared_events_s=1e6),
    "virtual:prepared=2e5+stall@1": CameraName("virtual", faults=("stall@1",), prepared_events_s=2e5),
    "virtual:firmware=9": CameraName("virtual", firmware=9),
    "virtual:firmware=9+busy+silence@1:0.5": CameraName("virtual", faults=("busy", "silence@1:0.5"), firmware=9),
    "dvxplorer": CameraName("dvxplorer"),
    "dvxplorer:DXM00042": CameraName("dvxplorer", "DXM00042"),
    "dv:DXM00042": CameraName("dv", "DXM00042"),
    "replay:some/a:b.recording.h5": CameraName("replay", "some/a:b.recording.h5"),
}


@pytest.mark.parametrize("text", CAMERAS)
def test_cameras(text: str) -> None:
    """Assert that a name is understood."""
    assert camera_name(text) == CAMERAS[text]


@pytest.mark.parametrize(
    "text",
    [
        *("", "simm", "webcam", "replay", "replay:", "sim:3", "virtual:prepared=x", "Virtual"),
        *("virtual:bogus", "virtual:unplug@2@3", "virtual:unplug@2=3", "virtual:prepared+busy@0"),
    ],
)
def test_no_such_camera(text: str) -> None:
    """Assert that other names are refused, with those that there are, or what is wrong with the number."""
    with pytest.raises(InputError) as refused:
        camera_name(text)
    assert "expected" in str(refused.value)


def test_near_miss_is_told() -> None:
    """Assert that a slip of the pen is understood."""
    with pytest.raises(InputError, match="did you mean dvxplorer"):
        camera_name("dvexplorer")


GRIPPERS = {
    "sim": GripperName("sim"),
    "none": GripperName("none"),
    "virtual:lost-answer@1+overload@2": GripperName("virtual", faults=("lost-answer@1", "overload@2")),
    "/dev/ttyUSB0": GripperName("port", "/dev/ttyUSB0", BAUD),
    "/dev/ttyUSB0@57600": GripperName("port", "/dev/ttyUSB0", 57600),
}


@pytest.mark.parametrize("text", GRIPPERS)
def test_grippers(text: str) -> None:
    """Assert that a name is understood."""
    assert gripper_name(text, CameraName("dvxplorer")) == GRIPPERS[text]


@pytest.mark.parametrize("text", ["", "grip", "/dev/ttyUSB0@fast", "/dev/ttyUSB0@0", "sim2", "virtual:dead@1"])
def test_no_such_gripper(text: str) -> None:
    """Assert that other names are refused."""
    with pytest.raises(InputError):
        gripper_name(text, CameraName("dvxplorer"))


def test_gripper_follows_the_camera() -> None:
    """Assert that without a name the gripper is that of the camera, and none where there is none."""
    kinds = {text: gripper_name(None, name).kind for text, name in CAMERAS.items()}
    assert kinds["sim"] == "sim"
    assert kinds["virtual:odd@1+unplug@2"] == "virtual"
    assert kinds["dvxplorer"] == kinds["replay:some/a:b.recording.h5"] == "none"


def test_settings_left_open_are_the_drivers() -> None:
    """Assert that only what is set is passed on."""
    assert CameraSettings().given() == {}
    assert CameraSettings(threshold_off=3).given() == {"threshold_off": 3}


@pytest.mark.parametrize(
    ("camera", "gripper"),
    [
        (CameraName("virtual", faults=("nonsense@1",)), GripperName("none")),
        (CameraName("virtual"), GripperName("virtual", faults=("nonsense",))),
        (CameraName("virtual", faults=("busy",)), GripperName("virtual")),
    ],
    ids=["camera", "gripper", "busy"],
)
def test_failed_opening_leaves_nothing_open(
    camera: CameraName, gripper: GripperName, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that when one device cannot be opened, those before it are closed again."""
    from evetac_cli.devices.virtual import gripper as virtual_gripper

    closed = []
    close = virtual_gripper.VirtualGripper.close
    monkeypatch.setattr(virtual_gripper.VirtualGripper, "close", lambda self: (closed.append(self), close(self)))
    with pytest.raises(EvetacError):
        naming.open_rig(
            replace(camera, prepared_events_s=1e4), gripper, CameraSettings(), None, np.random.SeedSequence(0)
        )
    assert len(closed) == (gripper == GripperName("virtual"))


def test_prepared_words_hold_the_rate() -> None:
    """Assert that prepared words are as many events a second as asked for, second after second."""
    from evetac_cli.devices.dvxplorer import event_words

    source = naming._prepared(20_000, np.random.SeedSequence(3))
    data = bytes(source._data)
    decoder = event_words.start()
    events = event_words.step(decoder, data)
    more = event_words.flush(decoder)
    t = np.concatenate([events.t, more.t]) - 1000
    assert np.bincount(t // 1_000_000).tolist() == [20_000] * naming.PREPARED_S
    assert not any(decoder.counted.values())
