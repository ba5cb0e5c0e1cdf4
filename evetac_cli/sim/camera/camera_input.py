"""Checks of the inputs of the camera: positions and paths in px, lines.

Invalid input raises a ValueError with expected and found, before a camera changes.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.arrays import Floats
from evetac_cli.errors import check_range
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera.contact_edges import ContactEdges, EdgePlace, LineMotion, check_place

FARTHEST_PX = 1e6
MOST_PIECES = 1000  # most pieces of a curved path in a slice

# Corners x0, y0, x1, y1 of a window, ends excluded, and the texture behind it.
Window = tuple[tuple[int, int, int, int], NDArray[np.float32] | None]


class ObjectMotion(NamedTuple):
    """Position of the object behind the window at start and end of a slice (2,), in px, and its texture's contrast."""

    start_px: Floats
    end_px: Floats
    contrast: float


class SliceMotion(NamedTuple):
    """Motion in a camera's view during a slice, in px.

    Dots (dots, 2) and the object's displacement (2,) move on straight lines from start to end. The contrast applies to
    the whole slice (1: the texture as drawn, 0: invisible). `dot_path_px` (k + 1, dots, 2) is for dots on curved paths:
    their positions at k + 1 equally spaced times, from start to end. A camera with contact edges needs
    `contact_edges_start` and `contact_edges_end`, between which they move and fade linearly.
    """

    dot_xy_px_start: ArrayLike
    dot_xy_px_end: ArrayLike
    object_xy_px_start: ArrayLike
    object_xy_px_end: ArrayLike
    texture_contrast: float
    dot_path_px: ArrayLike | None = None
    contact_edges_start: EdgePlace | None = None
    contact_edges_end: EdgePlace | None = None


def motions(dots: int, motion: SliceMotion) -> tuple[Floats, ObjectMotion]:
    """Return the paths of dots, (dots, k + 1, 2), and the motion of the object."""
    check_range("texture_contrast", motion.texture_contrast, 0.0, 1e3)
    start, end, begin, stop = (np.ascontiguousarray(ends, np.float64).reshape(-1, 2) for ends in motion[:4])
    assert len(start) == len(end) == dots
    path, ends = np.empty((dots, 2, 2)), np.empty((2, 2))
    if not _fill_ends(start, end, begin[0], stop[0], path, ends):
        raise ValueError(f"a slice's motion: expected finite positions within {FARTHEST_PX:g} px")
    if motion.dot_path_px is not None:
        path = _curved(motion.dot_path_px, start, end)
    return path, ObjectMotion(ends[0], ends[1], float(motion.texture_contrast))


@njit(cache=True, _nrt=False)
def _fill_ends(
    dots_start: Floats, dots_end: Floats, object_start: Floats, object_end: Floats, path: Floats, ends: Floats
) -> bool:
    """Fill dot paths (dots, 2, 2) and object positions (2, 2) at the slice's ends; return False if one is too far."""
    within = True
    for axis in range(2):
        ends[0, axis] = object_start[axis]
        ends[1, axis] = object_end[axis]
        within &= abs(ends[0, axis]) <= FARTHEST_PX and abs(ends[1, axis]) <= FARTHEST_PX  # false for NaN
        for dot in range(len(path)):
            path[dot, 0, axis] = dots_start[dot, axis]
            path[dot, 1, axis] = dots_end[dot, axis]
            within &= abs(dots_start[dot, axis]) <= FARTHEST_PX and abs(dots_end[dot, axis]) <= FARTHEST_PX
    return within


def positions(name: str, values: ArrayLike) -> Floats:
    """Return positions (n, 2) in px, contiguous."""
    xy = np.ascontiguousarray(values, np.float64)
    if xy.size == 0:
        return np.empty((0, 2))
    assert xy.ndim == 2 and xy.shape[1] == 2
    if not _all_within(xy, FARTHEST_PX):
        raise ValueError(f"{name}: expected finite positions within {FARTHEST_PX:g} px, found {xy.min()} to {xy.max()}")
    return xy


@njit(cache=True)
def _all_within(xy: Floats, limit: float) -> bool:
    return bool(np.all(np.abs(xy) <= limit))  # false for NaN


def _curved(dot_path_px: ArrayLike, dots_start: Floats, dots_end: Floats) -> Floats:
    """Return the vertices of every dot's path, (dots, k + 1, 2), from (k + 1, dots, 2)."""
    path = np.asarray(dot_path_px, np.float64)
    assert path.ndim == 3 and path.shape[1:] == dots_start.shape and 2 <= len(path) <= MOST_PIECES + 1
    positions("dot_path_px", path.reshape(-1, 2))
    assert np.array_equal(path[0], dots_start) and np.array_equal(path[-1], dots_end)
    return np.ascontiguousarray(path.transpose(1, 0, 2))


def line_motion(contact_edges: ContactEdges | None, motion: SliceMotion) -> LineMotion | None:
    """Return the checked motion of the lines in a slice; None if there are none, or none moves.

    A motion of the cut edge that is too small for scans to notice is ignored, which keeps a slow shear cheap.
    """
    start, end = motion.contact_edges_start, motion.contact_edges_end
    if contact_edges is None:
        assert start is None and end is None
        return None
    assert start is not None and end is not None
    if start is end is contact_edges.rested:
        return None
    previous, checked = contact_edges.placed
    first = checked if start is previous else check_place("contact_edges_start", contact_edges, start)
    last = first if end is start else check_place("contact_edges_end", contact_edges, end)
    contact_edges.placed = end, last
    places = (first, last)
    contact_edges.rested = end if start is end else None
    if contact_edges.still(*places, contact_edges.cut_resolution_px * 0.99):
        return None
    return contact_edges.motion(*places)
