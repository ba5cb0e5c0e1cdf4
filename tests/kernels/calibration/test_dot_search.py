"""Dots in a picture of the gel at rest: exact pictures, hidden rims, and what is no dot."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evetac_cli.kernels.calibration.dot_search import contrast, find, fit
from evetac_cli.kernels.calibration.rest_image import RestImage

Grid = NDArray[np.float64]


def picture(
    centres: Grid, radius: float, events: float = 8.0, shape: tuple[int, int] = (240, 320), reach: float = 12.0
) -> RestImage:
    """What dots with a smooth rim leave that were moved by `reach` px in all directions."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    edge = np.min([np.hypot(x - cx, y - cy) for cx, cy in centres], axis=0) - radius
    share = 1 / (1 + np.exp(-edge / 0.8))
    passed = edge < reach
    sides = (np.where(passed, events * (1 - share), 0), np.where(passed, events * share, 0))
    return RestImage(*(np.round(side).astype(np.uint8) for side in sides))


def places(rows: int, columns: int, pitch: float = 62.0) -> Grid:
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(40 + pitch * np.arange(columns), 40 + pitch * np.arange(rows)), axis=-1)
    return (grid + rng.uniform(-2, 2, grid.shape)).reshape(-1, 2)


def sorted_to(result: Grid, true: Grid) -> Grid:
    """Found dots in the order of the true ones."""
    return result[np.linalg.norm(true[:, None] - result[None], axis=2).argmin(axis=1)]


@pytest.mark.parametrize("radius", [6.0, 10.5, 15.0, 21.3])
def test_dots_of_any_size(radius: float) -> None:
    """Assert that all dots are found within 0.1 px, with their radius, from nothing."""
    true = places(3, 4)
    result = find(picture(true, radius))
    assert len(result.radius_px) == 12
    assert np.abs(sorted_to(result.centre_xy_px, true) - true).max() < 0.1
    assert np.abs(result.radius_px - radius).max() < 0.15


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.integers(5, 40))
@settings(deadline=None, max_examples=20)
def test_fit_is_exact_between_pixels(dx: float, dy: float, events: int) -> None:
    """Assert that a fit finds a dot within 0.1 px wherever in a pixel it lies, from 5 px away, at any contrast."""
    true = np.array([[60 + dx, 50 + dy]])
    seen = picture(true, 14.0, events, (100, 120))
    result = fit(seen, true + (3, -4), 13.0)
    assert np.abs(result.centre_xy_px - true).max() < 0.1


def test_picture_turned_and_mirrored() -> None:
    """Assert that a mirrored picture gives mirrored centres."""
    true = places(2, 3)
    seen = picture(true, 12.0)
    mirrored = RestImage(*(side[:, ::-1].copy() for side in seen))
    result, other = fit(seen, true, 12.0), fit(mirrored, [319, 0] + true * [-1, 1], 12.0)
    np.testing.assert_allclose(other.centre_xy_px, [319, 0] + result.centre_xy_px * [-1, 1], atol=1e-6)


def test_ring_without_middle() -> None:
    """Assert that small motions, which never uncover the middle of a dot, suffice."""
    true = places(3, 4)
    seen = picture(true, 15.0, reach=5.0)
    y, x = np.mgrid[:240, :320]
    inner = np.min([np.hypot(x - cx, y - cy) for cx, cy in true], axis=0) < 10
    result = find(RestImage(*(np.where(inner, 0, side).astype(np.uint8) for side in seen)))
    assert len(result.radius_px) == 12
    assert np.abs(sorted_to(result.centre_xy_px, true) - true).max() < 0.15


def test_half_a_rim_is_no_dot() -> None:
    """Assert that a dot of which half is hidden is refused, and the others are not."""
    true = places(3, 4)
    hidden = np.ones((240, 320), bool)
    x, y = true[5]
    hidden[:, int(x) - 30 : int(x)] = False
    seen = RestImage(*(side * hidden for side in picture(true, 12.0)))
    result = fit(seen, true, 12.0)
    assert np.isnan(result.centre_xy_px[5]).all()
    assert np.isfinite(result.centre_xy_px[[0, 3, 7, 11]]).all()


def test_dots_of_another_size_are_refused() -> None:
    """Assert that a dot half as large as the others is not one of them."""
    true = places(2, 4)
    small = picture(true[:1], 6.0)
    seen = picture(true[1:], 14.0).joined(small)
    result = fit(seen, true, 13.0)
    assert np.isnan(result.radius_px[0])
    assert np.isfinite(result.radius_px[1:]).all()


def test_other_shapes_are_no_dots() -> None:
    """Assert that nothing, noise, a straight edge, and light dots on dark are not taken for dots."""
    rng = np.random.default_rng(0)
    nothing = np.zeros((240, 320), np.uint8)
    edge = np.zeros((240, 320), np.uint8)
    edge[:, :160] = 8
    light = picture(places(3, 4), 14.0)
    for seen in (
        RestImage(nothing, nothing),
        RestImage(*(rng.integers(0, 9, (2, 240, 320)).astype(np.uint8))),
        RestImage(edge, 8 - edge),
    ):
        assert len(find(seen).radius_px) == 0
    around = find(RestImage(light.darker, light.brighter)).centre_xy_px
    assert all(np.linalg.norm(places(3, 4) - place, axis=1).min() > 5 for place in around)
    assert contrast(RestImage(nothing, nothing)) == 0.0
