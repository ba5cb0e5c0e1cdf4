"""The spread of thresholds, from counts whose spread is known."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import mismatch

SHAPE = (160, 200)
RATIO = 8.0


def counted(spread: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Events of two halves of strokes: a smooth picture, own thresholds, what is alike in both, chance of each half."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    seen = 80.0 + 30.0 * np.sin(x / 30.0) * np.cos(y / 40.0)
    alike = mismatch.ALIKE / RATIO * rng.standard_normal(SHAPE)
    own = np.exp(alike - mismatch.SENSITIVITY * spread * rng.standard_normal(SHAPE))
    first, second = (np.round(seen * own + 3.0 * rng.standard_normal(SHAPE)).astype(np.int64) for _ in range(2))
    return first, second


@pytest.mark.parametrize("spread", [0.03, 0.05, 0.08])
def test_the_spread_is_found(spread: float) -> None:
    """Assert that the interval holds the spread in about 95 of 100 cases, here in 16 of 20 at least."""
    result = [mismatch.estimate(*counted(spread, seed), RATIO, np.random.default_rng(seed)) for seed in range(20)]
    assert sum(one.low <= spread <= one.high for one in result) >= 16
    assert np.mean([one.value for one in result]) == pytest.approx(spread, rel=0.1)


def test_equal_thresholds() -> None:
    """Assert that neither chance nor what is alike in both halves is taken for a spread."""
    result = mismatch.estimate(*counted(0.0, 1), RATIO, np.random.default_rng(0))
    assert result.low == 0.0 and result.value < 0.01


def test_too_few_events() -> None:
    """Assert that a picture in which hardly anything moved is refused."""
    few = np.full(SHAPE, 3)
    with pytest.raises(ValueError, match="20 events a half"):
        mismatch.estimate(few, few, RATIO, np.random.default_rng(0))
