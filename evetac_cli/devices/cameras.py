"""Cameras by name, as on the command line: `--camera dvxplorer:DXM00042`.

`parse` turns a name into an object of one of the kinds in `KINDS`, or of a plug-in's, and touches no device; its `open`
starts the camera. A driver is imported only when a camera of its kind is opened, so that the library of a device that
is not used is not needed.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np

from evetac_cli import names, plugins
from evetac_cli.devices import EventCamera
from evetac_cli.devices.naming import EVENTS_S, FIRMWARES, no_such_device, options, parse_number
from evetac_cli.devices.replay import ReplayCamera
from evetac_cli.devices.virtual.faults import camera_fault
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.names import Capability
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import open_recording

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.word_sources import PreparedWords
    from evetac_cli.devices.virtual.world import VirtualWorld

PREPARED_EVENTS_S = 1_000_000
PREPARED_S = 120  # how long prepared words are played; then the camera is silent
FIRMWARE = 10


@dataclass(frozen=True)
class CameraSettings:
    """What can be set on an event camera; None leaves the driver's default."""

    threshold_on: int | None = None
    threshold_off: int | None = None
    readout_rate: str | None = None
    flush_us: int | None = None

    def given(self) -> dict[str, Any]:
        """The settings that are not left to the driver, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


class OpenedCamera(NamedTuple):
    """A camera that was opened, what it is and how it is set (for a header), and headers of the files that it plays."""

    camera: EventCamera
    setup: dict[str, Any]
    parents: tuple[Header, ...] = ()


@dataclass(frozen=True)
class NamedCamera:
    """A camera as it was named, before it is opened.

    A kind of camera is a class below this one, a frozen dataclass, since it is sent to other processes: `name`, `open`,
    and what else it does not share with most others.
    """

    name: ClassVar[str]
    own_gripper: ClassVar[str] = "none"  # the gripper that belongs to it where none is named

    @classmethod
    def parse(cls, text: str) -> Self:
        """Understand what stands behind the colon of its name; InputError for what it does not."""
        if text:
            raise no_such_device("camera", cls.name, f"{cls.name}:{text}", (cls.name,))
        return cls()

    @property
    def capabilities(self) -> frozenset[Capability]:
        """What commands may expect of it; SIMULATED: what it sees is simulated now (a replay may show it again)."""
        return frozenset({Capability.DEVICE})

    def has(self, capability: Capability) -> bool:
        """Whether commands may expect this of it."""
        return capability in self.capabilities

    @property
    def files(self) -> tuple[Path, ...]:
        """Recordings that it reads, as inputs of a job."""
        return ()

    @property
    def file_stem(self) -> str:
        """How the names of its recordings begin."""
        return self.name

    def __str__(self) -> str:
        return self.name

    def frame_px(self) -> tuple[int, int]:
        """Width and height of its frame."""
        return FRAME_PX

    def known_sensor(self) -> dict[str, Any]:
        """Datasets `sensor/...` that are known before it is opened."""
        return {}

    def parents(self) -> tuple[Header, ...]:
        """Headers of the recordings that it plays."""
        return ()

    def shows_simulation(self) -> bool:
        """Whether what it sees is, or once was, simulated."""
        return self.has(Capability.SIMULATED) or any(header["simulated"] for header in self.parents())

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Start the camera; DeviceError if it cannot be opened.

        world: what a virtual camera looks at, None for prepared words, which are drawn from the seeds. A `Simulated`
        camera has no driver: devices.simulated builds it together with its gripper.
        """
        raise NotImplementedError(f"{self.name} has no driver")


@dataclass(frozen=True)
class Simulated(NamedCamera):
    """`sim`: the camera of a scene that is simulated as fast as it is read."""

    name = "sim"
    own_gripper = "sim"

    @property
    def capabilities(self) -> frozenset[Capability]:
        """A scene is all that it can show; its time passes as slices are read."""
        return frozenset({Capability.STEPPED, Capability.SCENE, Capability.SIMULATED})


