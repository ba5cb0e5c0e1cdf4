"""The noise of an encoder, from readings at rest."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import encoder


@pytest.mark.parametrize("noise_ticks", [0.15, 0.4, 0.7, 1.5])
def test_noise(noise_ticks: float) -> None:
    """Assert the noise of readings at eight places, and at one, where it is less sure."""
    rng = np.random.default_rng(1)
    places = rng.uniform(100, 200, 8)
    rests = [np.floor(place + noise_ticks * rng.normal(size=300)).astype(np.int64) for place in places]
    estimate = encoder.noise(rests)
    assert estimate.low <= noise_ticks <= estimate.high
    assert estimate.value == pytest.approx(noise_ticks, rel=0.15)
    alone = encoder.noise(rests[:1])
    assert alone.high - alone.low > estimate.high - estimate.low


def test_without_noise() -> None:
    """Assert that readings which never change allow no noise or little."""
    estimate = encoder.noise([np.full(300, place) for place in range(8)])
    assert estimate.low < 0.01 and estimate.high < 0.2


def test_without_rest() -> None:
    """Assert that nothing is told by too few readings."""
    with pytest.raises(ValueError, match="never rests"):
        encoder.noise([np.zeros(5, np.int64)])
