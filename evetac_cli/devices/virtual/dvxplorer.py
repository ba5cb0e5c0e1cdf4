"""The virtual twin of a DVXplorer Mini: a pyusb backend with one camera on its bus, of either protocol generation.

It answers like the real camera, as far as that is known. This covers descriptors, vendor requests with their lengths,
registers, and a stream only while the camera runs. Transfers are sent when they are full or after the flush time. Words
come from a source: any object with `run(on)` and `take(most, timeout_s) -> bytes` of little-endian words.

Purpose: the driver, including pyusb, runs unchanged on this backend. Three properties of the real camera are unknown
and assumed here. Packets have 1024 bytes. The buffer has 512 KiB (the memory of its USB chip) and drops the oldest
words. After stale data were flushed, no words of a stopped run follow.
"""

import errno
import time
from array import array
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NoReturn

import usb.backend
import usb.core

from evetac_cli.devices.dvxplorer import protocol
from evetac_cli.devices.dvxplorer.protocol import Generation
from evetac_cli.devices.virtual.device_model import DeviceModel, WordSource
from evetac_cli.realtime.shared_time import TimeSource

FIFO_BYTES = 512 << 10
STORE_TO_FLASH = 0xC7  # executed and logged; the driver never sends it
_STRINGS = ("iniVation", "DVXplorer Mini")
_LOG_PACKET = b"\x00\x07\x40\xe2\x01\x00sensor fault\0"


def _fail(what: str, number: int, code: int) -> NoReturn:
    kind = usb.core.USBTimeoutError if number == errno.ETIMEDOUT else usb.core.USBError
    raise kind(what, code, number)


