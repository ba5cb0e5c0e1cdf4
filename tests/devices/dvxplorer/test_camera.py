"""The driver of the DVXplorer Mini against its virtual twin: pyusb, threads and all, but for the cable."""

import errno
import time
from collections.abc import Iterator
from contextlib import closing
from threading import Thread
from typing import Any

import numpy as np
import pytest
import usb.backend
import usb.core
from numpy.typing import NDArray

from evetac_cli.devices import EventCamera
from evetac_cli.devices.dvxplorer import camera as dvxplorer
from evetac_cli.devices.dvxplorer import event_words, protocol, usb_reader
from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera, find_cameras
from evetac_cli.devices.dvxplorer.protocol import READOUT_RATES, DvxplorerSettings
from evetac_cli.devices.virtual.dvxplorer import STORE_TO_FLASH, VirtualDvxplorer
from evetac_cli.devices.virtual.word_sources import PreparedWords, random_event_words
from evetac_cli.errors import DeviceError, DeviceTimeout
from evetac_cli.events import SLICE_US, Events, concatenate
from evetac_cli.realtime.shared_time import CREEP, HOST_TIME, PATIENCE_S, READER_S
from tests.patience import patient_words


def few(seconds: float, events_per_s: float = 20_000) -> NDArray[np.uint32]:
    return random_event_words(events_per_s, seconds, np.random.default_rng(0))


def decoded(words: NDArray[np.uint32]) -> Events:
    """Events of a stream, t = 0 at its first TIMESTAMP."""
    decoder = event_words.start()
    events = concatenate([event_words.step(decoder, words.tobytes()), event_words.flush(decoder)])
    assert decoder.first_ms is not None
    return events._replace(t=events.t - SLICE_US * decoder.first_ms)


def read(camera: EventCamera, slices: int) -> Events:
    """So many slices as one, each checked to be where it belongs."""
    parts = []
    for index in range(slices):
        part = camera.read()
        assert part is not None
        assert ((part.t // SLICE_US) == index).all()
        parts.append(part)
    return concatenate(parts)


def lost(camera: EventCamera) -> dict[str, int]:
    return {name: count for name, count in camera.counted.items() if count}


def same(one: Events, other: Events) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


class Nothing:
    """A sensor that sees nothing."""

    time = HOST_TIME

    def run(self, on: bool) -> None:
        pass

    def take(self, most: int, timeout_s: float) -> bytes:
        time.sleep(timeout_s)
        return b""


class VirtualBus(usb.backend.IBackend):  # type: ignore[misc]
    """Several virtual cameras on one bus."""

    def __init__(self, *cameras: VirtualDvxplorer) -> None:
        super().__init__()
        self._cameras = cameras

    def enumerate_devices(self) -> Iterator[Any]:
        for camera in self._cameras:
            yield from camera.enumerate_devices()

    def get_device_descriptor(self, dev: Any) -> Any:
        descriptor = dev.get_device_descriptor(dev)
        descriptor.address += self._cameras.index(dev)
        return descriptor


def _of_the_camera(name: str) -> Any:
    return lambda self, dev, *arguments: getattr(dev, name)(dev, *arguments)


for _name in (
    *("get_parent", "get_configuration_descriptor", "get_interface_descriptor", "get_endpoint_descriptor"),
    *("open_device", "close_device", "set_configuration", "get_configuration", "claim_interface", "clear_halt"),
    *("release_interface", "ctrl_transfer", "bulk_read", "intr_read", "is_kernel_driver_active"),
):
    setattr(VirtualBus, _name, _of_the_camera(_name))


@pytest.mark.parametrize(("firmware", "slices"), [(9, 200), (10, 1000)])
def test_no_event_is_lost(firmware: int, slices: int) -> None:
    """Assert that every event of a second comes at a million a second, in 1000 slices; and so with firmware 9."""
    words = random_event_words(1e6, (slices + 10) / 1000, np.random.default_rng(0))
    expected = decoded(words)
    device = VirtualDvxplorer(patient_words(words), firmware=firmware)
    with closing(DvxplorerCamera(backend=device)) as camera:
        events = read(camera, slices)
        assert camera.sensor["sensor/frame_px"].tolist() == [640, 480]
        assert lost(camera) == {}
    assert same(events, expected.part(0, events.size))
    assert events.size == 1000 * slices
    assert device.model.overflowed == 0


def test_host_time_of_a_slice() -> None:
    """Assert that no slice is handed out before it is over by the host's clock, as host_us tells it."""
    source = patient_words(few(0.4))
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(source))) as camera:
        for index in range(300):
            camera.read()
            assert camera.host_us(SLICE_US * (index + 1)) <= source.time.now_s() * 1e6 + 1
        assert source._began_s is not None
        assert 0 <= camera.host_us(0) - 1e6 * source._began_s < 50e3


