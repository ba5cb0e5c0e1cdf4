"""The dot grid: the row and column of every dot, and its neighbours.

`arrange` takes all dots of a grid and rejects anything else. `lattice` finds the grid in measured positions, of which
some may be no dots, and in which some dots may be missing. `neighbours` needs no grid: dots may come in any order.

Dots in no grid are one row of all of them, (1, n, 2), in any order.
"""

import numpy as np
from numpy.typing import NDArray

NEXT_DOOR = 0.3  # in pitches: largest deviation of a step to the next dot from the usual step of
NEARBY = 9  # ... this many positions around it
OFF_LATTICE = 0.35  # in pitches: largest deviation of a dot from the smooth surface through all dots
CORE = 2  # the grid grows from the dots within this many rows and columns of one of them
STARTS = 12  # number of dots it may start from
MOST_ROUNDS = 100  # one for each row or column that is added, and some that only exchange dots
# The smooth surface is a cubic polynomial of row and column: exact for a lens with third-order radial distortion.
POWERS = [(down, right) for down in range(4) for right in range(4 - down)]
STIFFNESS = 0.15  # holds its bends to what many dots show, so that few dots continue as a plane
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
    farther apart than its columns. From the middle of that piece the grid grows over all positions, also where a lens
    bends it: the next row or column is expected on a smooth surface through the dots so far. Positions off the lattice
    are dropped, and so is a first or last row or column with less than half of its dots, as long as `least` rows and
    columns remain. ValueError if there are not two rows and two columns at about right angles: staggered rows are not a
    grid.
    """
    places = np.asarray(places_xy_px, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 2 or not np.isfinite(places).all():
        raise ValueError(f"expected finite positions (n, 2), found shape {places.shape}")
    too_few = ValueError(f"expected at least two rows and two columns of dots, found none in {len(places)} positions")
    if len(places) < 4:
        raise too_few
    cells: dict[tuple[int, int], int] = {}
    oblique = False
    # Steps are of any length, or as long as the pitch: the choice that finds more dots wins.
    for usual_px in (None, pitch(places)):
        right, below = (_next_door(places, axis, usual_px) for axis in (0, 1))
        usual_right, usual_below = (_usual_nearby(steps, places) for steps in (right, below))
        known = np.isfinite(usual_right + usual_below).all(axis=1)
        if not known.any():
            continue
        lengths = [np.linalg.norm(usual[known], axis=1) for usual in (usual_right, usual_below)]
        cosine = np.abs((usual_right[known] * usual_below[known]).sum(axis=1)) / (lengths[0] * lengths[1])
        if np.median(cosine) > OBLIQUE:
            oblique = True
            continue
        cells = max(cells, _grown(places, _largest_piece(places, (right, below), (usual_right, usual_below))), key=len)
        if len(cells) == len(places):
            break
    if oblique and not cells:
        raise ValueError("expected columns at about right angles to rows, found staggered rows")
    index = np.array([*cells]).reshape(-1, 2)
    if not cells or (np.ptp(index, axis=0) < 1).any():
        raise too_few
    place_of = np.full(np.ptp(index, axis=0) + 1, -1)
    place_of[tuple((index - index.min(axis=0)).T)] = [*cells.values()]
    place_of = _without_weak_borders(place_of, least)
    if min(place_of.shape) < 2:
        raise too_few
    if (place_of >= 0).sum() < len(places):
        # Beyond the borders of a grid that a lens bends a lot, the surface folds back: cells there may have taken dots.
        cells = {(row, column): int(place_of[row, column]) for row, column in np.argwhere(place_of >= 0).tolist()}
        found = _matched(places, cells, np.argwhere(place_of >= -1))
        if len(found) > len(cells):
            place_of[tuple(np.array([*found]).T)] = [*found.values()]
    return np.where((place_of >= 0)[..., None], places[place_of], np.nan)


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


def _next_door(places: NDArray[np.float64], axis: int, usual_px: float | None) -> NDArray[np.float64]:
    """Return the step (n, 2) from each position to the nearest along +x or +y; NaN unless that one leads back to it.

    usual_px: about the length of all steps, None for any.
    """
    offset = places[None] - places[:, None]
    distance = np.linalg.norm(offset, axis=2)
    ahead = np.where(offset[..., axis] > TURNED * distance, distance, np.inf)
    if usual_px is not None:
        ahead[np.abs(distance - usual_px) >= NEXT_DOOR * usual_px] = np.inf
    nearest, back = ahead.argmin(axis=1), ahead.argmin(axis=0)
    every = np.arange(len(places))
    mutual = np.isfinite(ahead[every, nearest]) & (back[nearest] == every)
    return np.where(mutual[:, None], offset[every, nearest], np.nan)


def _usual_nearby(steps: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of the steps (n, 2) of the NEARBY positions around each; NaN if they have none."""
    distance = np.linalg.norm(places[None] - places[:, None], axis=2)
    around = steps[np.argsort(distance, axis=1, kind="stable")[:, :NEARBY]]
    usual = np.full_like(steps, np.nan)
    known = np.isfinite(around[..., 0]).any(axis=1)
    usual[known] = np.nanmedian(around[known], axis=1)
    return usual


