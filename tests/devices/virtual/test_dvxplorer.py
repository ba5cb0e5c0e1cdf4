"""The virtual DVXplorer Mini: answers, stream and faults as a program on the other side of pyusb meets them."""

import errno
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import usb.core
import usb.util
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.devices.virtual.dvxplorer import STORE_TO_FLASH, VirtualDvxplorer
from evetac_cli.devices.virtual.word_sources import PreparedWords, due_us, random_event_words
from evetac_cli.events import Events, concatenate
from tests.devices.stepped import SteppedWords
from tests.patience import patient_words

WRITE, READ = 0x40, 0xC0
SIZE = {9: 4, 10: 8}


def prepared(seconds: float, events_per_s: float = 20_000) -> NDArray[np.uint32]:
    return random_event_words(events_per_s, seconds, np.random.default_rng(0))


def plugged(device: VirtualDvxplorer) -> Any:
    """The camera as pyusb sees it."""
    device_handle = usb.core.find(idVendor=0x152A, idProduct=0x8419, backend=device)
    device_handle.set_configuration()
    usb.util.claim_interface(device_handle, 0)
    return device_handle


def write(device: Any, module: int, parameter: int, value: int, size: int = 8) -> int:
    sent: int = device.ctrl_transfer(WRITE, 0xBF, module, parameter, value.to_bytes(size, "big"), 100)
    return sent


def read(device: Any, module: int, parameter: int, size: int = 8) -> int:
    return int.from_bytes(bytes(device.ctrl_transfer(READ, 0xBF, module, parameter, size, 100)), "big")


def run(device: Any, firmware: int = 10) -> None:
    write(device, *((1, 3, 1) if firmware >= 10 else (5, 0x3000, 2)), SIZE[firmware])


def transfers(device: Any, size: int = 65536, timeout_ms: int = 20) -> Iterator[bytes]:
    """Transfers until nothing comes."""
    while True:
        try:
            yield bytes(device.read(0x82, size, timeout_ms))
        except usb.core.USBTimeoutError:
            return


def decoded(data: bytes) -> tuple[Events, dict[str, int]]:
    decoder = event_words.start()
    events = concatenate([event_words.step(decoder, data), event_words.flush(decoder)])
    return events, {name: count for name, count in decoder.counted.items() if count}


def same(one: Events, other: Events) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("firmware", SIZE)
def test_descriptors(firmware: int) -> None:
    """Assert what lsusb would show of a Mini: id, model and firmware, strings, and its two endpoints."""
    device = plugged(VirtualDvxplorer(patient_words(prepared(0.1)), firmware=firmware, serial="ABC"))
    assert device.bcdDevice == 0x0400 | firmware
    assert (device.serial_number, device.product) == ("ABC", "DVXplorer Mini")
    interface = device.get_active_configuration()[(0, 0)]
    kinds = {end.bEndpointAddress: usb.util.endpoint_type(end.bmAttributes) for end in interface}
    assert kinds == {0x82: usb.util.ENDPOINT_TYPE_BULK, 0x81: usb.util.ENDPOINT_TYPE_INTR}


@pytest.mark.parametrize(("firmware", "wrong"), [(10, 4), (9, 8), (10, 7), (9, 3)])
def test_wrong_length_stalls(firmware: int, wrong: int) -> None:
    """Assert a STALL for values of the other generation's length, both ways, and the right ones obeyed."""
    device = plugged(VirtualDvxplorer(patient_words(prepared(0.1)), firmware=firmware))
    size = SIZE[firmware]
    assert (read(device, 1, 0, size), read(device, 1, 1, size)) == (640, 480)
    assert write(device, 3, 5, 11, size) == size
    assert read(device, 3, 5, size) == 11
    for refused in (lambda: read(device, 1, 0, wrong), lambda: write(device, 3, 5, 1, wrong)):
        with pytest.raises(usb.core.USBError) as error:
            refused()
        assert error.value.errno == errno.EPIPE


