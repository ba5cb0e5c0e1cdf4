"""Background noise and hot pixels, without a camera."""

import numpy as np
import pytest

from evetac_cli.sim.camera.noise import HotPixels, Noise, add_noise, hot_rates
from evetac_cli.sim.camera.readout import sorted_columns
from evetac_cli.sim.setup.sensor import HotPixelTable

FRAME = (64, 48)
HOT = (np.array([5 * 64 + 3, 40 * 64 + 60]), np.array([0.0, 2000.0, 8000.0]))


def sampled(noise_rate_hz: float, slices: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and polarities of the noise of some slices."""
    rng = np.random.default_rng(0)
    keys = np.empty(10_000, np.int64)
    pixels, signs = [], []
    for _ in range(slices):
        _, x, y, p = sorted_columns(keys[: add_noise(Noise(noise_rate_hz, *HOT), FRAME, 0, rng, keys, 0)], 0)
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
    made = add_noise(Noise(1e4, *HOT), FRAME, 0, np.random.default_rng(0), keys, 2)
    assert made > 1000
    assert (keys[:2] == -7).all() and keys[2] != -7


def test_hot_rates_follow_their_quantiles() -> None:
    """Assert that drawn rates have the given evenly spaced quantiles."""
    rates = hot_rates((10.0, 20.0, 100.0), 20_000, np.random.default_rng(0))
    np.testing.assert_allclose(np.quantile(rates, [0.25, 0.5, 0.75]), [15.0, 20.0, 60.0], rtol=0.03)
    assert rates.min() >= 10.0 and rates.max() <= 100.0


TABLE = HotPixelTable(
    x_px=(3, 60),
    y_px=(5, 40),
    rate_hz=(400.0, 900.0),
    on_share=(0.7, 0.5),
    polarity_change_share=(0.3, 0.9),
    short_interval_share=(0.0, 0.6),
    short_interval_us=(0.0, 150.0),
    dead_time_us=400.0,
)


def of_table(step_us: float, slices: int, seed: int = 0) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Times and polarities of each pixel of TABLE, by x."""
    pixels, keys = HotPixels(TABLE, np.random.default_rng(seed)), np.empty(1000, np.int64)
    columns = [
        sorted_columns(keys[: pixels.add(1000 * number, FRAME[0], step_us, keys, 0)], 1000 * number)
        for number in range(slices)
    ]
    t, x, _, p = (np.concatenate([column[place] for column in columns]) for place in range(4))
    return {place: (t[x == place], p[x == place]) for place in TABLE.x_px}


@pytest.mark.parametrize("step_us", [0.0, 200.0, 197.3])
def test_hot_pixels_of_a_table(step_us: float) -> None:
    """Assert rate, polarity shares and shortest interval of every pixel, and steps of time stamps by column.

    Bounds are 5 sd of the count, or of the share, allowing for runs of one polarity.
    """
    slices = 20_000
    for place, (t, p) in of_table(step_us, slices).items():
        pixel = TABLE.x_px.index(place)
        expected = TABLE.rate_hz[pixel] * slices * 1e-3
        assert len(t) == pytest.approx(expected, abs=5 * 1.6 * expected**0.5)
        change = np.mean(p[1:] != p[:-1])
        assert change == pytest.approx(TABLE.polarity_change_share[pixel], abs=0.03)
        assert p.mean() == pytest.approx(TABLE.on_share[pixel], abs=0.04)
        assert np.diff(t).min() >= (0.0 if step_us else 1.0) + TABLE.dead_time_us - 2 - step_us
        if step_us:
            phase = (t + 0.5 - step_us * place / FRAME[0]) / step_us
            np.testing.assert_allclose(phase, np.round(phase), atol=0.6 / step_us)


def test_intervals_mix_two_exponentials() -> None:
    """Assert the distribution of times between events against its closed form, to 0.02 (20,000 events)."""
    t, _ = of_table(0.0, 22_000)[60]
    beyond_us = np.diff(t) - TABLE.dead_time_us
    long_us = (1e6 / 900.0 - 400.0 - 0.6 * 150.0) / 0.4
    for at_us in (50.0, 150.0, 500.0, 2000.0):
        expected = 0.6 * np.exp(-at_us / 150.0) + 0.4 * np.exp(-at_us / long_us)
        assert np.mean(beyond_us > at_us) == pytest.approx(expected, abs=0.02)


def test_a_table_starts_as_it_goes_on() -> None:
    """Assert that the first slices have the rate of all others: hot pixels have been on for long."""
    counts = [len(of_table(0.0, 2, seed)[60][0]) for seed in range(1500)]
    assert np.mean(counts) == pytest.approx(1.8, abs=5 * (1.8 / 1500) ** 0.5)


@pytest.mark.parametrize("step_us", [0.0, 197.3])
def test_polarity_and_steps_of_the_background(step_us: float) -> None:
    """Assert the share of ON events, and times that are spread over the slice, in steps where the sensor names some."""
    rng, keys = np.random.default_rng(0), np.empty(10_000, np.int64)
    nothing = (np.empty(0, np.int64), np.zeros(1))
    parts = []
    for number in range(500):
        made = add_noise(Noise(5.0, *nothing, 0.3, step_us), FRAME, 1000 * number, rng, keys, 0)
        parts.append(sorted_columns(keys[:made], 1000 * number))
    t, x, _, p = (np.concatenate([part[place] for part in parts]) for place in range(4))
    expected = 5.0 * FRAME[0] * FRAME[1] * 0.5
    assert len(t) == pytest.approx(expected, abs=5 * expected**0.5)
    assert p.mean() == pytest.approx(0.3, abs=5 * 0.46 / expected**0.5)
    assert (t // 1000).max() == 499 and (t % 1000).mean() == pytest.approx(500, abs=40)
    if step_us:
        phase = (t + 0.5 - step_us * x / FRAME[0]) / step_us
        np.testing.assert_allclose(phase, np.round(phase), atol=0.6 / step_us)
