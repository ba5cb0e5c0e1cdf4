"""Frames of the gel: brightness, noise, and where dots are drawn; dots followed along known paths, at rest, lost."""

import numpy as np
import pytest

from evetac_cli.sim.camera.rgb_sensor import RgbCamera, frame, start_tracker, track

RADIUS_PX = 7.5
SILENT = RgbCamera(noise_grey=0.0)

REST = np.array([[30.0, 30.0], [80.0, 32.0], [33.0, 85.0], [82.0, 80.0]])


def one_dot(x: float, y: float, camera: RgbCamera = SILENT) -> np.ndarray:
    """A frame of a single dot."""
    return frame(camera, [[x, y]], RADIUS_PX, np.random.default_rng(0))


def test_dark_on_bright() -> None:
    """Assert the grey of gel and dot, and their ratio, the exponential of the contrast, to the rounding of a grey."""
    sampled = one_dot(100, 60)
    assert sampled.shape == (240, 320)
    assert sampled[0, 0] == SILENT.gel_grey
    assert sampled[60, 100] == pytest.approx(SILENT.gel_grey / np.exp(SILENT.log_contrast), abs=0.6)


@pytest.mark.parametrize("place", [(100.0, 60.0), (100.37, 60.81), (57.5, 111.25)])
def test_a_dot_is_where_it_was_put(place: tuple[float, float]) -> None:
    """Assert that the centroid of what is dark is the dot's place, to a hundredth of a pixel."""
    dark = SILENT.gel_grey - one_dot(*place).astype(float)
    y, x = np.indices(dark.shape)
    result = (dark * x).sum() / dark.sum(), (dark * y).sum() / dark.sum()
    assert result == pytest.approx(place, abs=0.01)


def test_noise() -> None:
    """Assert that a frame differs from the one without noise by the noise's deviation (and rounding), and no mean."""
    camera = RgbCamera(noise_grey=3.0)
    off = one_dot(100, 60, camera).astype(float) - one_dot(100, 60)
    assert off.std() == pytest.approx(np.hypot(3.0, np.sqrt(1 / 12)), rel=0.01)
    assert abs(off.mean()) < 0.05


def test_nonsense_is_refused() -> None:
    """Assert that a radius of nothing is refused."""
    with pytest.raises(ValueError, match="radius"):
        frame(SILENT, [[0, 0]], 0.0, np.random.default_rng(0))


def drawn(dots: np.ndarray, radius_px: float = 7.5) -> np.ndarray:
    """A frame of soft dark discs."""
    y, x = np.indices((120, 160))
    distance = np.hypot(x[..., None] - dots[:, 0], y[..., None] - dots[:, 1]).min(axis=-1)
    return np.rint(180 - 140 / (1 + np.exp(2 * (distance - radius_px)))).astype(np.uint8)


def test_dots_are_followed() -> None:
    """Assert that dots on a circle of 10 px, at up to 2 px a frame, are followed to a fifth of a pixel."""
    state = start_tracker(drawn(REST), REST)
    for angle in np.linspace(0, 2 * np.pi, 40):
        moved = REST + 10 * np.array([np.sin(angle), 1 - np.cos(angle)])
        track(state, drawn(moved))
        assert np.abs(state.dot_xy_px - moved).max() < 0.2
        assert not state.lost.any()


def test_a_lost_dot_stays() -> None:
    """Assert that a dot whose flow cannot be found is reported as lost and stays where it was."""
    blank = np.full((120, 160), 180, np.uint8)
    state = start_tracker(blank, REST)
    track(state, blank)
    assert state.lost.all()
    assert np.array_equal(state.dot_xy_px, REST.astype(np.float32))
