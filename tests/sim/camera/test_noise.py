"""Background noise and hot pixels, without a camera."""

import numpy as np
import pytest

from evetac_cli.sim.camera.event_keys import sorted_columns
from evetac_cli.sim.camera.noise import add_noise, hot_rates

FRAME = (64, 48)
HOT = (np.array([5 * 64 + 3, 40 * 64 + 60]), np.array([0.0, 2000.0, 8000.0]))


def sampled(noise_rate_hz: float, slices: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and polarities of the noise of some slices."""
    rng = np.random.default_rng(0)
    keys = np.empty(10_000, np.int64)
    pixels, signs = [], []
    for _ in range(slices):
        _, x, y, p = sorted_columns(keys[: add_noise(noise_rate_hz, *HOT, FRAME, rng, keys, 0)], 0)
        pixels.append(y.astype(np.int64) * FRAME[0] + x)
        signs.append(p)
    return np.concatenate(pixels), np.concatenate(signs)


def test_rates() -> None:
    """Assert the asked rates of background and of each hot pixel within 5 sd of a Poisson count, polarities even."""
    slices = 2000
    pixels, signs = sampled(3.0, slices)
    hot = [np.count_nonzero(pixels == pixel) for pixel in HOT[0]]
    background = len(pixels) - sum(hot)
    for result, rate_hz in ((hot[0], 2003.0), (hot[1], 6003.0), (background, 3.0 * (64 * 48 - 2))):
        assert result == pytest.approx(rate_hz * slices * 1e-3, abs=5 * (rate_hz * slices * 1e-3) ** 0.5)
    assert signs.mean() == pytest.approx(0.5, abs=5 * 0.5 / len(signs) ** 0.5)


def test_silence() -> None:
    """Assert that without background only hot pixels fire."""
    assert set(sampled(0.0, 50)[0].tolist()) == set(HOT[0].tolist())


def test_full_keys_are_counted() -> None:
    """Assert that events beyond the room for them are counted, and that those made before are left alone."""
    keys = np.full(3, -7, np.int64)
    made = add_noise(1e4, *HOT, FRAME, np.random.default_rng(0), keys, 2)
    assert made > 1000
    assert (keys[:2] == -7).all() and keys[2] != -7


def test_hot_rates_follow_their_quantiles() -> None:
    """Assert that drawn rates have the given evenly spaced quantiles."""
    rates = hot_rates((10.0, 20.0, 100.0), 20_000, np.random.default_rng(0))
    np.testing.assert_allclose(np.quantile(rates, [0.25, 0.5, 0.75]), [15.0, 20.0, 60.0], rtol=0.03)
    assert rates.min() >= 10.0 and rates.max() <= 100.0
