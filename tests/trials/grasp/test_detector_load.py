"""How many events per second a detector can bear, from what it took."""

import pytest

from evetac_cli.trials.grasp.detector_load import EVENTS_OF_A_SLICE, FULL, LoadMeter


def fed(events: int, slice_s: float, event_s: float, slices: int = 2000) -> LoadMeter:
    """A meter of a detector to which a slice and an event cost so much, and which begins with a second of work."""
    taken_s = 0.0
    meter = LoadMeter(lambda: taken_s)
    for k in range(0, slices, 5):
        taken_s += 5 * (slice_s + events * event_s) + (k == 0)
        meter.add(5, 5 * events)
    return meter


@pytest.mark.parametrize("events", [10, 300, 1000])
def test_the_rate_does_not_hang_on_the_rate_at_which_it_was_measured(events: int) -> None:
    """Assert that share and rate are as fed, and that the rate that fills a core is the same from any of them."""
    slice_s = 2e-4
    load = fed(events, slice_s, slice_s / EVENTS_OF_A_SLICE).load()
    assert load is not None
    assert load.core_share == pytest.approx(0.2 * (1.0 + events / EVENTS_OF_A_SLICE))
    assert load.events_per_s == pytest.approx(1e3 * events)
    assert load.bearable_events_per_s == pytest.approx(1e3 * EVENTS_OF_A_SLICE * (FULL / 0.2 - 1.0))
    assert "could process about 3,500,000" in load.words()


def test_a_computer_on_which_slices_alone_fill_a_core() -> None:
    """Assert that it bears no event."""
    load = fed(10, 1e-3, 1e-6).load()
    assert load is not None
    assert load.bearable_events_per_s == 0.0


def test_too_little_to_say() -> None:
    """Assert that a grasp of a second says nothing."""
    assert fed(500, 1e-4, 1e-6, slices=1000).load() is None
