"""Devices by name: what each name means, and that nonsense is refused before anything is touched."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.devices import cameras, grippers
from evetac_cli.devices.cameras import CameraSettings, NamedCamera
from evetac_cli.devices.grippers import NamedGripper
from evetac_cli.devices.opening import open_rig, require_arm
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.names import Capability
from tests.conftest import Made

CAMERAS: dict[str, NamedCamera] = {
    "sim": cameras.Simulated(),
    "virtual": cameras.Virtual(),
    "virtual:unplug@2": cameras.Virtual(faults=("unplug@2",)),
    "virtual:odd@1+unplug@2": cameras.Virtual(faults=("odd@1", "unplug@2")),
    "virtual:prepared": cameras.Virtual(prepared_events_s=1e6),
    "virtual:prepared=2e5+stall@1": cameras.Virtual(faults=("stall@1",), prepared_events_s=2e5),
    "virtual:firmware=9": cameras.Virtual(firmware=9),
    "virtual:firmware=9+busy+silence@1:0.5": cameras.Virtual(faults=("busy", "silence@1:0.5"), firmware=9),
    "dvxplorer": cameras.Dvxplorer(),
    "dvxplorer:DXM00042": cameras.Dvxplorer("DXM00042"),
    "dv:DXM00042": cameras.Dv("DXM00042"),
    "replay:some/a:b.recording.h5": cameras.Replay(Path("some/a:b.recording.h5")),
}


@pytest.mark.parametrize("text", CAMERAS)
def test_cameras(text: str) -> None:
    """Assert that a name is understood, and that what it names can be sent to another process."""
    assert cameras.parse(text) == CAMERAS[text]
    assert pickle.loads(pickle.dumps(CAMERAS[text])) == CAMERAS[text]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("sim,virtual:busy", ["sim", "virtual:busy"]),
        ("replay:a,replayed.h5", ["replay:a,replayed.h5"]),
        ("replay:a,replay", ["replay:a,replay"]),
        ("replay:a,simple.h5,dvxplorer", ["replay:a,simple.h5", "dvxplorer"]),
        ("replay:a,b:c,replay:d", ["replay:a,b:c", "replay:d"]),
    ],
)
def test_several_cameras(text: str, named: list[str]) -> None:
    """Assert that a comma is part of a file's name unless a whole kind of camera stands behind it."""
    assert cameras.parse_several(text) == tuple(map(cameras.parse, named))


def test_what_kinds_say_of_themselves() -> None:
    """Assert which cameras simulate a scene, and how the files of each begin."""
    assert [text for text, camera in CAMERAS.items() if camera.has(Capability.SCENE)] == [
        *("sim", "virtual", "virtual:unplug@2", "virtual:odd@1+unplug@2"),
        *("virtual:firmware=9", "virtual:firmware=9+busy+silence@1:0.5"),
    ]
    stems = {text: CAMERAS[text].file_stem for text in ("virtual:prepared", "dvxplorer", "dv:DXM00042")}
    assert stems == {"virtual:prepared": "virtual", "dvxplorer": "dvxplorer", "dv:DXM00042": "dv-DXM00042"}
    replay = CAMERAS["replay:some/a:b.recording.h5"]
    assert (replay.file_stem, str(replay)) == ("replay-a:b", "replay:some/a:b.recording.h5")
    assert str(CAMERAS["dvxplorer:DXM00042"]) == "dvxplorer:DXM00042"


def test_a_replay_knows_its_recording(made: Made) -> None:
    """Assert that before it is opened, a replay says its frame, its dots and its recording, which is simulated."""
    replay = cameras.Replay(made.recordings[0])
    assert replay.frame_px() == (640, 480)
    assert "sensor/dot_xy_px" in replay.known_sensor()
    assert len(replay.parents()) == 1
    assert replay.shows_simulation()
    assert not replay.has(Capability.SIMULATED)


GRIPPERS: dict[str, NamedGripper] = {
    "sim": grippers.Simulated(),
    "none": grippers.NoGripper(),
    "virtual:lost-answer@1+overload@2": grippers.Virtual(("lost-answer@1", "overload@2")),
    "/dev/ttyUSB0": grippers.Serial("/dev/ttyUSB0", grippers.BAUD),
    "/dev/ttyUSB0@57600": grippers.Serial("/dev/ttyUSB0", 57600),
    "/dev/ttyUSB0:5": grippers.Serial("/dev/ttyUSB0", grippers.BAUD, 5),
    "/dev/ttyUSB0:0@1000000": grippers.Serial("/dev/ttyUSB0", 1_000_000, 0),
    "COM3:252@1e6": grippers.Serial("COM3", 1_000_000, 252),
    "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0": grippers.Serial(
        "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0"
    ),
    "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0:7@57600": grippers.Serial(
        "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0", 57600, 7
    ),
}


@pytest.mark.parametrize("text", GRIPPERS)
def test_grippers(text: str) -> None:
    """Assert that a name is understood, and that what it names can be sent to another process."""
    assert grippers.parse(text) == GRIPPERS[text]
    assert pickle.loads(pickle.dumps(GRIPPERS[text])) == GRIPPERS[text]


