"""Windows of known rates and polarities, and whether sets of windows whose distance is known can be told apart."""

import numpy as np
import pytest
from scipy.stats import norm

from evetac_cli.events import Events
from evetac_cli.kernels import realism

FRAME_PX = (64, 48)


def drawn(rates: np.ndarray, on_share: float, seed: int) -> tuple[Events, np.ndarray]:
    """Events of so many a slice, anywhere, and where each slice starts."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(rates)
    starts = np.concatenate([[0], np.cumsum(counts)])
    t_us = np.sort(np.repeat(1000 * np.arange(len(rates)), counts) + rng.integers(0, 1000, starts[-1]))
    x, y = rng.integers(0, FRAME_PX, (starts[-1], 2)).T.astype(np.uint16)
    return Events(t_us, x, y, (rng.random(starts[-1]) < on_share).astype(np.uint8)), starts


def test_rest_and_motion_are_told_apart() -> None:
    """Assert the rates and shares of a window that rests for half of its time."""
    at_rest = np.arange(500) < 250
    numbers = realism.features(*drawn(np.where(at_rest, 5.0, 200.0), 0.6, 0), at_rest, FRAME_PX)
    of = dict(zip(realism.FEATURES, numbers, strict=True))
    assert abs(of["rest, log events per slice"] - np.log(5.0)) < 0.1
    assert abs(of["motion, log events per slice"] - np.log(200.0)) < 0.02
    assert abs(of["motion, ON share"] - 0.6) < 0.01 and abs(of["rest, ON share"] - 0.6) < 0.05
    between = [of[f"motion, log time between ON events, {share} %"] for share in realism.QUANTILES]
    assert between == sorted(between)
    assert abs(of["motion, correlation over 2 px"]) < 0.1


def test_what_is_not_there_is_nan() -> None:
    """Assert that a window without rest, without motion, or without any event has NaN there and no more."""
    rest = [name.startswith("rest") for name in realism.FEATURES]
    moving = realism.features(*drawn(np.full(500, 100.0), 0.5, 1), np.zeros(500, np.bool_), FRAME_PX)
    still = realism.features(*drawn(np.full(500, 3.0), 0.5, 1), np.ones(500, np.bool_), FRAME_PX)
    empty = realism.features(*drawn(np.zeros(500), 0.5, 1), np.ones(500, np.bool_), FRAME_PX)
    assert np.isnan(moving[rest]).all() and np.isfinite(still[rest]).all()
    assert np.isnan(still[~np.array(rest)]).all() and np.isnan(empty).all()


def test_the_area_is_that_of_all_pairs() -> None:
    """Assert that the area is the share of pairs in the right order, ties half, and its known values."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 6, 40).astype(float), rng.integers(2, 9, 25).astype(float)
    above = (second[:, None] > first).mean() + 0.5 * (second[:, None] == first).mean()
    assert realism.area(first, second) == pytest.approx(above, abs=1e-12)
    assert realism.area(np.zeros(3), np.ones(4)) == 1.0 and realism.area(np.ones(3), np.ones(4)) == 0.5


def test_a_difference_of_known_size() -> None:
    """Assert that normal sets two standard deviations apart have nearly the area that no classifier can pass."""
    rng = np.random.default_rng(1)
    first, second = rng.standard_normal((400, 5)), rng.standard_normal((400, 5))
    second[:, 2] += 2.0
    best = norm.cdf(2.0 / np.sqrt(2.0))
    assert realism.separability(first, second) == pytest.approx(best, abs=0.03)


def test_equal_sets() -> None:
    """Assert that sets of one law, which share the motion of each window, are not told apart."""
    areas = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        motion = 3.0 * rng.standard_normal((32, 20))
        areas.append(realism.separability(*(motion + rng.standard_normal((32, 20)) for _ in range(2))))
    assert np.mean(areas) == pytest.approx(0.5, abs=0.08)


def test_what_a_window_cannot_tell() -> None:
    """Assert that NaN, constant and huge features neither break nor decide, whatever their share."""
    rng = np.random.default_rng(2)
    first, second = rng.standard_normal((2, 60, 4))
    second[:, 0] += 4.0
    for part in (first, second):
        part[:, 1] = np.nan
        part[:, 2] = 7.0
        part[rng.random(60) < 0.3, 0] = np.nan
        part[5, 3] = 1e300
    assert realism.separability(first, second) > 0.8
    assert 0.2 < realism.separability(first[:, 1:], second[:, 1:]) < 0.8
