"""A thread that moves buffers from a camera's data endpoint into a queue of bounded size.

Reason: pyusb runs one blocking transfer at a time, and the camera loses data that are not fetched. So nothing may keep
the thread from its next transfer. If the consumer is too slow, the oldest buffers are dropped and their events counted,
as far as their words are plausible.

The consumer is woken by a TIMESTAMP or by an empty read, because only these end a slice. It gets all waiting data in
one piece: each decoding call has a cost, and the two threads share an interpreter. If data that may end a slice are
still waiting when more arrive, the consumer is behind, and more transfers would only slow it down. The thread then
pauses, so that its next transfer may bring twice the data.
"""

import errno
import itertools
import time
from array import array
from collections import Counter, deque
from threading import Condition, Thread
from typing import Any, NamedTuple

import numpy as np
import usb.core

from evetac_cli.devices.dvxplorer import protocol
from evetac_cli.devices.dvxplorer.event_word_loops import plausible_events
from evetac_cli.errors import DeviceError, DeviceTimeout
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource

READ_TIMEOUT_MS = 2  # how long a read waits for a silent camera, and so how much later its slices are closed
READ_BYTES = 65536
BLOCK_BYTES = 256  # overhead of a block: many short blocks fill memory too
QUEUE_BYTES = 64 << 20  # 1.5 s of the worst case, 10 million single events per second
BREATH_S = 5e-4  # pause between transfers while the consumer is behind; a camera buffers what it sees in that time
ERRORS_IN_A_ROW = 5
LOG_EVERY_S = 0.5
TIMESTAMP_CODE = 2  # bits 26 and up of a word
_GONE = (errno.ENODEV, errno.ENOENT, errno.ESHUTDOWN)
_BY_ERRNO: dict[int | None, tuple[str, str]] = {  # what happened, and what to do
    **dict.fromkeys(_GONE, ("is no longer on the bus", "plug it in again, in a USB 3 port and with a firm cable")),
    errno.EACCES: ("you have no permission to open it", "`evetac doctor udev` prints the udev rule to install"),
    errno.EBUSY: ("is used by another program", "close DV, the ROS node or the other evetac that has it open"),
    errno.ETIMEDOUT: ("did not answer in time", "unplug the camera and plug it in again"),
}
_OTHER = "refused the request, or the USB connection is bad", "plug it in again, without a hub"


def device_error(error: OSError, where: str, doing: str) -> DeviceError:
    """Return the DeviceError for an error of libusb; `doing` names the action, for example `reading events`."""
    what, hint = _BY_ERRNO.get(error.errno, _OTHER)
    kind = DeviceTimeout if error.errno == errno.ETIMEDOUT else DeviceError
    return kind(what, where=where, found=f"{error.strerror or error} (errno {error.errno}) while {doing}", hint=hint)


class Block(NamedTuple):
    """The data of consecutive reads of the data endpoint; host times in us, of the first and the last read."""

    data: bytes
    begun_us: float
    ended_us: float
    gap: bool  # whether bytes before the block were lost
    emptied: bool  # whether the last read left nothing in the camera


def _may_end_slice(block: Block) -> bool:
    """Return whether the block contains a TIMESTAMP, is empty, or has cut words that may hide a TIMESTAMP."""
    if not block.data or block.gap or len(block.data) % 4:
        return True
    return bool((np.frombuffer(block.data, "<u4") >> 26 == TIMESTAMP_CODE).any())


