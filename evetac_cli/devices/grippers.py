"""Grippers by name, as on the command line: `--gripper /dev/ttyUSB0:1@2000000`.

`parse` turns a name into an object of a kind below, or of a plug-in's kind, and touches no device. The object's `open`
starts the driver, which is imported only then.
"""

import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from evetac_cli import names, plugins
from evetac_cli.devices import Gripper
from evetac_cli.devices.naming import gripper_fault, no_such_device, number, options, parse_number
from evetac_cli.devices.rh_p12_rn.control_table import LAST_ID, SDK_RATES
from evetac_cli.errors import InputError
from evetac_cli.names import Capability

if TYPE_CHECKING:
    from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
    from evetac_cli.devices.virtual.gripper import VirtualGripper
    from evetac_cli.devices.virtual.servo_plant import SharedPlant

PORT_BEGINS = ("/", "./", "COM", "tty")
_OF_A_PATH = re.compile(r"\d\.\d|/")  # text after a colon that belongs to the port's own name
BAUD, ID = 2_000_000, 1  # defaults if none is named
# A virtual servo answers only when the computer runs its process, which a busy one may delay by a tenth of a second.
VIRTUAL_ANSWER_MS = 200.0
VIRTUAL_WATCHDOG_MS = 1000
VIRTUAL_WATCHDOG_FACTOR = 5  # factor on a requested watchdog time for virtual devices

Mode = Literal["current", "position"]


@dataclass(frozen=True)
class NamedGripper:
    """A gripper as it was named, before it is opened.

    Each kind of gripper is a subclass: a frozen dataclass, because it is sent to other processes. It defines `name`,
    `capabilities`, `open`, and the properties in which it differs from most others.
    """

    name: ClassVar[str]
    # What commands may expect of it. Without HARDWARE it may be moved without --arm, so a kind must leave out HARDWARE
    # explicitly.
    capabilities: ClassVar[frozenset[Capability]] = frozenset({Capability.MOVED, Capability.HARDWARE})
    watchdog_ms: int | None = field(default=None, kw_only=True)  # requested; None: the driver's default

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse the text after the colon of the name; InputError for an unknown option."""
        if text:
            raise no_such_device("gripper", cls.name, f"{cls.name}:{text}", (cls.name,))
        return cls()

    def has(self, capability: Capability) -> bool:
        """Return whether commands may expect this of the gripper."""
        return capability in self.capabilities

    @property
    def port(self) -> str:
        """The serial port of the gripper; empty if it has none."""
        return ""

    @property
    def baud(self) -> int:
        """Bits per second on the wire."""
        return BAUD

    @property
    def id(self) -> int:
        """The gripper's id on the wire."""
        return ID

    def __str__(self) -> str:
        return self.name

    def settings(self, **requested: Any) -> "RhP12RnSettings":
        """Return settings with the requested values, adapted to this gripper: a virtual one gets more time.

        A driver of another gripper ignores settings that it does not use. ValueError for values that no gripper can
        have.
        """
        from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings

        watchdog = {} if self.watchdog_ms is None else {"watchdog_ms": self.watchdog_ms}
        return RhP12RnSettings(id=self.id, **watchdog | requested)

    def open_peer(self, plant: "SharedPlant | None") -> "VirtualGripper | None":
        """Start the virtual servo behind the port; None if the servo is real or there is none."""
        return None

    def open(self, mode: Mode, port: str, settings: "RhP12RnSettings | None" = None) -> tuple[Gripper | None, Any]:
        """Return the gripper, and its identity and settings for a header; DeviceError if it does not answer.

        port: the gripper's serial port, empty if it has none; settings: None for the defaults.
        """
        raise NotImplementedError(f"{self.name} has no driver")

    def release(self, port: str, settings: "RhP12RnSettings") -> str:
        """Switch torque off after the process that commanded the gripper has died.

        Return a sentence on what was read back.
        """
        return "the state of torque is unknown"


class RhP12RnGripper(NamedGripper):
    """A ROBOTIS RH-P12-RN(A) through evetac's driver; a real one unless the kind is virtual."""

    def open(self, mode: Mode, port: str, settings: "RhP12RnSettings | None" = None) -> tuple[Gripper | None, Any]:
        """Start the driver on a port."""
        from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn

        driver = RhP12Rn(port, self.baud, mode, settings or self.settings())
        described = {key: value for key, value in driver.described.items() if key != "eeprom_written"}
        return driver, {"name": self.name, **described}

    def release(self, port: str, settings: "RhP12RnSettings") -> str:
        """Open the port again, which is free once that process has ended, and switch torque off."""
        from evetac_cli.devices.rh_p12_rn.torque import release

        return release(port, self.baud, id_=settings.id, watchdog_ms=settings.watchdog_ms, answer_ms=settings.answer_ms)