@pytest.mark.parametrize(
    ("firmware", "request_", "refused"),
    [
        (10, (WRITE, 0xBF, 1, 0, bytes(8)), True),  # a size that can only be read
        (10, (WRITE, 0xBF, 5, 0x3000, bytes(8)), True),  # a sensor register
        (10, (WRITE, 0xBF, 0, 0, bytes(8)), True),  # a module of other boards
        (10, (WRITE, 0xB1, 2, 0, None), False),
        (10, (WRITE, 0xC6, 0, 0, None), False),
        (10, (WRITE, STORE_TO_FLASH, 0, 0, None), False),
        (10, (WRITE, 0x77, 0, 0, None), True),
        (9, (WRITE, 0xB1, 2, 0, None), True),
        (9, (WRITE, 0xC6, 0, 0, None), True),
        (9, (WRITE, 0xBF, 5, 0x3000, bytes(4)), False),
        (9, (WRITE, 0xBF, 1, 14, bytes(4)), True),  # a parameter of firmware 10
    ],
)
def test_requests(firmware: int, request_: tuple[Any, ...], refused: bool) -> None:
    """Assert which requests each generation knows, and that those obeyed are logged."""
    camera = VirtualDvxplorer(patient_words(prepared(0.1)), firmware=firmware)
    device = plugged(camera)
    if refused:
        with pytest.raises(usb.core.USBError) as error:
            device.ctrl_transfer(*request_, 100)
        assert error.value.errno == errno.EPIPE
    else:
        device.ctrl_transfer(*request_, 100)
    assert len(camera.log) == (not refused)
    assert STORE_TO_FLASH not in {each[0] for each in camera.log} or request_[1] == STORE_TO_FLASH


