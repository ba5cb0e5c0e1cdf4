"""Slices of event words that come in reads: closed by device time or by the host's clock, and the clocks between."""

import numpy as np

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


def test_gap_drops_to_the_next_timestamp() -> None:
    """Assert that after lost bytes the words up to the next TIMESTAMP are dropped and counted."""
    slices = running()
    slices.push_words(block([100]), 0.0, 100.0, emptied=True)
    rest = np.frombuffer(block([1100, 1200, 2300], until_ms=3), "<u4")[1:].tobytes()  # without its first TIMESTAMP
    closed = slices.push_words(rest, 0.0, 100.0, emptied=True, gap=True)
    assert [part.t.tolist() for part in closed] == [[], [], [2300]]
    assert slices.counted["events_in_dropped_frames"] == 3


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
