"""The rim of dots from an image at rest, against pictures made from the model itself."""

import numpy as np
import pytest

from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.kernels.identify import rim
from evetac_cli.sim.camera import optics

CENTRES = np.array([[40.0 + 60 * column + 0.3 * row, 40.0 + 60 * row] for row in range(3) for column in range(4)])
LOG_CONTRAST = 1.61
EVENTS = 40  # many a pixel, so that whole events round little


def shown(radius_px: float, sigma_px: float) -> RestImage:
    """Dots as every pixel would count them that was moved onto gel and onto ink."""
    y, x = np.mgrid[:200, :280]
    distance = np.min(np.hypot(x[..., None] - CENTRES[:, 0], y[..., None] - CENTRES[:, 1]), axis=2)
    share = rim.darkening_share(distance, radius_px, sigma_px, LOG_CONTRAST)
    darker = np.round(EVENTS * share).astype(np.uint8)
    return RestImage((EVENTS - darker).astype(np.uint8), darker)


@pytest.mark.parametrize(("radius_px", "sigma_px"), [(15.0, 1.2), (13.2, 0.9), (16.4, 1.9)])
def test_the_model_comes_back(radius_px: float, sigma_px: float) -> None:
    """Assert that radius and blur of a picture that follows the model are found, from a radius 1 px off."""
    rims = rim.profile(shown(radius_px, sigma_px), CENTRES, radius_px + 1.0)
    found_radius, found_sigma = rim.fit(rims, radius_px + 1.0, LOG_CONTRAST)
    assert found_radius == pytest.approx(radius_px, abs=0.02)
    assert found_sigma == pytest.approx(sigma_px, abs=0.03)
    plateau = rims.plateau_events.sum() / rims.plateau_pixels.sum()
    assert plateau == pytest.approx(EVENTS, rel=0.001)


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
    rims = rim.profile(shown(15.0, 1.2), CENTRES, 15.0)
    off_px = [rim.fit(rims, 15.0, LOG_CONTRAST * factor)[0] - 15.0 for factor in (1 / 1.5, 1.5)]
    assert max(map(abs, off_px)) < 0.3, off_px


def test_too_little_is_refused() -> None:
    """Assert that a picture in which nothing moved, and too few dots, are refused."""
    nothing = np.zeros((200, 280), np.uint8)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="moved"):
        rim.profile(RestImage(nothing, nothing), CENTRES, 15.0)
    with pytest.raises(ValueError, match="8 dots"):
        rim.estimate(shown(15.0, 1.2), CENTRES[:3], 15.0, LOG_CONTRAST, rng)
