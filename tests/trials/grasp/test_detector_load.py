"""How many events per second a detector can bear, from what it took."""

from collections.abc import Callable

import pytest

from evetac_cli.trials.grasp.detector_load import FULL, LoadMeter


def fed(events_of: Callable[[int], int], slice_s: float, event_s: float, slices: int = 2000) -> LoadMeter:
    """A meter of a detector to which a slice and an event cost so much."""
    taken_s = 0.0

    meter = LoadMeter(lambda: taken_s)
    for k in range(0, slices, 5):
        events = events_of(k)
        taken_s += 5 * slice_s + events * event_s
        meter.add(5, events)
    return meter


def test_a_rate_that_does_not_change_gives_a_lower_bound() -> None:
    """Assert that share and rate are as fed, and that all of it counts as growing with the rate."""
    load = fed(lambda k: 500, 1e-4, 1e-6).load()
    assert load is not None
    assert load.core_share == pytest.approx(0.2)
    assert load.events_per_s == pytest.approx(100_000)
    assert load.bearable_events_per_s == pytest.approx(FULL / 0.2 * 100_000)
    assert "took 20% of a core for 100,000 events per s" in load.words()
    assert "could bear 450,000" in load.words()


def test_a_rate_that_changes_tells_what_an_event_costs() -> None:
    """Assert that the rate is found at which slices and events together fill a core."""
    load = fed(lambda k: 250 * (k // 100), 1e-4, 1e-7).load()
    assert load is not None
    assert load.bearable_events_per_s == pytest.approx((FULL - 0.1) / 1e-7, rel=1e-3)


def test_too_little_to_say() -> None:
    """Assert that a grasp of less than a second says nothing, and one without events bears none that it knows of."""
    assert fed(lambda k: 500, 1e-4, 1e-6, slices=900).load() is None
    load = fed(lambda k: 0, 1e-4, 1e-6).load()
    assert load is not None
    assert load.bearable_events_per_s == 0.0
