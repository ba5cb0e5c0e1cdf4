"""What waits for whoever decodes: reads that are joined, and when they are worth waking somebody."""

import errno
from array import array
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import usb.core

from evetac_cli.devices.dvxplorer import event_words, protocol, usb_reader
from evetac_cli.devices.dvxplorer.usb_reader import Block, UsbReader
from evetac_cli.errors import DeviceError

STAMP = event_words.timestamp(7).tobytes()
COLUMN = np.array([1 << 26 | 5], "<u4").tobytes()


class Device:
    """A camera that answers reads one after the other, b"" by a timeout, and is unplugged then."""

    def __init__(self, reads: Sequence[bytes | OSError]) -> None:
        self._reads = list(reads)

    def read(self, endpoint: int, buffer: "array[int]", timeout_ms: int) -> int:
        if endpoint != protocol.DATA_ENDPOINT:
            raise usb.core.USBTimeoutError("no message")
        if not self._reads:
            raise usb.core.USBError("gone", -4, errno.ENODEV)
        data = self._reads.pop(0)
        if isinstance(data, OSError):
            raise data
        if not data:
            raise usb.core.USBTimeoutError("nothing")
        buffer[: len(data)] = array("B", data)
        return len(data)

    def clear_halt(self, endpoint: int) -> None:
        """Nothing is halted."""


class Clock:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.now = 0.0

    def now_s(self) -> float:
        self.now += 1e-6
        return self.now


def blocks(*reads: bytes | OSError, queue_bytes: int = 1 << 20) -> list[Block]:
    """What is taken, once all was read; the times are in the order of asking."""
    reader = UsbReader(Device(reads), "a camera", queue_bytes, Clock())  # type: ignore[arg-type]
    reader.run()
    assert isinstance(reader.failure, DeviceError)
    taken = []
    while (block := reader.take()) is not None:
        taken.append(block)
    return taken


def test_reads_without_a_break_are_one_block() -> None:
    """Assert that it begins with the first of them and ends with the last, and that an empty read stands alone."""
    taken = blocks(COLUMN, STAMP + COLUMN, COLUMN, b"", b"", COLUMN, b"")
    assert [block.data for block in taken] == [COLUMN + STAMP + COLUMN + COLUMN, b"", COLUMN, b""]
    assert [(round(block.begun_us), round(block.ended_us)) for block in taken] == [(1, 6), (9, 10), (11, 12), (13, 14)]
    assert all(block.emptied and not block.gap for block in taken)


def test_a_gap_is_between_two_blocks() -> None:
    """Assert that bytes which were lost on the way are missing before the first byte of a block."""
    broken = usb.core.USBError("damaged", -1, errno.EIO)
    assert [(block.data, block.gap) for block in blocks(COLUMN, broken, STAMP, COLUMN)] == [
        (COLUMN, False),
        (STAMP + COLUMN, True),
    ]


def test_a_block_is_no_longer_than_the_largest_read() -> None:
    """Assert that a long backlog comes in pieces, and that a full read says that there is more."""
    full = STAMP * (usb_reader.READ_BYTES // 4)
    taken = blocks(full[:-4], STAMP, STAMP, full)
    assert [len(block.data) for block in taken] == [len(full), 4, len(full)]
    assert [block.emptied for block in taken] == [True, True, False]


@pytest.mark.parametrize(
    ("data", "gap", "may"),
    [
        (COLUMN * 3, False, False),
        (COLUMN + STAMP + COLUMN, False, True),
        (b"", False, True),
        (COLUMN[:3], False, True),
        (COLUMN, True, True),
    ],
)
def test_what_may_end_a_slice(data: bytes, gap: bool, may: bool) -> None:
    assert usb_reader._may_end_slice(Block(data, 0.0, 1.0, gap, True)) == may


def test_who_is_behind_gets_more_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the next transfer waits a little where what was due waits already, unless the camera holds more."""
    slept: list[float] = []
    monkeypatch.setattr(usb_reader, "time", SimpleNamespace(sleep=slept.append, monotonic=lambda: 0.0))
    full = COLUMN * (usb_reader.READ_BYTES // len(COLUMN))
    for reads, times in (((COLUMN, COLUMN, STAMP), 0), ((STAMP, COLUMN, COLUMN), 2), ((STAMP, full, COLUMN), 1)):
        slept.clear()
        blocks(*reads)
        assert slept == [usb_reader.BREATH_S] * times
