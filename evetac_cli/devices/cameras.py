"""Cameras by name, as on the command line: `--camera dvxplorer:DXM00042`.

`parse` turns a name into an object of a kind in `KINDS`, or of a plug-in's kind, and touches no device. The object's
`open` starts the camera. Its driver is imported only then, so the libraries of unused devices need not be installed.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np

from evetac_cli import names, plugins
from evetac_cli.devices import EventCamera
from evetac_cli.devices.naming import EVENTS_S, FIRMWARES, camera_fault, no_such_device, options, parse_number
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.names import Capability
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import open_recording

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.word_sources import PreparedWords
    from evetac_cli.devices.virtual.world import VirtualWorld

PREPARED_EVENTS_S = 1_000_000
PREPARED_S = 120  # duration of prepared words; the camera is silent afterwards
FIRMWARE = 10
BLOCK_SLICES = 20  # slices that are read at once: a paced replay must not wait for a large block


@dataclass(frozen=True)
class CameraSettings:
    """Settings of an event camera; None leaves the driver's default."""

    threshold_on: int | None = None
    threshold_off: int | None = None
    readout_rate: str | None = None
    flush_us: int | None = None

    def explicit_values(self) -> dict[str, Any]:
        """Return the settings that differ from None, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


class OpenedCamera(NamedTuple):
    """An opened camera, its identity and settings for a header, and the headers of the files that it replays."""

    camera: EventCamera
    setup: dict[str, Any]
    parents: tuple[Header, ...] = ()


@dataclass(frozen=True)
class NamedCamera:
    """A camera as it was named, before it is opened.

    Each kind of camera is a subclass: a frozen dataclass, because it is sent to other processes. It defines `name`,
    `open`, and the properties in which it differs from most others.
    """

    name: ClassVar[str]
    own_gripper: ClassVar[str] = "none"  # the gripper used with this camera if none is named

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse the text after the colon of the name; InputError for an unknown option."""
        if text:
            raise no_such_device("camera", cls.name, f"{cls.name}:{text}", (cls.name,))
        return cls()

    @property
    def capabilities(self) -> frozenset[Capability]:
        """The capabilities of this camera on which commands can rely.

        SIMULATED: a simulation runs now; a replay may show an earlier one.
        """
        return frozenset({Capability.DEVICE})

    def has(self, capability: Capability) -> bool:
        """Return whether commands may expect this of the camera."""
        return capability in self.capabilities

    @property
    def files(self) -> tuple[Path, ...]:
        """Recordings that the camera reads, as inputs of a job."""
        return ()

    @property
    def file_stem(self) -> str:
        """The beginning of the names of its recordings."""
        return self.name

    def __str__(self) -> str:
        return self.name

    def frame_px(self) -> tuple[int, int]:
        """Return the width and height of the camera's frame."""
        return FRAME_PX

    def known_sensor(self) -> dict[str, Any]:
        """Return the datasets `sensor/...` that are known before the camera is opened."""
        return {}

    def parents(self) -> tuple[Header, ...]:
        """Return the headers of the recordings that the camera replays."""
        return ()

    def shows_simulation(self) -> bool:
        """Return whether the camera shows a simulation, or a recording of one."""
        return self.has(Capability.SIMULATED) or any(header["simulated"] for header in self.parents())

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Start the camera; DeviceError if it cannot be opened.

        world: the scene in front of a virtual camera; None for prepared words, which are drawn from the seeds. A
        `Simulated` camera has no driver: devices.simulated builds it together with its gripper.
        """
        raise NotImplementedError(f"{self.name} has no driver")


@dataclass(frozen=True)
class Simulated(NamedCamera):
    """`sim`: the camera of a scene that is simulated as fast as its slices are read."""

    name = "sim"
    own_gripper = "sim"

    # It always needs a scene; its time passes as slices are read.
    capabilities = frozenset({Capability.STEPPED, Capability.SCENE, Capability.SIMULATED})


@dataclass(frozen=True)
class Virtual(NamedCamera):
    """`virtual[:OPTION+OPTION...]`: the real driver on a virtual DVXplorer, in real time."""

    name = "virtual"
    own_gripper = "virtual"
    faults: tuple[str, ...] = ()  # such as `unplug@2.0`
    prepared_events_s: float | None = None  # plays prepared words at this event rate instead of a simulated scene
    firmware: int = FIRMWARE

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse `prepared[=EVENTS_S]`, `firmware=NUMBER` and faults, joined by +; InputError for anything else."""
        name = f"{cls.name}:{text}"
        faults: list[str] = []
        rate = firmware = None
        for option in options(text):
            key, has_value, value = option.partition("=")
            if key == "prepared" and rate is None:
                where = "--camera virtual:prepared=EVENTS_S"
                rate = parse_number(value, *EVENTS_S, where, name) if has_value else float(PREPARED_EVENTS_S)
            elif key == "firmware" and has_value and firmware is None:
                firmware = int(parse_number(value, *FIRMWARES, "--camera virtual:firmware=NUMBER", name, whole=True))
            else:
                camera_fault(option)
                faults.append(option)
        return cls(tuple(faults), rate, FIRMWARE if firmware is None else firmware)

    @property
    def capabilities(self) -> frozenset[Capability]:
        """A device that shows a scene, unless it plays prepared words."""
        device = frozenset({Capability.DEVICE, Capability.ADJUSTABLE, Capability.SIMULATED})
        return device if self.prepared_events_s is not None else device | {Capability.SCENE}

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Start the driver on a virtual camera that shows the world or plays prepared words."""
        from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer

        source = prepared_words(self.prepared_events_s or PREPARED_EVENTS_S, seeds) if world is None else world
        backend = VirtualDvxplorer(source, self.firmware, faults=self.faults)
        return _open_dvxplorer(self.name, None, settings, backend)


@dataclass(frozen=True)
class Dvxplorer(NamedCamera):
    """`dvxplorer[:SERIAL]`: a DVXplorer Mini, through evetac's own driver."""

    name = "dvxplorer"
    capabilities = frozenset({Capability.DEVICE, Capability.HARDWARE, Capability.ADJUSTABLE})
    serial: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse an optional serial number."""
        return cls(text or None)

    def __str__(self) -> str:
        return f"{self.name}:{self.serial}" if self.serial else self.name

    @property
    def file_stem(self) -> str:
        """The kind, and the serial number if it was named."""
        return f"{self.name}-{_stem(self.serial)}" if self.serial else self.name

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Start the camera with this serial number, or the only camera."""
        return _open_dvxplorer(self.name, self.serial, settings, None)


