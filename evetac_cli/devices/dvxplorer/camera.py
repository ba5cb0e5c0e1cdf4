"""Driver of a DVXplorer Mini over pyusb: finds, configures, starts, reads and in every case stops the camera.

A thread (usb_reader.py) moves buffers from the camera into a queue. The caller's thread, in `read`, decodes the words
and cuts them into slices (WordSlices). pyusb is imported here, in usb_reader.py, in probe.py and in the virtual camera.
"""

import errno
import math
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import libusb_package
import numpy as np
import usb.core
import usb.util

from evetac_cli.devices.device_slices import FAR_US, DeviceSlices
from evetac_cli.devices.dvxplorer import event_words, protocol
from evetac_cli.devices.dvxplorer.protocol import DvxplorerSettings, Generation
from evetac_cli.devices.dvxplorer.usb_reader import QUEUE_BYTES, READ_BYTES, READ_TIMEOUT_MS, UsbReader, device_error
from evetac_cli.errors import DeviceError, install_hint
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource

WHERE = "--camera dvxplorer"
CONTROL_TIMEOUT_MS = 1000
STOP_TIMEOUT_MS = 250  # for a request to a camera that is being released: it may hang, and Ctrl-C waits for it
DRAIN_READS = 50
PATIENCE_US = 1000  # on top of the flush time: readout, transfer, drift of the clock
HOLDING_BACK_US = 20_000  # firmware 9 has no flush time; how long a quiet Mini holds back events is unknown
SUPER_SPEED = 4  # pyusb's code of USB 3


class FoundCamera(NamedTuple):
    """A DVXplorer on the bus, from its descriptors; nothing on the camera was changed."""

    serial: str | None  # None: no permission to read it
    board: int  # protocol.MINI_BOARD for a supported camera
    firmware: int
    speed: int | None  # of the link: 3 high (USB 2), 4 super (USB 3) and above
    where: str  # bus and address
    device: Any  # pyusb's device object


def find_cameras(backend: Any = None) -> list[FoundCamera]:
    """Return all DVXplorer cameras on the bus; DeviceError if libusb is missing."""
    backend = backend or libusb_package.get_libusb1_backend()
    if backend is None:
        raise DeviceError("libusb, of the package libusb-package, was not found", where=WHERE, hint=install_hint())
    cameras = []
    for device in usb.core.find(find_all=True, idVendor=protocol.VENDOR, idProduct=protocol.PRODUCT, backend=backend):
        serial = _serial(device)
        usb.util.dispose_resources(device)
        board, firmware = device.bcdDevice >> 8, device.bcdDevice & 0xFF
        where = f"USB bus {device.bus} address {device.address}"
        cameras.append(FoundCamera(serial, board, firmware, device.speed, where, device))
    return cameras


def _serial(device: Any) -> str | None:
    """Return the serial number of a camera, or None if it cannot be read."""
    try:
        text: str | None = usb.util.get_string(device, device.iSerialNumber)
    except (ValueError, usb.core.USBError):  # pyusb raises ValueError if it may not open the device
        return None
    return text


def _choose(serial: str | None, backend: Any) -> FoundCamera:
    """Return the camera with this serial number, or the only camera; DeviceError if there is none, or more than one."""
    cameras = find_cameras(backend)
    fitting = [camera for camera in cameras if serial is None or camera.serial in (serial, None)]
    minis = [camera for camera in fitting if camera.board == protocol.MINI_BOARD]
    matching = [camera for camera in minis if serial is None or camera.serial == serial] or minis
    if len(matching) == 1:
        return matching[0]
    if not minis and fitting:
        raise DeviceError(
            "is not a DVXplorer Mini",
            where=fitting[0].where,
            expected="board 4 (bcdDevice 0x04..), the Mini or Micro",
            found=f"board {fitting[0].board}",
            hint="its events come in another format; record with DV and import: evetac record --from FILE.aedat4",
        )
    several = serial is None and len(cameras) > 1
    raise DeviceError(
        "there are several cameras" if several else "there is no such camera",
        where=WHERE,
        expected=f"one DVXplorer Mini (USB 152a:8419){f' with serial number {serial}' if serial else ''}",
        found=", ".join(each.serial or f"one without read permission, {each.where}" for each in cameras)
        or "none on the bus",
        hint=f"name one: {WHERE}:SERIAL" if several else "plug it in, or run `evetac doctor` to find the fault",
    )


