"""The host's filter against noise: which events it keeps, and that it leaves nothing behind where there is none."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.events import concatenate
from evetac_cli.formats.imports import read_events
from evetac_cli.kernels.noise_filter import NoiseFilter
from evetac_cli.sim.camera.readout import Columns
from tests.sim.camera.small_frames import FRAME, QUIET, line, play, start

NOISY = dataclasses.replace(QUIET, noise_rate_hz=20.0, hot_pixels=3, hot_rate_hz=(500.0, 900.0))


def columns(events: list[tuple[int, int, int]]) -> Columns:
    """Columns of events (time in us, column, row), all of them ON."""
    t, x, y = np.array(events).reshape(-1, 3).T
    return t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), np.ones(len(t), np.uint8)


def kept(events: list[tuple[int, int, int]], support_ms: float = 1.0) -> list[bool]:
    """Which of some events a fresh filter keeps, told one by one."""
    noise_filter = NoiseFilter(support_ms, FRAME)
    return [len(noise_filter.keep(columns([event]))[0]) == 1 for event in events]


def supported(t: Any, x: Any, y: Any, support_us: float) -> np.ndarray:
    """Of all events whether one earlier in the list, at one of the 8 pixels around, is less than so long ago."""
    t, x, y = (np.asarray(column, np.int64) for column in (t, x, y))
    beside = (np.abs(x[:, None] - x) <= 1) & (np.abs(y[:, None] - y) <= 1) & ((x[:, None] != x) | (y[:, None] != y))
    before = np.arange(len(t))[:, None] > np.arange(len(t))
    return (beside & before & (t[:, None] - t < support_us)).any(axis=1)  # type: ignore[no-any-return]


def test_what_supports_an_event() -> None:
    """Assert that any of the 8 pixels around supports an event within the time, its own pixel and others never do."""
    for dx in (-2, -1, 0, 1, 2):
        for dy in (-2, -1, 0, 1, 2):
            beside = max(abs(dx), abs(dy)) == 1
            assert kept([(0, 10 + dx, 10 + dy), (999, 10, 10)]) == [False, beside]
            assert kept([(0, 10 + dx, 10 + dy), (1000, 10, 10)]) == [False, False]


def test_an_event_that_is_left_out_supports_others() -> None:
    """Assert that what is left out counts for what follows beside it, from one slice to the next."""
    assert kept([(0, 5, 5), (900, 6, 5), (1800, 7, 5), (2900, 8, 5)]) == [False, True, True, False]


def test_the_corners_of_the_frame() -> None:
    """Assert that pixels at one edge of the frame do not support those at the other, nor those of the next row."""
    right, bottom = FRAME[0] - 1, FRAME[1] - 1
    assert kept([(0, 0, 0), (1, right, 0), (2, 0, bottom), (3, right, bottom)]) == [False] * 4
    assert kept([(0, right, 7), (1, 0, 8), (2, right, 8)]) == [False, False, True]


@given(
    st.lists(st.tuples(st.integers(0, 3000), st.integers(20, 26), st.integers(20, 26)), min_size=1, max_size=60),
    st.integers(1, 4),
)
def test_against_every_pair(events: list[tuple[int, int, int]], parts: int) -> None:
    """Assert which events are kept against a comparison of all pairs, however the events are cut into slices."""
    events = sorted(events, key=lambda event: event[0])
    t, x, y, _ = columns(events)
    expected = supported(t, x, y, 700.0)
    noise_filter = NoiseFilter(0.7, FRAME)
    cut = np.array_split(np.arange(len(events)), parts)
    left = [noise_filter.keep(columns([events[k] for k in part])) for part in cut if len(part)]
    found = [tuple(event[:3]) for part in left for event in zip(*(column.tolist() for column in part), strict=True)]
    assert found == [event for event, keep in zip(events, expected, strict=True) if keep]
    assert noise_filter.removed == np.count_nonzero(~expected)


@pytest.mark.slow
def test_a_camera_hands_on_what_its_filter_keeps() -> None:
    """Assert that a camera with a filter hands on what all of its events leave of it, to the last column."""
    path = line([[50.0, 40.0]], (0.2, 0.1))
    free = concatenate(play(start([[50.0, 40.0]], NOISY), path, 40))
    state = start([[50.0, 40.0]], dataclasses.replace(NOISY, support_ms=3.0))
    filtered = concatenate(play(state, path, 40))
    expected = free.at(supported(free.t, free.x, free.y, 3000.0))
    assert 0 < filtered.size < free.size
    assert all(map(np.array_equal, filtered, expected))


@pytest.mark.parametrize("support_ms", [2.0, 100.0])
def test_the_makers_filter_keeps_the_same(outside_file: Callable[[str], Path], support_ms: float) -> None:
    """Assert on real noise that the filter keeps, event by event, what the camera maker's library keeps."""
    import datetime

    dv = pytest.importorskip("dv_processing")
    recorded = read_events(outside_file("dvxplorer_static_noise.aedat4")).events
    events = recorded._replace(t=recorded.t + 10**10)  # theirs takes all pixels to have had an event at 0
    store = dv.EventStore()
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        store.push_back(t, x, y, bool(p))
    theirs = dv.noise.BackgroundActivityNoiseFilter((640, 480), datetime.timedelta(milliseconds=support_ms))
    theirs.accept(store)
    wanted = theirs.generateEvents().numpy()
    t, x, y, _ = NoiseFilter(support_ms, (640, 480)).keep(tuple(column.copy() for column in events))  # type: ignore[arg-type]
    assert 0 < len(t) < events.size
    for mine, name in ((t, "timestamp"), (x, "x"), (y, "y")):
        np.testing.assert_array_equal(mine, wanted[name])
