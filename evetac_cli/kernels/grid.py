"""The dot grid: which row and column every dot belongs to."""

import numpy as np
from numpy.typing import NDArray


def arrange(dot_xy_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sort dots given in any order into (rows, columns, 2), rows from top to bottom, columns from left to right.

    Accepts (dots, 2) or an array already of shape (rows, columns, 2). Rows are told apart by gaps in y that exceed half
    the pitch, so the grid may be tilted by up to about half a pitch over its width. ValueError if the rows are uneven.
    """
    dots = np.asarray(dot_xy_px, dtype=np.float64)
    if dots.ndim == 3 and dots.shape[2] == 2:
        return dots
    if dots.ndim != 2 or dots.shape[1] != 2 or len(dots) == 0:
        raise ValueError(f"expected (dots, 2), found shape {dots.shape}")
    if not np.isfinite(dots).all():
        raise ValueError("expected finite centres; missing dots are only possible in a (rows, columns, 2) grid")
    by_row = dots[np.argsort(dots[:, 1], kind="stable")]
    breaks = np.flatnonzero(np.diff(by_row[:, 1]) > pitch(dots) / 2) + 1
    rows = np.split(by_row, breaks)
    sizes = {len(row) for row in rows}
    if len(sizes) != 1:
        raise ValueError(f"expected rows of equal length, found {[len(row) for row in rows]} dots a row")
    return np.stack([row[np.argsort(row[:, 0], kind="stable")] for row in rows])


def pitch(dot_xy_px: NDArray[np.float64]) -> float:
    """Median distance from a dot to its nearest neighbour, in px; infinite for a single dot."""
    dots = dot_xy_px.reshape(-1, 2)
    dots = dots[np.isfinite(dots).all(axis=1)]
    distance = np.linalg.norm(dots[:, None] - dots[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))
