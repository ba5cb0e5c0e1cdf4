"""Grippers by name, as on the command line: `--gripper /dev/ttyUSB0@2000000`.

`parse` turns a name into an object of one of the kinds below and touches no device; its `open` starts the driver, which
is imported only then.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from evetac_cli.devices import Gripper
from evetac_cli.devices.naming import no_such_device, parse_number
from evetac_cli.devices.virtual.faults import gripper_fault

if TYPE_CHECKING:
    from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
    from evetac_cli.devices.virtual.gripper import VirtualGripper
    from evetac_cli.devices.virtual.servo_plant import SharedPlant

NAMES = "sim, virtual, none, or a PORT[@BAUD] such as /dev/ttyUSB0@2000000"
PORT_BEGINS = ("/", "./", "COM", "tty")
BAUD = 2_000_000
# A virtual servo answers when the computer lets it run, which a busy one may not do for a tenth of a second.
VIRTUAL_ANSWER_MS = 200.0
VIRTUAL_WATCHDOG_MS = 1000
VIRTUAL_WATCHDOG_FACTOR = 5  # how much longer a watchdog time that was asked for is for virtual devices

Mode = Literal["current", "position"]


@dataclass(frozen=True)
class NamedGripper:
    """A gripper as it was named, before it is opened; the class variables say what commands may expect of its kind."""

    name: ClassVar[str]
    is_stepped: ClassVar[bool] = False  # part of a simulation whose time passes as slices are read
    is_hardware: ClassVar[bool] = False  # it moves real fingers
    is_moved: ClassVar[bool] = True  # commands move it
    watchdog_ms: int | None = field(default=None, kw_only=True)  # asked for; None: the driver's

    @property
    def port(self) -> str:
        """The serial port at which it is; empty where it has none of its own."""
        return ""

    @property
    def baud(self) -> int:
        """Bits a second on the wire."""
        return BAUD

    def __str__(self) -> str:
        return self.name

    def patient(self, settings: "RhP12RnSettings") -> "RhP12RnSettings":
        """The settings that were asked for, as this gripper can keep them: a virtual one gets more time."""
        return settings

    def default_settings(self) -> "RhP12RnSettings":
        """The driver's settings where nothing is asked for."""
        from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings

        return RhP12RnSettings() if self.watchdog_ms is None else RhP12RnSettings(watchdog_ms=self.watchdog_ms)

    def open_peer(self, plant: "SharedPlant | None") -> "VirtualGripper | None":
        """Start the virtual servo behind the port; None where the servo is real, or there is none."""
        return None

    def open(self, mode: Mode, port: str) -> tuple[Gripper | None, Any]:
        """The gripper at a port, and what it is and how it is set (for a header); DeviceError if it does not answer."""
        from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn

        driver = RhP12Rn(port, self.baud, mode, self.default_settings())
        return driver, self.setup(driver.described)

    def setup(self, described: Mapping[str, Any]) -> dict[str, Any]:
        """What a header says of a gripper that its driver describes so."""
        return {"name": self.name, **{key: value for key, value in described.items() if key != "eeprom_written"}}


@dataclass(frozen=True)
class NoGripper(NamedGripper):
    """`none`: a camera alone."""

    name = "none"
    is_moved = False

    def open(self, mode: Mode, port: str) -> tuple[Gripper | None, Any]:
        """There is nothing to open."""
        return None, self.name


@dataclass(frozen=True)
class Simulated(NamedGripper):
    """`sim`: the gripper of a simulated scene; devices.simulated builds it together with the camera."""

    name = "sim"
    is_stepped = True


@dataclass(frozen=True)
class Virtual(NamedGripper):
    """`virtual[:FAULT+FAULT...]`: the real driver before a virtual servo, in real time."""

    name = "virtual"
    faults: tuple[str, ...] = ()

    def patient(self, settings: "RhP12RnSettings") -> "RhP12RnSettings":
        """Longer times, because the computer that simulates the servo stops it now and then."""
        watchdog_ms = VIRTUAL_WATCHDOG_FACTOR * settings.watchdog_ms
        return replace(settings, answer_ms=VIRTUAL_ANSWER_MS, watchdog_ms=watchdog_ms)

    def default_settings(self) -> "RhP12RnSettings":
        """Times that a busy computer can keep."""
        if self.watchdog_ms is not None:
            return self.patient(super().default_settings())
        return replace(super().default_settings(), answer_ms=VIRTUAL_ANSWER_MS, watchdog_ms=VIRTUAL_WATCHDOG_MS)

    def open_peer(self, plant: "SharedPlant | None") -> "VirtualGripper | None":
        """Start the virtual servo; plant: the finger that it moves, None for one of its own."""
        from evetac_cli.devices.virtual.gripper import VirtualGripper

        return VirtualGripper(plant, self.faults)


@dataclass(frozen=True)
class Serial(NamedGripper):
    """`PORT[@BAUD]`: a ROBOTIS RH-P12-RN(A) at a serial port."""

    name = "port"
    is_hardware = True
    port: str = ""
    baud: int = BAUD

    def __str__(self) -> str:
        return f"{self.port}@{self.baud}"


def parse(text: str) -> NamedGripper:
    """Understand --gripper; InputError if there is no such gripper, or no such fault of a virtual one."""
    kind, _, rest = text.partition(":")
    if kind == Virtual.name:
        faults = tuple(filter(None, rest.split("+")))
        for each in faults:
            gripper_fault(each)
        return Virtual(faults)
    if text == Simulated.name:
        return Simulated()
    if text == NoGripper.name:
        return NoGripper()
    if text.startswith(PORT_BEGINS):
        port, at, baud = text.partition("@")
        return Serial(port, int(parse_number(baud, "--gripper PORT@BAUD", text)) if at else BAUD)
    raise no_such_device("gripper", NAMES, text, (Simulated.name, Virtual.name, NoGripper.name))
