"""The forward operator of touch maps: closed forms, convergence, and how dots are seen."""

import math

import numpy as np
import pytest

from evetac_cli.kernels.touch import dot_motion as operator
from evetac_cli.kernels.touch.dot_motion import PRESSURE, CellGrid, GelLayer, cells_about, dot_motion

LAYER = GelLayer(lens_mm=math.inf)
DOTS = np.stack(np.meshgrid(np.linspace(-6.3, 6.1, 4), np.linspace(-4.2, 4.4, 3)), -1).reshape(-1, 2)


def even(kind: int, layer: GelLayer = LAYER) -> np.ndarray:
    """Motion of a dot in the middle under an even traction of 1 Pa on 60 by 60 mm, (2,)."""
    line = np.arange(-30.0, 31.0)
    return dot_motion(layer, CellGrid(line, line), np.zeros((1, 2)))[0, :, kind].sum(axis=-1)


def test_even_shear_moves_the_layer_as_a_block() -> None:
    """Assert that an even shear moves dots by H/G along it, less below the surface, and across it not at all."""
    for depth_mm in (0.0, 1.0):
        moved = even(0, LAYER._replace(print_depth_mm=depth_mm))
        assert moved[0] == pytest.approx((4.0 - depth_mm) / 145e3, rel=0.01)
        assert abs(moved[1]) < 1e-9


def test_even_pressure_moves_dots_by_parallax_alone() -> None:
    """Assert that an even pressure moves no dot of an incompressible layer, and a compressible one's by r s / Z."""
    assert np.abs(even(2)).max() < 1e-4 * 4.0 / 145e3
    layer = GelLayer(poisson=0.4, lens_mm=25.0)
    line = np.arange(-30.0, 31.0)
    moved = dot_motion(layer, CellGrid(line, line), np.array([[5.0, 0.0]]))[0, :, 2].sum(axis=-1)
    thinner = 4.0 * (1 - 0.8) / (2 * 145e3 * 0.6)
    assert moved == pytest.approx([5.0 / 25.0 * thinner, 0.0], rel=0.02, abs=1e-3 * thinner)


@pytest.mark.slow
def test_a_point_load_far_from_the_back_is_that_of_a_half_space() -> None:
    """Assert that a cell of a thick layer moves dots as a point force on a half space does (Cerruti, Boussinesq).

    Half a millimetre above the origin: along the force (2 - v + v ...) / ...; with v = 0.5, u = F (1 + x^2/r^2) / (4 pi
    G r) along it. Pressure moves nothing aside at v = 0.5.
    """
    layer = LAYER._replace(height_mm=60.0)
    cells = CellGrid(np.array([0.0]), np.array([0.0]))
    dots = np.array([[5.0, 0.0], [0.0, 5.0], [3.0, 4.0]])
    moved = dot_motion(layer, cells, dots)[:, :, :, 0]
    r, along = 5.0, dots[:, 0] / 5.0
    sheared = (1 + along**2) / (4 * math.pi * 145e3 * r)
    back = 0.1 * sheared[0]  # the layer ends 60 mm down, and the wave without end has no room
    assert moved[:, 0, 0] == pytest.approx(sheared, abs=back)
    assert moved[2, 1, 0] == pytest.approx(0.6 * 0.8 / (4 * math.pi * 145e3 * r), abs=back)
    assert np.abs(moved[:, :, 2]).max() < back


def test_finer_waves_change_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that more waves and a larger box hardly change what a contact does to dots; each cell converges."""
    cells = cells_about(DOTS, 4.0)
    motions = {}
    for points in (1, 2, 4, 8):
        monkeypatch.setattr(operator, "POINTS_PER_CELL", points)
        motions[points] = dot_motion(LAYER, cells, DOTS)[:, :, :2]
    errors = [np.linalg.norm(motions[n] - motions[8]) / np.linalg.norm(motions[8]) for n in (1, 2, 4)]
    assert errors[1] < 0.06 and errors[0] > 3 * errors[1] > 6 * errors[2]
    contact = np.exp(-(cells.middle_mm**2).sum(axis=1) / 8)
    assert np.abs((motions[2] - motions[8]) @ contact).max() < 0.01 * np.abs(motions[8] @ contact).max()
    monkeypatch.setattr(operator, "POINTS_PER_CELL", 2)
    monkeypatch.setattr(operator, "APART_HEIGHTS", 16)
    assert np.linalg.norm(dot_motion(LAYER, cells, DOTS)[:, :, :2] - motions[2]) < 1e-3 * np.linalg.norm(motions[2])


def test_a_mirror_image_moves_alike() -> None:
    """Assert that dots and cells mirrored in x have motions mirrored in x."""
    cells = CellGrid(np.arange(-5.0, 6.0), np.arange(-4.0, 5.0))
    layer = GelLayer(print_depth_mm=0.3)
    moved = dot_motion(layer, cells, DOTS).reshape(len(DOTS), 2, 3, 9, 11)
    mirrored = dot_motion(layer, cells, DOTS * [-1, 1]).reshape(moved.shape)[..., ::-1]
    sign = np.array([[1, -1, -1], [-1, 1, 1]])[:, :, None, None]
    assert mirrored == pytest.approx(moved * sign, abs=1e-9 * np.abs(moved).max())


def test_an_even_shear_moves_a_gel_that_ends_evenly() -> None:
    """Assert that all dots of a gel with free edges move by traction times height over modulus, in its own direction.

    Without edges the gel beyond holds them back. Far from its edges a gel moves as one that has none.
    """
    layer = LAYER._replace(edges_mm=(-10.0, -8.0, 9.0, 8.0))
    cells = cells_about(DOTS, 20.0, layer.edges_mm)
    assert (cells.x_mm[0], cells.x_mm[-1], cells.y_mm[0], cells.y_mm[-1]) == (-10.0, 8.0, -8.0, 8.0)
    ends, endless = (dot_motion(one, cells, DOTS) for one in (layer, LAYER))
    evenly = layer.height_mm / layer.shear_modulus_pa
    for axis in (0, 1):
        assert ends[:, axis, axis].sum(axis=-1) == pytest.approx(evenly, rel=0.03)
        assert np.abs(ends[:, 1 - axis, axis].sum(axis=-1)).max() < 0.03 * evenly
        assert (endless[:, axis, axis].sum(axis=-1) < 0.97 * evenly).all()
    middle = np.abs(cells.middle_mm).max(axis=1) < 1
    near = np.hypot(*DOTS.T) < 3
    assert ends[near][..., middle] == pytest.approx(endless[near][..., middle], abs=0.02 * np.abs(endless).max())


def test_a_gel_that_is_pressed_evenly_bulges_out_at_its_edge() -> None:
    """Assert that even pressure moves dots out beside a free edge, and the more the nearer, and none without edges."""
    layer = LAYER._replace(edges_mm=(-40.0, -40.0, 7.0, 40.0))
    line = np.array([[x, 0.0] for x in (-5.0, 0.0, 3.0, 6.0)])
    cells = cells_about(line, 30.0, layer.edges_mm)
    out = dot_motion(layer, cells, line)[:, 0, PRESSURE].sum(axis=-1)
    assert (np.diff(out[1:]) > 0).all() and out[-1] > 5 * abs(out[0])
    inside = np.abs(dot_motion(LAYER, cells_about(line, 30.0), line)[:, :, PRESSURE].sum(axis=-1))
    assert inside.max() < 0.1 * out[-1]
