"""The gel at rest from events of its motion: runs, rests, and what noise must not do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.kernels.calibration import rest_image
from evetac_cli.kernels.calibration.rest_image import image, quiet_spells, start, step


def seen(polarities: list[int], *, backwards: bool = False, packet: int = 1000) -> tuple[int, int]:
    """What a block of 3 x 3 pixels, all with these events in turn, came to: brighter, darker."""
    state = start((9, 9))
    y, x = (axis.ravel().astype(np.uint16) for axis in np.mgrid[3:6, 3:6])
    events = [(x, y, np.full(9, p, np.uint8)) for p in polarities]
    packets = [events[first : first + packet] for first in range(0, len(events), packet)]
    for part in packets[::-1] if backwards else packets:
        step(state, *(np.concatenate(column) for column in zip(*part, strict=True)), backwards=backwards)
    picture = image(state)
    assert picture.brighter.shape == (9, 9)
    assert not picture.brighter[:3].any()
    return int(picture.brighter[4, 4]), int(picture.darker[4, 4])


def test_only_the_first_run_counts() -> None:
    """Assert that a pixel has the length of its first run, whatever follows, and nothing on the other side."""
    assert seen([1] * 5 + [0] * 9 + [1] * 30) == (5, 0)
    assert seen([0] * 7 + [1] * 2 + [0] * 20) == (0, 7)
    assert seen([]) == (0, 0)


def test_stray_events_end_nothing() -> None:
    """Assert that one event of the other polarity, before a run or within it, costs at most one event of the run."""
    assert seen([0] + [1] * 6 + [0] * 9) == (5, 0)
    assert seen([1, 1, 1, 0, 1, 1, 1] + [0] * 9) == (5, 0)


@given(st.lists(st.integers(0, 1), max_size=30), st.integers(1, 7))
@settings(deadline=None, max_examples=60)
def test_backwards_is_time_reversed(polarities: list[int], packet: int) -> None:
    """Assert that playing back is the same as playing the reversed events of the other polarity, however cut."""
    mirrored = [1 - p for p in polarities[::-1]]
    assert seen(polarities, backwards=True, packet=packet) == seen(mirrored)


def test_endless_runs_are_cut() -> None:
    """Assert that a pixel that fires 10^5 times with one polarity neither overflows nor wraps around."""
    brighter, darker = seen([1] * 100_000, packet=100_000)
    assert (brighter, darker) == (rest_image.MOST_EVENTS, 0)


def test_hot_pixels_and_foreign_places_are_left_out() -> None:
    """Assert that a pixel that fires alone is not in the picture, and events outside the frame are ignored."""
    state = start((20, 10))
    hot = np.full(50, 5, np.uint16)
    step(state, hot, hot, np.ones(50, np.uint8))
    outside = np.array([20, 65535, 3, 3], np.uint16), np.array([3, 3, 10, 65535], np.uint16), np.ones(4, np.uint8)
    step(state, *outside)
    assert state.highest.sum() == 50
    assert not image(state).brighter.any()


@pytest.mark.parametrize("noise", [0, 10, 95])
def test_rests_are_found(noise: int) -> None:
    """Assert that rests between strokes are found to 20 ms, in noise as of a quiet and of a bare camera."""
    rate = np.full(3000, noise)
    for first in (300, 1200, 2100):
        rate[first : first + 600] += 800
    spells = quiet_spells(np.random.default_rng(0).poisson(rate))
    assert len(spells) == 4
    expected = [(0, 300), (900, 1200), (1800, 2100), (2700, 3000)]
    assert np.abs(np.array(spells) - expected).max() <= 20


def test_rests_where_nothing_or_everything_moves() -> None:
    """Assert that stillness and steady motion are one spell, and that too short a recording has none."""
    assert quiet_spells(np.zeros(1000, np.int64)) == [(0, 1000)]
    assert quiet_spells(np.full(1000, 5000)) == [(0, 1000)]
    assert quiet_spells(np.zeros(49, np.int64)) == []
    assert quiet_spells(np.zeros(0, np.int64)) == []
