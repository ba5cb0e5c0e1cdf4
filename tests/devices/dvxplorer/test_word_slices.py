"""Slices of event words that come in reads: closed by device time or by the host's clock, and the clocks between."""

import numpy as np
import pytest

from evetac_cli.devices import losses
from evetac_cli.devices.device_slices import ClockOffset
from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.devices.dvxplorer.camera import WordSlices
from evetac_cli.events import Events

PATIENCE_US = 2000.0


def block(t_us: list[int], first_ms: int = 1, until_ms: int | None = None) -> bytes:
    """Words of one event each at these times."""
    count = len(t_us)
    zeros = np.zeros(count, np.uint16)
    words = event_words.encode(Events(np.array(t_us, np.int64), zeros, zeros, zeros.astype(np.uint8)), first_ms)
    end = [] if until_ms is None else [event_words.timestamp(first_ms + until_ms)]
    return np.concatenate([words, *end]).tobytes()


def running() -> WordSlices:
    slices = WordSlices(PATIENCE_US)
    slices.start(0.0)
    return slices


def test_slices_close_by_device_time() -> None:
    """Assert that a slice is closed by the first word of a later one, empty ones included, however late it is."""
    slices = running()
    assert slices.push_words(block([100, 950], 40), 0.0, 1e3, emptied=True) == []
    closed = slices.push_words(block([3500], 40), 9e9, 9e9, emptied=False)
    assert [part.t.tolist() for part in closed] == [[100, 950], [], []]
    assert slices.open_events == 1
    closed = slices.push_words(block([], 40, until_ms=4), 9e9, 9e9, emptied=False)
    assert [part.t.tolist() for part in closed] == [[3500]]


def test_slices_close_by_the_hosts_clock_when_the_sensor_is_silent() -> None:
    """Assert that an empty read closes what was over, by the camera's clock, so much before it that all has come."""
    slices = running()
    slices.push_words(block([100]), 1e6, 1e6 + 100, emptied=True)  # so device time 0 is host time 1 s
    assert slices.push_words(b"", 1e6 + 1000 + PATIENCE_US - 1, 9e9, emptied=True) == []
    closed = slices.push_words(b"", 1e6 + 1000 + PATIENCE_US, 9e9, emptied=True)
    assert [part.t.tolist() for part in closed] == [[100]]
    closed = slices.push_words(b"", 1e6 + 4000 + PATIENCE_US, 9e9, emptied=True)
    assert [part.size for part in closed] == [0, 0, 0]
    assert slices.push_words(bytes(64), 1e6 + 4999 + PATIENCE_US, 9e9, emptied=True) == []
    assert len(slices.push_words(bytes(64), 1e6 + 5000 + PATIENCE_US, 9e9, emptied=True)) == 1
    assert slices.counted["late_events"] == 0


def test_full_reads_say_nothing_of_silence() -> None:
    """Assert that a read that may have left words in the camera closes nothing by the host's clock."""
    slices = running()
    slices.push_words(block([100]), 0.0, 100.0, emptied=True)
    assert slices.push_words(bytes(64), 9e6, 9e6, emptied=False) == []


def test_late_events_are_counted() -> None:
    """Assert that events of closed slices go nowhere else, and that the rest of their packet is kept."""
    slices = running()
    slices.push_words(block([100]), 0.0, 100.0, emptied=True)
    assert len(slices.push_words(b"", 5000 + PATIENCE_US, 5000 + PATIENCE_US, emptied=True)) == 5
    closed = slices.push_words(block([3000, 4999, 5000], until_ms=6), 9e3, 9e3, emptied=True)
    assert [part.t.tolist() for part in closed] == [[5000]]
    assert slices.counted["late_events"] == 2


def test_silent_from_the_start() -> None:
    """Assert that slices of a silent camera begin on their own, and that its first words go on from there."""
    slices = running()
    assert slices.push_words(b"", 99_999.0, 1e5, emptied=True) == []
    closed = slices.push_words(b"", 100_000.0, 1e5, emptied=True)
    assert len(closed) == 98
    (first,) = slices.push_words(block([10, 20], first_ms=777, until_ms=1), 101e3, 102e3, emptied=True)
    assert first.t.tolist() == [98_010, 98_020]
    assert slices.host_us(98_000) <= 102e3


def test_offset_is_the_least_delay_of_the_window() -> None:
    """Assert that the estimate is the least of a window, follows drift, and forgets."""
    rng = np.random.default_rng(0)
    offset = ClockOffset()
    assert offset.us is None
    for device_us in range(0, 60_000_000, 10_000):
        host_us = 5e6 + 1.00005 * device_us
        offset.add(host_us + rng.exponential(500.0), device_us)
        if device_us > 1e6:
            assert offset.us is not None
            # 5.5 s of 50 ppm back at most, and the least of 500 delays above it
            assert -280 < offset.us - (host_us - device_us) < 50


