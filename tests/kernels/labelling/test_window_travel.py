"""How far an object goes by the events of its window: rates, noise and pixels that never stop."""

import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.kernels.labelling import window_travel
from evetac_cli.kernels.labelling.window_travel import STEP_MS

RATE, FADING_PX = 500.0, 30.0
WINDOW = (565, 0, 640, 480)


@pytest.mark.parametrize("path_px", [0.5, 5.0, 50.0, 400.0])
def test_travel_follows_from_events_that_fade(path_px: float) -> None:
    """Assert that events fading as the module says give back the distance, to the step of the sum, short or long."""
    object_px = np.linspace(0, path_px, 4001)
    moved = RATE * FADING_PX * np.log1p(object_px / FADING_PX)
    reported = window_travel.travel(moved, np.full(4000, RATE), FADING_PX)
    np.testing.assert_allclose(reported, object_px, rtol=0.01, atol=0.01)


def test_medians_are_those_of_all_values_so_far() -> None:
    """Assert that each weighted median is that of a sorted list of the values up to it, also where values are equal."""
    rng = np.random.default_rng(0)
    rates, weights = np.round(rng.random(300), 1), 0.1 * rng.integers(1, 9, 300)
    for count, median in enumerate(window_travel._medians(rates, weights), 1):
        ordered, by = np.array(sorted(zip(rates[:count], weights[:count], strict=True))).T
        reached = np.cumsum(by)
        assert median == ordered[np.searchsorted(reached, 0.5 * reached[-1])]


def test_noise_is_what_the_window_makes_while_the_dots_rest() -> None:
    """Assert that noise of 0.9 events per slice is told to 5 %, of rest amid motion; the least step is a third off."""
    rng = np.random.default_rng(3)
    leading = np.repeat(np.arange(6.0), 13)[:61]
    events = np.concatenate([[0], np.cumsum(rng.poisson(0.9, 3000))])
    for at in np.flatnonzero(np.diff(leading) > 0):
        events[STEP_MS * (at + 1) :] += 500
    assert window_travel.noise_rate(events, leading) == pytest.approx(0.9, rel=0.05)
    assert np.diff(events[::STEP_MS]).min() / STEP_MS < 0.7
    assert window_travel.noise_rate(np.zeros(20, np.int64), np.zeros(1)) == 0.0


def test_a_rate_is_known_from_steps_that_ended_before() -> None:
    """Assert that the rate is the assumed one until a step has told another, 30 ms after its end."""
    gone_px = np.minimum(0.01 * np.arange(601), 4.0)
    moved = 300.0 * FADING_PX * np.log1p(gone_px / FADING_PX)
    rate = window_travel.events_per_px(moved, gone_px[::STEP_MS], RATE, FADING_PX)
    known = 2 * STEP_MS + window_travel.LAG_MS  # the first step is never used
    assert (rate.per_px[:known] == RATE).all()
    assert not rate.is_known[:known].any()
    assert rate.is_known[known:].all()
    np.testing.assert_allclose(rate.per_px[known:], 300.0, rtol=0.01)


def test_hot_pixels_do_not_count() -> None:
    """Assert that a pixel with events in every block of time is left out, and one that an edge passes is not."""
    slices = 1000
    t = np.repeat(np.arange(slices) * 1000, 2)
    x, y = np.tile([600, 610], slices), np.tile([10, 20], slices)
    y[1::2] += np.arange(slices) // 10  # moves on
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), np.zeros(len(t), np.uint8))
    last, busy = np.full((480, 75), -1, np.int64), np.zeros((480, 75), np.int64)
    for first in range(0, len(t), 500):
        window_travel.block_counts(events.part(first, first + 500), WINDOW, last, busy)
    quiet = window_travel.quiet_pixels(busy, slices)
    assert np.argwhere(~quiet).tolist() == [[10, 35]]
    assert window_travel.slice_counts(events, WINDOW, quiet, 0, slices).tolist() == [1] * slices
    assert window_travel.slice_counts(events.part(0, 0), WINDOW, quiet, 0, 3).tolist() == [0, 0, 0]
