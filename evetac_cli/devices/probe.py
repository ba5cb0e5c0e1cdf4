"""The queries of `evetac doctor` to a machine: USB cameras, serial ports and their grippers; it changes nothing.

All queries go through one object, so that tests can substitute folders for /sys and /proc, and virtual devices for real
ones.
"""

import re
import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import libusb_package
import usb.core
import usb.util

from evetac_cli.devices.dvxplorer import protocol
from evetac_cli.devices.dvxplorer.camera import CONTROL_TIMEOUT_MS, FoundCamera, find_cameras
from evetac_cli.devices.rh_p12_rn.control_table import SDK_RATES
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import ANSWER_MS, Bus, BusDevice, latency_timer_ms, scan
from evetac_cli.errors import programs_using

FTDI = "0403"  # USB vendor of the chip in ROBOTIS' U2D2
# Registers read from a gripper that answers.
READ = (
    "Firmware Version",
    "Return Delay Time",
    "Operating Mode",
    "Hardware Error Status",
    "Torque Enable",
    "Current Limit",
    "Present Input Voltage",
    "Min Voltage Limit",
    "Max Voltage Limit",
    "Present Temperature",
    "Temperature Limit",
    "Present Position",
    "Min Position Limit",
    "Max Position Limit",
)


class SerialPort(NamedTuple):
    """A port of a USB adapter, as described in sysfs."""

    path: Path
    vendor: str  # four hexadecimal digits, or empty
    product: str


class CameraAnswer(NamedTuple):
    """The result of opening a camera: errno (0 for success), message, and the size of its sensor."""

    errno: int
    message: str
    frame_px: tuple[int, int] | None


@dataclass(frozen=True)
class Host:
    """The machine that evetac runs on, or one that a test makes up."""

    sysfs: Path = Path("/sys")
    proc: Path = Path("/proc")
    dev: Path = Path("/dev")
    usb_backend: Any = None  # a pyusb backend; None: libusb
    answer_ms: float = ANSWER_MS
    broadcast_ms: float = 0.0  # how long to wait for answers to a broadcast, in ms; 0: as long as the maker's SDK does
    rates: tuple[int, ...] = SDK_RATES

    def has_libusb(self) -> bool:
        """Return whether a USB library is available."""
        return self.usb_backend is not None or libusb_package.get_libusb1_backend() is not None

    def cameras(self) -> list[FoundCamera]:
        """Return all DVXplorer cameras on USB, whether or not they can be opened."""
        return find_cameras(self.usb_backend)

    def ask_camera(self, camera: FoundCamera) -> CameraAnswer:
        """Open and claim a camera, read the size of its sensor, and release it."""
        size = protocol.generation(camera.firmware).value
        device = camera.device
        try:
            usb.util.claim_interface(device, 0)
            columns, rows = (
                int.from_bytes(
                    bytes(
                        device.ctrl_transfer(
                            protocol.READ, protocol.CONFIG, protocol.DVS, which, size, CONTROL_TIMEOUT_MS
                        )
                    ),
                    "big",
                )
                for which in (protocol.COLUMNS, protocol.ROWS)
            )
        except (usb.core.USBError, ValueError, NotImplementedError) as error:
            number = getattr(error, "errno", None) or -1
            return CameraAnswer(number, f"{getattr(error, 'strerror', None) or error} (errno {number})", None)
        finally:
            with suppress(usb.core.USBError):
                usb.util.dispose_resources(device)
        return CameraAnswer(0, "", (columns, rows))

    def serial_ports(self) -> list[SerialPort]:
        """Return the serial ports of USB adapters, from sysfs."""
        ports = []
        for entry in sorted((self.sysfs / "class" / "tty").glob("tty[UA][SC][BM]*")):
            vendor = product = ""
            for folder in (entry / "device").resolve().parents:
                if (folder / "idVendor").is_file():
                    vendor, product = ((folder / name).read_text().strip() for name in ("idVendor", "idProduct"))
                    break
            ports.append(SerialPort(self.dev / entry.name, vendor, product))
        return ports

    def latency_ms(self, port: Path) -> int | None:
        """Return how long the adapter of a port holds back an answer, in ms; None if it has no such timer."""
        return latency_timer_ms(str(port), self.sysfs / "bus" / "usb-serial" / "devices")

    def programs_using(self, path: Path) -> list[str]:
        """Return this user's programs that have a file open, as `name (pid)`; those of other users are not visible."""
        return programs_using(path, self.proc)

    def scan(self, port: Path, id_: int = 1) -> list[BusDevice]:
        """Return the grippers on a port.

        This id is searched at every rate; other ids only at the rates where it answered, or at all rates if it did not.
        """
        of_id = scan(str(port), self.rates, (id_,), answer_ms=self.answer_ms)
        devices = {(each.baud, each.id): each for each in of_id}
        for baud in {each.baud for each in of_id} or self.rates:
            with Bus(str(port), baud, answer_ms=self.answer_ms) as bus:
                for other, (model, _) in bus.devices(self.broadcast_ms).items():
                    devices.setdefault((baud, other), BusDevice(baud, other, model))
        return list(devices.values())

    def registers(self, port: Path, gripper: BusDevice, names: Iterable[str] = READ) -> dict[str, int]:
        """Return values of a gripper's registers by name; DeviceError if it does not answer."""
        with Bus(str(port), gripper.baud, gripper.id, answer_ms=self.answer_ms) as bus:
            bus.tolerant = True  # a reported hardware error is part of the result
            return {name: bus.read(name) for name in names}

    def free_bytes(self, folder: Path) -> int:
        """Return the number of free bytes on the disk of a folder."""
        return shutil.disk_usage(folder).free

    def has_package(self, name: str) -> bool:
        """Return whether the module `name` is installed; it is not imported."""
        return find_spec(name) is not None

    def missing_libraries(self) -> list[str]:
        """Return the distributions that evetac needs without extras and that are not installed."""
        try:
            needed = [one for one in metadata.requires("evetac") or () if "extra ==" not in one]
        # evetac runs from its folder without being installed, so its requirements are not recorded
        except metadata.PackageNotFoundError:
            return []
        names = [re.split(r"[^\w.-]", one)[0] for one in needed]
        return [name for name in names if not self.distributions([name])]

    def distributions(self, names: Iterable[str]) -> list[str]:
        """Return those of some distributions that are installed, with their versions."""
        installed = []
        for name in names:
            with suppress(metadata.PackageNotFoundError):
                installed.append(f"{name} {metadata.version(name)}")
        return installed
