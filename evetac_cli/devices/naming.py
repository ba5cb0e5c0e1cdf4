"""Devices by name, as on the command line: `--camera dvxplorer:DXM00042 --gripper /dev/ttyUSB0@2000000`.

A name is understood without touching a device; `open_rig` then opens what was named. Drivers are imported only when
they are named, so that nobody needs the libraries of a device that he has not.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from evetac_cli.devices import Clock, Closable, EventCamera, Gripper, Rig
from evetac_cli.devices.replay import ReplayCamera
from evetac_cli.devices.virtual.faults import camera_fault, gripper_fault
from evetac_cli.errors import InputError

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.word_sources import PreparedWords
    from evetac_cli.devices.virtual.world import VirtualWorld

CAMERAS = "sim, virtual, dvxplorer[:SERIAL], dv[:SERIAL] or replay:FILE"
GRIPPERS = "sim, virtual, none, or a PORT[@BAUD] such as /dev/ttyUSB0@2000000"
BAUD = 2_000_000
PREPARED_EVENTS_S = 1_000_000
PREPARED_S = 30  # how long prepared words are played; then the camera is silent
TIMESTAMP_CODE = 2  # of an event word: bits 26 up
FIRMWARE = 10
# A virtual servo answers when the computer lets it run, which a busy one may not do for a tenth of a second.
VIRTUAL_ANSWER_MS = 200.0
VIRTUAL_WATCHDOG_MS = 1000


@dataclass(frozen=True)
class CameraName:
    """A camera as it was named."""

    kind: str  # sim, virtual, dvxplorer, dv, replay
    which: str | None = None  # serial number, or file
    faults: tuple[str, ...] = ()  # of a virtual one, as `unplug@2.0`
    prepared_events_s: float | None = None  # a virtual one that plays prepared words instead of a world
    firmware: int = FIRMWARE  # of a virtual one

    def __str__(self) -> str:
        return self.kind + (f":{self.which}" if self.which else "")


@dataclass(frozen=True)
class GripperName:
    """A gripper as it was named."""

    kind: str  # sim, virtual, port, none
    port: str = ""
    baud: int = BAUD
    faults: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.port}@{self.baud}" if self.kind == "port" else self.kind


@dataclass(frozen=True)
class CameraSettings:
    """What can be set on an event camera; None leaves the driver's default."""

    threshold_on: int | None = None
    threshold_off: int | None = None
    readout_rate: str | None = None
    flush_us: int | None = None

    def given(self) -> dict[str, Any]:
        """Those that are set."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def camera_name(text: str) -> CameraName:
    """Understand --camera; InputError if there is no such kind of camera, or no such fault of a virtual one."""
    kind, _, rest = text.partition(":")
    if kind in ("dvxplorer", "dv"):
        return CameraName(kind, rest or None)
    if kind == "replay" and rest:
        return CameraName(kind, rest)
    if kind == "sim" and not rest:
        return CameraName(kind)
    if kind == "virtual":
        given = list(filter(None, rest.split("+")))
        options = {name: option for option in given if (name := option.partition("=")[0]) in ("prepared", "firmware")}
        faults = tuple(option for option in given if option not in options.values())
        for each in faults:
            camera_fault(each)
        prepared, firmware = (options.get(name, "").partition("=")[2] for name in ("prepared", "firmware"))
        rate = _number(prepared or str(PREPARED_EVENTS_S), "prepared=EVENTS_S", text)
        number = round(_number(firmware or str(FIRMWARE), "firmware=NUMBER", text))
        return CameraName(kind, None, faults, rate if "prepared" in options else None, number)
    raise _unknown("camera", "--camera", CAMERAS, text, ("sim", "virtual", "dvxplorer", "dv", "replay:"))


def gripper_name(text: str | None, camera: CameraName) -> GripperName:
    """Understand --gripper; by default what belongs to the camera: sim to sim, virtual to virtual, none to others."""
    if text is None:
        return GripperName(camera.kind if camera.kind in ("sim", "virtual") else "none")
    kind, _, rest = text.partition(":")
    if kind == "virtual":
        faults = tuple(filter(None, rest.split("+")))
        for each in faults:
            gripper_fault(each)
        return GripperName(kind, faults=faults)
    if text in ("sim", "none"):
        return GripperName(text)
    if text.startswith(("/", "./", "COM", "tty")):
        port, at, baud = text.partition("@")
        return GripperName("port", port, int(_number(baud, "--gripper PORT@BAUD", text)) if at else BAUD)
    raise _unknown("gripper", "--gripper", GRIPPERS, text, ("sim", "virtual", "none"))


def _number(text: str, where: str, found: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 1 <= value < 1e9:
        raise InputError("not a number", where=where, expected="1 to 1e9", found=found)
    return value


def _unknown(what: str, where: str, expected: str, found: str, near: tuple[str, ...]) -> InputError:
    guess = get_close_matches(found, near, n=1)
    hint = f"did you mean {guess[0]}?" if guess else ""
    return InputError(f"no such {what}", where=where, expected=expected, found=found, hint=hint)


def open_rig(
    camera: CameraName,
    gripper: GripperName,
    settings: CameraSettings,
    plan: Mapping[str, Any] | None,
    seeds: np.random.SeedSequence,
    *,
    mode: Literal["current", "position"] = "current",
    **durations: float,
) -> Rig:
    """Open what was named, the gripper first: a camera's clock starts when it is opened.

    plan: what a virtual world simulates, as in devices.simulated.rig; mode: of the gripper. DeviceError if a device
    cannot be opened; what was opened until then is closed again.
    """
    with ExitStack() as opened:
        world = None
        if plan is not None and camera.kind == "virtual" and camera.prepared_events_s is None:
            from evetac_cli.devices.virtual.world import VirtualWorld

            world = VirtualWorld(plan, seeds, tells_truth=False, **durations)
            opened.callback(world.close)
        hand, servo, hand_setup = _open_gripper(gripper, world, mode)
        for device in (servo, hand):
            if device is not None:
                opened.callback(device.close)
        gel_camera, eye_setup, parents = open_camera(camera, settings, world, seeds)
        opened.pop_all()
    return Rig(
        gel_camera,
        hand,
        gel_camera,
        holding_ma=world.holding_ma if world else 0.0,
        drawn=world.drawn if world else "",
        sensor=world.sensor if world else {},
        setup={"camera": eye_setup, "gripper": hand_setup},
        simulated=camera.kind == "virtual",
        parents=parents,
        peers=tuple(peer for peer in (servo, world) if peer is not None),
    )


class Opened(EventCamera, Clock, Protocol):
    """A camera that is running, and its clock."""


def open_camera(
    name: CameraName, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
) -> tuple[Opened, dict[str, Any], tuple[dict[str, Any], ...]]:
    """The camera, what it is and how it is set, and headers of what it plays; DeviceError if it cannot be opened."""
    if name.kind == "replay":
        replay = ReplayCamera(Path(name.which or ""), paced=True)
        return replay, {"name": name.kind, "recording": replay.header["id"]}, (replay.header,)
    from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
    from evetac_cli.devices.dvxplorer.protocol import DvxplorerSettings

    chosen = DvxplorerSettings(**settings.given())
    if name.kind == "dv":
        from evetac_cli.devices.dv import DvCamera

        through_dv = DvCamera(name.which, chosen)
        which = str(through_dv.sensor["sensor/name"])
        return through_dv, {"name": name.kind, "sensor": which, "settings": asdict(chosen)}, ()
    backend = None
    if name.kind == "virtual":
        from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer

        source = _prepared(name.prepared_events_s or PREPARED_EVENTS_S, seeds) if world is None else world
        backend = VirtualDvxplorer(source, name.firmware, faults=name.faults)
    camera = DvxplorerCamera(name.which, chosen, backend=backend)
    about = {"serial": camera.serial, "firmware": camera.firmware, "settings": asdict(chosen)}
    return camera, {"name": name.kind, **about}, ()


def _prepared(events_s: float, seeds: np.random.SeedSequence) -> "PreparedWords":
    """Words of a second of events at random, for half a minute again and again."""
    from evetac_cli.devices.virtual.word_sources import PreparedWords, random_event_words

    second = random_event_words(events_s, 1.0, np.random.default_rng(seeds))
    stamps = second >> 26 == TIMESTAMP_CODE
    return PreparedWords(
        np.concatenate([np.where(stamps, second + np.uint32(1000 * played), second) for played in range(PREPARED_S)])
    )


def _open_gripper(
    name: GripperName, world: "VirtualWorld | None", mode: Literal["current", "position"]
) -> tuple[Gripper | None, Closable | None, Any]:
    """The gripper, its virtual twin if it has one, and what it is and how it is set."""
    if name.kind == "none":
        return None, None, name.kind
    from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn, RhP12RnSettings

    servo = None
    port = name.port
    patience = RhP12RnSettings()
    if name.kind == "virtual":
        from evetac_cli.devices.virtual.gripper import VirtualGripper

        servo = VirtualGripper(world.plant if world else None, name.faults)
        port = servo.port
        patience = RhP12RnSettings(answer_ms=VIRTUAL_ANSWER_MS, watchdog_ms=VIRTUAL_WATCHDOG_MS)
    try:
        hand = RhP12Rn(port, name.baud, mode, patience)
    except BaseException:
        if servo is not None:
            servo.close()
        raise
    about = {key: value for key, value in hand.described.items() if key != "eeprom_written"}
    return hand, servo, {"name": name.kind, **about}