class UsbReader(Thread):
    """Moves buffers from the camera into a queue until `end` is called or the camera fails."""

    def __init__(self, device: Any, where: str, queue_bytes: int, clock: TimeSource = HOST_TIME) -> None:
        super().__init__(name=f"reads {where}", daemon=True)
        self._device = device
        self._where = where
        self._queue_bytes = queue_bytes
        self._clock = clock
        self._blocks: deque[Block] = deque()
        self._waiting_bytes = 0
        plausible_events(np.empty(0, np.uint32))  # loads or compiles it now, not when the queue is already full
        self._is_due = False  # data that may end a slice are waiting
        self._changed = Condition()
        self._running = True
        self.failure: DeviceError | None = None
        self.lost: Counter[str] = Counter()
        self.messages: deque[str] = deque(maxlen=100)

    def take(self) -> Block | None:
        """Return the next block, with all reads that follow without a gap; None after the last one."""
        with self._changed:
            while not self._is_due and self._running and self.failure is None:
                self._changed.wait()
            taken = list(itertools.islice(self._blocks, 1))
            size = sum(len(block.data) for block in taken)
            for block in itertools.islice(self._blocks, 1, None):
                size += len(block.data)
                if not taken[-1].data or not block.data or block.gap or size > READ_BYTES:
                    break
                taken.append(block)
            for block in taken:
                self._blocks.popleft()
                self._waiting_bytes -= len(block.data) + BLOCK_BYTES
            self._is_due = bool(self._blocks)
        if not taken:
            return None
        first, last = taken[0], taken[-1]
        data = first.data if first is last else b"".join(block.data for block in taken)
        return Block(data, first.begun_us, last.ended_us, first.gap, last.emptied)

    @property
    def waiting(self) -> bytes:
        """Return the data in the queue."""
        with self._changed:
            return b"".join(block.data for block in self._blocks)

    def end(self) -> None:
        """Stop reading and wait for the thread to end."""
        with self._changed:
            self._running = False
            self._changed.notify_all()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        """Read until the end; any failure of this thread is raised later by `read`."""
        try:
            self._read_on()
        except Exception as error:
            failure = error if isinstance(error, DeviceError) else DeviceError(f"reading failed: {error!r}")
            self._fail(failure)

    def _fail(self, failure: DeviceError) -> None:
        with self._changed:
            self.failure = failure
            self._changed.notify_all()

    def _read_on(self) -> None:
        buffer = array("B", bytes(READ_BYTES))
        failures = 0
        gap = False
        next_log_s = time.monotonic()
        while self._running:
            begun_us = self._clock.now_s() * 1e6
            try:
                count = self._device.read(protocol.DATA_ENDPOINT, buffer, READ_TIMEOUT_MS)
                failures = 0
            except usb.core.USBTimeoutError:
                count = 0
            except usb.core.USBError as error:
                failures += 1
                self.lost["usb_errors"] += 1
                if not self._recovered(error, failures):
                    return
                if error.errno != errno.EPIPE:  # data in a halted endpoint are not lost
                    self.lost["failed_transfers"] += 1
                    gap = True
                continue
            data, ended_us = memoryview(buffer)[:count].tobytes(), self._clock.now_s() * 1e6
            is_behind = self._put(Block(data, begun_us, ended_us, gap, count < READ_BYTES))
            gap = False
            if is_behind and count < READ_BYTES:
                time.sleep(BREATH_S)
            if time.monotonic() >= next_log_s:
                next_log_s = time.monotonic() + LOG_EVERY_S
                self._read_log()

    def _put(self, block: Block) -> bool:
        """Add a block to the queue; return whether data that were due before are still waiting."""
        with self._changed:
            was_due = self._is_due
            if not block.data and self._blocks and not self._blocks[-1].data:
                before = self._blocks.pop()  # of two empty reads in a row, only the later one is needed
                self._waiting_bytes -= BLOCK_BYTES
                block = block._replace(gap=block.gap or before.gap)
            self._blocks.append(block)
            self._waiting_bytes += len(block.data) + BLOCK_BYTES
            while self._waiting_bytes > self._queue_bytes and len(self._blocks) > 1:
                dropped = self._blocks.popleft().data
                self._waiting_bytes -= len(dropped) + BLOCK_BYTES
                self._blocks[0] = self._blocks[0]._replace(gap=True)
                self.lost["events_in_full_queue"] += plausible_events(np.frombuffer(dropped, "<u4", len(dropped) // 4))
            if not self._is_due and (self._waiting_bytes > READ_BYTES or _may_end_slice(block)):
                self._is_due = True
                self._changed.notify_all()
            return was_due

    def _recovered(self, error: Any, failures: int) -> bool:
        """Clear a halted endpoint and return True.

        Give up after too many errors in a row, or if the device has gone.
        """
        recovered = error.errno not in _GONE and failures <= ERRORS_IN_A_ROW
        if recovered:
            try:
                self._device.clear_halt(protocol.DATA_ENDPOINT)
            except usb.core.USBError as second:
                error, recovered = second, False
        if not recovered:
            self._fail(device_error(error, self._where, "reading events"))
        return recovered

    def _read_log(self) -> None:
        """Fetch the camera's own messages; it sends them only if something is wrong."""
        try:
            packet = bytes(self._device.read(protocol.DEBUG_ENDPOINT, 64, 1))
        except usb.core.USBError:  # usually a timeout: no message; other errors show on the data endpoint
            return
        if len(packet) > 6 and packet[0] == protocol.LOG_PACKET:
            text = packet[6:].split(b"\0")[0].decode("latin-1")
            self.messages.append(f"{text} (code {packet[1]}, at {int.from_bytes(packet[2:6], 'little')})")
