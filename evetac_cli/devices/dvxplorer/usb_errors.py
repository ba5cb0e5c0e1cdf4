"""Errors of a camera on USB for the user: where, what was expected and found, and what to do."""

import errno

from evetac_cli.errors import DeviceError, DeviceTimeout, install_hint

_GONE = (errno.ENODEV, errno.ENOENT, errno.ESHUTDOWN)
_UNPLUGGED = (
    DeviceError,
    "is no longer on the bus",
    "plug it in again, in a USB 3 port and with a firm cable; what was recorded until now is kept",
)
_BY_ERRNO: dict[int | None, tuple[type[DeviceError], str, str]] = {
    **dict.fromkeys(_GONE, _UNPLUGGED),
    errno.EACCES: (
        DeviceError,
        "may not be opened by you",
        "install the udev rule that `evetac doctor --print-udev` prints, and plug the camera in again",
    ),
    errno.EBUSY: (
        DeviceError,
        "is used by another program",
        "close DV, ROS nodes or another evetac that have it open",
    ),
    errno.ETIMEDOUT: (DeviceTimeout, "did not answer in time", "unplug the camera and plug it in again"),
}
_OTHER = (DeviceError, "refused, or the link is bad", "plug it in again, without a hub")
_BOARDS = {0: "an FX2 board", 1: "a DVXplorer (FX3)", 2: "a DVXplorer (FX3)", 3: "a DVXplorer (FX3)", 5: "an FX3 gen2"}


def gone(error: OSError) -> bool:
    """Whether the device is no longer there, so that trying again is no use."""
    return error.errno in _GONE


def device_error(error: OSError, where: str, doing: str) -> DeviceError:
    """The DeviceError for an error of libusb; `doing` says what was being done, as in `reading events`."""
    message = f"{error.strerror or error} (errno {error.errno}) while {doing}"
    kind, what, hint = _BY_ERRNO.get(error.errno, _OTHER)
    return kind(what, where=where, found=message, hint=hint)


def no_libusb() -> DeviceError:
    """Libusb cannot be loaded."""
    return DeviceError(
        "there is no libusb",
        where="--camera dvxplorer",
        expected="the shared library that the package libusb-package brings",
        hint=install_hint(),
    )


def wrong_model(where: str, board: int) -> DeviceError:
    """The camera is a DVXplorer whose board is not that of a Mini, and whose events come in another format."""
    return DeviceError(
        "is not a DVXplorer Mini",
        where=where,
        expected="board 4 (bcdDevice 0x04..), the Mini or Micro",
        found=f"board {board}: {_BOARDS.get(board, 'unknown')}",
        hint="its events come in another format; record with DV and import: evetac record --from FILE.aedat4",
    )


def not_found(serial: str | None, on_bus: list[str]) -> DeviceError:
    """No camera, not the wanted one, or several where one is wanted; on_bus: serial numbers of those that are there."""
    several = serial is None and len(on_bus) > 1
    return DeviceError(
        "there are several cameras" if several else "there is no such camera",
        where=f"--camera dvxplorer{':' + serial if serial else ''}",
        expected="one DVXplorer Mini (USB 152a:8419)" + (f" with serial number {serial}" if serial else ""),
        found=", ".join(on_bus) or "none on the bus",
        hint="name one: --camera dvxplorer:SERIAL" if several else "plug it in, and ask `evetac doctor` what is wrong",
    )


def not_ready(where: str) -> DeviceError:
    """The camera shows no data endpoint: just after it was plugged in, or in its boot loader."""
    return DeviceError(
        "is not ready",
        where=where,
        expected="a bulk endpoint 0x82",
        found="none",
        hint="wait two seconds after plugging it in; if that does not help, its firmware has to be flashed again",
    )


def other_sensor(where: str, size: tuple[int, int]) -> DeviceError:
    """The camera's sensor has another size (columns, rows) than this driver knows."""
    return DeviceError("has another sensor", where=where, expected="640 x 480", found=f"{size[0]} x {size[1]}")
