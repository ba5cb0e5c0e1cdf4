"""The dot grid: which row and column every dot belongs to."""

import numpy as np
from numpy.typing import NDArray


def arrange(dot_xy_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sort dots given in any order into (rows, columns, 2), rows from top to bottom, columns from left to right.

    Accepts (dots, 2) or an array already sorted as (rows, columns, 2), with NaN where a dot is missing. Rows are told
    apart by gaps in y that exceed half the pitch, so the grid may be tilted by up to about half a pitch over its width.
    ValueError if the rows run into each other or are uneven, or their dots do not stand below each other.
    """
    dots = np.asarray(dot_xy_px, dtype=np.float64)
    if dots.ndim not in (2, 3) or dots.shape[-1] != 2 or dots.size == 0:
        raise ValueError(f"expected (dots, 2), found shape {dots.shape}")
    if dots.ndim == 3:
        if np.isinf(dots).any():
            raise ValueError("expected finite centres, or NaN for a missing dot")
        if (np.diff(dots[..., 1], axis=0) <= 0).any() or (np.diff(dots[..., 0], axis=1) <= 0).any():
            raise ValueError("expected rows from top to bottom and columns from left to right")
        return dots
    if not np.isfinite(dots).all():
        raise ValueError("expected finite centres; missing dots are only possible in a (rows, columns, 2) grid")
    half = pitch(dots) / 2
    by_row = dots[np.argsort(dots[:, 1], kind="stable")]
    breaks = np.flatnonzero(np.diff(by_row[:, 1]) > half) + 1
    rows = np.split(by_row, breaks)
    sizes = {len(row) for row in rows}
    if len(sizes) != 1:
        raise ValueError(f"expected rows of equal length, found {[len(row) for row in rows]} dots a row")
    grid = np.stack([row[np.argsort(row[:, 0], kind="stable")] for row in rows])
    if (np.diff(grid[..., 0], axis=1) <= half).any():
        raise ValueError("expected dots of a row further apart; rows run into each other (tilted?), or dots come twice")
    if (np.abs(np.diff(grid[..., 0], axis=0)) > half).any():
        raise ValueError("expected dots below each other; every row lacks dots, or has too many, in another place")
    return grid


def pitch(dot_xy_px: NDArray[np.float64]) -> float:
    """Median distance from a dot to its nearest neighbour, in px; infinite for a single dot."""
    dots = dot_xy_px.reshape(-1, 2)
    dots = dots[np.isfinite(dots).all(axis=1)]
    distance = np.linalg.norm(dots[:, None] - dots[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))
