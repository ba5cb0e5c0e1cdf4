"""The noise of a camera from events at rest: intervals hold the truth, and a table of hot pixels comes back.

Simulated sensors, seeds below 10,000. Times between events against laws that are known.
"""

import numpy as np
import pytest

from evetac_cli.kernels.identify import rest
from evetac_cli.kernels.identify.rest import RestNoise
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel
from evetac_cli.sim.setup.sensor import HotPixelTable

FRAME = (160, 120)
# Of so many sensors, where 95 % are expected: a correct estimator is below once in some hundreds of times.
FEWEST_HELD = {20: 16, 100: 88}


def identified(model: CameraModel, seed: int, slices: int) -> tuple[RestNoise, camera.CameraState]:
    rng = np.random.default_rng(seed)
    state = camera.start(model, np.empty((0, 2)), None, rng)
    parts = [camera.step_still(state, 1000 * number, rng) for number in range(slices)]
    t, x, y, p = (np.concatenate([getattr(part, column) for part in parts]) for column in "txyp")
    return rest.analyse(t, x, y, p, FRAME, 1000 * slices, np.random.default_rng(seed)), state


@pytest.mark.parametrize("sensors", [20, pytest.param(100, marks=pytest.mark.slow)])
def test_intervals_hold_the_truth(sensors: int) -> None:
    """Assert that 95 % intervals of rates, shares and hot pixels' rates hold the truth about as often (95 of 100)."""
    held = dict.fromkeys(("noise_hz", "noise_on_share", "hot_total_hz", "hot_on_share"), 0)
    pixels_held = pixels = 0
    for seed in range(sensors):
        model = CameraModel(
            frame_px=FRAME, noise_rate_hz=0.5, noise_on_share=0.4, hot_pixels=8, hot_rate_hz=(20.0, 200.0)
        )
        noise, state = identified(model, seed, 1500)
        rates_hz = np.diff(state.noise.hot_cumulative_hz)
        truth = {
            "noise_hz": 0.5,
            "noise_on_share": 0.4,
            "hot_total_hz": rates_hz.sum() + 8 * 0.5,
            "hot_on_share": 0.4,
        }
        for name, value in truth.items():
            estimate = getattr(noise, name)
            held[name] += estimate.low <= value <= estimate.high
        listed = dict(zip((noise.table.y_px * FRAME[0] + noise.table.x_px).tolist(), range(8), strict=False))
        assert set(listed) == set(state.noise.hot_pixel.tolist())
        for pixel, rate_hz in zip(state.noise.hot_pixel.tolist(), rates_hz, strict=True):
            place = listed[pixel]
            pixels += 1
            pixels_held += noise.table.low_hz[place] <= rate_hz + 0.5 <= noise.table.high_hz[place]
    assert min(held.values()) >= FEWEST_HELD[sensors], held
    assert pixels_held / pixels >= 0.95 - 4 * (0.95 * 0.05 / pixels) ** 0.5


def test_a_table_comes_back() -> None:
    """Assert that steps, dead time, rates, polarities and the law of intervals of a table are found again."""
    rng = np.random.default_rng(5)
    count = 60
    table = HotPixelTable(
        x_px=tuple(range(0, 120, 2)),
        y_px=tuple(range(0, 60)),
        rate_hz=tuple(rng.uniform(100.0, 400.0, count).tolist()),
        on_share=tuple(rng.uniform(0.4, 0.6, count).tolist()),
        polarity_change_share=(0.7,) * count,
        short_interval_share=(0.5,) * count,
        short_interval_us=(300.0,) * count,
        dead_time_us=400.0,
    )
    model = CameraModel(frame_px=FRAME, noise_rate_hz=0.1, hot_pixels=0, timestamp_step_us=200.0, hot_pixel_table=table)
    noise, _ = identified(model, 5, 4000)
    assert noise.timestamp_step_us is not None and noise.dead_time_us is not None
    assert noise.timestamp_step_us.value == pytest.approx(200.0, abs=0.01)
    assert noise.timestamp_step_us.low <= 200.0 <= noise.timestamp_step_us.high
    assert noise.dead_time_us.low <= 400.0 <= noise.dead_time_us.high + 1e-6
    assert noise.table.x_px.tolist() == list(table.x_px) and noise.table.y_px.tolist() == list(table.y_px)
    np.testing.assert_allclose(noise.table.rate_hz / table.rate_hz, 1.0, atol=0.3)
    assert np.mean(noise.table.rate_hz / table.rate_hz) == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(noise.table.polarity_change_share, 0.7, atol=0.12)
    assert np.median(noise.table.short_interval_share) == pytest.approx(0.5, abs=0.05)
    assert np.median(noise.table.short_interval_us) == pytest.approx(300.0, rel=0.15)


