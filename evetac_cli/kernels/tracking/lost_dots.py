"""Dots that have lost track: flagged when they are far from where their neighbours place them, put back at rest.

Why so: a dot that has lost track finds no rim of its own. When few events have come for a while and its neighbours are
back where they began, its place is known without events, and it starts anew from there (only with `rest_slices`, so
that the paper's presets stay what they are).
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.calibration.grid import MAX_NEIGHBOURS
from evetac_cli.kernels.compiled import njit

LOST_PX = 40.0  # with the paper's constants, no event of a dot's own edge is in its ring from 35 px on
AT_REST_PX = 3.0  # neighbours displaced by less than this, in the mean, are at rest


@njit(cache=True)
def update(state: np.void, moved: bool, ring_events: NDArray[np.int32]) -> None:
    """Flag the lost dots when something moved; put them back after `rest_slices` slices of rest.

    state: tracker.STATE; ring_events: (dots + 1,) of this slice.
    """
    dots = state["dots"]
    centre_xy_px, rest_xy_px = state["centre_xy_px"][: dots + 1], state["rest_xy_px"][:dots]
    neighbours, lost = state["neighbours"][:dots], state["lost"][:dots]
    if moved:
        _find_lost(centre_xy_px, rest_xy_px, neighbours, lost)
    if state["rest_slices"] == 0:
        return
    total = 0
    for i in range(dots):
        total += ring_events[i]
    at_rest = state["slices_at_rest"] + 1 if 2 * total < dots else 0
    state["slices_at_rest"] = at_rest
    if at_rest >= state["rest_slices"]:
        _put_back(centre_xy_px, rest_xy_px, neighbours, lost)


@njit(cache=True)
def _mean_displacement(
    i: int,
    centre_xy_px: NDArray[np.float64],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    left_out: NDArray[np.uint8],
) -> tuple[float, float, int]:
    """Mean displacement (x, y) of those neighbours of dot i that are not to be left out, and how many those are."""
    displacement_x = 0.0
    displacement_y = 0.0
    count = 0
    for entry in range(MAX_NEIGHBOURS):
        j = neighbours[i, entry]
        if j < 0:
            break
        if left_out[j]:
            continue
        displacement_x += centre_xy_px[j, 0] - rest_xy_px[j, 0]
        displacement_y += centre_xy_px[j, 1] - rest_xy_px[j, 1]
        count += 1
    return displacement_x / max(count, 1), displacement_y / max(count, 1), count


@njit(cache=True)
def _find_lost(
    centre_xy_px: NDArray[np.float64],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    lost: NDArray[np.uint8],
) -> None:
    """Flag the dots whose displacement is more than LOST_PX from the mean displacement of all their neighbours."""
    furthest_px2 = 0.0
    for i in range(lost.shape[0]):
        displacement_x = centre_xy_px[i, 0] - rest_xy_px[i, 0]
        displacement_y = centre_xy_px[i, 1] - rest_xy_px[i, 1]
        furthest_px2 = max(furthest_px2, displacement_x * displacement_x + displacement_y * displacement_y)
    if 4.0 * furthest_px2 <= LOST_PX * LOST_PX:  # then no two are further apart
        lost[:] = 0
        return
    none = np.zeros_like(lost)
    for i in range(lost.shape[0]):
        displacement_x, displacement_y, count = _mean_displacement(i, centre_xy_px, rest_xy_px, neighbours, none)
        if count == 0:
            continue
        displacement_x = centre_xy_px[i, 0] - rest_xy_px[i, 0] - displacement_x
        displacement_y = centre_xy_px[i, 1] - rest_xy_px[i, 1] - displacement_y
        lost[i] = displacement_x * displacement_x + displacement_y * displacement_y > LOST_PX * LOST_PX


@njit(cache=True)
def _put_back(
    centre_xy_px: NDArray[np.float64],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    lost: NDArray[np.uint8],
) -> None:
    """Put lost dots where their neighbours place them, if these are at rest, and clear their flags."""
    for i in range(lost.shape[0]):
        if not lost[i]:
            continue
        displacement_x, displacement_y, count = _mean_displacement(i, centre_xy_px, rest_xy_px, neighbours, lost)
        if count > 0 and displacement_x * displacement_x + displacement_y * displacement_y < AT_REST_PX * AT_REST_PX:
            centre_xy_px[i, 0] = min(max(rest_xy_px[i, 0] + displacement_x, 0.0), FRAME_PX[0] - 1.0)
            centre_xy_px[i, 1] = min(max(rest_xy_px[i, 1] + displacement_y, 0.0), FRAME_PX[1] - 1.0)
            lost[i] = 0
