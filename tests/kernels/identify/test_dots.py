"""Rims of dots against pictures made from the model, optics of known dots, and the lens of the simulated camera."""

import numpy as np
import pytest

from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.kernels.identify import dots
from evetac_cli.kernels.identify.dots import DotOptics
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.gel_camera import Lens

CENTRES = np.array([[40.0 + 60 * column + 0.3 * row, 40.0 + 60 * row] for row in range(3) for column in range(4)])
LOG_CONTRAST = 1.61
ON_EVENTS, OFF_EVENTS = 40, 50  # many a pixel, so that whole events round little

EXCESS, NOISE_HZ = 0.25, 0.05

FRAME_PX = (640, 480)
PRINTED = np.stack(np.meshgrid(np.linspace(60, 560, 9), np.linspace(40, 420, 7)), axis=-1)


def shown(radius_px: float | np.ndarray, sigma_px: float) -> dots.Runs:
    """Dots as every pixel would count them that was moved onto gel and onto ink, OFF with a lower threshold."""
    y, x = np.mgrid[:200, :280]
    off_px = np.hypot(x[..., None] - CENTRES[:, 0], y[..., None] - CENTRES[:, 1]) - radius_px
    share = dots.darkening_share(off_px.min(axis=2) + 15.0, 15.0, sigma_px, LOG_CONTRAST)

    def counted(events: int, part: np.ndarray) -> np.ndarray:
        return np.round(events * part).astype(np.uint8)

    before = RestImage(counted(ON_EVENTS, 1 - share), counted(OFF_EVENTS, share))
    after = RestImage(counted(OFF_EVENTS, 1 - share), counted(ON_EVENTS, share))
    return dots.Runs(before, after)


@pytest.mark.parametrize(("radius_px", "sigma_px"), [(15.0, 1.2), (13.2, 0.9), (16.4, 1.9)])
def test_the_model_comes_back(radius_px: float, sigma_px: float) -> None:
    """Assert that radius, blur and events of a picture that follows the model are fitted, from a radius 1 px off."""
    fitted, profile = dots.fit_rims(shown(radius_px, sigma_px), CENTRES, radius_px + 1.0, LOG_CONTRAST)
    np.testing.assert_allclose(fitted.radius_px, radius_px, atol=0.02)
    np.testing.assert_allclose(fitted.sigma_px, sigma_px, atol=0.04)
    np.testing.assert_allclose(fitted.centre_xy_px, CENTRES, atol=0.02)
    np.testing.assert_allclose(fitted.inside_on, ON_EVENTS, rtol=0.01)
    expected = dots.darkening_share(profile.distance_px + radius_px, radius_px, sigma_px, LOG_CONTRAST)
    near = np.abs(profile.distance_px) < 5.0
    np.testing.assert_allclose(profile.share[near], expected[near], atol=0.03)
    np.testing.assert_allclose(fitted.excess, 0.0, atol=0.03)


def test_unequal_dots_are_no_blur() -> None:
    """Assert that dots of different size are each found in their size, and with the blur that they have in common."""
    radius_px = 15.0 * (1.0 + 0.06 * np.linspace(-1.5, 1.5, len(CENTRES)))
    fitted, _ = dots.fit_rims(shown(radius_px, 1.2), CENTRES + 0.8, 15.0, LOG_CONTRAST)
    np.testing.assert_allclose(fitted.radius_px, radius_px, atol=0.05)
    np.testing.assert_allclose(fitted.sigma_px, 1.2, atol=0.05)


def test_the_model_is_the_cameras() -> None:
    """Assert that the share of darkening is the level of the simulated camera, from ink (0) to gel (1)."""
    table = optics.dot_profile(15.0, 1.2, LOG_CONTRAST)
    distance = table.inner_px + np.arange(1, optics.PROFILE_STEPS) / table.steps_per_px
    level = table.level[1 : optics.PROFILE_STEPS]
    np.testing.assert_allclose(
        dots.darkening_share(distance, 15.0, 1.2, LOG_CONTRAST), 1 + level / LOG_CONTRAST, atol=1e-4
    )


def test_another_contrast_is_another_shape() -> None:
    """Assert that a contrast that is 1.5 times wrong hardly changes the radius, as docs/identify.md says."""
    for factor in (1 / 1.5, 1.5):
        fitted, _ = dots.fit_rims(shown(15.0, 1.2), CENTRES, 15.0, LOG_CONTRAST * factor)
        assert np.abs(fitted.radius_px - 15.0).max() < 0.3


def test_dots_that_do_not_show() -> None:
    """Assert that a place without a dot has none."""
    away = np.array([[70.0, 70.0], [-200.0, 50.0], [900.0, 900.0]])
    fitted, _ = dots.fit_rims(shown(15.0, 1.2), away, 15.0, LOG_CONTRAST)
    assert np.isnan(fitted.radius_px).all() and np.isnan(fitted.inside_on).all()


def seen(count: int, radius_spread: float, contrast_spread: float, seed: int, ratio: float = 8.0) -> DotOptics:
    """Fitted dots as a camera would show them that is as the corrections say."""
    rng = np.random.default_rng(seed)
    chance = 1.0 + np.array([[dots.RADIUS_CHANCE], [dots.CONTRAST_CHANCE]]) * rng.standard_normal((2, count))
    radius_px = 15.0 * (1.0 + radius_spread * rng.standard_normal(count)) * chance[0]
    contrast = ratio * (1.0 + contrast_spread * rng.standard_normal(count)) * chance[1]
    return DotOptics(
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


def test_too_few_dots_for_optics() -> None:
    """Assert that too few dots are refused, and that dots which do not show are no dots."""
    few = seen(10, 0.0, 0.0, 1)
    few.radius_px[3:] = np.nan
    with pytest.raises(ValueError, match="8 dots"):
        dots.optics(few, 1.0, 1.0, NOISE_HZ, np.random.default_rng(0))


def flat_dots(rng: np.random.Generator, jitter_px: float) -> np.ndarray:
    """The printed grid, turned, moved and a little smaller, each dot a little off."""
    angle = 0.02
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return 0.97 * PRINTED.reshape(-1, 2) @ turn + [6.0, -4.0] + jitter_px * rng.standard_normal((63, 2))


@pytest.mark.parametrize("k1", [-0.05, 0.0, 0.02])
def test_the_lens_is_found(k1: float) -> None:
    """Assert that k1 of regular dots is exact, and that of irregular ones within its interval in 17 of 20 cases."""
    lens = Lens(FRAME_PX, k1, 0.0)
    exact = dots.distortion(lens.seen(flat_dots(np.random.default_rng(0), 0.0)), PRINTED.reshape(-1, 2), FRAME_PX)
    assert exact.value == pytest.approx(k1, abs=2e-4)
    held = 0
    for seed in range(20):
        seen = lens.seen(flat_dots(np.random.default_rng(seed), 1.5))
        estimated = dots.distortion(seen, PRINTED.reshape(-1, 2), FRAME_PX)
        held += estimated.low <= k1 <= estimated.high
    assert held >= 17
