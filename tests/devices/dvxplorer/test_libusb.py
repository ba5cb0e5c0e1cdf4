"""Our driver over the real libusb, and the maker's own driver (dv-processing 2), both on our virtual camera.

Their libusb meets a faked Linux (fake_usbfs.c), whose requests threads here hand on to the virtual camera. Skipped
where there is no C compiler, or no dv-processing.
"""

import errno
import os
import shutil
import socket
import struct
import subprocess
import sys
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
import usb.core

from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.devices.dvxplorer.protocol import DVS, RUN, DvxplorerSettings, Generation, configure
from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer
from evetac_cli.devices.virtual.word_sources import PreparedWords, random_event_words
from evetac_cli.events import Events

pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None or sys.platform != "linux" or not Path("/usr/include/linux/usbdevice_fs.h").exists(),
    reason="needs a C compiler and the headers of Linux",
)

REPOSITORY = Path(__file__).resolve().parents[3]
AS_THE_MAKER = DvxplorerSettings(flush_us=2000)
WAIT_MS = 20  # of a bulk transfer, after which its request is put again

# Programs on the other side: they print what was wrong, if anything, and save the events. Ours is patient, because
# this camera is a process that may be kept from running.
MAKERS = """
import sys, time
from datetime import timedelta
import numpy as np
import dv_processing as dv

camera = dv.io.camera.DVXplorerM()
camera.setTimeInterval(timedelta(microseconds=1000))
parts, end = [], time.monotonic() + float(sys.argv[2])
while time.monotonic() < end:
    batch = camera.getNextEventBatch()
    if batch is None:
        time.sleep(0.001)
    elif batch.size():
        parts.append(batch.numpy())
rows = np.concatenate(parts)
np.savez(sys.argv[1], t=rows["timestamp"], x=rows["x"], y=rows["y"], p=rows["polarity"])
print(camera.getCameraName())
"""
OURS = """
import sys
import numpy as np
from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
from evetac_cli.errors import DeviceError
from evetac_cli.events import concatenate

camera = DvxplorerCamera("DXM00042", patience_us=1_000_000)
parts = []
try:
    for _ in range(int(1000 * float(sys.argv[2]))):
        parts.append(camera.read())
except DeviceError as error:
    print(error)
np.savez(sys.argv[1], **concatenate(parts)._asdict())
print({name: count for name, count in camera.counted.items() if count}, *camera.notes)
camera.close()
"""


def descriptors(device: VirtualDvxplorer) -> bytes:
    """What Linux shows of a device in /sys: its descriptors, as on the wire."""
    about = device.get_device_descriptor(device)
    names = ("bLength", "bDescriptorType", "bcdUSB", "bDeviceClass", "bDeviceSubClass", "bDeviceProtocol")
    names += ("bMaxPacketSize0", "idVendor", "idProduct", "bcdDevice", "iManufacturer", "iProduct", "iSerialNumber")
    parts = [struct.pack("<BBHBBBBHHHBBBB", *(getattr(about, name) for name in names), about.bNumConfigurations)]
    config = device.get_configuration_descriptor(device, 0)
    names = ("bLength", "bDescriptorType", "wTotalLength", "bNumInterfaces", "bConfigurationValue", "iConfiguration")
    parts.append(
        struct.pack("<BBHBBBBB", *(getattr(config, name) for name in names), config.bmAttributes, config.bMaxPower)
    )
    face = device.get_interface_descriptor(device, 0, 0, 0)
    names = ("bLength", "bDescriptorType", "bInterfaceNumber", "bAlternateSetting", "bNumEndpoints", "bInterfaceClass")
    names += ("bInterfaceSubClass", "bInterfaceProtocol", "iInterface")
    parts.append(bytes(getattr(face, name) for name in names))
    names = ("bLength", "bDescriptorType", "bEndpointAddress", "bmAttributes", "wMaxPacketSize", "bInterval")
    for index in range(2):
        end = device.get_endpoint_descriptor(device, index, 0, 0, 0)
        parts.append(struct.pack("<BBBBHB", *(getattr(end, name) for name in names)))
    assert config.wTotalLength == sum(len(part) for part in parts[1:])
    return b"".join(parts)


def serve(device: VirtualDvxplorer, peer: socket.socket) -> None:
    """Hand requests of one endpoint on to the camera, until the other side is gone."""
    with peer, peer.makefile("rb") as requests:
        while len(head := requests.read(16)) == 16:
            kind, length, request_type, request, value, index, _ = struct.unpack("<IIBBHHH", head)
            incoming = kind == 1 or request_type & 0x80
            data = array("B", bytes(length) if incoming else requests.read(length))
            try:
                if kind == 2:
                    device.clear_halt(device, 0x82)
                    count, status = 0, 0
                elif kind == 1:
                    count, status = device.bulk_read(device, 0x82, 0, data, WAIT_MS), 0
                else:
                    count, status = device.ctrl_transfer(device, request_type, request, value, index, data, 1000), 0
            except usb.core.USBError as error:
                count, status = 0, -(error.errno or errno.EIO)
            try:
                peer.sendall(struct.pack("<iI", status, count) + (data[:count].tobytes() if incoming else b""))
            except OSError:
                return