def test_a_port_is_written_with_its_rate() -> None:
    """Assert that a gripper at a port says where it is, which and how fast, so that it can be read again."""
    assert str(GRIPPERS["/dev/ttyUSB0:5"]) == "/dev/ttyUSB0:5@2000000"
    for gripper in GRIPPERS.values():
        if isinstance(gripper, grippers.Serial):
            assert grippers.parse(str(gripper)) == grippers.parse(gripper.shortest) == gripper
    shortest = [each.shortest for each in GRIPPERS.values() if isinstance(each, grippers.Serial)]
    assert shortest[:4] == ["/dev/ttyUSB0", "/dev/ttyUSB0@57600", "/dev/ttyUSB0:5", "/dev/ttyUSB0:0@1000000"]
    assert str(GRIPPERS["/dev/ttyUSB0@57600"]) == "/dev/ttyUSB0@57600"
    assert (GRIPPERS["/dev/ttyUSB0@57600"].port, GRIPPERS["/dev/ttyUSB0@57600"].baud) == ("/dev/ttyUSB0", 57600)
    assert (GRIPPERS["sim"].port, GRIPPERS["sim"].baud) == ("", grippers.BAUD)


def test_settings_of_a_named_gripper() -> None:
    """Assert that the driver is set up for the id and the watchdog that were named, and a virtual one gets time."""
    named = grippers.parse("/dev/ttyUSB0:7")
    assert named.settings() == RhP12RnSettings(id=7)
    assert named.settings(watchdog_ms=60, max_current_ma=9) == RhP12RnSettings(id=7, watchdog_ms=60, max_current_ma=9)
    assert replace(named, watchdog_ms=40).settings() == RhP12RnSettings(id=7, watchdog_ms=40)
    virtual = grippers.parse("virtual")
    assert virtual.settings().id == 1
    assert (
        virtual.settings(watchdog_ms=60).watchdog_ms == replace(virtual, watchdog_ms=60).settings().watchdog_ms == 300
    )
    assert virtual.settings().answer_ms == virtual.settings(answer_ms=5.0).answer_ms == grippers.VIRTUAL_ANSWER_MS


@pytest.mark.parametrize("id_", [0, 252])
def test_a_gripper_of_any_id_is_opened_and_described_by_it(id_: int) -> None:
    """Assert that what is named is what is spoken to, and that the header says so."""
    with VirtualGripper(registers={"ID": id_}) as servo:
        named = replace(grippers.parse(f"{servo.port}:{id_}"), watchdog_ms=500)
        driver, setup = named.open("current", named.port)
        assert driver is not None
        driver.write_current(3)
        assert servo.read_register("Goal Current") == 3
        driver.close()
    assert (setup["name"], setup["id"], setup["baud"]) == ("port", id_, 2_000_000)


def test_gripper_follows_the_camera() -> None:
    """Assert that without a name the gripper is that of the camera, and none where it has none."""
    own = {text: grippers.parse(camera.own_gripper) for text, camera in CAMERAS.items()}
    assert own["sim"] == grippers.Simulated()
    assert own["virtual:odd@1+unplug@2"] == grippers.Virtual()
    assert own["dvxplorer"] == own["replay:some/a:b.recording.h5"] == grippers.NoGripper()


@pytest.mark.parametrize(
    ("camera", "gripper"),
    [
        (cameras.Virtual(faults=("nonsense@1",)), grippers.NoGripper()),
        (cameras.Virtual(), grippers.Virtual(("nonsense",))),
        (cameras.Virtual(faults=("busy",)), grippers.Virtual()),
    ],
    ids=["camera", "gripper", "busy"],
)
def test_failed_opening_leaves_nothing_open(
    camera: cameras.Virtual, gripper: NamedGripper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that when one device cannot be opened, those before it are closed again."""
    from evetac_cli.devices.virtual import gripper as virtual_gripper

    closed = []
    close = virtual_gripper.VirtualGripper.close
    monkeypatch.setattr(virtual_gripper.VirtualGripper, "close", lambda self: (closed.append(self), close(self)))
    with pytest.raises(EvetacError):
        open_rig(replace(camera, prepared_events_s=1e4), gripper, CameraSettings(), None, np.random.SeedSequence(0))
    assert len(closed) == (gripper == grippers.Virtual())


def test_a_gripper_is_a_real_one_unless_it_says_otherwise() -> None:
    """Assert that a kind of gripper that says nothing is moved with --arm alone; and which kinds say otherwise."""

    class Unsaid(NamedGripper):
        name = "unsaid"

    class OurDriver(grippers.RhP12RnGripper):
        name = "our-driver"

    for kind in (Unsaid, OurDriver):
        with pytest.raises(InputError, match="this would move a real gripper"):
            require_arm(kind(), armed=False)
    unarmed = [text for text, gripper in GRIPPERS.items() if not gripper.has(Capability.HARDWARE)]
    assert unarmed == ["sim", "none", "virtual:lost-answer@1+overload@2"]