@pytest.mark.parametrize("firmware", SIZE)
def test_the_stream_runs_only_while_told_to(firmware: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that nothing comes before RUN nor after its end, and everything between, padded with zeros only."""
    words = prepared(0.1)
    device = plugged(VirtualDvxplorer(PreparedWords(words, paced=False), firmware=firmware))
    assert list(transfers(device, timeout_ms=1)) == []
    run(device, firmware)
    data = b"".join(transfers(device))
    assert [word for word in np.frombuffer(data, "<u4") if word] == words.tolist()
    assert len(data) % 16 == 0
    source = SteppedWords(words, monkeypatch)
    device = plugged(VirtualDvxplorer(source, firmware=firmware))
    run(device, firmware)
    source.clock.sleep(0.05)
    before = bytes(device.read(0x82, 65536, 5))
    write(device, *((1, 3, 0) if firmware >= 10 else (5, 0x3000, 0)), SIZE[firmware])
    source.clock.sleep(1.0)
    after = b"".join(transfers(device, timeout_ms=5))
    assert before
    assert after == b""


@given(st.lists(st.sampled_from([4, 16, 512, 1024, 4096, 65536]), min_size=1, max_size=10))
@settings(max_examples=20, deadline=None)
def test_no_word_is_lost_whatever_the_reads(sizes: list[int]) -> None:
    """Assert that reads of any size give all words, in order."""
    words = prepared(0.02)
    device = plugged(VirtualDvxplorer(PreparedWords(words, paced=False)))
    write(device, 1, 12, 1)
    run(device)
    data = b""
    turn = 0
    while True:
        try:
            data += bytes(device.read(0x82, sizes[turn % len(sizes)], 5))
        except usb.core.USBTimeoutError:
            break
        turn += 1
    assert [word for word in np.frombuffer(data, "<u4") if word] == words.tolist()


@pytest.mark.parametrize(("flush_us", "least", "most"), [(1000, 150, 201), (5000, 35, 41), (20_000, 9, 11)])
def test_flush_time(flush_us: int, least: int, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a shorter flush time makes more and shorter transfers of the same words: one for each such time."""
    words = prepared(0.2)
    device = plugged(VirtualDvxplorer(SteppedWords(words, monkeypatch)))
    write(device, 1, 12, flush_us)
    run(device)
    parts = list(transfers(device, timeout_ms=50))
    assert least <= len(parts) <= most
    assert [word for word in np.frombuffer(b"".join(parts), "<u4") if word] == words.tolist()


def test_overflow_loses_the_oldest() -> None:
    """Assert that words nobody fetched are counted, and that the latest are still there."""
    words = prepared(0.1, 500_000)
    camera = VirtualDvxplorer(patient_words(words), fifo_bytes=4000)
    device = plugged(camera)
    run(device)
    time.sleep(0.15)
    data = b"".join(transfers(device))
    left = [word for word in np.frombuffer(data, "<u4") if word]
    assert left == words[-len(left) :].tolist()
    assert 0 < len(left) <= 1000
    assert camera.model.overflowed + len(left) == len(words)


def test_odd_transfers_cut_words_but_lose_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert odd lengths, and the same bytes in all."""
    words = prepared(0.1)
    device = plugged(VirtualDvxplorer(SteppedWords(words, monkeypatch), faults=("odd@0:0.2",)))
    run(device)
    parts = list(transfers(device))
    assert sum(len(part) % 2 for part in parts) > 0.5 * len(parts)
    assert same(decoded(b"".join(parts))[0], decoded(words.tobytes())[0])


# The sources of words.


def test_due_times() -> None:
    """Assert the time of every word after the first TIMESTAMP, over a wrap."""
    t = np.array([0, 0, 250, 1000, 3999], np.int64)
    zeros = np.zeros(5, np.uint16)
    x = np.array([1, 2, 3, 4, 5], np.uint16)
    words = event_words.encode(Events(t, x, zeros, zeros.astype(np.uint8)), first_ms=2**22 - 1)
    kinds = [int(word >> 26) if word < 2**31 else "g" for word in words]
    assert kinds == [2, 1, "g", 1, "g", 1, "g", 2, 1, "g", 2, 1, "g"]
    assert due_us(words).tolist() == [0, 0, 0, 0, 0, 250, 250, 1000, 1000, 1000, 3000, 3999, 3999]
    assert due_us(words[:0]).size == 0


def test_paced_words_come_in_time() -> None:
    """Assert that no word comes before its time, that a stop stops time, and that silence ends a wait."""
    words = prepared(0.3)
    due = due_us(words)
    source = patient_words(words)
    assert source.take(100, 0.01) == b""
    began = source.time.now_s()
    source.run(True)
    taken = 0
    while taken < len(words) // 2:
        taken += len(source.take(4096, 1.0)) // 4
        assert due[taken - 1] <= 1e6 * (source.time.now_s() - began)
    source.run(False)
    assert source.take(4096, 0.05) == b""
    assert source.left == len(words) - taken
    source.run(True)
    while source.left:
        assert source.take(4096, 1.0)
    assert source.take(4096, 0.01) == b""


@pytest.mark.parametrize("most", [4, 1001, 1 << 20])
def test_words_that_are_sent_again_and_again(most: int) -> None:
    """Assert the words of all turns, with later TIMESTAMPs, however they are taken, and none before its time."""
    words = prepared(0.02)
    stamps = words >> 26 == 2
    expected = np.concatenate([np.where(stamps, words + np.uint32(20 * turn), words) for turn in range(3)])
    source = patient_words(words, times=3, period_ms=20)
    due = due_us(expected)
    began = source.time.now_s()
    source.run(True)
    data = b""
    while source.left:
        data += source.take(most, 1.0)
        assert due[(len(data) - 1) // 4] <= 1e6 * (source.time.now_s() - began)
    assert np.frombuffer(data, "<u4").tolist() == expected.tolist()
    assert source.take(most, 0.01) == b""
