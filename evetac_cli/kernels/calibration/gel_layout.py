"""Layout of a gel from its dots: whether they fill the frame, where a window can be, and how the sensor is mounted.

An Evetac has 7 rows of 9 dots, which fill the frame of its camera. A cut gel lacks the last column, where its window
is (paper, "Evetac"). A closed gel with a worn last column looks the same. Upright, mirrored and rotated gels differ by
a third of a pitch. So the dots alone justify a question or a suspicion, but no certainty.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.calibration import grid

ROWS, CLOSED_COLUMNS, CUT_COLUMNS = 7, 9, 8  # of an Evetac's gel
WINDOW_SHARE = 100 / 640  # width of an Evetac's window, as a share of the frame's longer side
CENTRED = 0.3  # in pitches: largest offset of a whole gel from the middle of the frame; 0.25 in a simulated sensor
ROOM = 1.5  # in pitches from the outermost dots to the border of the frame: room for another row or column
CLEARER = 0.5  # in pitches: extra room that the side of a window must have over every other side
SIDES = ("left", "top", "right", "bottom")

Grid = NDArray[np.float64]
Window = tuple[int, int, int, int]  # x0, y0, x1, y1, ends excluded


def margins(dot_xy_px: Grid, frame_px: tuple[int, int]) -> Grid:
    """Return the distances in pitches from the outermost dots' centres to the border of the frame, as in SIDES.

    dot_xy_px: (rows, columns, 2). A missing dot counts with the position that follows from the others.
    """
    dots, step_px = _without_gaps(dot_xy_px)
    margins_px: Grid = np.concatenate([dots.min(axis=0), np.array(frame_px) - dots.max(axis=0)])
    return margins_px / np.tile(step_px, 2)


def free_sides(dot_xy_px: Grid, frame_px: tuple[int, int]) -> list[str]:
    """Return the sides of the frame with room for another row or column of dots, or for a window."""
    return [side for side, free in zip(SIDES, margins(dot_xy_px, frame_px), strict=True) if free >= ROOM]


def completed(dot_xy_px: Grid, size: tuple[int, int], frame_px: tuple[int, int]) -> Grid:
    """Return the grid of a closed gel of this size (rows, columns): outer ones without any found dot are NaN.

    They are added so that the whole grid is in the middle of the frame. ValueError if that is impossible, or if more
    rows or columns were found.
    """
    left, top, right, bottom = margins(dot_xy_px, frame_px)
    shown = dot_xy_px.shape[:2]
    first = (
        _missing_before("row", size[0] - shown[0], top, bottom),
        _missing_before("column", size[1] - shown[1], left, right),
    )
    whole = np.full((*size, 2), np.nan)
    whole[first[0] : first[0] + shown[0], first[1] : first[1] + shown[1]] = dot_xy_px
    return whole


def window(dot_xy_px: Grid, radius_px: float, frame_px: tuple[int, int]) -> tuple[str, Window]:
    """Return the side of a cut gel's window, one of SIDES, and the strip x0, y0, x1, y1 there.

    The window is at the side with the most room next to the dots. It is as deep as an Evetac's, or begins half way to
    the column that was cut away. ValueError if no side has room for it, or if several have about the same room.
    """
    free = margins(dot_xy_px, frame_px)
    side = int(free.argmax())
    if free[side] < ROOM:
        raise ValueError("there is no room for a window next to the dots")
    if free[side] < np.delete(free, side).max() + CLEARER:
        near = [name for name, room in zip(SIDES, free, strict=True) if room > free[side] - CLEARER]
        raise ValueError(f"there is about the same room for a window on several sides: {', '.join(near)}")
    width, height = frame_px
    pitch_px = _without_gaps(dot_xy_px)[1][side % 2]
    depth_px = round(WINDOW_SHARE * max(frame_px))
    if depth_px > free[side] * pitch_px - radius_px:
        depth_px = round((free[side] - 0.5) * pitch_px)
    strips = {
        "left": (0, 0, depth_px, height),
        "top": (0, 0, width, depth_px),
        "right": (width - depth_px, 0, width, height),
        "bottom": (0, height - depth_px, width, height),
    }
    return SIDES[side], strips[SIDES[side]]


def touches(window_px: Window, dot_xy_px: Grid, radius_px: float) -> bool:
    """Whether a dot, or a part of one, is in the window."""
    dots = dot_xy_px.reshape(-1, 2)
    dots = dots[np.isfinite(dots).all(axis=1)]
    nearest = np.clip(dots, window_px[:2], window_px[2:])
    return bool((np.linalg.norm(dots - nearest, axis=1) < radius_px).any())


def mounting(dot_xy_px: Grid, frame_px: tuple[int, int], window_px: Window | None) -> str:
    """Describe how a grid of an Evetac's size deviates from an upright sensor, as far as its shape and window show it.

    Empty if it does not. A closed gel that is mirrored or upside down looks like an upright one.
    """
    upright = (ROWS, CLOSED_COLUMNS if window_px is None else CUT_COLUMNS)
    if dot_xy_px.shape[1::-1] == upright:
        return f"the sensor seems to be turned by 90 degrees: an Evetac has {upright[0]} rows of {upright[1]} dots"
    if dot_xy_px.shape[:2] == upright and window_px is not None and window_px[0] + window_px[2] < frame_px[0]:
        how = "mirrored or turned by 180 degrees"
        return f"the sensor seems to be {how}: the window is at the left, an Evetac's is at the right"
    return ""


def _without_gaps(dot_xy_px: Grid) -> tuple[Grid, Grid]:
    """Return dots (n, 2), with missing ones on the plane through the others, and the pitch along x and y.

    The plane is exact for a grid that is shifted, rotated or stretched. Dots in no grid, one row, have no gaps.
    """
    shown = np.isfinite(dot_xy_px[..., 0])
    if len(dot_xy_px) == 1:
        return dot_xy_px[shown], np.full(2, grid.pitch(dot_xy_px))
    row, column = np.mgrid[: shown.shape[0], : shown.shape[1]]
    index = np.stack([column, row, np.ones_like(row)], axis=-1)
    plane = np.linalg.lstsq(index[shown], dot_xy_px[shown], rcond=None)[0]
    filled: Grid = np.where(shown[..., None], dot_xy_px, index @ plane)
    return filled.reshape(-1, 2), np.linalg.norm(plane[:2], axis=1)


def _missing_before(what: str, missing: int, before: float, after: float) -> int:
    """Return the number of missing rows or columns before the first one that was found; margins in pitches."""
    if missing < 0:
        raise ValueError(f"more {what}s of dots were found")
    if missing == 0:
        return 0
    first = min(max(round((before - after + missing) / 2), 0), missing)
    if abs((before - first) - (after - (missing - first))) / 2 > CENTRED:
        raise ValueError(f"the dots do not show which {what} is missing")
    return first
