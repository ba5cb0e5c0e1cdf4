"""Grippers by name, as on the command line: `--gripper /dev/ttyUSB0:1@2000000`.

`parse` turns a name into an object of one of the kinds below and touches no device; its `open` starts the driver, which
is imported only then.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from evetac_cli.devices import Gripper
from evetac_cli.devices.naming import no_such_device, number, options, parse_number
from evetac_cli.devices.rh_p12_rn.control_table import LAST_ID, SDK_RATES
from evetac_cli.devices.virtual.faults import gripper_fault
from evetac_cli.errors import InputError
from evetac_cli.names import Capability

if TYPE_CHECKING:
    from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
    from evetac_cli.devices.virtual.gripper import VirtualGripper
    from evetac_cli.devices.virtual.servo_plant import SharedPlant

NAMES = "sim, virtual, none, or a PORT[:ID][@BAUD] such as /dev/ttyUSB0, /dev/ttyUSB0:5 or /dev/ttyUSB0@57600"
PORT_BEGINS = ("/", "./", "COM", "tty")
_OF_A_PATH = re.compile(r"\d\.\d|/")  # what is behind a colon of a port's own name
BAUD, ID = 2_000_000, 1  # where none is named
# A virtual servo answers when the computer lets it run, which a busy one may not do for a tenth of a second.
VIRTUAL_ANSWER_MS = 200.0
VIRTUAL_WATCHDOG_MS = 1000
VIRTUAL_WATCHDOG_FACTOR = 5  # how much longer a watchdog time that was asked for is for virtual devices

Mode = Literal["current", "position"]


@dataclass(frozen=True)
class NamedGripper:
    """A gripper as it was named, before it is opened."""

    name: ClassVar[str]
    capabilities: ClassVar[frozenset[Capability]] = frozenset({Capability.MOVED})  # what commands may expect of it
    watchdog_ms: int | None = field(default=None, kw_only=True)  # asked for; None: the driver's

    def has(self, capability: Capability) -> bool:
        """Whether commands may expect this of it."""
        return capability in self.capabilities

    @property
    def port(self) -> str:
        """The serial port at which it is; empty where it has none of its own."""
        return ""

    @property
    def baud(self) -> int:
        """Bits a second on the wire."""
        return BAUD

    @property
    def id(self) -> int:
        """Its number on the wire."""
        return ID

    def __str__(self) -> str:
        return self.name

    def settings(self, **asked: Any) -> "RhP12RnSettings":
        """The driver's settings with what is asked for, as this gripper can keep them: a virtual one gets more time.

        ValueError for what no gripper can keep.
        """
        from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings

        watchdog = {} if self.watchdog_ms is None else {"watchdog_ms": self.watchdog_ms}
        return RhP12RnSettings(id=self.id, **watchdog | asked)

    def open_peer(self, plant: "SharedPlant | None") -> "VirtualGripper | None":
        """Start the virtual servo behind the port; None where the servo is real, or there is none."""
        return None

    def open(self, mode: Mode, port: str) -> tuple[Gripper | None, Any]:
        """The gripper at a port, and what it is and how it is set (for a header); DeviceError if it does not answer."""
        from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn

        driver = RhP12Rn(port, self.baud, mode, self.settings())
        return driver, self.setup(driver.described)

    def setup(self, described: Mapping[str, Any]) -> dict[str, Any]:
        """What a header says of a gripper that its driver describes so."""
        return {"name": self.name, **{key: value for key, value in described.items() if key != "eeprom_written"}}


@dataclass(frozen=True)
class NoGripper(NamedGripper):
    """`none`: a camera alone."""

    name = "none"
    capabilities = frozenset()

    def open(self, mode: Mode, port: str) -> tuple[Gripper | None, Any]:
        """There is nothing to open."""
        return None, self.name


@dataclass(frozen=True)
class Simulated(NamedGripper):
    """`sim`: the gripper of a simulated scene; devices.simulated builds it together with the camera."""

    name = "sim"
    capabilities = frozenset({Capability.STEPPED})


@dataclass(frozen=True)
class Virtual(NamedGripper):
    """`virtual[:FAULT+FAULT...]`: the real driver before a virtual servo, in real time."""

    name = "virtual"
    faults: tuple[str, ...] = ()

    def settings(self, **asked: Any) -> "RhP12RnSettings":
        """Longer times, because the computer that simulates the servo stops it now and then."""
        kept = super().settings(**asked)
        is_asked = "watchdog_ms" in asked or self.watchdog_ms is not None
        watchdog_ms = VIRTUAL_WATCHDOG_FACTOR * kept.watchdog_ms if is_asked else VIRTUAL_WATCHDOG_MS
        return replace(kept, answer_ms=VIRTUAL_ANSWER_MS, watchdog_ms=watchdog_ms)

    def open_peer(self, plant: "SharedPlant | None") -> "VirtualGripper | None":
        """Start the virtual servo; plant: the finger that it moves, None for one of its own."""
        from evetac_cli.devices.virtual.gripper import VirtualGripper

        return VirtualGripper(plant, self.faults)


@dataclass(frozen=True)
class Serial(NamedGripper):
    """`PORT[:ID][@BAUD]`: a ROBOTIS RH-P12-RN(A) at a serial port."""

    name = "port"
    capabilities = frozenset({Capability.MOVED, Capability.HARDWARE})
    port: str = ""
    baud: int = BAUD
    id: int = ID

    def __str__(self) -> str:
        return f"{self._of_id}@{self.baud}"

    @property
    def shortest(self) -> str:
        """The shortest name for it: id and rate only where they are not the usual ones."""
        return self._of_id if self.baud == BAUD else str(self)

    @property
    def _of_id(self) -> str:
        return self.port if self.id == ID else f"{self.port}:{self.id}"


def parse(text: str) -> NamedGripper:
    """Understand --gripper; InputError if there is no such gripper, or no such fault of a virtual one."""
    kind, _, rest = text.partition(":")
    if kind == Virtual.name:
        faults = options(rest)
        for each in faults:
            gripper_fault(each)
        return Virtual(faults)
    if text == Simulated.name:
        return Simulated()
    if text == NoGripper.name:
        return NoGripper()
    if text.startswith(PORT_BEGINS):
        return parse_port(text)
    raise no_such_device("gripper", NAMES, text, (Simulated.name, Virtual.name, NoGripper.name))


def parse_port(text: str) -> Serial:
    """Understand PORT[:ID][@BAUD]; InputError for an id or a rate that no gripper can have.

    A port may have colons of its own, as /dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0: what stands behind the
    last one is an id unless it is like `1.0`, or has a slash.
    """
    named, at, rate = text.rpartition("@") if "@" in text else (text, "", "")
    if ":" in rate:
        raise InputError("the id comes before the baud rate", where="--gripper", expected="PORT:ID@BAUD", found=text)
    bauds = [each for each in SDK_RATES if number(rate) == each] if at else [BAUD]
    if not bauds:
        rates = ", ".join(map(str, SDK_RATES))
        raise InputError("no such baud rate", where="--gripper PORT@BAUD", expected=f"one of {rates}", found=text)
    port, colon, last = named.rpartition(":")
    if not colon or _OF_A_PATH.search(last):
        return Serial(named, bauds[0])
    return Serial(port, bauds[0], int(parse_number(last, 0, LAST_ID, "--gripper PORT:ID", text, whole=True)))
