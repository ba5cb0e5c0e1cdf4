"""Dots and texture in log brightness: against the formulas they tabulate."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

from evetac_cli.sim.camera import optics
from tests.sim.camera.small_frames import texture_level

FRAME = (90, 60)
TEXTURE = optics.texture(np.random.default_rng(5), (256, 512), 12.0, 0.06)


def formula(distance_px: NDArray[np.float64], sigma_px: float, log_contrast: float) -> Any:
    """L(d) = ln(I_dot + (I_gel - I_dot) Phi(d / sigma)) with I_gel = 1."""
    ink = math.exp(-log_contrast)
    return np.log(ink + (1 - ink) * 0.5 * (1 + erf(distance_px / sigma_px / math.sqrt(2))))


def level_at(profile: optics.DotProfile, rho_px: NDArray[np.float64]) -> NDArray[np.float64]:
    inner, steps = np.float32(profile.inner_px), np.float32(profile.steps_per_px)
    at = [optics.profile_position(np.float32(rho) ** 2, inner, steps) for rho in rho_px]
    return np.array([optics.profile_level(np.float32(position), profile.level) for position in at])


@pytest.mark.parametrize(("sigma_px", "log_contrast"), [(1.2, 1.61), (0.7, 1.61), (1.6, 1.07)])
def test_profile_is_the_formula(sigma_px: float, log_contrast: float) -> None:
    """Assert that the table is the erf edge: to interpolation error inside the rim, to 0.0011 where it is cut off."""
    profile = optics.dot_profile(15.0, sigma_px, log_contrast)
    rho = np.linspace(0.0, 40.0, 5001)
    error = np.abs(level_at(profile, rho) - formula(rho - 15.0, sigma_px, log_contrast))
    step = 1 / profile.steps_per_px
    within = (rho > profile.inner_px + step) & (rho < profile.outer_px - step)
    assert error[within].max() < 5e-5
    assert error.max() < 1.1e-3


def test_profile_ends() -> None:
    """Assert that the level is exactly ink inside the rim and exactly gel outside: what is left out cannot change."""
    profile = optics.dot_profile(15.0)
    rho = np.array([0.0, profile.inner_px - 1e-3, profile.outer_px + 1e-3, 1e3, 1e6])
    ink = np.float32(-optics.LOG_CONTRAST)
    np.testing.assert_array_equal(level_at(profile, rho), [ink, ink, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["radius_px", "sigma_px", "log_contrast"])
def test_profile_refuses(name: str, value: float) -> None:
    """Assert that every parameter must be positive and finite."""
    given = {"radius_px": 15.0, "sigma_px": 1.2, "log_contrast": 1.61, name: value}
    with pytest.raises(ValueError, match=name):
        optics.dot_profile(**given)


def test_gel_is_the_darkest_dot() -> None:
    """Assert that overlapping and half-hidden dots are drawn as the minimum of their formulas, the rest as bare gel."""
    dots = np.array([[20.3, 30.7], [41.0, 36.2], [88.9, -3.0], [-500.0, 20.0], [1e6, -1e6]])
    y, x = np.mgrid[: FRAME[1], : FRAME[0]]
    expected = np.min([formula(np.hypot(x - dot[0], y - dot[1]) - 12.0, 1.2, 1.61) for dot in dots], axis=0)
    picture = optics.gel_level(FRAME, dots, optics.dot_profile(12.0))
    assert np.abs(picture - expected).max() < 1.1e-3
    assert picture[50, 85] == 0.0
    assert not optics.gel_level(FRAME, np.empty((0, 2)), optics.dot_profile(12.0)).any()


@pytest.mark.parametrize("half_px", [8.0, 12.0])
def test_texture_statistics(half_px: float) -> None:
    """Assert mean, deviation, normal tails, and an autocorrelation of 2^-(r/h)^2 along x and y."""
    field = optics.texture(np.random.default_rng(1), (1024, 1024), half_px, 0.06).astype(float)
    assert field.mean() == pytest.approx(0.0, abs=1e-7)
    assert field.std() == pytest.approx(0.06, rel=1e-5)
    assert np.mean(np.abs(field) > 0.12) == pytest.approx(0.0455, abs=0.008)  # beyond two deviations
    correlation = np.fft.irfft2(np.abs(np.fft.rfft2(field)) ** 2)
    correlation /= correlation[0, 0]
    distance = np.arange(int(2 * half_px))
    # About 2500 independent patches of 2 h: correlations are uncertain by 0.02.
    np.testing.assert_allclose(correlation[0, : len(distance)], 2.0 ** -((distance / half_px) ** 2), atol=0.05)
    np.testing.assert_allclose(correlation[: len(distance), 0], 2.0 ** -((distance / half_px) ** 2), atol=0.05)


@pytest.mark.parametrize(
    ("shape", "half_px", "log_sd", "named"),
    [
        ((128, 128), 17.0, 0.06, "half_correlation_px"),
        ((128, 128), 0.0, 0.06, "half_correlation_px"),
        ((128, 128), math.nan, 0.06, "half_correlation_px"),
        ((128, 128), 4.0, -0.1, "log_sd"),
        ((128, 128), 4.0, math.nan, "log_sd"),
        ((128, 128), 4.0, math.inf, "log_sd"),
    ],
)
def test_texture_refuses(shape: tuple[int, int], half_px: float, log_sd: float, named: str) -> None:
    """Assert that a wrong size, correlation or deviation is named."""
    with pytest.raises(ValueError, match=named):
        optics.texture(np.random.default_rng(0), shape, half_px, log_sd)


def sample(
    first: tuple[int, int], moved: tuple[float, float], contrast: float, shape: tuple[int, int]
) -> NDArray[np.float32]:
    return texture_level(TEXTURE, shape, first, moved, contrast)


@pytest.mark.parametrize("moved", [(0, 0), (3, -7), (-600, 1000)])
def test_whole_shifts_copy(moved: tuple[int, int]) -> None:
    """Assert that a shift by whole pixels copies the texture, over any number of periods and across the seam."""
    rows = (20 + np.arange(300) - moved[1]) % TEXTURE.shape[0]
    columns = (40 + np.arange(600) - moved[0]) % TEXTURE.shape[1]
    np.testing.assert_array_equal(sample((40, 20), moved, 1.0, (300, 600)), TEXTURE[np.ix_(rows, columns)])


def test_fractions_are_bilinear() -> None:
    """Assert that a fraction of a pixel mixes the four neighbours by area."""
    rng = np.random.default_rng(2)
    for moved in rng.uniform(-700, 700, (20, 2)):
        y, x = np.mgrid[5:45, 500:620]
        x0, y0 = np.floor(x - moved[0]).astype(int), np.floor(y - moved[1]).astype(int)
        along, down = x - moved[0] - x0, y - moved[1] - y0
        expected = sum(
            (along if right else 1 - along)
            * (down if lower else 1 - down)
            * TEXTURE[(y0 + lower) % TEXTURE.shape[0], (x0 + right) % TEXTURE.shape[1]]
            for right in (0, 1)
            for lower in (0, 1)
        )
        np.testing.assert_allclose(sample((500, 5), (moved[0], moved[1]), 1.0, (40, 120)), expected, atol=1e-7)


def test_contrast_scales() -> None:
    """Assert that contrast multiplies the level, down to exactly nothing."""
    full = sample((540, 0), (1.3, 2.7), 1.0, (100, 60))
    np.testing.assert_allclose(sample((540, 0), (1.3, 2.7), 0.25, (100, 60)), 0.25 * full, rtol=1e-5, atol=1e-9)
    assert not sample((540, 0), (1.3, 2.7), 0.0, (100, 60)).any()


def test_squared_radius_inverts_the_profile() -> None:
    """Assert that the radius of a level has that level, and that ink, gel and beyond have none."""
    for radius_px, sigma_px in ((15.0, 1.2), (15.0, 0.01), (0.5, 2.0)):
        profile = optics.dot_profile(radius_px, sigma_px)
        inner_px, steps_per_px, levels = profile.inner_px, profile.steps_per_px, profile.level[:-1].astype(np.float64)
        arguments = (inner_px, steps_per_px, profile.level, optics.level_index(profile))
        for target in np.random.default_rng(0).uniform(-1.60998, -2e-5, 2000).tolist():
            radius2 = optics.squared_radius(target, *arguments)
            if radius2 >= 0.0:
                at = np.interp((math.sqrt(radius2) - inner_px) * steps_per_px, np.arange(len(levels)), levels)
                assert at == pytest.approx(target, abs=1e-9)
            else:
                assert np.interp(-inner_px * steps_per_px, np.arange(len(levels)), levels) > target
        for never, targets in ((-1.0, (-1.62, -1.61, -1.61 + 1e-7)), (math.inf, (1e-9, 0.0, -1e-7))):
            assert all(optics.squared_radius(target, *arguments) == never for target in targets)
        assert math.isnan(optics.squared_radius(math.nan, *arguments))
