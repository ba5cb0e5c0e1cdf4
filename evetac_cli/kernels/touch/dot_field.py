"""Displacement of the gel surface at fixed positions, independent of the grid of dots.

At each position of a lattice in mm, the value is that of a plane fitted to the displacements of the dots around it,
with more weight for nearer dots. Where no dot is near (next to a cut gel, between lost dots), the value is 0.
"""

import numpy as np

from evetac_cli.arrays import Floats

X_MM = np.array([-8.4, -6.0, -3.6, -1.2, 1.2, 3.6, 6.0, 8.4])
Y_MM = np.array([-6.0, -3.6, -1.2, 1.2, 3.6, 6.0])
LATTICE_MM: Floats = np.stack(np.meshgrid(X_MM, Y_MM), axis=-1).reshape(-1, 2)  # from the centre of the view
WIDTH_MM = 1.7  # standard deviation of the weight over distance: about a pitch of the paper's dots
WIDTH_PITCHES = 0.85  # ... for wider grids: in pitches
REACH_WIDTHS = 1.25  # a position has no value if its nearest dot is farther than this many widths
LEAST_DOTS = 6  # fewer dots do not determine a field


def lattice_weights(rest_mm: Floats) -> Floats:
    """Return weights (positions, dots) that give the displacement at each lattice position from dots at (dots, 2)."""
    apart = rest_mm[None] - LATTICE_MM[:, None]
    distance = np.linalg.norm(apart, axis=2)
    width = max(WIDTH_MM, WIDTH_PITCHES * _pitch_mm(rest_mm))
    nearer = np.exp(-0.5 * (distance / width) ** 2)
    terms = np.concatenate([np.ones_like(apart[..., :1]), apart], axis=2)
    squares = np.einsum("ld,ldi,ldj->lij", nearer, terms, terms)
    inverse = np.linalg.pinv(squares, rcond=1e-6, hermitian=True)
    weights: Floats = np.einsum("lj,ldj,ld->ld", inverse[:, 0], terms, nearer)
    weights[distance.min(axis=1) > REACH_WIDTHS * width] = 0.0
    return weights


def _pitch_mm(rest_mm: Floats) -> float:
    """Return the median distance of a dot from its nearest neighbour."""
    apart = np.linalg.norm(rest_mm[:, None] - rest_mm[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(axis=1)))
