"""The rims of dots from images at rest, against pictures made from the model itself."""

import numpy as np
import pytest

from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.kernels.identify import rim
from evetac_cli.sim.camera import optics

CENTRES = np.array([[40.0 + 60 * column + 0.3 * row, 40.0 + 60 * row] for row in range(3) for column in range(4)])
LOG_CONTRAST = 1.61
ON_EVENTS, OFF_EVENTS = 40, 50  # many a pixel, so that whole events round little


def shown(radius_px: float | np.ndarray, sigma_px: float) -> rim.Runs:
    """Dots as every pixel would count them that was moved onto gel and onto ink, OFF with a lower threshold."""
    y, x = np.mgrid[:200, :280]
    off_px = np.hypot(x[..., None] - CENTRES[:, 0], y[..., None] - CENTRES[:, 1]) - radius_px
    share = rim.darkening_share(off_px.min(axis=2) + 15.0, 15.0, sigma_px, LOG_CONTRAST)

    def counted(events: int, part: np.ndarray) -> np.ndarray:
        return np.round(events * part).astype(np.uint8)

    before = RestImage(counted(ON_EVENTS, 1 - share), counted(OFF_EVENTS, share))
    after = RestImage(counted(OFF_EVENTS, 1 - share), counted(ON_EVENTS, share))
    return rim.Runs(before, after)


@pytest.mark.parametrize(("radius_px", "sigma_px"), [(15.0, 1.2), (13.2, 0.9), (16.4, 1.9)])
def test_the_model_comes_back(radius_px: float, sigma_px: float) -> None:
    """Assert that radius, blur and events of a picture that follows the model are found, from a radius 1 px off."""
    dots, profile = rim.fit(shown(radius_px, sigma_px), CENTRES, radius_px + 1.0, LOG_CONTRAST)
    np.testing.assert_allclose(dots.radius_px, radius_px, atol=0.02)
    np.testing.assert_allclose(dots.sigma_px, sigma_px, atol=0.04)
    np.testing.assert_allclose(dots.centre_xy_px, CENTRES, atol=0.02)
    np.testing.assert_allclose(dots.inside_on, ON_EVENTS, rtol=0.01)
    expected = rim.darkening_share(profile.distance_px + radius_px, radius_px, sigma_px, LOG_CONTRAST)
    near = np.abs(profile.distance_px) < 5.0
    np.testing.assert_allclose(profile.share[near], expected[near], atol=0.03)
    np.testing.assert_allclose(dots.excess, 0.0, atol=0.03)


def test_unequal_dots_are_no_blur() -> None:
    """Assert that dots of different size are each found in their size, and with the blur that they have in common."""
    radius_px = 15.0 * (1.0 + 0.06 * np.linspace(-1.5, 1.5, len(CENTRES)))
    dots, _ = rim.fit(shown(radius_px, 1.2), CENTRES + 0.8, 15.0, LOG_CONTRAST)
    np.testing.assert_allclose(dots.radius_px, radius_px, atol=0.05)
    np.testing.assert_allclose(dots.sigma_px, 1.2, atol=0.05)


def test_the_model_is_the_cameras() -> None:
    """Assert that the share of darkening is the level of the simulated camera, from ink (0) to gel (1)."""
    table = optics.dot_profile(15.0, 1.2, LOG_CONTRAST)
    distance = table.inner_px + np.arange(1, optics.PROFILE_STEPS) / table.steps_per_px
    level = table.level[1 : optics.PROFILE_STEPS]
    np.testing.assert_allclose(
        rim.darkening_share(distance, 15.0, 1.2, LOG_CONTRAST), 1 + level / LOG_CONTRAST, atol=1e-4
    )


def test_another_contrast_is_another_shape() -> None:
    """Assert that a contrast that is 1.5 times wrong moves the radius by no more than docs/identify.md says."""
    for factor in (1 / 1.5, 1.5):
        dots, _ = rim.fit(shown(15.0, 1.2), CENTRES, 15.0, LOG_CONTRAST * factor)
        assert np.abs(dots.radius_px - 15.0).max() < 0.3


def test_what_does_not_show() -> None:
    """Assert that a picture in which nothing moved is refused, and that a place without a dot has none."""
    nothing = np.zeros((200, 280), np.uint8)
    with pytest.raises(ValueError, match="moved"):
        rim.fit(rim.Runs(RestImage(nothing, nothing), RestImage(nothing, nothing)), CENTRES, 15.0, LOG_CONTRAST)
    away = np.array([[70.0, 70.0], [-200.0, 50.0], [900.0, 900.0]])
    dots, _ = rim.fit(shown(15.0, 1.2), away, 15.0, LOG_CONTRAST)
    assert np.isnan(dots.radius_px).all() and np.isnan(dots.inside_on).all()
