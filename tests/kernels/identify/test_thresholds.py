"""The thresholds of pixels: events that scans merge, and the ratio and spreads, from counts that are known."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import thresholds

FRAME_PX = (8, 4)

WIDE = (200, 300)

SHAPE = (160, 200)
RATIO = 8.0


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
        state = thresholds.start(FRAME_PX)
        t_us, p = scanned(speed, 3.0, threshold, seed)
        place = np.full(len(t_us), 2, np.uint16)
        thresholds.add(state, t_us, place, place, p, 1)
        passed.append((threshold * state.on[1, 2, 2], threshold * state.off[1, 2, 2]))
    assert np.mean(passed, axis=0) == pytest.approx(2.9, abs=0.15)
    assert state.on[0].sum() == 0 and state.events[1].sum() == len(t_us)


def test_slow_strokes_lose_nothing() -> None:
    """Assert that all events are kept where nothing moves fast, and that nothing at all keeps all."""
    state = thresholds.start(FRAME_PX)
    assert state.kept_share == 1.0
    t_us, p = scanned(0.002, 3.0, 0.2, 0)
    place = np.zeros(len(t_us), np.uint16)
    thresholds.add(state, t_us, place, place, p, 0)
    assert state.kept_share > 0.99


def of_each_polarity(off_over_on: float, spread: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """ON and OFF events of pixels that rise as much as they fall, but for one unfinished threshold of either."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: WIDE[0], : WIDE[1]]
    climbed = 55.0 + 30.0 * np.sin(x / 30.0) * np.cos(y / 40.0)
    own = 1.0 + spread * rng.standard_normal((2, *WIDE))
    beside = 1.0 + np.sqrt(thresholds.ALIKE_VARIANCE) * rng.standard_normal(WIDE)
    on = climbed / own[0] + rng.uniform(-1.0, 1.0, WIDE)
    off = climbed / own[1] / off_over_on * beside + rng.uniform(-1.0, 1.0, WIDE)
    return np.maximum(on, 0.0), np.maximum(off, 0.0)


@pytest.mark.parametrize(("ratio", "spread"), [(0.8, 0.03), (1.0, 0.05), (1.25, 0.08)])
def test_both_are_found(ratio: float, spread: float) -> None:
    """Assert that the intervals hold ratio and spread in about 95 of 100 cases, here in 9 of 10 at least."""
    held = np.zeros(2)
    for seed in range(10):
        estimated = thresholds.of_either_polarity(
            *of_each_polarity(ratio, spread, seed), 0.0, np.random.default_rng(seed)
        )
        truth = (estimated.off_over_on, ratio), (estimated.mismatch, spread)
        held += [one.low <= value <= one.high for one, value in truth]
    assert (held >= 9).all(), held


def test_one_threshold_for_both() -> None:
    """Assert that pixels whose ON and OFF have one threshold show none that differ apart."""
    estimated = thresholds.of_either_polarity(*of_each_polarity(1.0, 0.0, 3), 0.0, np.random.default_rng(0))
    assert estimated.mismatch.low == 0.0 and estimated.mismatch.high < 0.02


def test_noise_and_hot_pixels_change_little() -> None:
    """Assert that known noise is taken off, and that hot pixels do not count."""
    on, off = of_each_polarity(1.2, 0.03, 5)
    rng = np.random.default_rng(1)
    on, off = (side + rng.poisson(2.0, WIDE) for side in (on, off))
    hot = rng.random(WIDE) < 0.002
    on, off = np.where(hot, 900.0, on), np.where(hot, 900.0, off)
    estimated = thresholds.of_either_polarity(on, off, 2.0, np.random.default_rng(0))
    assert estimated.off_over_on.low <= 1.2 <= estimated.off_over_on.high


def test_too_few_events_of_either_polarity() -> None:
    """Assert that a picture in which hardly anything moved, or hot pixels alone, is refused."""
    few = np.full(WIDE, 3.0)
    with pytest.raises(ValueError, match="10 ON and OFF events"):
        thresholds.of_either_polarity(few, few, 0.0, np.random.default_rng(0))
    spots = np.where(np.random.default_rng(0).random(WIDE) < 0.1, 500.0, 0.0)
    with pytest.raises(ValueError, match="as busy as their neighbours"):
        thresholds.of_either_polarity(spots, spots, 0.0, np.random.default_rng(0))


def of_halves(spread: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Events of two halves of strokes: a smooth picture, own thresholds, what is alike in both, chance of each half."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    seen = 80.0 + 30.0 * np.sin(x / 30.0) * np.cos(y / 40.0)
    alike = thresholds.ALIKE / RATIO * rng.standard_normal(SHAPE)
    own = np.exp(alike - thresholds.SENSITIVITY * spread * rng.standard_normal(SHAPE))
    first, second = (np.round(seen * own + 3.0 * rng.standard_normal(SHAPE)).astype(np.int64) for _ in range(2))
    return first, second


@pytest.mark.parametrize("spread", [0.03, 0.05, 0.08])
def test_the_spread_is_found(spread: float) -> None:
    """Assert that the interval holds the spread in about 95 of 100 cases, here in 16 of 20 at least."""
    result = [
        thresholds.of_both_polarities(*of_halves(spread, seed), RATIO, np.random.default_rng(seed))
        for seed in range(20)
    ]
    assert sum(one.low <= spread <= one.high for one in result) >= 16
    assert np.mean([one.value for one in result]) == pytest.approx(spread, rel=0.1)
