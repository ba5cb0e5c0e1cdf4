"""Streams of words that are damaged, as the driver's decoder and slices meet them: what they may cost, and what not."""

from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera, WordSlices
from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer
from evetac_cli.devices.virtual.word_sources import random_event_words
from evetac_cli.events import Events, Slicer
from tests.devices.dvxplorer.test_camera import Nothing
from tests.patience import patient_words

BLOCK_US = 1000.0  # of the host's time from one read to the next
AHEAD_MS = 25  # that slices may be ahead of the host's time
KINDS = (np.int64, np.uint16, np.uint16, np.uint8)  # of the columns of events


def prepared(seconds: float, events_per_s: float = 200_000) -> NDArray[np.uint32]:
    return random_event_words(events_per_s, seconds, np.random.default_rng(0))


def in_reads(words: NDArray[np.uint32]) -> list[bytes]:
    """The bytes of a stream, a millisecond in each read."""
    return [part.tobytes() for part in np.split(words, np.flatnonzero(words >> 26 == 2)) if len(part)]


def sound() -> list[bytes]:
    return in_reads(prepared(0.4))


def random_words() -> list[bytes]:
    rng = np.random.default_rng(1)
    return [rng.integers(0, 1 << 32, 16384, np.uint32).tobytes() for _ in range(300)]


def random_behind_sound_ones() -> list[bytes]:
    return [*sound()[:50], *random_words()[:100], *sound()[50:]]


def hole_in_a_read() -> list[bytes]:
    reads = sound()
    joined = b"".join(reads[100:300])
    return [*reads[:100], joined[:1001] + joined[1004:], *reads[300:]]


def hole_in_the_first_read() -> list[bytes]:
    joined = b"".join(sound())
    return [joined[:401] + joined[404:]]