@dataclass(frozen=True)
class Virtual(NamedCamera):
    """`virtual[:OPTION+OPTION...]`: the real driver before a virtual DVXplorer, in real time."""

    name = "virtual"
    own_gripper = "virtual"
    faults: tuple[str, ...] = ()  # such as `unplug@2.0`
    prepared_events_s: float | None = None  # plays prepared words of this rate instead of a simulated scene
    firmware: int = FIRMWARE

    @classmethod
    def parse(cls, text: str) -> Self:
        """Understand `prepared[=EVENTS_S]`, `firmware=NUMBER` and faults, joined by +; InputError for any other."""
        name = f"{cls.name}:{text}"
        faults: list[str] = []
        rate = firmware = None
        for option in options(text):
            key, is_given, given = option.partition("=")
            if key == "prepared" and rate is None:
                where = "--camera virtual:prepared=EVENTS_S"
                rate = parse_number(given, *EVENTS_S, where, name) if is_given else float(PREPARED_EVENTS_S)
            elif key == "firmware" and is_given and firmware is None:
                firmware = int(parse_number(given, *FIRMWARES, "--camera virtual:firmware=NUMBER", name, whole=True))
            else:
                camera_fault(option)
                faults.append(option)
        return cls(tuple(faults), rate, FIRMWARE if firmware is None else firmware)

    @property
    def capabilities(self) -> frozenset[Capability]:
        """A device in front of a scene, unless it plays prepared words."""
        device = frozenset({Capability.DEVICE, Capability.ADJUSTABLE, Capability.SIMULATED})
        return device if self.prepared_events_s is not None else device | {Capability.SCENE}

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Start the driver on a virtual camera that looks at the world, or plays prepared words."""
        from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer

        source = prepared_words(self.prepared_events_s or PREPARED_EVENTS_S, seeds) if world is None else world
        backend = VirtualDvxplorer(source, self.firmware, faults=self.faults)
        return _open_dvxplorer(self.name, None, settings, backend)


@dataclass(frozen=True)
class Dvxplorer(NamedCamera):
    """`dvxplorer[:SERIAL]`: a DVXplorer Mini, by our driver."""

    name = "dvxplorer"
    serial: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Understand a serial number, or nothing."""
        return cls(text or None)

    @property
    def capabilities(self) -> frozenset[Capability]:
        """A real camera, whose thresholds and readout rate can be set."""
        return frozenset({Capability.DEVICE, Capability.HARDWARE, Capability.ADJUSTABLE})

    def __str__(self) -> str:
        return f"{self.name}:{self.serial}" if self.serial else self.name

    @property
    def file_stem(self) -> str:
        """The kind, and the serial number if it was named."""
        return f"{self.name}-{_stem(self.serial)}" if self.serial else self.name

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Start the camera of this serial number, or the only one."""
        return _open_dvxplorer(self.name, self.serial, settings, None)


@dataclass(frozen=True)
class Dv(Dvxplorer):
    """`dv[:SERIAL]`: a DVXplorer Mini, by the maker's library dv-processing."""

    name = "dv"

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Start the camera of this serial number, or the first."""
        from evetac_cli.devices.dv import DvCamera
        from evetac_cli.devices.dvxplorer.protocol import DvxplorerSettings

        chosen = DvxplorerSettings(**settings.given())
        camera = DvCamera(self.serial, chosen)
        sensor = str(camera.sensor["sensor/name"])
        return OpenedCamera(camera, {"name": self.name, "sensor": sensor, "settings": asdict(chosen)})


@dataclass(frozen=True)
class Replay(NamedCamera):
    """`replay:FILE`: a recording, handed out at the pace at which it was made."""

    name = "replay"
    path: Path

    @classmethod
    def parse(cls, text: str) -> Self:
        """Understand the name of a file; InputError without one."""
        if not text:
            raise _no_such_camera(cls.name)
        return cls(Path(text))

    @property
    def capabilities(self) -> frozenset[Capability]:
        """A device whose stream ends, and which cannot be set up."""
        return frozenset({Capability.DEVICE, Capability.REPLAY})

    def __str__(self) -> str:
        return f"{self.name}:{self.path}"

    @property
    def files(self) -> tuple[Path, ...]:
        """The recording that is replayed."""
        return (self.path,)

    @property
    def file_stem(self) -> str:
        """Kind, and the name of the recording without its ending."""
        return f"{self.name}-{_stem(self.path)}"

    def frame_px(self) -> tuple[int, int]:
        """The frame of the recording."""
        with open_recording(self.path) as recording:
            return recording.frame_px

    def known_sensor(self) -> dict[str, Any]:
        """All that the recording says of its sensor."""
        with open_recording(self.path) as recording:
            return recording.sensor_datasets()

    def parents(self) -> tuple[Header, ...]:
        """The header of the recording."""
        with open_recording(self.path) as recording:
            return (recording.header,)

    def open(
        self, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
    ) -> OpenedCamera:
        """Open the recording; its time begins with the first slice that is read."""
        camera = ReplayCamera(self.path, paced=True)
        return OpenedCamera(camera, {"name": self.name, "recording": camera.header["id"]}, (camera.header,))


# What stands before the colon: what comes after it is given to the kind, which refuses what it does not understand.
KINDS: dict[str, type[NamedCamera]] = {kind.name: kind for kind in (Simulated, Virtual, Dvxplorer, Dv, Replay)}


def parse(text: str) -> NamedCamera:
    """Understand --camera; InputError if it is no kind of camera, ours or a plug-in's, or has no such option."""
    name, _, rest = text.partition(":")
    kind = KINDS.get(name) or plugins.find(plugins.CAMERAS, name, NamedCamera)
    if kind is None:
        raise _no_such_camera(text)
    return kind.parse(rest)


