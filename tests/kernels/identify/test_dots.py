"""What the rims of all dots tell, from dots whose sizes and contrasts are known."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import dots
from evetac_cli.kernels.identify.rim import Dots

EXCESS, NOISE_HZ = 0.25, 0.05


def seen(count: int, radius_spread: float, contrast_spread: float, seed: int, ratio: float = 8.0) -> Dots:
    """Fitted dots as a camera would show them that is as the corrections say."""
    rng = np.random.default_rng(seed)
    chance = 1.0 + np.array([[dots.RADIUS_CHANCE], [dots.CONTRAST_CHANCE]]) * rng.standard_normal((2, count))
    radius_px = 15.0 * (1.0 + radius_spread * rng.standard_normal(count)) * chance[0]
    contrast = ratio * (1.0 + contrast_spread * rng.standard_normal(count)) * chance[1]
    return Dots(
        rng.uniform(0, 400, (count, 2)),
        radius_px + dots.RADIUS_ADDED_PX + dots.RADIUS_BY_EVENTS_PX / ratio**2,
        np.full(count, 1.2 / dots.blur_over_seen(EXCESS, ratio / 1.2, NOISE_HZ)),
        contrast - dots.RUN_LACKS,
        np.full(count, EXCESS),
    )


def test_intervals_hold_the_truth() -> None:
    """Assert that each interval holds what the dots were made with in about 95 of 100 cases, here in 34 of 40."""
    truth = {"dot_radius_px": 15.0, "edge_sigma_px": 1.2, "contrast_over_threshold": 8.0}
    truth |= {"dot_radius_spread": 0.03, "dot_contrast_spread": 0.08}
    held = dict.fromkeys(truth, 0)
    for seed in range(40):
        estimated = dots.optics(seen(63, 0.03, 0.08, seed), 1.0, 1.2, NOISE_HZ, np.random.default_rng(seed))
        for name, value in truth.items():
            one = getattr(estimated, name)
            held[name] += one.low <= value <= one.high
    assert min(held.values()) >= 34, held


def test_equal_dots() -> None:
    """Assert that chance is not taken for a spread."""
    estimated = [
        dots.optics(seen(63, 0.0, 0.0, seed), 1.0, 1.2, NOISE_HZ, np.random.default_rng(0)) for seed in range(20)
    ]
    assert sum(one.dot_radius_spread.low == 0.0 and one.dot_contrast_spread.low == 0.0 for one in estimated) >= 19


def test_too_few() -> None:
    """Assert that too few dots are refused, and that dots which do not show are no dots."""
    few = seen(10, 0.0, 0.0, 1)
    few.radius_px[3:] = np.nan
    with pytest.raises(ValueError, match="8 dots"):
        dots.optics(few, 1.0, 1.0, NOISE_HZ, np.random.default_rng(0))