def ahead(ms: int) -> list[bytes]:
    words = prepared(0.4)
    words[(words >> 26 == 2) & (np.arange(len(words)) > len(words) // 2)] += np.uint32(ms)
    return in_reads(words)


def one_word_far_ahead() -> list[bytes]:
    return [event_words.timestamp(1).tobytes() + event_words.timestamp(900_000).tobytes(), *sound()]


STREAMS: dict[str, Callable[[], list[bytes]]] = {
    "random words": random_words,
    "random words behind sound ones": random_behind_sound_ones,
    "a hole in a read": hole_in_a_read,
    "a hole in the first read": hole_in_the_first_read,
    "a clock that jumps ahead by 0.9 s": lambda: ahead(900),
    "a clock that jumps ahead by 500 s": lambda: ahead(500_000),
    "a clock that jumps back": lambda: ahead(-150 % (1 << 22)),
    "one word far ahead": one_word_far_ahead,
}


@pytest.fixture
def most(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """The most slices that may be closed: more of them is a failure before memory is full."""
    limit = [0.0]
    close_until = Slicer.close_until

    def checked(slicer: Slicer, slices: int) -> list[Events]:
        assert slices <= limit[0], f"{slices} slices closed in {limit[0]:g} ms"
        return close_until(slicer, slices)

    monkeypatch.setattr(Slicer, "close_until", checked)
    yield limit


@pytest.mark.parametrize("name", STREAMS)
def test_h2_damaged_words_make_no_more_slices_than_the_hosts_time(name: str, most: list[float]) -> None:
    """Assert that slices never run ahead of the host's clock, whatever the words, and that they go on with it."""
    slices = WordSlices(2000.0)
    slices.start(0.0)
    closed = 0
    now_us = 0.0
    for data in [*STREAMS[name](), *[b""] * 200]:
        begun_us, now_us = now_us, now_us + BLOCK_US
        most[0] = now_us * 1e-3 + AHEAD_MS
        closed += len(slices.push_words(data, begun_us, now_us, emptied=True))
    assert closed >= now_us * 1e-3 - 50


@pytest.mark.parametrize("name", ["a hole in a read", "a clock that jumps ahead by 500 s", "a clock that jumps back"])
def test_h2_a_damaged_stream_goes_on(name: str, most: list[float]) -> None:
    """Assert that after damage events come again, those that did not are counted, and slices hold their own time."""
    slices = WordSlices(2000.0)
    slices.start(0.0)
    parts: list[Events] = []
    now_us = 0.0
    for data in [*STREAMS[name](), *[b""] * 20]:
        begun_us, now_us = now_us, now_us + BLOCK_US * max(1, len(data) // 600)
        most[0] = now_us * 1e-3 + AHEAD_MS
        parts += slices.push_words(data, begun_us, now_us, emptied=True)
    assert all(((part.t // 1000) == k).all() for k, part in enumerate(parts))
    got = sum(part.size for part in parts)
    said = slices.counted["events_in_dropped_frames"] + slices.counted["late_events"]
    assert sum(slices.counted.values()) > said  # beside the events, why they were lost
    assert got > 0.45 * 80_000
    assert said <= 80_000 - got
    if "clock" in name:
        assert said == 80_000 - got - slices.open_events


def test_m8_a_camera_that_sends_nothing_is_no_quiet_scene() -> None:
    """Assert that slices of a camera that does not even send the time are counted, and those of a quiet one are not."""
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(Nothing()))) as camera:
        for _ in range(300):
            camera.read()
        assert camera.counted["ms_without_time"] >= 250
    stamps = np.concatenate([event_words.timestamp(ms) for ms in range(1, 400)])
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(patient_words(stamps)))) as camera:
        for _ in range(300):
            camera.read()
        assert not any(camera.counted.values())


@pytest.mark.parametrize(("fault", "ms"), [("silence@0.2:0.3", 300), ("silence@0.3:0.2", 200)])
def test_m8_a_stream_with_a_hole_is_counted(fault: str, ms: int) -> None:
    """Assert that the time in which a stream stood still is counted once it goes on, to the millisecond or two."""
    device = VirtualDvxplorer(patient_words(prepared(0.9)), faults=(fault,))
    with closing(DvxplorerCamera(backend=device)) as camera:
        for _ in range(800):
            camera.read()
        assert abs(camera.counted["ms_without_time"] - ms) <= 30


def test_m8_events_of_damaged_frames_are_counted_but_none_that_never_were() -> None:
    """Assert that most events that damage cost are counted, and no more than the virtual camera's own count."""
    words = prepared(0.6)
    device = VirtualDvxplorer(patient_words(words), faults=("damage@0:3",))
    with closing(DvxplorerCamera(backend=device)) as camera:
        got = sum(part.size for part in (camera.read() for _ in range(550)) if part is not None)
        missing = camera.counted
    lost = 550 * 200 - got
    assert lost > 10_000
    assert 0.8 * lost <= missing["events_in_dropped_frames"] + missing["events_before_first_timestamp"] <= lost


@pytest.mark.parametrize("flood", ["padding", "frames of one time"])
def test_h2_a_flood_without_time_does_not_stop_the_slices(flood: str) -> None:
    """Assert that slices go on by the host's clock though every read is full, and none brings a time."""
    frame = event_words.encode(Events(*(np.zeros(1, kind) for kind in KINDS)))[1:]
    data = bytes(65536) if flood == "padding" else np.tile(frame, 8000).tobytes()
    slices = WordSlices(2000.0)
    slices.start(0.0)
    closed = 0
    for ms in range(2000):
        closed += len(slices.push_words(data, 1e3 * ms, 1e3 * (ms + 1), emptied=False))
    assert closed >= 1400


def test_an_hour_without_the_program_is_handed_out_in_pieces() -> None:
    """Assert that slices of a program that was stopped come a thousand at a time, each with its events, and all do."""
    slices = WordSlices(2000.0)
    slices.start(0.0)
    first, later = (
        in_reads(prepared(0.1))[0],
        event_words.encode(Events(*(np.zeros(1, kind) for kind in KINDS)), 60_000),
    )
    slices.push_words(first, 0.0, 1e3, emptied=True)
    sizes = [part.size for part in slices.push_words(later.tobytes(), 60e6, 60e6, emptied=True)]
    sizes += [
        part.size for part in slices.push_words(event_words.timestamp(60_100).tobytes(), 60.2e6, 60.2e6, emptied=True)
    ]
    while closed := slices.more():
        assert len(closed) <= 1000
        sizes += [part.size for part in closed]
    assert len(sizes) == 60_099
    assert [k for k, size in enumerate(sizes) if size] == [0, 59_999]