def parse_several(text: str) -> tuple[NamedCamera, ...]:
    """Understand cameras with commas between them; a comma behind which no camera begins is part of a file's name.

    InputError where one serial number is named twice: a device can be opened once.
    """
    first, *parts = text.split(",")
    named = [first]
    for part in parts:
        if _begins_camera(part):
            named.append(part)
        else:
            named[-1] += f",{part}"
    cameras = tuple(map(parse, named))
    serials = [camera.serial for camera in cameras if isinstance(camera, Dvxplorer) and camera.serial]
    if len(set(serials)) < len(serials):
        raise InputError("the same camera twice", where="--camera", expected="serial numbers that differ", found=text)
    return cameras


def _begins_camera(part: str) -> bool:
    """Whether a camera begins so: what stands before a colon, or all of it, is a kind; a replay has a file."""
    name, colon, _ = part.partition(":")
    if name == Replay.name:
        return bool(colon)
    return name in KINDS or plugins.named(plugins.CAMERAS, name) is not None


def _no_such_camera(text: str) -> InputError:
    others = plugins.usable(plugins.CAMERAS)
    return no_such_device("camera", names.either([*names.CAMERAS, *others]), text, (*KINDS, *others))


def prepared_words(events_s: float, seeds: np.random.SeedSequence, time: TimeSource = HOST_TIME) -> "PreparedWords":
    """Event words of one second of events at random, played again and again for two minutes of a clock."""
    from evetac_cli.devices.virtual.word_sources import PreparedWords, random_event_words

    second = random_event_words(events_s, 1.0, np.random.default_rng(seeds))
    return PreparedWords(second, times=PREPARED_S, period_ms=1000, time=time)


def _open_dvxplorer(name: str, serial: str | None, settings: CameraSettings, backend: Any) -> OpenedCamera:
    """Start our driver; backend: the virtual USB device that it speaks to, None for the computer's own USB."""
    from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
    from evetac_cli.devices.dvxplorer.protocol import DvxplorerSettings

    chosen = DvxplorerSettings(**settings.given())
    camera = DvxplorerCamera(serial, chosen, backend=backend)
    about = {"serial": camera.serial, "firmware": camera.firmware, "settings": asdict(chosen)}
    return OpenedCamera(camera, {"name": name, **about})


def _stem(name: str | Path) -> str:
    """A serial number, or a file's name without folder and endings."""
    return Path(name).name.split(".")[0]