def test_poisson_pixels_have_no_steps() -> None:
    """Assert that uniform times are told from steps, and that there is no dead time."""
    model = CameraModel(frame_px=FRAME, noise_rate_hz=0.1, hot_pixels=20, hot_rate_hz=(50.0, 200.0))
    noise, _ = identified(model, 7, 3000)
    assert noise.timestamp_step_us == (0.0, 0.0, 0.0)
    assert noise.dead_time_us is not None and noise.dead_time_us.low == 0.0
    assert (noise.table.short_interval_share > 0).mean() < 0.3
    assert noise.hot_pixels.low <= 20 <= noise.hot_pixels.high


def test_a_silent_camera() -> None:
    """Assert that no event is a result too: a rate of 0 with its upper end, and what is not told."""
    noise, _ = identified(CameraModel(frame_px=FRAME, noise_rate_hz=0.0, hot_pixels=0), 1, 1000)
    assert noise.noise_hz.value == noise.noise_hz.low == 0.0
    assert noise.noise_hz.high == pytest.approx(3.69 / (160 * 120), rel=0.01)
    assert np.isnan(noise.noise_on_share.value) and (noise.noise_on_share.low, noise.noise_on_share.high) == (0.0, 1.0)
    assert noise.timestamp_step_us is None and noise.dead_time_us is None and len(noise.table.x_px) == 0


def test_what_moves_is_refused() -> None:
    """Assert that busy pixels all over the picture, or side by side, are not taken for hot ones."""
    rng = np.random.default_rng(0)
    count = 50_000
    columns = (np.sort(rng.integers(0, 10**6, count)), rng.integers(0, 60, count), rng.integers(0, 60, count))
    with pytest.raises(ValueError, match="moves"):
        rest.analyse(*columns, np.ones(count, np.uint8), FRAME, 10**6, rng)
    edge = (np.arange(1000) * 1000, np.arange(1000) % 20, np.full(1000, 7))  # 20 pixels in a row, 50 times each
    with pytest.raises(ValueError, match="20 side by side"):
        rest.analyse(*edge, np.ones(1000, np.uint8), FRAME, 10**6, rng)


def test_a_pixel_that_fires_at_every_scan() -> None:
    """Assert that a pixel as busy as its dead time allows is listed with its rate, and has no short intervals."""
    rng = np.random.default_rng(0)
    duration_us, scan_us = 3_000_000, 200
    times = [np.arange(scan_us, duration_us, scan_us)]
    times += [np.unique(rng.integers(2, duration_us // scan_us, 300)) * scan_us for _ in range(30)]
    pixel = np.repeat(np.arange(31) * 4, [len(one) for one in times])
    t_us = np.concatenate(times)
    order = np.argsort(t_us, kind="stable")
    x, y = pixel[order].astype(np.uint16), np.full(len(t_us), 7, np.uint16)
    p = (np.arange(len(t_us)) % 2).astype(np.uint8)
    noise = rest.analyse(t_us[order], x, y, p, FRAME, duration_us, rng)
    assert noise.dead_time_us is not None and noise.dead_time_us.value == scan_us
    assert noise.table.rate_hz[0] == pytest.approx(5000, rel=1e-3)
    assert noise.table.short_interval_share[0] == noise.table.short_interval_us[0] == 0.0


def mixed(count: int, share: float, short_us: float, long_us: float, dead_us: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    mean_us = np.where(rng.random(count) < share, short_us, long_us)
    return dead_us + rng.exponential(1.0, count) * mean_us


@pytest.mark.parametrize("step_us", [50.3, 197.28, 200.0])
def test_steps_are_found(step_us: float) -> None:
    """Assert that the step of stamped times is found, within its interval, whole microseconds and all."""
    times = np.cumsum(mixed(3000, 0.5, 500.0, 4000.0, 2 * step_us))
    stamped = np.floor(np.floor(times / step_us) * step_us)
    result = rest.time_step(np.diff(stamped))
    assert result is not None and result.low <= step_us <= result.high
    assert result.high - result.low < 1e-3 * step_us


@pytest.mark.parametrize("dead_us", [0.0, 400.0])
def test_dead_time(dead_us: float) -> None:
    """Assert that the dead time's interval holds it in about 95 of 100 cases; rare shorter times do not count."""
    held = 0
    for seed in range(100):
        between_us = mixed(2000, 0.4, 300.0, 3000.0, dead_us, seed)
        between_us[:10] = 1.0
        result = rest.dead_time(between_us, 0.0, np.random.default_rng(seed))
        assert result is not None
        held += result.low <= dead_us <= result.high
    assert held >= 85


def test_two_exponentials() -> None:
    """Assert that share and mean of the shorter one come back, and that one exponential is left one."""
    share, short_us = rest.two_exponentials(mixed(4000, 0.6, 300.0, 8000.0, 400.0), 400.0, 0.0)
    assert share == pytest.approx(0.6, abs=0.05)
    assert short_us == pytest.approx(300.0, rel=0.2)
    one = [rest.two_exponentials(mixed(100, 0.0, 1.0, 3000.0, 0.0, seed), 0.0, 0.0) for seed in range(60)]
    assert sum(share == 0.0 for share, _ in one) >= 42
    assert rest.two_exponentials(np.array([100.0, 200.0]), 0.0, 0.0) == (0.0, 0.0)
