"""The dot grid: the row and column of every dot, and its neighbours.

`arrange` takes all dots of a grid and rejects anything else. `lattice` finds the grid in measured positions, of which
some may be no dots, and in which some dots may be missing. `neighbours` needs no grid: dots may come in any order.

Dots in no grid are one row of all of them, (1, n, 2), in any order.
"""

import numpy as np
from numpy.typing import NDArray

NEXT_DOOR = 0.3  # in pitches: largest deviation of a step to the next dot from the usual step
OFF_LATTICE = 0.35  # ... and of a dot from the plane through all dots
TURNED = 0.8  # cosine of the largest angle of a step to the right from the x axis
OBLIQUE = 0.34  # cosine of the angle between rows and columns: at most 20 degrees off a right angle
LEAST_APART_PX = 1.0  # two dots that are closer are at the same position
MOST_DOTS = 256  # of a gel: capacity of tracker and features
MOST_FRAME_PX = 2048  # width or height of a frame with dots: capacity of the tracker
MAX_NEIGHBOURS = 8
NEIGHBOUR_PITCHES = 1.7  # between the diagonal (1.41) and the second next dot (2)


def arrange(dot_xy_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sort dots in any order into (rows, columns, 2), rows from top to bottom, columns from left to right.

    Accepts (dots, 2) or an already sorted array (rows, columns, 2) with NaN for missing dots; a single row is returned
    unchanged. Rows are separated by gaps in y of more than half the pitch, so the grid may be tilted by up to about
    half a pitch over its width. ValueError if rows overlap in y or have unequal length, or if their dots are not below
    each other.
    """
    dots = np.asarray(dot_xy_px, dtype=np.float64)
    if dots.ndim not in (2, 3) or dots.shape[-1] != 2 or dots.size == 0:
        raise ValueError(f"expected (dots, 2), found shape {dots.shape}")
    if dots.ndim == 3:
        if np.isinf(dots).any():
            raise ValueError("expected finite centres, or NaN for a missing dot")
        sorted_wrong = (np.diff(dots[..., 1], axis=0) <= 0).any() or (np.diff(dots[..., 0], axis=1) <= 0).any()
        if len(dots) > 1 and sorted_wrong:
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
        raise ValueError(f"expected rows of equal length, found {[len(row) for row in rows]} dots per row")
    grid = np.stack([row[np.argsort(row[:, 0], kind="stable")] for row in rows])
    if (np.diff(grid[..., 0], axis=1) <= half).any():
        raise ValueError("expected dots of a row further apart; rows overlap (tilted?), or dots are listed twice")
    if (np.abs(np.diff(grid[..., 0], axis=0)) > half).any():
        raise ValueError("expected dots below each other; every row lacks dots, or has extra ones, in another column")
    return grid


def lattice(places_xy_px: NDArray[np.float64], least: tuple[int, int] = (0, 0)) -> NDArray[np.float64]:
    """Find the grid in positions (n, 2) in any order: (rows, columns, 2) like `arrange`, NaN for a missing dot.

    Steps from dot to dot connect the largest piece of a grid that is tilted by up to about 20 degrees; its rows may be
    farther apart than its columns. A plane through that piece gives the row and column of every position. Positions off
    the lattice are dropped, and so is a first or last row or column with less than half of its dots, as long as `least`
    rows and columns remain. ValueError if there are not two rows and two columns at about right angles: staggered rows
    are not a grid.
    """
    places = np.asarray(places_xy_px, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 2 or not np.isfinite(places).all():
        raise ValueError(f"expected finite positions (n, 2), found shape {places.shape}")
    too_few = ValueError(f"expected at least two rows and two columns of dots, found none in {len(places)} positions")
    if len(places) < 4:
        raise too_few
    offset = places[None] - places[:, None]
    cells: dict[int, tuple[int, int]] = {}
    oblique = False
    # The row pitch is equal to the column pitch, or independent of it: the choice that connects more positions wins.
    for usual_px in (pitch(places), None):
        right, below = (_next_door(offset, axis, usual_px) for axis in (0, 1))
        if not right.any() or not below.any():
            continue
        steps = [(near, np.median(offset[near], axis=0), cell) for near, cell in ((right, (0, 1)), (below, (1, 0)))]
        along, down = (step / np.linalg.norm(step) for _, step, _ in steps)
        if abs(along @ down) > OBLIQUE:
            oblique = True
            continue
        shorter_px = min(float(np.linalg.norm(step)) for _, step, _ in steps)
        piece = _largest_piece(steps, offset, shorter_px)
        if len(piece) > len(cells):
            cells, step_px = piece, shorter_px
    if not cells:
        if oblique:
            raise ValueError("expected columns at about right angles to rows, found staggered rows")
        raise too_few
    members = np.array(list(cells))
    index = np.array([cells[member] for member in members])
    if (np.ptp(index, axis=0) < 1).any():
        raise too_few
    plane = np.linalg.lstsq(np.column_stack([index, np.ones(len(index))]), places[members], rcond=None)[0]
    exact = (places - plane[2]) @ np.linalg.inv(plane[:2])
    cell = np.round(exact).astype(np.int64)
    off = np.linalg.norm((cell - exact) @ plane[:2], axis=1)
    on_lattice = np.flatnonzero(off < OFF_LATTICE * step_px)
    cell -= cell[on_lattice].min(axis=0)
    grid = np.full((*(cell[on_lattice].max(axis=0) + 1), 2), np.nan)
    for place in on_lattice[np.argsort(-off[on_lattice], kind="stable")]:  # of two in one cell the better one remains
        grid[tuple(cell[place])] = places[place]
    grid = _without_weak_borders(grid, least)
    if min(grid.shape[:2]) < 2:
        raise too_few
    return grid


def impossible(dot_xy_px: NDArray[np.float64], radius_px: float | None = None) -> tuple[str, str] | None:
    """Return (expected, found) if the dots cannot be those of a gel; None if they can.

    dot_xy_px: (rows, columns, 2), NaN for a missing dot. radius_px: of a dot, if known.
    """
    present = np.isfinite(dot_xy_px).all(axis=2)
    dots = dot_xy_px[present]
    if present.size > MOST_DOTS:
        return f"at most {MOST_DOTS} dots", "{} x {}".format(*present.shape)
    distance = np.linalg.norm(dots[:, None] - dots[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    nearest = float(distance.min(initial=np.inf))
    if nearest < LEAST_APART_PX:
        place = dots[int(np.argmin(distance) // len(dots))]
        return f"dots at least {LEAST_APART_PX:g} px apart", f"two at ({place[0]:.4g}, {place[1]:.4g})"
    if radius_px is not None and radius_px >= nearest:
        return "dots further apart than their radius", f"{nearest:.4g} px apart, radius {radius_px:.4g} px"
    if (present.sum(axis=1) > 1).any() and (present.sum(axis=0) > 1).any():  # dots on a line are one row
        across = np.linalg.svd(dots - dots.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(dots))
        if across < LEAST_APART_PX:
            return "rows and columns", "all dots on one line"
    return None


def one_row(places_xy_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions (n, 2) in no grid as (1, n, 2), sorted from the top and then from the left."""
    return places_xy_px[np.lexsort(places_xy_px.T)][None]


def in_words(rows: int, columns: int) -> str:
    """Describe a layout of dots."""
    return f"{rows} rows x {columns} columns" if rows > 1 else f"{columns} dots in no grid"


def _next_door(offset: NDArray[np.float64], axis: int, step_px: float | None) -> NDArray[np.bool_]:
    """Return which positions (n, n) are about a step from others along +x or +y, by offsets (n, n, 2) between them.

    step_px: None for the usual distance to the nearest position in that direction.
    """
    distance = np.linalg.norm(offset, axis=2)
    towards = offset[..., axis] > TURNED * distance
    if step_px is None:
        nearest = np.where(towards, distance, np.inf).min(axis=1)
        if not np.isfinite(nearest).any():
            return np.asarray(towards, np.bool_)
        step_px = float(np.median(nearest[np.isfinite(nearest)]))
    return np.asarray(towards & (np.abs(distance - step_px) < NEXT_DOOR * step_px), np.bool_)


def _largest_piece(
    steps: list[tuple[NDArray[np.bool_], NDArray[np.float64], tuple[int, int]]],
    offset: NDArray[np.float64],
    step_px: float,
) -> dict[int, tuple[int, int]]:
    """Return position -> (row, column) for the largest set that single steps to the right or down connect."""
    links: dict[int, list[tuple[int, int, int]]] = {place: [] for place in range(len(offset))}
    for near, step, (down, right) in steps:
        fits = near & (np.linalg.norm(offset - step, axis=2) < NEXT_DOOR * step_px)
        for first, second in np.argwhere(fits).tolist():
            links[first].append((second, down, right))
            links[second].append((first, -down, -right))
    best: dict[int, tuple[int, int]] = {}
    seen: set[int] = set()
    for place in links:
        if place in seen:
            continue
        piece = {place: (0, 0)}
        waiting = [place]
        while waiting:
            here = waiting.pop()
            row, column = piece[here]
            for other, down, right in links[here]:
                if other not in piece:
                    piece[other] = (row + down, column + right)
                    waiting.append(other)
        seen |= piece.keys()
        best = max(best, piece, key=len)
    return best


def _without_weak_borders(grid: NDArray[np.float64], least: tuple[int, int]) -> NDArray[np.float64]:
    """Remove first and last rows and columns with less than half of their dots, the emptiest first."""
    while grid.size:
        present = np.isfinite(grid[..., 0])
        borders = []
        if len(grid) > least[0]:
            borders += [(present[0].mean(), grid[1:]), (present[-1].mean(), grid[:-1])]
        if grid.shape[1] > least[1]:
            borders += [(present[:, 0].mean(), grid[:, 1:]), (present[:, -1].mean(), grid[:, :-1])]
        share, rest = min(borders, key=lambda border: border[0], default=(1.0, grid))
        if share >= 0.5:
            break
        grid = rest
    return grid


def pitch(dot_xy_px: NDArray[np.float64]) -> float:
    """Return the median distance from a dot to its nearest neighbour, in px; infinite for a single dot."""
    dots = dot_xy_px.reshape(-1, 2)
    dots = dots[np.isfinite(dots).all(axis=1)]
    distance = np.linalg.norm(dots[:, None] - dots[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def neighbours(dot_xy_px: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the up to 8 grid neighbours of every dot: (n, 8) indices, nearest first, filled up with -1.

    Neighbours are the dots within 1.7 pitches: along rows, columns and both diagonals. Missing dots (NaN) have none.
    """
    distance_px = np.linalg.norm(dot_xy_px[:, None] - dot_xy_px[None], axis=2)
    np.fill_diagonal(distance_px, np.inf)
    near = distance_px < NEIGHBOUR_PITCHES * pitch(dot_xy_px)
    indices = np.full((len(dot_xy_px), MAX_NEIGHBOURS), -1, np.int32)
    for dot in range(len(dot_xy_px)):
        others = np.flatnonzero(near[dot])
        others = others[np.argsort(distance_px[dot, others], kind="stable")][:MAX_NEIGHBOURS]
        indices[dot, : len(others)] = others
    return indices