def test_time_waits_for_the_first_read() -> None:
    """Assert that the stream of a virtual camera waits for who reads it from its start, not from the first slice on."""
    source = patient_words(few(0.4))
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(source))) as camera:
        began_s = time.monotonic()
        time.sleep(0.3)  # as a program that is kept from running
        assert source._began_s is not None
        passed_s = source.time.now_s() - source._began_s
        waited_s = time.monotonic() - began_s
        assert passed_s < READER_S + CREEP * waited_s + max(0.0, waited_s - PATIENCE_S) + 5e-3
        read(camera, 300)
        assert lost(camera) == {}


def test_close_ends_a_read() -> None:
    """Assert that a read that waits in another thread ends with None when the camera is closed."""
    camera = DvxplorerCamera(backend=VirtualDvxplorer(Nothing()))
    got: list[Any] = []

    def wait() -> None:
        while True:
            got.append(camera.read())
            if got[-1] is None:
                return

    waiting = Thread(target=wait)
    waiting.start()
    time.sleep(0.05)
    camera.close()
    waiting.join(5)
    assert not waiting.is_alive()


def writes(device: VirtualDvxplorer) -> list[tuple[int, ...]]:
    """The requests a camera obeyed: (request, value) or, of a parameter, (module, parameter, value)."""
    return [
        (value, index, int.from_bytes(data, "big")) if request == protocol.CONFIG else (request, value)
        for request, value, index, data in device.log
    ]


def test_measured_order_of_firmware_10() -> None:
    """Assert the start that was measured from the maker's driver, with a flush every ms, and the stop at the end."""
    device = VirtualDvxplorer(Nothing())
    DvxplorerCamera(backend=device).close()
    stop = [(1, 3, 0), (3, 2, 0), (3, 3, 0), (3, 4, 0)]
    start = [
        *((0xB1, 2), (0xC6, 0)),
        *stop,
        *((1, 13, 8), (1, 14, 9), (1, 15, 9), (1, 4, 0), (1, 5, 0), (1, 6, 0), (1, 8, 1), (1, 9, 0), (1, 10, 0)),
        *((1, 19, 0), (1, 20, 0), (1, 21, 640), (1, 22, 480), (1, 23, 0), (1, 11, 1), (1, 12, 1000)),
        *((1, 24, 0), (1, 23, 0), (1, 25, 0), (1, 23, 0)),
        (1, 3, 1),
    ]
    assert writes(device) == start + stop
    assert {len(data) for request, *_, data in device.log if request == protocol.CONFIG} == {8}


def test_measured_order_of_firmware_9() -> None:
    """Assert that sensor registers are written before the clock is reset and the stream mode set, with 4 bytes each."""
    device = VirtualDvxplorer(Nothing(), firmware=9)
    DvxplorerCamera(backend=device).close()
    sent = writes(device)
    assert sent[-8:] == [
        *((5, 0x3238, 1), (5, 0x3238, 0), (5, 0x3000, 2)),
        *((5, 0x3000, 0), (1, 3, 0), (3, 2, 0), (3, 3, 0), (3, 4, 0)),
    ]
    bias = [(5, 0x18, 4), (5, 0xC, 0x14), (5, 0xB, 6), (5, 0x12, 0x7D), (5, 0x1C, 0), (5, 0x1E, 8)]
    assert sent[5:11] == bias
    assert (5, 0x3255, 0x0D) in sent  # global hold set, the other bits as they were
    assert (5, 0x3067, 0x80) in sent
    assert (5, 0x3200, 0x06) in sent
    assert {len(data) for *_, data in device.log} == {4}
    last = {register: value for module, register, value in sent if module == 5}
    assert [last[register] for register in (0x325C, 0x325D, 0x325E, 0x3240, 0x3241, 0x3242)] == [0, 0xAF, 0xC8, 0, 0, 7]
    assert [last[register] for register in (0x3261, 0x3262, 0x3251, 0x3201)] == [0, 15, 10, 1]