@dataclass(frozen=True)
class NoGripper(NamedGripper):
    """`none`: a camera without a gripper."""

    name = "none"
    capabilities = frozenset()

    def open(self, mode: Mode, port: str, settings: "RhP12RnSettings | None" = None) -> tuple[Gripper | None, Any]:
        """Return no gripper: there is nothing to open."""
        return None, self.name


@dataclass(frozen=True)
class Simulated(NamedGripper):
    """`sim`: the gripper of a simulated scene; devices.simulated builds it together with the camera."""

    name = "sim"
    capabilities = frozenset({Capability.STEPPED})


@dataclass(frozen=True)
class Virtual(RhP12RnGripper):
    """`virtual[:FAULT+FAULT...]`: the real driver on a virtual servo, in real time."""

    name = "virtual"
    capabilities = frozenset({Capability.MOVED})
    faults: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse faults, joined by +; InputError for anything else."""
        faults = options(text)
        for each in faults:
            gripper_fault(each)
        return cls(faults)

    def settings(self, **requested: Any) -> "RhP12RnSettings":
        """Return settings with longer times, because the computer that simulates the servo pauses it now and then."""
        kept = super().settings(**requested)
        is_requested = "watchdog_ms" in requested or self.watchdog_ms is not None
        watchdog_ms = VIRTUAL_WATCHDOG_FACTOR * kept.watchdog_ms if is_requested else VIRTUAL_WATCHDOG_MS
        return replace(kept, answer_ms=VIRTUAL_ANSWER_MS, watchdog_ms=watchdog_ms)

    def open_peer(self, plant: "SharedPlant | None") -> "VirtualGripper | None":
        """Start the virtual servo; plant: the finger that it moves, None for its own."""
        from evetac_cli.devices.virtual.gripper import VirtualGripper

        return VirtualGripper(plant, self.faults)


@dataclass(frozen=True)
class Serial(RhP12RnGripper):
    """`PORT[:ID][@BAUD]`: a ROBOTIS RH-P12-RN(A) on a serial port."""

    name = "port"
    port: str = ""
    baud: int = BAUD
    id: int = ID

    def __str__(self) -> str:
        return f"{self._of_id}@{self.baud}"

    @property
    def shortest(self) -> str:
        """The shortest name of the gripper: with id and rate only if they differ from the defaults."""
        return self._of_id if self.baud == BAUD else str(self)

    @property
    def _of_id(self) -> str:
        return self.port if self.id == ID else f"{self.port}:{self.id}"


# Kinds of gripper by the text before the colon, except ports.
KINDS: dict[str, type[NamedGripper]] = {kind.name: kind for kind in (Simulated, Virtual, NoGripper)}


def parse(text: str) -> NamedGripper:
    """Parse --gripper; InputError if no built-in or plug-in kind has this name, or the kind has no such option."""
    if text.startswith(PORT_BEGINS):
        return parse_port(text)
    name, _, rest = text.partition(":")
    kind = KINDS.get(name) or plugins.find(plugins.GRIPPERS, name, NamedGripper)
    if kind is None:
        others = plugins.usable(plugins.GRIPPERS)
        expected = f"{names.either([*others, *names.GRIPPERS])} such as /dev/ttyUSB0, /dev/ttyUSB0:5@57600"
        raise no_such_device("gripper", expected, text, (*KINDS, *others))
    return kind.parse(rest)


def parse_port(text: str) -> Serial:
    """Parse PORT[:ID][@BAUD]; InputError for an id or a rate that no gripper can have.

    A port's own name may contain colons, for example /dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0. The text
    after the last colon is an id, unless it looks like `1.0` or contains a slash.
    """
    port_and_id, at, rate = text.rpartition("@") if "@" in text else (text, "", "")
    if ":" in rate:
        raise InputError("the id comes before the baud rate", where="--gripper", expected="PORT:ID@BAUD", found=text)
    bauds = [each for each in SDK_RATES if number(rate) == each] if at else [BAUD]
    if not bauds:
        rates = ", ".join(map(str, SDK_RATES))
        raise InputError("no such baud rate", where="--gripper PORT@BAUD", expected=f"one of {rates}", found=text)
    port, colon, last = port_and_id.rpartition(":")
    if not colon or _OF_A_PATH.search(last):
        return Serial(port_and_id, bauds[0])
    return Serial(port, bauds[0], int(parse_number(last, 0, LAST_ID, "--gripper PORT:ID", text, whole=True)))
