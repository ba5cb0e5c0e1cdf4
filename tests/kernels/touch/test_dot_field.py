"""The displacement field on a lattice: what grid the dots are on does not matter, nor which of them are lost."""

import numpy as np
import pytest

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.touch import dot_field
from evetac_cli.kernels.touch.dot_field import LATTICE_MM, lattice_field, mirrored


def grid(pitch_mm: float = 2.0, *, seed: int = 0, offset_mm: float = 0.0) -> Floats:
    """Dots over the view, off a square grid by some 0.05 mm; (dots, 2)."""
    x, y = np.arange(-9.0, 9.01, pitch_mm), np.arange(-7.0, 7.01, pitch_mm)
    dots = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + offset_mm
    return dots + np.random.default_rng(seed).normal(0, 0.05, dots.shape)


def seen(moved_mm: Floats) -> Flags:
    return np.ones(moved_mm.shape[:2], np.bool_)


def linear(at_mm: Floats) -> Floats:
    """A stretched, sheared and shifted surface, (1, places, 2)."""
    return (at_mm @ np.array([[0.02, -0.01], [0.03, 0.015]]) + [0.4, -0.2])[None]


@pytest.mark.parametrize("rest_mm", [grid(), grid(1.4, seed=1), grid(2.9, seed=2), grid(2.0, offset_mm=0.7)])
def test_a_linear_field_is_exact_on_any_grid(rest_mm: Floats) -> None:
    """Assert that shift, stretch and shear are read exactly wherever dots are near, whatever their pitch and offset."""
    moved_mm = linear(rest_mm)
    field = lattice_field(moved_mm, rest_mm, seen(moved_mm))
    nearest = np.linalg.norm(LATTICE_MM[:, None] - rest_mm[None], axis=2).min(axis=1)
    assert (nearest < 2.1).mean() > 0.9
    assert np.allclose(field[0, nearest < 2.1], linear(LATTICE_MM)[0, nearest < 2.1], atol=1e-9)


def test_lost_dots_are_left_out() -> None:
    """Assert that dots which are lost, NaN or without a place do not change what the others say, sample by sample."""
    rest_mm = grid()
    moved_mm = np.repeat(linear(rest_mm), 4, axis=0)
    tracked = seen(moved_mm)
    moved_mm[1, 10] = 77.0
    tracked[1, 10] = False
    moved_mm[2, [3, 40]] = np.nan
    missing_mm = np.append(rest_mm, [[np.nan, np.nan]], axis=0)
    moved_mm = np.append(moved_mm, np.zeros((4, 1, 2)), axis=1)
    field = lattice_field(moved_mm, missing_mm, np.append(tracked, np.ones((4, 1), np.bool_), axis=1))
    assert np.allclose(field, np.broadcast_to(field[3], field.shape), atol=1e-9)


def test_too_few_dots_say_nothing() -> None:
    """Assert NaN where fewer than six dots are tracked, and none of it in other samples; no dots and no samples too."""
    rest_mm = grid()
    moved_mm = np.repeat(linear(rest_mm), 2, axis=0)
    tracked = seen(moved_mm)
    tracked[0, 5:] = False
    field = lattice_field(moved_mm, rest_mm, tracked)
    assert np.isnan(field[0]).all()
    assert np.isfinite(field[1]).all()
    assert np.isnan(lattice_field(np.empty((3, 0, 2)), np.empty((0, 2)), np.empty((3, 0), np.bool_))).all()
    assert lattice_field(moved_mm[:0], rest_mm, tracked[:0]).shape == (0, len(LATTICE_MM), 2)


def test_no_gel_is_no_displacement() -> None:
    """Assert that places without a dot near them, as beside a cut gel, have the displacement 0."""
    rest_mm = grid()[grid()[:, 0] < 3.0]
    moved_mm = linear(rest_mm)
    field = lattice_field(moved_mm, rest_mm, seen(moved_mm))
    assert (field[0, LATTICE_MM[:, 0] > 8.0] == 0).all()
    assert (field[0, LATTICE_MM[:, 0] < 2.0] != 0).all()


def test_mirrored() -> None:
    """Assert that a field mirrored is that of dots mirrored, and that twice mirrored is as before."""
    rest_mm = grid()
    moved_mm = linear(rest_mm)
    field = lattice_field(moved_mm, rest_mm, seen(moved_mm))
    over = lattice_field(moved_mm * [1, -1], rest_mm * [1, -1], seen(moved_mm))
    assert np.allclose(mirrored(field), over, atol=1e-9)
    assert np.array_equal(mirrored(mirrored(field)), field)


def test_shapes_that_do_not_fit() -> None:
    """Assert that arrays of different dots are refused."""
    with pytest.raises(ValueError, match="expected shapes"):
        lattice_field(np.zeros((2, 5, 2)), np.zeros((6, 2)), np.ones((2, 5), np.bool_))


def test_dots_that_were_left_behind_are_left_out() -> None:
    """Assert that dots which stayed where the others moved on change nothing, in these samples alone."""
    rest_mm = grid()
    moved_mm = np.repeat(linear(rest_mm) + [0.8, -0.6], 3, axis=0)
    true = lattice_field(moved_mm, rest_mm, seen(moved_mm))
    behind = [11, 30, 31, 52]
    moved_mm[1, behind] = 0.0
    kept = dot_field.with_neighbours(moved_mm, rest_mm, seen(moved_mm))
    assert np.flatnonzero(~kept[1]).tolist() == behind
    assert kept[[0, 2]].all()
    assert np.allclose(lattice_field(moved_mm, rest_mm, seen(moved_mm)), true, atol=1e-9)


def test_the_border_of_a_contact_is_kept() -> None:
    """Assert that no dot is left out of a surface whose displacement fades over 2.3 mm beside a sheared face."""
    rest_mm = grid()
    fades = np.exp(-np.maximum(rest_mm[:, 0] - 1.0, 0.0) / 2.3)
    moved_mm = np.stack([fades, np.zeros_like(fades)], axis=1)[None]
    assert dot_field.with_neighbours(moved_mm, rest_mm, seen(moved_mm)).all()


def test_neighbours_of_few_or_unseen_dots() -> None:
    """Assert that dots without enough neighbours are kept, and that dots which are not seen count for nothing."""
    rest_mm = grid()
    moved_mm = 1.5 * linear(rest_mm)
    few = dot_field.with_neighbours(moved_mm[:, :8], rest_mm[:8], seen(moved_mm[:, :8]))
    assert few.all()
    wrong = moved_mm.copy()
    wrong[0, ::2] = 50.0
    tracked = seen(moved_mm)
    tracked[0, ::2] = False
    assert np.array_equal(dot_field.with_neighbours(wrong, rest_mm, tracked), tracked)
