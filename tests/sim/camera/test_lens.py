"""Lens distortion: its closed form, and what a camera sees of it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.sim.camera.gel_camera import Lens
from evetac_cli.sim.setup.plan import one_sensor
from tests.sim.camera.gel_cameras import gel_camera

FRAME = (640, 480)


def test_formula() -> None:
    """Assert that a point is seen on its ray, at r (1 + k1 r^2 + k2 r^4), and the middle where it is."""
    lens = Lens(FRAME, -0.1, 0.03)
    assert lens.seen([320.0, 240.0]) == pytest.approx([320.0, 240.0])
    for part in (0.2, 0.7, 1.0):
        place = np.array([320.0, 240.0]) * (1 + part)
        factor = 1 - 0.1 * part**2 + 0.03 * part**4
        assert lens.seen(place) - [320, 240] == pytest.approx((place - [320, 240]) * factor)


def test_a_line_is_seen_as_its_points() -> None:
    """Assert that where a curve of seen points crosses a row is where the line is seen to cross it."""
    lens = Lens(FRAME, -0.08, 0.01)
    x = 540.0 + 0.01 * np.arange(480.0)
    seen = lens.seen_line(x)
    for row in (60, 240, 400):
        at_x, at_y = lens.seen([x[row], row])
        assert np.interp(at_y, np.arange(480.0), seen) == pytest.approx(at_x, abs=0.01)
    assert seen[240] - seen[10] > 1.0


@pytest.mark.parametrize(("k1", "k2"), [(-0.3, -0.1), (-0.5, 0.0), (math.nan, 0.0)])
def test_folding_lenses_are_refused(k1: float, k2: float) -> None:
    """Assert that a lens which would show a point twice is refused."""
    with pytest.raises(ValueError, match="distortion"):
        Lens(FRAME, k1, k2)


def test_camera_behind_a_lens() -> None:
    """Assert that dots and their truth are where the lens shows them, and the gel is where it was."""
    sensor = replace(one_sensor("evetac"), noise_hz=0.0, hot_pixels=0)
    lens = Lens(FRAME, -0.06, 0.0)
    plain, behind = (gel_camera(one, cut=True) for one in (sensor, replace(sensor, distortion=(-0.06, 0.0))))
    np.testing.assert_array_equal(plain.rest_m, behind.rest_m)
    np.testing.assert_allclose(behind.grid_xy_px, lens.seen(plain.grid_xy_px), atol=1e-9)
    shift_m = np.full_like(plain.rest_m, 2e-4)
    events = [camera.render(shift_m, np.array([1e-4, 0.0]), 0.0, 0) for camera in (plain, behind)]
    np.testing.assert_allclose(behind.dot_xy_px, lens.seen(plain.dot_xy_px), atol=1e-9)
    assert 0.7 < events[1].size / events[0].size < 1.0  # a barrel shows corners, and their motion, smaller
    assert np.hypot(*(behind.grid_xy_px - [320, 240]).reshape(-1, 2).T).max() < 390.0
