"""The arrays of the scanning camera, grouped as its compiled loops take them.

Groups are used down to the functions that `_scan` calls and to `scan_lines`; the functions below take single arrays
(for the reason see dots).
"""

from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.contact_edges import EdgePlace, LineMotion, Outline
from evetac_cli.sim.camera.optics import DotShapes

MOST_LISTED = 512  # most pixels in the list of a dot; larger or more blurred dots may have no list
# Number of adjacent window pixels that are compared together. With more, the pixel nearest to its threshold causes more
# others to be compared; with fewer, there are more runs to visit.
RUN_PX = 16
# For numba a Python number or truth value that is written into a call has its own type, and the called function is
# compiled once more for it, which takes some seconds. These constants have the types of all others.
ZERO, FALSE, TRUE = cast("int", np.int64(0)), cast("bool", np.bool_(False)), cast("bool", np.bool_(True))


class CandidatePixels(NamedTuple):
    """The pixels of the gel that may fire: a cache of what follows from references and paths; may always be discarded.

    If its distance from the nearest dot is between the square roots of `lower2_px2` and `upper2_px2` (height, width), a
    pixel certainly does not fire. Infinity as the first: to be computed when a dot comes near.

    While a dot stays in its `list_box` (dots, 4: centre and half sides, NaN without a list), only the first
    `list_length` pixels of its list `listed` may fire. Their radii are in `listed_px2` (dots, 2, pixels), side by side
    in memory, because memory access is the cost of visiting a list. A negative `list_length` counts the scans that a
    dot has been without a list.

    `level_index` speeds up the computation of radii. `light` (2,) is the flicker's contribution to all levels, minus
    the middle of its range, and half that range (see light): radii hold for the whole range.

    `drawn_dots` (height, width) and `drawn_at` (dots, 3) are dots drawn for passing outlines; `doubtful` is their
    scratch (see outline). The rest is scratch: `active` for a frame and `entry` for a list; `places` for positions of
    dots and derived arrays; `flags` (4, dots) for marks.

    Also scratch are `line` (width,) for the levels of a row, and `runs` (2, height, 4) for the pixels that outline and
    cut edge change.

    Compiled code that creates no arrays counts no references to arrays, which took a sixth of a slice.
    """

    level_index: NDArray[np.int16]
    lower2_px2: NDArray[np.float32]
    upper2_px2: NDArray[np.float32]
    list_box: NDArray[np.float64]
    listed: NDArray[np.int32]
    listed_px2: NDArray[np.float32]
    list_length: NDArray[np.int64]
    active: NDArray[np.int32]
    entry: NDArray[np.int64]
    light: NDArray[np.float32]
    drawn_dots: NDArray[np.float32]
    drawn_at: NDArray[np.float64]
    doubtful: NDArray[np.uint8]
    places: NDArray[np.float64]
    flags: NDArray[np.uint8]
    line: NDArray[np.float32]
    runs: NDArray[np.int64]


class CandidateRuns(NamedTuple):
    """The runs of RUN_PX pixels of the window that may fire: those whose `due_at` (rows, runs) has been reached.

    `row_due_at` (rows,) is the least of a row. `travelled` (1,) sums the largest possible change of any level so far,
    from the texture's steepest slopes `across` and `down`, log units per px; `greatest` is its highest level.
    """

    due_at: NDArray[np.float64]
    row_due_at: NDArray[np.float64]
    travelled: NDArray[np.float64]
    across: float
    down: float
    greatest: float


class GelPixels(NamedTuple):
    """The gel: the positions of its dots at the last scan (dots, 2), a dot's profile, its pixels, (height, width) each.

    `release_us` is the time until which a pixel is blind; its rows are empty if the refractory period is shorter than a
    scan. `middle_shift` is the difference between a pixel's reference and the level of its last event: half the
    difference of its ON and OFF thresholds. Then `threshold` is their mean, and a pixel fires as if both were equal.
    It is empty if they are equal. Dots that differ have `shapes`, and `profile` has the least inner and the largest
    outer radius.
    """

    seen_dot_xy_px: NDArray[np.float64]
    profile: optics.DotProfile
    reference: NDArray[np.float32]
    threshold: NDArray[np.float32]
    release_us: NDArray[np.float64]
    candidates: CandidatePixels
    middle_shift: NDArray[np.float32]
    shapes: DotShapes


class WindowPixels(NamedTuple):
    """The window: its first pixel in the frame, the texture that slides by, and its pixels, (rows, columns) each.

    `seen_object` is the object's x, y in px and the texture's contrast at the last scan, NaN before the first. For
    `middle_shift` see GelPixels.
    """

    first_x: int
    first_y: int
    seen_object: NDArray[np.float64]
    texture: NDArray[np.float32]
    reference: NDArray[np.float32]
    threshold: NDArray[np.float32]
    release_us: NDArray[np.float64]
    candidate_runs: CandidateRuns
    middle_shift: NDArray[np.float32]