class VirtualDvxplorer(usb.backend.IBackend):  # type: ignore[misc]  # pyusb has no types
    """One camera and its bus; pass it as `backend` to DvxplorerCamera.

    firmware: 10 takes 8-byte values, 9 and earlier 4-byte values; board: 4 for a Mini; faults: see naming.py. `model`
    is the camera behind the USB; `log` holds every executed vendor request: (request, value, index, data).
    """

    def __init__(
        self,
        source: WordSource,
        firmware: int = 10,
        serial: str = "DXM00042",
        faults: tuple[str, ...] = (),
        board: int = protocol.MINI_BOARD,
        fifo_bytes: int = FIFO_BYTES,
    ) -> None:
        super().__init__()
        self._firmware = firmware
        self._board = board
        self._strings = ("\u0409", *_STRINGS, serial)
        self._configuration = 1
        self._source = source
        self.model = DeviceModel(source, firmware, faults, fifo_bytes)
        self.log: list[tuple[int, int, int, bytes]] = []

    @property
    def time(self) -> TimeSource:
        """The time source of its words; the driver uses it too."""
        return self._source.time

    # The interface that pyusb requires of a bus.

    def enumerate_devices(self) -> Iterator[Any]:
        """Yield the camera, unless it is unplugged."""
        if not self.model.has("unplug"):
            yield self

    def get_parent(self, dev: Any) -> None:
        """Return None: the camera is not on a hub."""

    def get_device_descriptor(self, dev: Any) -> Any:
        """Return the device descriptor, as lsusb shows it."""
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0300,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=9,
            idVendor=protocol.VENDOR,
            idProduct=protocol.PRODUCT,
            bcdDevice=self._board << 8 | self._firmware,
            iManufacturer=1,
            iProduct=2,
            iSerialNumber=3,
            bNumConfigurations=1,
            address=2,
            bus=9,
            port_number=1,
            port_numbers=(1,),
            speed=3 if self.model.has("usb2") else 4,
        )

    def get_configuration_descriptor(self, dev: Any, config: int) -> Any:
        """Return the descriptor of the only configuration."""
        if config:
            raise IndexError
        numbers = {"bLength": 9, "bDescriptorType": 2, "wTotalLength": 32, "bNumInterfaces": 1}
        numbers |= {"bConfigurationValue": 1, "iConfiguration": 0, "bmAttributes": 0x80, "bMaxPower": 112}
        return SimpleNamespace(**numbers, extra_descriptors=[])

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
        """Return the descriptor of the only interface, which has no alternate settings."""
        if intf or alt:
            raise IndexError
        numbers = {"bLength": 9, "bDescriptorType": 4, "bInterfaceNumber": 0, "bAlternateSetting": 0}
        numbers |= {"bNumEndpoints": 2, "bInterfaceClass": 255, "bInterfaceSubClass": 0, "bInterfaceProtocol": 0}
        return SimpleNamespace(**numbers, iInterface=0, extra_descriptors=[])

    def get_endpoint_descriptor(self, dev: Any, ep: int, intf: int, alt: int, config: int) -> Any:
        """Return the bulk endpoint of the events or the interrupt endpoint of the log."""
        address, kind, packet = ((protocol.DATA_ENDPOINT, 2, 1024), (protocol.DEBUG_ENDPOINT, 3, 64))[ep]
        numbers = {"bLength": 7, "bDescriptorType": 5, "bEndpointAddress": address, "bmAttributes": kind}
        numbers |= {"wMaxPacketSize": packet, "bInterval": 1, "bRefresh": 0, "bSynchAddress": 0}
        return SimpleNamespace(**numbers, extra_descriptors=[])

    def open_device(self, dev: Any) -> Any:
        """Return the handle for all further calls, which is this camera; USBError without permission."""
        self._check()
        if self.model.has("no-permission"):
            _fail("Access denied (insufficient permissions)", errno.EACCES, -3)
        return self

    def close_device(self, dev_handle: Any) -> None:
        """Do nothing: a virtual camera has no resources to release."""

    def set_configuration(self, dev_handle: Any, config_value: int) -> None:
        """Set the configuration by its number."""
        self._check()
        self._configuration = config_value

    def get_configuration(self, dev_handle: Any) -> int:
        """Return the number of the configuration that is set."""
        self._check()
        return self._configuration

    def claim_interface(self, dev_handle: Any, intf: int) -> None:
        """Claim the interface; USBError (busy) if the fault is that another program has it."""
        self._check()
        if self.model.has("busy"):
            _fail("Resource busy", errno.EBUSY, -6)

    def release_interface(self, dev_handle: Any, intf: int) -> None:
        """Do nothing: a virtual camera has no resources to release."""

    def is_kernel_driver_active(self, dev_handle: Any, intf: int) -> bool:
        """Return False: no kernel driver claims this camera."""
        return False

    def clear_halt(self, dev_handle: Any, ep: int) -> None:
        """Clear a halted endpoint, unless the fault is that it cannot be cleared."""
        self._check()
        self.model.halted = self.model.has("stall-for-good")

    def ctrl_transfer(
        self,
        dev_handle: Any,
        bmRequestType: int,  # argument names of pyusb
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: Any,
        timeout: int,
    ) -> int:
        """Answer a request to the camera; unknown requests get a STALL."""
        self._check()
        if (bmRequestType, bRequest, wValue >> 8) == (0x80, 6, 3):
            text = self._strings[wValue & 0xFF].encode("utf-16-le")
            return _answer(data, bytes([len(text) + 2, 3]) + text)
        if bmRequestType == protocol.READ and bRequest == protocol.CONFIG:
            value = self.model.read(wValue, wIndex)
            if value is not None and len(data) == self.model.generation.value:
                return _answer(data, value.to_bytes(len(data), "big"))
        elif bmRequestType == protocol.WRITE and self._obeys(bRequest, wValue, wIndex, bytes(data), timeout):
            self.log.append((bRequest, wValue, wIndex, bytes(data)))
            return len(data)
        _fail("Pipe error", errno.EPIPE, -9)

    def bulk_read(self, dev_handle: Any, ep: int, intf: int, buff: "array[int]", timeout: int) -> int:
        """Read one transfer of event words into the buffer; return the number of bytes."""
        self._check()
        self.model.halted |= self.model.once("stall") or self.model.has("stall-for-good")
        if self.model.halted:
            _fail("Pipe error", errno.EPIPE, -9)
        data = self.model.transfer(len(buff), timeout / 1000)
        self._check()
        if not data:
            _fail("Operation timed out", errno.ETIMEDOUT, -7)
        return _answer(buff, data)

    def intr_read(self, dev_handle: Any, ep: int, intf: int, buff: "array[int]", timeout: int) -> int:
        """Read one packet of the debug endpoint into the buffer; return the number of bytes."""
        self._check()
        if self.model.once("log"):
            return _answer(buff, _LOG_PACKET)
        time.sleep(timeout / 1000)
        _fail("Operation timed out", errno.ETIMEDOUT, -7)

    def _obeys(self, request: int, value: int, index: int, data: bytes, timeout_ms: int) -> bool:
        """Execute a vendor request to write; return False if the camera has no such request."""
        if request == protocol.CONFIG:
            size = self.model.generation.value
            return len(data) == size and self.model.write(value, index, int.from_bytes(data, "big"))
        if self.model.generation is Generation.REGISTERS:
            return False
        if request == protocol.FLUSH_STALE:
            if self.model.has("slow-flush"):
                time.sleep(timeout_ms / 1000)
                _fail("Operation timed out", errno.ETIMEDOUT, -7)
            self.model.flush_stale()
        return request in (protocol.FLUSH_STALE, protocol.LOG_LEVEL, STORE_TO_FLASH)

    def _check(self) -> None:
        """Raise USBError (no such device) once the plug is pulled."""
        if self.model.has("unplug"):
            self.model.power_off()
            _fail("No such device (it may have been disconnected)", errno.ENODEV, -4)


def _answer(buffer: Any, data: bytes) -> int:
    """Copy as many bytes as fit into a pyusb buffer; return their number."""
    count = min(len(buffer), len(data))
    buffer[:count] = array("B", data[:count])
    return count
