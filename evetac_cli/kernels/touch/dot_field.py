"""The displacement of the gel's surface at fixed places, from dots wherever they are: what does not depend on the grid.

At each place of a lattice in mm stands the value of a plane fitted to the displacements of the dots about it, nearer
ones counting more. Where no dot is near (beside a cut gel, between lost dots) it is 0.

Dots that a tracker left behind without notice, as it does in a soft gel that moves fast, are told by their neighbours,
which moved otherwise, and left out.
"""

import numpy as np

from evetac_cli.arrays import Flags, Floats

X_MM = np.array([-8.4, -6.0, -3.6, -1.2, 1.2, 3.6, 6.0, 8.4])
Y_MM = np.array([-6.0, -3.6, -1.2, 1.2, 3.6, 6.0])
LATTICE_MM: Floats = np.stack(np.meshgrid(X_MM, Y_MM), axis=-1).reshape(-1, 2)  # from the middle of the view
WIDTH_MM = 1.7  # sd of the weight over distance: about a pitch of the paper's dots
WIDTH_PITCHES = 0.85  # ... of a wider grid
REACH_WIDTHS = 1.25  # a place has no value where the nearest dot is farther
LEAST_DOTS = 6  # fewer say nothing
NEIGHBOURS = 8  # of a dot
ALONE_MM = 0.3  # a dot that is off its neighbours' median by more was left behind ...
ALONE_SPREADS = 4.0  # ... unless they differ so much among themselves, as at the border of a contact
MOST_VALUES = 4_000_000  # of neighbours at once


def lattice_weights(rest_mm: Floats) -> Floats:
    """Weights (places, dots) that give the displacement at each place of the lattice from that of dots (dots, 2)."""
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
    """Median distance of a dot from its nearest."""
    apart = np.linalg.norm(rest_mm[:, None] - rest_mm[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(axis=1)))


def lattice_field(moved_mm: Floats, rest_mm: Floats, tracked: Flags) -> Floats:
    """Displacements in mm (n, places, 2) on the lattice, from those of dots (n, dots, 2).

    rest_mm: (dots, 2) from the middle of the view; tracked: (n, dots), other dots are left out, and so are those whose
    displacement or place is not finite, and those that moved otherwise than their neighbours. NaN in samples with fewer
    than LEAST_DOTS dots. ValueError on other shapes.
    """
    dots = len(rest_mm)
    if moved_mm.shape != (len(moved_mm), dots, 2) or rest_mm.shape != (dots, 2) or tracked.shape != moved_mm.shape[:2]:
        shapes = f"{moved_mm.shape}, {rest_mm.shape} and {tracked.shape}"
        raise ValueError(f"expected shapes (n, dots, 2), (dots, 2) and (n, dots), found {shapes}")
    seen = tracked & np.isfinite(moved_mm).all(axis=2) & np.isfinite(rest_mm).all(axis=1)
    seen = with_neighbours(moved_mm, rest_mm, seen)
    field = np.full((len(moved_mm), len(LATTICE_MM), 2), np.nan)
    if not seen.size:
        return field
    bits = np.packbits(seen, axis=1)
    _, sample, group = np.unique(bits.view(f"V{bits.shape[1]}").reshape(-1), return_index=True, return_inverse=True)
    for number, mask in enumerate(seen[sample]):
        if mask.sum() < LEAST_DOTS:
            continue
        rows = np.flatnonzero(group == number)
        weights = lattice_weights(rest_mm[mask])
        field[rows] = np.einsum("ld,ndc->nlc", weights, moved_mm[rows][:, mask], optimize=True)
    return field


def with_neighbours(moved_mm: Floats, rest_mm: Floats, seen: Flags) -> Flags:
    """Of the seen dots (n, dots) those that moved about as the median of their neighbours did."""
    dots = len(rest_mm)
    if dots <= NEIGHBOURS:
        return seen
    apart = np.linalg.norm(rest_mm[:, None] - rest_mm[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1)[:, :NEIGHBOURS]
    kept = seen.copy()
    largest = np.where(seen[..., None], np.abs(moved_mm), 0.0).max(axis=(1, 2), initial=0.0)
    moving = np.flatnonzero(largest > ALONE_MM / 3)  # no two dots can be farther apart in the others
    block = max(1, MOST_VALUES // (2 * NEIGHBOURS * dots))
    for first in range(0, len(moving), block):
        rows = moving[first : first + block]
        for _ in range(2):  # again without those that were found, which count among their neighbours' neighbours
            around = np.where(kept[rows, :, None], moved_mm[rows], np.nan)[:, near]
            middle = _median(around)
            spread = _median(np.linalg.norm(around - middle[:, :, None], axis=3))
            off = np.linalg.norm(moved_mm[rows] - middle, axis=2)
            kept[rows] = seen[rows] & ~(off > np.maximum(ALONE_MM, ALONE_SPREADS * spread))
    return kept


def _median(values: Floats) -> Floats:
    """Median over the third axis of what is no NaN; NaN where all are."""
    ordered = np.sort(values, axis=2)  # NaN last
    count = np.isfinite(values).sum(axis=2, keepdims=True)
    low, high = (np.take_along_axis(ordered, at, axis=2) for at in (np.maximum(count - 1, 0) // 2, count // 2))
    middle: Floats = 0.5 * (low + high)[:, :, 0]
    return middle


def mirrored(field: Floats) -> Floats:
    """The field (n, places, 2) of the same contact on the other side of the x axis."""
    grid = field.reshape(len(field), len(Y_MM), len(X_MM), 2)[:, ::-1]
    other: Floats = (grid * [1.0, -1.0]).reshape(field.shape)
    return other