# A camera whose clock starts anew, and what of that is silence


def ms_of_events(first_ms: int, count: int) -> bytes:
    """Words of so many milliseconds with an event in each, and the TIMESTAMP after them."""
    return block([1000 * ms + 100 for ms in range(count)], first_ms, until_ms=count)


def read_on(slices: WordSlices, first_ms: int, begin_ms: int, count: int) -> int:
    """Reads of a millisecond each, that bring what a camera sends, and leave nothing in it; events in closed slices."""
    events = 0
    for ms in range(count):
        now_us = 1e3 * (begin_ms + ms + 1)
        closed = slices.push_words(ms_of_events(first_ms + ms, 1), now_us - 1e3, now_us, emptied=True)
        events += sum(part.size for part in closed)
    return events


@pytest.mark.parametrize("stalled_ms", [0, 150, 3000])
@pytest.mark.parametrize("jump_ms", [5000, -5000, 100_000])
def test_a_stalled_program_is_no_silent_camera(stalled_ms: int, jump_ms: int) -> None:
    """Assert that where a clock starts anew while the program is kept from running, no time without words is counted.

    All that the camera sent meanwhile comes in one read, at the end of the stall: the number of events lost is known.
    """
    slices = running()
    events = read_on(slices, 10_000, 0, 50)
    jumped = 10_050 + jump_ms
    ended_us = 1e3 * (50 + stalled_ms + 30)
    closed = slices.push_words(ms_of_events(jumped, stalled_ms + 30), 50e3, ended_us, emptied=True)
    events += sum(part.size for part in closed)
    events += read_on(slices, jumped + stalled_ms + 30, 80 + stalled_ms, 800)
    while more := slices.more():
        events += sum(part.size for part in more)
    assert slices.counted["clock_restarts"] >= 1
    assert slices.counted["ms_without_time"] == 0
    assert losses.events_lost(slices.counted) == 50 + stalled_ms + 30 + 800 - events - slices.open_events


def find_nothing(slices: WordSlices, begin_ms: int, count: int) -> None:
    """Reads of a millisecond each that find the camera empty."""
    for ms in range(begin_ms, begin_ms + count):
        slices.push_words(b"", 1e3 * ms, 1e3 * (ms + 1), emptied=True)


@pytest.mark.parametrize("silent_ms", [50, 90, 250, 3000])
def test_a_silence_before_the_first_word_is_counted(silent_ms: int) -> None:
    """Assert that a camera that says nothing after it was started is said to have been silent, for good."""
    slices = running()
    find_nothing(slices, 0, silent_ms)
    read_on(slices, 777, silent_ms, 300)
    counted = slices.counted["ms_without_time"]
    assert counted == 0 if silent_ms < 100 else abs(counted - silent_ms) <= 30


def test_times_that_are_refused_are_no_silence() -> None:
    """Assert that a clock that runs ten times too fast, of which most times are refused, is not called silent."""
    slices = running()
    read_on(slices, 10_000, 0, 50)
    for ms in range(600):
        now_us = 1e3 * (51 + ms)
        slices.push_words(ms_of_events(10_050 + 10 * ms, 1), now_us - 1e3, now_us, emptied=True)
    stalled = b"".join(ms_of_events(10_050 + 10 * ms, 1) for ms in range(600, 1000))
    slices.push_words(stalled, 650e3, 1050e3, emptied=True)
    read_on(slices, 20_050, 1050, 300)
    assert slices.counted["refused_timestamps"] > 100
    assert slices.counted["ms_without_time"] == 0


@pytest.mark.parametrize("silent_ms", [0, 90, 3000])
@pytest.mark.parametrize("jump_ms", [5000, -5000, 0])
def test_a_silence_before_a_new_clock_is_counted(silent_ms: int, jump_ms: int) -> None:
    """Assert that reads that found nothing are time without words, whether or not the clock starts anew after them."""
    slices = running()
    read_on(slices, 10_000, 0, 50)
    find_nothing(slices, 50, silent_ms)
    counts = []
    for ms in range(50 + silent_ms, 850 + silent_ms):
        counts.append(slices.counted["ms_without_time"])
        read_on(slices, 10_000 + ms + jump_ms, ms, 1)
    assert slices.counted["clock_restarts"] == (jump_ms != 0)
    assert counts == sorted(counts)  # what was counted stays so
    counted = slices.counted["ms_without_time"]
    assert counted == 0 if silent_ms < 100 else abs(counted - silent_ms) <= 30