class ScanTimes(NamedTuple):
    """The scans of one slice: readout time of each column (scans, width), in us of the slice, and the slice's start."""

    readout_us: NDArray[np.int64]
    t0_us: float
    refractory_us: float


class SlicePlaces(NamedTuple):
    """Positions of dots in some scans, and of near dots, (dots, scans, 2); boxes (dots, 4) of both; one more box."""

    at_xy: NDArray[np.float64]
    near_xy: NDArray[np.float64]
    box: NDArray[np.float64]
    near_box: NDArray[np.float64]
    wider: NDArray[np.float64]


@njit(cache=True, inline="always")
def gel_pixels(gel: tuple[Any, ...]) -> GelPixels:
    """Name the gel's arrays, from a plain tuple in the order of GelPixels, with plain tuples inside."""
    profile, candidates = gel[1], gel[5]
    return GelPixels(
        gel[0],
        optics.DotProfile(profile[0], profile[1], profile[2], profile[3]),
        gel[2],
        gel[3],
        gel[4],
        CandidatePixels(
            candidates[0],
            candidates[1],
            candidates[2],
            candidates[3],
            candidates[4],
            candidates[5],
            candidates[6],
            candidates[7],
            candidates[8],
            candidates[9],
            candidates[10],
            candidates[11],
            candidates[12],
            candidates[13],
            candidates[14],
            candidates[15],
            candidates[16],
        ),
        gel[6],
        DotShapes(gel[7][0], gel[7][1], gel[7][2], gel[7][3]),
    )


@njit(cache=True, inline="always")
def window_pixels(window: tuple[Any, ...]) -> WindowPixels:
    """Name the window's arrays, from a plain tuple in the order of WindowPixels, with plain tuples inside."""
    runs = window[7]
    return WindowPixels(
        window[0],
        window[1],
        window[2],
        window[3],
        window[4],
        window[5],
        window[6],
        CandidateRuns(runs[0], runs[1], runs[2], runs[3], runs[4], runs[5]),
        window[8],
    )


@njit(cache=True, inline="always")
def line_motion(lines: tuple[Any, ...]) -> LineMotion:
    """Name moving lines, from a plain tuple in the order of LineMotion, with plain tuples inside."""
    start, end, outline = lines[:3]
    return LineMotion(
        EdgePlace(start[0], start[1], start[2]),
        EdgePlace(end[0], end[1], end[2]),
        Outline(outline[0], outline[1], outline[2], outline[3]),
        lines[3],
        lines[4],
        lines[5],
        lines[6],
        lines[7],
        lines[8],
    )


@njit(cache=True, inline="always")
def slice_places(places: NDArray[np.float64], dots: int, scans: int) -> SlicePlaces:
    """Return scratch for the positions of dots in some scans, from `CandidatePixels.places`; see SlicePlaces."""
    path = 2 * dots * scans
    boxes = 2 * path
    last = boxes + 8 * dots
    return SlicePlaces(
        places[:path].reshape(dots, scans, 2),
        places[path:boxes].reshape(dots, scans, 2),
        places[boxes : boxes + 4 * dots].reshape(dots, 4),
        places[boxes + 4 * dots : last].reshape(dots, 4),
        places[last : last + 4].reshape(1, 4),
    )


def all_pixels(
    shape: tuple[int, int], dots: int, profile: optics.DotProfile, light: NDArray[np.float32], scans: int
) -> CandidatePixels:
    """Return candidates for the start, when all pixels of a frame (height, width) may fire."""
    height, width = shape
    return CandidatePixels(
        level_index=optics.level_index(profile),
        lower2_px2=np.full(shape, np.inf, np.float32),
        upper2_px2=np.full(shape, np.inf, np.float32),
        list_box=np.full((dots, 4), np.nan),
        listed=np.empty((dots, MOST_LISTED), np.int32),
        listed_px2=np.empty((dots, 2, MOST_LISTED), np.float32),
        list_length=np.zeros(dots, np.int64),
        active=np.empty(max(height * width, MOST_LISTED) + 1, np.int32),
        entry=np.empty(MOST_LISTED + 1, np.int64),
        light=light,
        drawn_dots=np.zeros(shape, np.float32),
        drawn_at=np.zeros((dots, 3)),
        doubtful=np.zeros((height, -(-width // 8) * 8), np.uint8),
        places=np.empty(6 * dots * scans + 16 * dots + 8),
        flags=np.zeros((4, dots), np.uint8),
        line=np.empty(width, np.float32),
        runs=np.zeros((2, height, 4), np.int64),
    )


def all_runs(shape: tuple[int, int], texture: NDArray[np.float32]) -> CandidateRuns:
    """Return candidates for the start, when all runs of a window (rows, columns) may fire."""
    rows, columns = shape
    return CandidateRuns(
        np.full((rows, -(-columns // RUN_PX)), -np.inf),
        np.full(rows, -np.inf),
        np.zeros(1),
        *optics.texture_slope(texture),
    )