def _largest_piece(
    places: NDArray[np.float64],
    steps: tuple[NDArray[np.float64], NDArray[np.float64]],
    usual: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> dict[tuple[int, int], int]:
    """Return (row, column) -> position for the largest set that usual steps to the right and down connect."""
    links: list[list[tuple[int, int, int]]] = [[] for _ in places]
    shorter_px = np.fmin(*(np.linalg.norm(each, axis=1) for each in usual))
    for step, expected, (down, right) in zip(steps, usual, ((0, 1), (1, 0)), strict=True):
        fits = np.linalg.norm(step - expected, axis=1) < NEXT_DOOR * shorter_px
        for first in np.flatnonzero(fits).tolist():
            second = int(np.linalg.norm(places - places[first] - step[first], axis=1).argmin())
            links[first].append((second, down, right))
            links[second].append((first, -down, -right))
    best: dict[int, tuple[int, int]] = {}
    seen: set[int] = set()
    for place in range(len(places)):
        if place in seen:
            continue
        piece = {place: (0, 0)}
        waiting = [place]
        while waiting:
            here = waiting.pop(0)
            row, column = piece[here]
            for other, down, right in links[here]:
                if other not in piece:
                    piece[other] = (row + down, column + right)
                    waiting.append(other)
        seen |= piece.keys()
        best = max(best, piece, key=len)
    return {cell: place for place, cell in best.items()}


def _grown(places: NDArray[np.float64], piece: dict[tuple[int, int], int]) -> dict[tuple[int, int], int]:
    """Return (row, column) -> position of all positions on the lattice, from a part of a piece of it.

    A piece may contain wrong steps, next to missing dots. So the grid grows from up to STARTS parts of it in turn, the
    middle one first, until it has all positions; otherwise the largest result counts.
    """
    index = np.array([*piece])
    best: dict[tuple[int, int], int] = {}
    from_middle = np.abs(index - np.median(index, axis=0)).max(axis=1)
    for start in index[np.argsort(from_middle, kind="stable")][:: -(-len(index) // STARTS)]:
        core = {cell: place for cell, place in piece.items() if np.abs(cell - start).max() <= CORE}
        best = max(best, _grown_from(places, core), key=len)
        if len(best) == len(places):
            break
    return best


def _grown_from(places: NDArray[np.float64], cells: dict[tuple[int, int], int]) -> dict[tuple[int, int], int]:
    """Return (row, column) -> position of all positions on a lattice of which some cells are known.

    Each round expects dots in all cells so far and next to them, or, if that finds none, up to two cells away.
    """
    for _ in range(MOST_ROUNDS):
        for away in (1, 2):
            near = {(row + d, column) for row, column in cells for d in range(-away, away + 1)}
            near |= {(row, column + d) for row, column in cells for d in range(-away, away + 1)}
            found = _matched(places, cells, np.array(sorted(near)))
            if not found.keys() <= cells.keys():
                break
        if found == cells or not found:
            break
        cells = found
    return cells


def _matched(
    places: NDArray[np.float64], cells: dict[tuple[int, int], int], wanted: NDArray[np.int64]
) -> dict[tuple[int, int], int]:
    """Return the position that fits best in each of the wanted cells (n, 2), by a surface through the known cells."""
    index = np.array([*cells])
    middle = index.mean(axis=0)
    half = np.maximum(np.ptp(index, axis=0).max() / 2, 1)
    bends = np.diag([STIFFNESS / half * (sum(powers) > 1) for powers in POWERS])
    terms = np.concatenate([_terms((index - middle) / half), bends])
    known_px = np.concatenate([places[[*cells.values()]], np.zeros((len(POWERS), 2))])
    surface = np.linalg.lstsq(terms, known_px, rcond=None)[0]
    expected = _terms((wanted - middle) / half) @ surface
    # At a corner that a lens bends, the step to the dot inside counts: the one outwards may be next to nothing.
    steps = np.array([[(0, -1), (0, 1)], [(-1, 0), (1, 0)]])
    next_px = np.stack([_terms((wanted + step - middle) / half) @ surface - expected for step in steps.reshape(-1, 2)])
    pitch_px = np.linalg.norm(next_px, axis=2).reshape(2, 2, -1).max(axis=1).min(axis=0)
    off = np.linalg.norm(places[None] - expected[:, None], axis=2) / np.maximum(pitch_px, 1e-9)[:, None]
    found: dict[tuple[int, int], int] = {}
    used: set[int] = set()
    pairs = np.argwhere(off < OFF_LATTICE)
    for number, place in pairs[np.argsort(off[tuple(pairs.T)], kind="stable")].tolist():
        row, column = wanted[number].tolist()
        if (row, column) not in found and place not in used:
            found[row, column] = place
            used.add(place)
    return found


def _terms(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the terms (n, terms) of a cubic polynomial in row and column."""
    return np.stack([cells[:, 0] ** down * cells[:, 1] ** right for down, right in POWERS], axis=1)


def _without_weak_borders(place_of: NDArray[np.int64], least: tuple[int, int]) -> NDArray[np.int64]:
    """Remove first and last rows and columns with less than half of their dots, the emptiest first.

    place_of: (rows, columns) index of a position, -1 for none.
    """
    while place_of.size:
        present = place_of >= 0
        borders = []
        if len(place_of) > least[0]:
            borders += [(present[0].mean(), place_of[1:]), (present[-1].mean(), place_of[:-1])]
        if place_of.shape[1] > least[1]:
            borders += [(present[:, 0].mean(), place_of[:, 1:]), (present[:, -1].mean(), place_of[:, :-1])]
        share, rest = min(borders, key=lambda border: border[0], default=(1.0, place_of))
        if share >= 0.5:
            break
        place_of = rest
    return place_of


def pitch(dot_xy_px: NDArray[np.float64]) -> float:
    """Return the median distance from a dot to its nearest neighbour; infinite for a single dot."""
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
