"""The ratio of the thresholds and their spread, from counts whose ratio and spread are known."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import polarity

SHAPE = (200, 300)


def counted(off_over_on: float, spread: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """ON and OFF events of pixels that rise as much as they fall, but for one unfinished threshold of either."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    climbed = 55.0 + 30.0 * np.sin(x / 30.0) * np.cos(y / 40.0)
    own = 1.0 + spread * rng.standard_normal((2, *SHAPE))
    beside = 1.0 + np.sqrt(polarity.ALIKE_VARIANCE) * rng.standard_normal(SHAPE)
    on = climbed / own[0] + rng.uniform(-1.0, 1.0, SHAPE)
    off = climbed / own[1] / off_over_on * beside + rng.uniform(-1.0, 1.0, SHAPE)
    return np.maximum(on, 0.0), np.maximum(off, 0.0)


@pytest.mark.parametrize(("ratio", "spread"), [(0.8, 0.03), (1.0, 0.05), (1.25, 0.08)])
def test_both_are_found(ratio: float, spread: float) -> None:
    """Assert that the intervals hold ratio and spread in about 95 of 100 cases, here in 9 of 10 at least."""
    held = np.zeros(2)
    for seed in range(10):
        estimated = polarity.estimate(*counted(ratio, spread, seed), 0.0, np.random.default_rng(seed))
        truth = (estimated.off_over_on, ratio), (estimated.mismatch, spread)
        held += [one.low <= value <= one.high for one, value in truth]
    assert (held >= 9).all(), held


def test_one_threshold_for_both() -> None:
    """Assert that pixels whose ON and OFF have one threshold show none that differ apart."""
    estimated = polarity.estimate(*counted(1.0, 0.0, 3), 0.0, np.random.default_rng(0))
    assert estimated.mismatch.low == 0.0 and estimated.mismatch.high < 0.02


def test_noise_and_hot_pixels_change_little() -> None:
    """Assert that known noise is taken off, and that hot pixels do not count."""
    on, off = counted(1.2, 0.03, 5)
    rng = np.random.default_rng(1)
    on, off = (side + rng.poisson(2.0, SHAPE) for side in (on, off))
    hot = rng.random(SHAPE) < 0.002
    on, off = np.where(hot, 900.0, on), np.where(hot, 900.0, off)
    estimated = polarity.estimate(on, off, 2.0, np.random.default_rng(0))
    assert estimated.off_over_on.low <= 1.2 <= estimated.off_over_on.high


def test_too_few_events() -> None:
    """Assert that a picture in which hardly anything moved, or hot pixels alone, is refused."""
    few = np.full(SHAPE, 3.0)
    with pytest.raises(ValueError, match="10 events"):
        polarity.estimate(few, few, 0.0, np.random.default_rng(0))
    spots = np.where(np.random.default_rng(0).random(SHAPE) < 0.1, 500.0, 0.0)
    with pytest.raises(ValueError, match="as busy as their neighbours"):
        polarity.estimate(spots, spots, 0.0, np.random.default_rng(0))
