"""Error messages for a USB camera: location, expected and found values, and what to do."""

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
        "you have no permission to open it",
        "install the udev rule that `evetac doctor --print-udev` prints, and plug the camera in again",
    ),
    errno.EBUSY: (
        DeviceError,
        "is used by another program",
        "close DV, the ROS node or the other evetac that has it open",
    ),
    errno.ETIMEDOUT: (DeviceTimeout, "did not answer in time", "unplug the camera and plug it in again"),
}
_OTHER = (DeviceError, "refused the request, or the USB connection is bad", "plug it in again, without a hub")
_BOARDS = {0: "an FX2 board", 1: "a DVXplorer (FX3)", 2: "a DVXplorer (FX3)", 3: "a DVXplorer (FX3)", 5: "an FX3 gen2"}


def gone(error: OSError) -> bool:
    """Return whether the device has gone, so that another attempt is useless."""
    return error.errno in _GONE


def device_error(error: OSError, where: str, doing: str) -> DeviceError:
    """Return the DeviceError for an error of libusb; `doing` names the action, for example `reading events`."""
    message = f"{error.strerror or error} (errno {error.errno}) while {doing}"
    kind, what, hint = _BY_ERRNO.get(error.errno, _OTHER)
    return kind(what, where=where, found=message, hint=hint)


def no_libusb() -> DeviceError:
    """Return the error for a missing libusb."""
    return DeviceError(
        "libusb was not found",
        where="--camera dvxplorer",
        expected="the shared library from the package libusb-package",
        hint=install_hint(),
    )


def wrong_model(where: str, board: int) -> DeviceError:
    """Return the error for a DVXplorer that is not a Mini and whose events have another format."""
    return DeviceError(
        "is not a DVXplorer Mini",
        where=where,
        expected="board 4 (bcdDevice 0x04..), the Mini or Micro",
        found=f"board {board}: {_BOARDS.get(board, 'unknown')}",
        hint="its events come in another format; record with DV and import: evetac record --from FILE.aedat4",
    )


def not_found(serial: str | None, on_bus: list[str]) -> DeviceError:
    """Return the error if no camera, the wrong one, or several were found; on_bus: the serial numbers found."""
    several = serial is None and len(on_bus) > 1
    return DeviceError(
        "there are several cameras" if several else "there is no such camera",
        where=f"--camera dvxplorer{':' + serial if serial else ''}",
        expected="one DVXplorer Mini (USB 152a:8419)" + (f" with serial number {serial}" if serial else ""),
        found=", ".join(on_bus) or "none on the bus",
        hint="name one: --camera dvxplorer:SERIAL"
        if several
        else "plug it in, or run `evetac doctor` to find the fault",
    )


def not_ready(where: str) -> DeviceError:
    """Return the error for a camera without a data endpoint: it was just plugged in, or is in its boot loader."""
    return DeviceError(
        "is not ready",
        where=where,
        expected="a bulk endpoint 0x82",
        found="none",
        hint="wait two seconds after plugging it in; if that does not help, flash its firmware again",
    )


def other_sensor(where: str, size: tuple[int, int]) -> DeviceError:
    """Return the error for a sensor whose size (columns, rows) this driver does not support."""
    return DeviceError("has a different sensor", where=where, expected="640 x 480", found=f"{size[0]} x {size[1]}")
