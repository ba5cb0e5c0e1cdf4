"""The displacement field on a lattice: what grid the dots are on does not matter."""

import numpy as np
import pytest

from evetac_cli.arrays import Floats
from evetac_cli.kernels.touch.sticking import LATTICE_MM, lattice_weights


def grid(pitch_mm: float = 2.0, *, seed: int = 0, offset_mm: float = 0.0) -> Floats:
    """Dots over the view, off a square grid by some 0.05 mm; (dots, 2)."""
    x, y = np.arange(-9.0, 9.01, pitch_mm), np.arange(-7.0, 7.01, pitch_mm)
    dots = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + offset_mm
    return dots + np.random.default_rng(seed).normal(0, 0.05, dots.shape)


def linear(at_mm: Floats) -> Floats:
    """A stretched, sheared and shifted surface, (places, 2)."""
    moved: Floats = at_mm @ np.array([[0.02, -0.01], [0.03, 0.015]]) + [0.4, -0.2]
    return moved


@pytest.mark.parametrize("rest_mm", [grid(), grid(1.4, seed=1), grid(2.9, seed=2), grid(2.0, offset_mm=0.7)])
def test_a_linear_field_is_exact_on_any_grid(rest_mm: Floats) -> None:
    """Assert that shift, stretch and shear are read exactly wherever dots are near, whatever their pitch and offset."""
    field = lattice_weights(rest_mm) @ linear(rest_mm)
    nearest = np.linalg.norm(LATTICE_MM[:, None] - rest_mm[None], axis=2).min(axis=1)
    assert (nearest < 2.1).mean() > 0.9
    assert np.allclose(field[nearest < 2.1], linear(LATTICE_MM)[nearest < 2.1], atol=1e-9)


def test_no_gel_is_no_displacement() -> None:
    """Assert that places without a dot near them, as beside a cut gel, have the displacement 0."""
    rest_mm = grid()[grid()[:, 0] < 3.0]
    field = lattice_weights(rest_mm) @ linear(rest_mm)
    assert (field[LATTICE_MM[:, 0] > 8.0] == 0).all()
    assert (field[LATTICE_MM[:, 0] < 2.0] != 0).all()