@pytest.mark.parametrize(
    ("on", "off", "expected"),
    [
        (0, 0, {0x1C: 0, 0xB: 4, 0x1E: 8, 0x12: 0x7F}),
        (8, 8, {0x1C: 8, 0xB: 4, 0x1E: 0, 0x12: 0x7F}),
        (9, 9, {0x1C: 0, 0xB: 6, 0x1E: 8, 0x12: 0x7D}),
        (17, 17, {0x1C: 8, 0xB: 6, 0x1E: 0, 0x12: 0x7D}),
    ],
)
def test_thresholds(on: int, off: int, expected: dict[int, int]) -> None:
    """Assert thresholds as parameters of firmware 10 and as the registers of firmware 9."""
    settings = DvxplorerSettings(threshold_on=on, threshold_off=off)
    for firmware in (10, 9):
        device = VirtualDvxplorer(Nothing(), firmware=firmware)
        DvxplorerCamera(settings=settings, backend=device).close()
        sent = writes(device)
        wanted = [(1, 14, on), (1, 15, off)] if firmware == 10 else [(5, *each) for each in expected.items()]
        assert set(wanted) <= set(sent)


def test_settings_out_of_range() -> None:
    """Assert a ValueError that names the setting, the range and what was found."""
    for wrong, match in (
        ({"threshold_on": 18}, "threshold_on: expected 0 to 17, found 18"),
        ({"threshold_off": -1}, "threshold_off"),
        ({"readout_rate": "fast"}, "variable-5000"),
        ({"flush_us": 0}, "flush_us"),
    ):
        with pytest.raises(ValueError, match=match):
            DvxplorerSettings(**wrong)  # type: ignore[arg-type]
    codes = [list(READOUT_RATES).index(name) for name in ("constant-100", "lossy-2000", "variable-5000")]
    assert codes == [0, 4, 8]


@pytest.mark.parametrize("firmware", [9, 10])
def test_flash_is_never_written(firmware: int) -> None:
    """Assert that the request to store to flash is not among those sent, in a life with faults."""
    device = VirtualDvxplorer(patient_words(few(0.3)), firmware=firmware, faults=("stall@0.05", "damage@0.1"))
    with closing(DvxplorerCamera(backend=device)) as camera:
        read(camera, 200)
    assert device.log
    assert STORE_TO_FLASH not in {request for request, *_ in device.log}
    assert STORE_TO_FLASH not in {value for value in vars(protocol).values() if isinstance(value, int)}


def test_stale_words_are_not_ours() -> None:
    """Assert that what an earlier run left in the camera is thrown away."""
    for firmware in (9, 10):
        device = VirtualDvxplorer(PreparedWords(few(0.2, 500_000), paced=False), firmware=firmware)
        left_running(device)
        words = few(0.2)
        device.model._source = patient_words(words)
        with closing(DvxplorerCamera(backend=device)) as camera:
            events = read(camera, 100)
            assert lost(camera) == {}
        assert same(events, decoded(words).part(0, events.size))


def left_running(device: VirtualDvxplorer) -> None:
    """As after a program that was killed: the camera's buffer is full."""
    size = device.model.generation.value
    module, parameter, value = (1, 3, 1) if size == 8 else (5, 0x3000, 2)
    device.ctrl_transfer(None, 0x40, 0xBF, module, parameter, value.to_bytes(size, "big"), 100)
    device.model.transfer(4, 0.01)


# What goes wrong.


@pytest.mark.parametrize(
    ("device", "words"),
    [
        (VirtualDvxplorer(Nothing(), faults=("no-permission",)), ["no permission to open", "errno 13", "doctor udev"]),
        (VirtualDvxplorer(Nothing(), faults=("busy",)), ["DXM00042", "another program", "errno 16", "close DV"]),
        (VirtualDvxplorer(Nothing(), faults=("unplug@0",), board=3), ["no such camera", "none on the bus", "doctor"]),
        (VirtualDvxplorer(Nothing(), board=2), ["not a DVXplorer Mini", "board 4", "board 2"]),
    ],
    ids=["no permission", "busy", "not there", "wrong model"],
)
def test_cameras_that_cannot_be_opened(device: VirtualDvxplorer, words: list[str]) -> None:
    """Assert a DeviceError that says where, what was found and what to do; and nothing is sent to the camera."""
    bus = VirtualBus() if "none on the bus" in words else device
    with pytest.raises(DeviceError) as error:
        DvxplorerCamera(backend=bus)
    for word in (*words, "try:"):
        assert word in str(error.value)
    assert device.log == []