@contextmanager
def on_a_fake_linux(device: VirtualDvxplorer, folder: Path) -> Iterator[dict[str, str]]:
    """Environment of a process in which the camera is plugged in."""
    source = Path(__file__).with_name("fake_usbfs.c")
    shim = folder / "fake_usbfs.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", shim, source, "-ldl", "-lpthread"], check=True)
    sysfs = folder / "9-1"
    sysfs.mkdir()
    (sysfs / "descriptors").write_bytes(descriptors(device))
    for name, text in {"busnum": "9", "devnum": "2", "speed": "5000", "bConfigurationValue": "1"}.items():
        (sysfs / name).write_text(text + "\n")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(folder / "usb"))
        listening.listen()

        def accept() -> None:
            try:
                while True:
                    Thread(target=serve, args=(device, listening.accept()[0]), daemon=True).start()
            except OSError:
                return

        Thread(target=accept, daemon=True).start()
        paths = {"LD_PRELOAD": shim, "FAKE_USBFS_ROOT": folder, "FAKE_USBFS_SOCKET": folder / "usb"}
        yield {**os.environ, **{name: str(path) for name, path in paths.items()}}
        listening.shutdown(socket.SHUT_RDWR)


def run(program: str, device: VirtualDvxplorer, folder: Path, seconds: float) -> tuple[Events, str]:
    """What a program saw of the camera, and said."""
    with on_a_fake_linux(device, folder) as environment:
        call = [sys.executable, "-W", "error", "-c", program, str(folder / "seen.npz"), str(seconds)]
        done = subprocess.run(
            call, env=environment, capture_output=True, text=True, timeout=60, check=False, cwd=REPOSITORY
        )
    assert done.returncode == 0, done.stderr
    with np.load(folder / "seen.npz") as seen:
        return Events(*(seen[name] for name in Events._fields)), done.stdout.strip()


def in_order(events: Events) -> list[Any]:
    """Columns as Python integers, times from the first event on, sorted by time, column, row and polarity."""
    order = np.lexsort((events.p, events.y, events.x, events.t))
    return [(events.t - events.t.min())[order].tolist(), *(column[order].tolist() for column in events[1:])]


def test_the_makers_driver_sees_what_we_see(tmp_path: Path) -> None:
    """Assert that the maker's driver starts our camera, and makes of our words the events that we make of them."""
    pytest.importorskip("dv_processing")
    decoder = event_words.start()
    events = event_words.step(decoder, random_event_words(100_000, 0.3, np.random.default_rng(0)).tobytes())
    words = event_words.encode(events, first_ms=2**22 - 100)  # so that the milliseconds wrap on the way
    device = VirtualDvxplorer(PreparedWords(words))
    seen, printed = run(MAKERS, device, tmp_path, 1.0)
    assert printed == "DVXplorerM_DXM00042"
    assert events.size - 100 <= seen.size <= events.size  # it keeps back the last interval
    assert in_order(seen) == in_order(events.part(0, seen.size))
    writes = [
        (value, index, int.from_bytes(data, "big")) for request, value, index, data in device.log if request == 0xBF
    ]
    ours = [(each.module, each.parameter, each.value) for each in configure(Generation.PARAMETERS, AS_THE_MAKER)]
    assert [each for each in writes if each[0] == DVS] == [*ours, (DVS, RUN, 1), (DVS, RUN, 0)]


@pytest.mark.parametrize(("firmware", "faults", "lost"), [(9, (), {}), (10, ("stall@0.1",), {"usb_errors": 1})])
@pytest.mark.slow
def test_our_driver_over_libusb(firmware: int, faults: tuple[str, ...], lost: dict[str, int], tmp_path: Path) -> None:
    """Assert that the driver finds, starts and reads a camera through the real libusb; a stall costs no event."""
    words = random_event_words(100_000, 0.6, np.random.default_rng(0))
    device = VirtualDvxplorer(PreparedWords(words), firmware=firmware, faults=faults)
    seen, printed = run(OURS, device, tmp_path, 0.5)
    assert printed == str(lost)
    decoder = event_words.start()
    events = event_words.step(decoder, words.tobytes())
    assert seen.size == 50_000
    assert [column.tolist() for column in seen] == [
        column[: seen.size].tolist() for column in events._replace(t=events.t - 1000)
    ]


@pytest.mark.slow
def test_unplugged_over_libusb(tmp_path: Path) -> None:
    """Assert that the real libusb says of an unplugged camera what our virtual bus says."""
    device = VirtualDvxplorer(
        PreparedWords(random_event_words(20_000, 0.5, np.random.default_rng(0))), faults=("unplug@0.2",)
    )
    seen, printed = run(OURS, device, tmp_path, 0.4)
    assert seen.size > 0
    assert "no longer on the bus" in printed
    assert "errno 19" in printed