class WordSlices(DeviceSlices):
    """Cuts the words of one camera into slices; see DeviceSlices."""

    def __init__(self, patience_us: float) -> None:
        super().__init__(patience_us)
        event_words.step(event_words.start(), bytes(4))  # loads or compiles the decoder before time is critical
        self._decoder = event_words.start()
        self._quiet_ms = 0  # total length of silences that the camera's times do not measure
        # host time since which every read was full and none brought a time
        self._flooded_since_us: float | None = None

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by reason: events, words, timestamps, bytes and time."""
        counts = dict(self._decoder.counted)
        counts["clock_restarts"] += self.clock_restarts
        counts["ms_without_time"] += self._quiet_ms
        if self.ms_without_time > event_words.QUIET_MS:  # the present silence; the decoder counted earlier ones
            counts["ms_without_time"] += self.ms_without_time
        return {**counts, "late_events": self.late_events, "early_events": self.early_events}

    @property
    def open_events(self) -> int:
        """Number of decoded events of slices that are not closed."""
        return self.waiting_events + self._decoder.frame.size

    @property
    def undecoded(self) -> bytes:
        """The bytes of an incomplete word."""
        return self._decoder.rest

    def push_words(
        self, data: bytes, begun_us: float, ended_us: float, *, emptied: bool, gap: bool = False
    ) -> list[Events]:
        """Take the data of a read from begun_us to ended_us; return the slices that it closes.

        emptied: whether the read left nothing in the camera; gap: whether bytes before it were lost in transfer.
        """
        if gap:
            event_words.bytes_were_lost(self._decoder)
        before_us = self._decoder.now_us
        quiet_ms, unmeasured = self.ms_without_time, self._decoder.unmeasured_times
        events = event_words.step(self._decoder, data, self.device_ms(ended_us), self._most_ms(ended_us))
        if self._decoder.unmeasured_times > unmeasured:  # empty reads measure the silence before it
            self.note_sent(ended_us)
            self._quiet_ms += quiet_ms if quiet_ms > event_words.QUIET_MS else 0
        closed = []
        if self._decoder.first_ms is not None and data:
            closed = self.push(events, SLICE_US * self._decoder.first_ms, self._decoder.now_us, ended_us)
        if emptied or self._decoder.now_us != before_us:
            self._flooded_since_us = None
        elif self._flooded_since_us is None:
            self._flooded_since_us = ended_us
        is_flooded = self._flooded_since_us is not None and ended_us - self._flooded_since_us > FAR_US
        if self._decoder.now_us == before_us and (emptied or is_flooded):
            slices = self.over(begun_us if emptied else ended_us - FAR_US)
            closed += self.take(event_words.flush(self._decoder)) + self.close_until(slices)
        return closed

    def _most_ms(self, host_us: float) -> int:
        """Return the most ms that can have passed since the first TIMESTAMP."""
        origin_us, first_ms = self._origin_us, self._decoder.first_ms
        before_ms = self._closed if origin_us is None or first_ms is None else first_ms - origin_us // SLICE_US
        return int(self.most_us(host_us)) // SLICE_US - before_ms


class DvxplorerCamera:
    """A running DVXplorer Mini; an EventCamera, and the clock of its recording.

    serial: which camera, None for the only one; backend: a pyusb backend, None for libusb.

    queue_bytes: how many bytes may wait for `read`.

    DeviceError, with a message, for anything that keeps the camera from running. `notes` are for the user; `messages`
    come from the camera.
    """

    def __init__(
        self,
        serial: str | None = None,
        settings: DvxplorerSettings | None = None,
        backend: Any = None,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        self.settings = settings or DvxplorerSettings()
        camera = _choose(serial, backend)
        self._device = camera.device
        self.where = f"camera {camera.serial or camera.where}"
        self.firmware = camera.firmware
        self._generation = protocol.generation(camera.firmware)
        self.notes: tuple[str, ...] = ()
        if camera.speed and camera.speed < SUPER_SPEED:
            self.notes += (f"{self.where} is connected by USB 2 and will lose events in fast motion: use a USB 3 port",)
        if camera.firmware > protocol.NEWEST_FIRMWARE:
            self.notes += (
                f"{self.where} has firmware {camera.firmware}; versions 8 to {protocol.NEWEST_FIRMWARE} are supported",
            )
        self._ready: deque[Events] = deque()
        self._open = True
        self._claimed = False
        self.time: TimeSource = getattr(backend, "time", HOST_TIME)  # a virtual camera has its own time
        self._reader = UsbReader(self._device, self.where, queue_bytes, self.time)
        self._handed_out = 0
        try:
            self._claim()
            self.serial = camera.serial or _serial(self._device)
            self._set_up()
            held_us = self.settings.flush_us if self._generation is Generation.PARAMETERS else HOLDING_BACK_US
            self._slices = WordSlices(held_us + PATIENCE_US)
            self._reader.start()
            self._slices.start(self._now_us())  # before RUN, so that no time in its stream is earlier
            self.time.slices_read_until(self.time.now_s())  # from here a virtual camera's time waits for `read`
            self._send(protocol.run(self._generation))
        except BaseException as error:
            self.close()
            if isinstance(error, usb.core.USBError):
                raise device_error(error, self.where, "setting up the camera") from error
            raise
        self._left = 0  # events of the slice that was open when the camera failed
        self.sensor: Mapping[str, Any] = {
            "sensor/frame_px": np.array(FRAME_PX, np.int32),
            "sensor/name": f"dvxplorer:{self.serial}",
        }

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by reason: events, words, timestamps and bytes."""
        own = {name: self._reader.lost[name] for name in ("events_in_full_queue", "usb_errors", "failed_transfers")}
        return {**self._slices.counted, **own, "events_after_last_slice": self._left}

    @property
    def waiting(self) -> tuple[int, bytes]:
        """Decoded events, and undecoded words, that are in no returned slice and not lost."""
        decoded = self._slices.open_events + sum(part.size for part in self._ready)
        return decoded, self._slices.undecoded + self._reader.waiting

    @property
    def messages(self) -> tuple[str, ...]:
        """The latest messages from the camera itself."""
        return tuple(self._reader.messages)

    def read(self) -> Events | None:
        """Return the next slice once it is closed; None after close; DeviceError if the camera has failed."""
        while self._open and not self._ready:
            self._ready += self._slices.more()
            if self._ready:
                break
            block = self._reader.take()
            if block is None:
                if self._reader.failure is not None and self._open:
                    self._left = self._slices.open_events
                    raise self._reader.failure
                return None
            data, begun_us, ended_us, gap, emptied = block
            self._ready += self._slices.push_words(data, begun_us, ended_us, emptied=emptied, gap=gap)
        if not self._open:
            return None
        self._handed_out += 1
        self.time.slices_read_until(self._slices.host_us(self._handed_out * SLICE_US) * 1e-6)
        return self._ready.popleft()

    def host_us(self, device_us: float) -> float:
        """Return the reading of `time`, in us, at which the camera's clock showed this time of the recording."""
        return self._slices.host_us(device_us)

    def now_us(self) -> int:
        """Return the present time of the recording, by the camera's clock."""
        return int(self._slices.recording_us(self._now_us()))

    def _now_us(self) -> float:
        return self.time.now_s() * 1e6

    def close(self) -> None:
        """Stop and release the camera; a second call does nothing."""
        if not self._open:
            return
        self._open = False
        self.time.slices_read_until(math.inf)
        try:
            self._reader.end()
            if self._claimed:  # otherwise another program may own the camera, and this would stop its stream
                self._send(protocol.stop(self._generation), STOP_TIMEOUT_MS)
        except usb.core.USBError:
            pass  # the camera has gone
        finally:
            usb.util.dispose_resources(self._device)

    def _claim(self) -> None:
        """Claim the camera.

        The configuration is set only if none is, because setting it again could reset the camera.
        """
        try:
            configuration = self._device.get_active_configuration()
        except usb.core.USBError as error:
            if error.errno is not None:
                raise
            self._device.set_configuration()  # without an errno, the error means that no configuration is set
            configuration = self._device.get_active_configuration()
        usb.util.claim_interface(self._device, 0)
        self._claimed = True
        if usb.util.find_descriptor(configuration[(0, 0)], bEndpointAddress=protocol.DATA_ENDPOINT) is None:
            hint = "wait two seconds after plugging it in; if that does not help, flash its firmware again"
            raise DeviceError("is not ready", where=self.where, expected="a bulk endpoint 0x82", hint=hint)

    def _set_up(self) -> None:
        """Configure the camera up to the start of the stream, in the order measured from the maker's drivers."""
        if self._generation is Generation.PARAMETERS:
            self._request(protocol.LOG_LEVEL, 2)
            with suppress(usb.core.USBTimeoutError):  # known to hang on some hosts, and not needed
                self._request(protocol.FLUSH_STALE, 0)
        self._send(protocol.stop(self._generation))
        try:
            size = (self._read(protocol.DVS, protocol.COLUMNS), self._read(protocol.DVS, protocol.ROWS))
        except usb.core.USBTimeoutError:
            size = FRAME_PX  # these reads hang on some hosts
        if size != FRAME_PX:
            raise DeviceError("has a different sensor", where=self.where, expected="640 x 480", found=str(size))
        self._send(protocol.configure(self._generation, self.settings))
        if self._generation is Generation.REGISTERS:
            self._device.clear_halt(protocol.DATA_ENDPOINT)
        self._drain()

    def _drain(self) -> None:
        """Discard data of an earlier run: its times do not belong to this one."""
        for _ in range(DRAIN_READS):
            try:
                self._device.read(protocol.DATA_ENDPOINT, READ_BYTES, READ_TIMEOUT_MS)
            except usb.core.USBTimeoutError:
                return
            except usb.core.USBError as error:
                if error.errno != errno.EPIPE:
                    raise
                self._device.clear_halt(protocol.DATA_ENDPOINT)

    def _request(self, request: int, value: int) -> None:
        self._device.ctrl_transfer(protocol.WRITE, request, value, 0, None, CONTROL_TIMEOUT_MS)

    def _read(self, module: int, parameter: int) -> int:
        size = self._generation.value
        answer = self._device.ctrl_transfer(protocol.READ, protocol.CONFIG, module, parameter, size, CONTROL_TIMEOUT_MS)
        return int.from_bytes(bytes(answer), "big")

    def _send(self, orders: Iterable[protocol.Order], timeout_ms: int = CONTROL_TIMEOUT_MS) -> None:
        for order in orders:
            value = order.value if isinstance(order, protocol.Write) else self._changed_bits(order)
            data = value.to_bytes(self._generation.value, "big")
            self._device.ctrl_transfer(protocol.WRITE, protocol.CONFIG, order.module, order.parameter, data, timeout_ms)

    def _changed_bits(self, order: protocol.Change) -> int:
        return self._read(order.module, order.parameter) & ~order.clear | order.set