def test_cameras_are_told_apart_by_serial() -> None:
    """Assert that each of two cameras on a bus gives its own events, and that no name, or a wrong one, is refused."""
    streams = [random_event_words(20_000, 0.3, np.random.default_rng(seed)) for seed in range(2)]
    devices = [VirtualDvxplorer(patient_words(words), serial=f"CAM{k}") for k, words in enumerate(streams)]
    bus = VirtualBus(*devices)
    assert [camera.serial for camera in find_cameras(bus)] == ["CAM0", "CAM1"]
    with pytest.raises(DeviceError, match="several cameras") as error:
        DvxplorerCamera(backend=bus)
    assert "CAM0, CAM1" in str(error.value)
    with pytest.raises(DeviceError, match="no such camera"):
        DvxplorerCamera("CAM2", backend=bus)
    with (
        closing(DvxplorerCamera("CAM1", backend=bus)) as second,
        closing(DvxplorerCamera("CAM0", backend=bus)) as first,
    ):
        for camera, words in zip((first, second), streams, strict=True):
            events = read(camera, 200)
            assert same(events, decoded(words).part(0, events.size))
        # the second was started before the first
        assert first.host_us(0) > second.host_us(0)


def test_looking_changes_nothing() -> None:
    """Assert that find_cameras reads serial, model, firmware and link without a request to the camera."""
    device = VirtualDvxplorer(Nothing(), firmware=9, faults=("usb2", "busy"))
    (camera,) = find_cameras(device)
    assert (camera.serial, camera.board, camera.firmware, camera.speed) == ("DXM00042", 4, 9, 3)
    assert device.log == []
    (camera,) = find_cameras(VirtualDvxplorer(Nothing(), faults=("no-permission",)))
    assert camera.serial is None


@pytest.mark.parametrize(("fault", "firmware", "word"), [("usb2", 10, "USB 2"), ("log@0", 11, "firmware 11")])
def test_notes(fault: str, firmware: int, word: str) -> None:
    """Assert that what does not keep a camera from running is in its notes."""
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(Nothing(), firmware=firmware, faults=(fault,)))) as camera:
        assert any(word in note for note in camera.notes)


def test_log_of_the_camera() -> None:
    """Assert that the document's log packet is read and put into words."""
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(Nothing(), faults=("log@0",)))) as camera:
        for _ in range(2000):
            if camera.read() is None or camera.messages:
                break
        assert camera.messages == ("sensor fault (code 7, at 123456)",)


def test_unplugged() -> None:
    """Assert that slices that were over come first, then an error in words, each time, and that close is quiet."""
    device = VirtualDvxplorer(patient_words(few(0.5)), faults=("unplug@0.4",))
    camera = DvxplorerCamera(backend=device)
    slices = 0
    with pytest.raises(DeviceError, match="no longer on the bus") as error:
        while camera.read() is not None:
            slices += 1
    assert "DXM00042" in str(error.value)
    assert "plug it in again" in str(error.value)
    assert 50 < slices <= 405
    with pytest.raises(DeviceError):
        camera.read()
    assert set(lost(camera)) <= {"usb_errors", "events_after_last_slice"}
    camera.close()
    assert camera.read() is None


