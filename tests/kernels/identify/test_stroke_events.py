"""Events of pixels with those that scans merge, from a brightness that rises and falls at known speeds."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import stroke_events

FRAME_PX = (8, 4)


def scanned(speed: float, rise: float, threshold: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Times in us and polarities of a pixel whose log brightness rises by `rise` and falls again, at a speed a scan."""
    rng = np.random.default_rng(seed)
    steps = int(np.ceil(rise / speed))
    up = np.minimum(speed * np.arange(1, steps + 1), rise)
    level = np.concatenate([up, np.full(500, rise), rise - up, np.zeros(500)])
    reference, t_us, p = rng.uniform(-threshold, threshold), [], []
    for scan, value in enumerate(level):
        if abs(value - reference) >= threshold:
            t_us.append(200 * scan)
            p.append(value > reference)
            reference = value
    return np.array(t_us, np.int64), np.array(p, np.uint8)


@pytest.mark.parametrize("speed", [0.007, 0.043, 0.093])
def test_merged_events_are_added(speed: float) -> None:
    """Assert that the events of a rise are its thresholds, however fast it is, less what the last one lacks."""
    passed = []
    for seed, threshold in enumerate(np.linspace(0.15, 0.25, 300)):
        state = stroke_events.start(FRAME_PX)
        t_us, p = scanned(speed, 3.0, threshold, seed)
        place = np.full(len(t_us), 2, np.uint16)
        stroke_events.add(state, t_us, place, place, p, 1)
        passed.append((threshold * state.on[1, 2, 2], threshold * state.off[1, 2, 2]))
    assert np.mean(passed, axis=0) == pytest.approx(2.9, abs=0.15)
    assert state.on[0].sum() == 0 and state.events[1].sum() == len(t_us)


def test_slow_strokes_lose_nothing() -> None:
    """Assert that all events are kept where nothing moves fast, and that nothing at all keeps all."""
    state = stroke_events.start(FRAME_PX)
    assert state.kept_share == 1.0
    t_us, p = scanned(0.002, 3.0, 0.2, 0)
    place = np.zeros(len(t_us), np.uint16)
    stroke_events.add(state, t_us, place, place, p, 0)
    assert state.kept_share > 0.99


def test_what_does_not_fit() -> None:
    """Assert that events outside the frame are left out, and columns of different lengths refused."""
    state = stroke_events.start(FRAME_PX)
    one = np.ones(1, np.uint8)
    stroke_events.add(state, np.zeros(1, np.int64), np.array([8], np.uint16), np.array([1], np.uint16), one, 0)
    assert state.events.sum() == 0
    with pytest.raises(ValueError, match="equal length"):
        stroke_events.add(state, np.zeros(2, np.int64), np.zeros(1, np.uint16), np.zeros(1, np.uint16), one, 0)