@dataclass(frozen=True)
class Dv(Dvxplorer):
    """`dv[:SERIAL]`: a DVXplorer Mini, through the maker's library dv-processing."""

    name = "dv"

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Start the camera with this serial number, or the first camera."""
        from evetac_cli.devices.dv import DvCamera
        from evetac_cli.devices.dvxplorer.protocol import DvxplorerSettings

        driver_settings = DvxplorerSettings(**settings.explicit_values())
        camera = DvCamera(self.serial, driver_settings)
        sensor = str(camera.sensor["sensor/name"])
        return OpenedCamera(camera, {"name": self.name, "sensor": sensor, "settings": asdict(driver_settings)})


@dataclass(frozen=True)
class Replay(NamedCamera):
    """`replay:FILE`: a recording, played at its original speed."""

    name = "replay"
    capabilities = frozenset({Capability.DEVICE, Capability.REPLAY})
    path: Path

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse the name of a file; InputError if it is missing."""
        if not text:
            raise _no_such_camera(cls.name)
        return cls(Path(text))

    def __str__(self) -> str:
        return f"{self.name}:{self.path}"

    @property
    def files(self) -> tuple[Path, ...]:
        """The recording that is replayed."""
        return (self.path,)

    @property
    def file_stem(self) -> str:
        """The kind, and the name of the recording without its extension."""
        return f"{self.name}-{_stem(self.path)}"

    def frame_px(self) -> tuple[int, int]:
        """Return the frame size of the recording."""
        with open_recording(self.path) as recording:
            return recording.frame_px

    def known_sensor(self) -> dict[str, Any]:
        """Return all sensor datasets of the recording."""
        with open_recording(self.path) as recording:
            return recording.sensor_datasets()

    def parents(self) -> tuple[Header, ...]:
        """Return the header of the recording."""
        with open_recording(self.path) as recording:
            return (recording.header,)

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Open the recording; its time begins when the first slice is read."""
        camera = ReplayCamera(self.path, paced=True)
        return OpenedCamera(camera, {"name": self.name, "recording": camera.header["id"]}, (camera.header,))


# Kinds of camera by the text before the colon. The kind parses the text after the colon, and rejects unknown options.
KINDS: dict[str, type[NamedCamera]] = {kind.name: kind for kind in (Simulated, Virtual, Dvxplorer, Dv, Replay)}


def parse(text: str) -> NamedCamera:
    """Parse --camera; InputError if no built-in or plug-in kind has this name, or the kind has no such option."""
    name, _, rest = text.partition(":")
    kind = KINDS.get(name) or plugins.find(plugins.CAMERAS, name, NamedCamera)
    if kind is None:
        raise _no_such_camera(text)
    return kind.parse(rest)


def parse_several(text: str) -> tuple[NamedCamera, ...]:
    """Parse cameras separated by commas; a comma that no camera name follows is part of a file name.

    InputError if a serial number is named twice, because a device can be opened only once.
    """
    first, *parts = text.split(",")
    texts = [first]
    for part in parts:
        if _begins_camera(part):
            texts.append(part)
        else:
            texts[-1] += f",{part}"
    cameras = tuple(map(parse, texts))
    serials = [camera.serial for camera in cameras if isinstance(camera, Dvxplorer) and camera.serial]
    if len(set(serials)) < len(serials):
        raise InputError("the same camera twice", where="--camera", expected="serial numbers that differ", found=text)
    return cameras


def _begins_camera(part: str) -> bool:
    """Return whether the part begins with a kind of camera, up to a colon or its end; a replay must name a file."""
    name, colon, _ = part.partition(":")
    if name == Replay.name:
        return bool(colon)
    return name in KINDS or plugins.by_name(plugins.CAMERAS, name) is not None


def _no_such_camera(text: str) -> InputError:
    others = plugins.usable(plugins.CAMERAS)
    return no_such_device("camera", names.either([*names.CAMERAS, *others]), text, (*KINDS, *others))


def prepared_words(events_s: float, seeds: np.random.SeedSequence, time: TimeSource = HOST_TIME) -> "PreparedWords":
    """Return a source that repeats one second of random event words for two minutes of a clock."""
    from evetac_cli.devices.virtual.word_sources import PreparedWords, random_event_words

    second = random_event_words(events_s, 1.0, np.random.default_rng(seeds))
    return PreparedWords(second, times=PREPARED_S, period_ms=1000, time=time)


def _open_dvxplorer(name: str, serial: str | None, settings: CameraSettings, backend: Any) -> OpenedCamera:
    """Start evetac's driver; backend: the virtual USB device, or None for the computer's own USB."""
    from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
    from evetac_cli.devices.dvxplorer.protocol import DvxplorerSettings

    driver_settings = DvxplorerSettings(**settings.explicit_values())
    camera = DvxplorerCamera(serial, driver_settings, backend=backend)
    about = {"serial": camera.serial, "firmware": camera.firmware, "settings": asdict(driver_settings)}
    return OpenedCamera(camera, {"name": name, **about})


def _stem(name: str | Path) -> str:
    """Return a serial number, or a file name without folder and extensions."""
    return Path(name).name.split(".")[0]


class ReplayCamera:
    """A camera whose slices come from a recording; also the clock of that recording.

    If paced, a slice is returned when as much time has passed since the first as in the recording, as from a device.
    """

    counted: Mapping[str, int] = MappingProxyType({})
    notes: tuple[str, ...] = ()
    time: TimeSource = HOST_TIME

    def __init__(self, path: Path, *, paced: bool = False) -> None:
        self._recording = open_recording(path)
        self.header: Header = self._recording.header
        self.sensor: Mapping[str, Any] = self._recording.sensor_datasets()
        blocks = self._recording.blocks(BLOCK_SLICES)
        self._slices = chain.from_iterable(block.slices() for block in blocks)
        self._handed_out = 0
        self._open = True
        self._paced = paced
        self._started_us = 0.0

    def read(self) -> Events | None:
        """Return the next slice, or None after the last one; if paced, not before its time.

        SchemaError if events are not in their slices.
        """
        events = next(self._slices, None) if self._open else None
        if events is None:
            return None
        if self._paced:
            now_us = self.time.now_s() * 1e6
            self._started_us = self._started_us or now_us
            self.time.sleep(max(0.0, self.host_us((self._handed_out + 1) * SLICE_US) - now_us) * 1e-6)
        self._handed_out += 1
        return events

    def now_us(self) -> int:
        """Return the end of the slice that was read last."""
        return self._handed_out * SLICE_US

    def host_us(self, device_us: float) -> float:
        """Return the host time in us at which a paced replay reaches this time of the recording."""
        return self._started_us + device_us if self._paced else math.nan

    def close(self) -> None:
        """Close the file."""
        self._open = False
        self._recording.close()