def test_camera_that_answers_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a request without an answer ends after its time limit, in words, and the flush is not needed."""
    monkeypatch.setattr(dvxplorer, "CONTROL_TIMEOUT_MS", 50)
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(Nothing(), faults=("slow-flush",)))) as camera:
        assert read(camera, 5).size == 0
    device = VirtualDvxplorer(Nothing())
    device.model.write = lambda *_: (_ for _ in ()).throw(usb.core.USBTimeoutError("Operation timed out", -7, 110))  # type: ignore[method-assign]
    with pytest.raises(DeviceTimeout, match="did not answer in time"):
        DvxplorerCamera(backend=device)


def test_a_stall_is_cleared() -> None:
    """Assert that a halted endpoint costs nothing, and that one that stays halted is an error after some tries."""
    words = few(0.4)
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(patient_words(words), faults=("stall@0.1",)))) as camera:
        events = read(camera, 300)
        assert lost(camera) == {"usb_errors": 1}
    assert same(events, decoded(words).part(0, events.size))
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(Nothing(), faults=("stall-for-good@0.02",)))) as camera:
        with pytest.raises(DeviceError, match="Pipe error"):
            read(camera, 1000)
        assert lost(camera)["usb_errors"] == usb_reader.ERRORS_IN_A_ROW + 1


def test_a_bad_transfer_is_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that after an error that may have cost bytes nothing is believed before the next TIMESTAMP."""
    words = few(0.4, 200_000)
    device = VirtualDvxplorer(patient_words(words))
    bulk_read = device.bulk_read
    sent = [0]

    def bad(*arguments: Any) -> int:
        count: int = bulk_read(*arguments)
        before, sent[0] = sent[0], sent[0] + count
        if before < 2 * words.size <= sent[0]:  # half of the bytes
            raise usb.core.USBError("Overflow", -8, errno.EOVERFLOW)
        return count

    monkeypatch.setattr(device, "bulk_read", bad)
    with closing(DvxplorerCamera(backend=device)) as camera:
        events = read(camera, 300)
        missing = lost(camera)
    assert missing.pop("usb_errors") == missing.pop("failed_transfers") == 1
    assert missing.keys() <= {"events_in_dropped_frames", "missing_words"}
    expected = decoded(words)
    rows = set(zip(*(column.tolist() for column in expected), strict=True))
    assert rows >= set(zip(*(column.tolist() for column in events), strict=True))
    assert events.size < 300 * 200


FAULTS = {
    "lost-timestamps@0.1:0.05": {"missing_words", "events_in_dropped_frames"},
    "odd@0.1:0.1": set[str](),
    "torn@0.1": {"torn_bytes", "events_in_dropped_frames"},
    "damage@0.1:0.05": {"events_in_dropped_frames"},
    "silence@0.1:0.05": set[str](),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_damage_is_counted_and_ends(fault: str) -> None:
    """Assert that no fault stops the slices, that it costs only its own time, and that what can be known is counted."""
    words = few(0.4, 200_000)
    expected = decoded(words)
    device = VirtualDvxplorer(patient_words(words), faults=(fault,))
    with closing(DvxplorerCamera(backend=device)) as camera:
        parts = [camera.read() for _ in range(350)]
        missing = lost(camera)
    assert FAULTS[fault] <= set(missing)
    starts = np.searchsorted(expected.t, np.arange(351) * SLICE_US)
    whole = [
        part is not None and same(part, expected.part(a, b))
        for part, a, b in zip(parts, starts, starts[1:], strict=False)
    ]
    if fault.startswith("odd"):
        assert all(whole)
        assert missing == {}
    else:
        assert not all(whole)
        assert sum(whole) > 100
        gone = expected.part(0, int(starts[350])).size - sum(part.size for part in parts if part is not None)
        assert gone > 0


def test_reader_too_slow() -> None:
    """Assert that a full queue drops the oldest, that its events are counted, and that the rest is whole."""
    words = few(0.3, 500_000)
    expected = decoded(words)
    device = VirtualDvxplorer(patient_words(words))
    with closing(DvxplorerCamera(backend=device, queue_bytes=100_000)) as camera:
        while camera.counted["events_in_full_queue"] <= 20_000:
            time.sleep(0.01)
        parts = [camera.read() for _ in range(330)]
        missing = lost(camera)
    got = concatenate([part for part in parts if part is not None])
    dropped = missing.pop("events_in_full_queue")
    # besides: the frame that the gap cut, and what came before the next TIMESTAMP
    cut = sum(missing.pop(name, 0) for name in ("events_in_dropped_frames", "events_before_first_timestamp"))
    assert dropped > 20_000
    assert missing.keys() <= {"missing_words", "ms_without_time"}  # the words are over before the last slice is
    assert expected.size == got.size + dropped + cut
