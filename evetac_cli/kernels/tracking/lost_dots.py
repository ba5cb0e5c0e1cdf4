"""Dots that have lost track: flagged, so that nobody trusts them, and put back at rest.

A dot is lost where it is far from where its neighbours place it. With `fit` there are four more signs, of which each
comes long before a dot is far:
- Its neighbours go on and it stays, and one of its rims shows the motion alone: the other is hidden, behind the edge of
  the window or of the frame.
- It lies amid eight neighbours that go on, and stays: it has vanished. At the edge of the grid this is no sign, as gel
  beside a contact does stay.
- Both rims show more motion in a slice than a slice may follow, or most of many events lie inside of the dot: it has
  gone faster than that, and its rims with it.
- The light flickers, which makes events at every rim, and all dots drift by 1 to 2 px a second. This flag goes when the
  flicker does.

Why so: a dot that has lost track finds no rim of its own. When few events have come for a while and its neighbours are
back where they began, its place is known without events, and it starts anew from there (only with `rest_slices`, so
that the paper's presets stay what they are).

The constants of these signs were chosen on ten simulated slips, rubs and shears with seeds below 10,000, none of whose
dots they flag: these are followed within 2.3 px, gel beside the contact of a heavy object among them.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.calibration.grid import MAX_NEIGHBOURS
from evetac_cli.kernels.compiled import njit

LOST_PX = 40.0  # with the paper's constants, no event of a dot's own edge is in its ring from 35 px on
AT_REST_PX = 3.0  # neighbours displaced by less than this, in the mean, are at rest
WAY_PX = 3.0  # ways are remembered over about so much motion of the neighbours
ONE_RIM_SLICES = 100.0  # what one rim alone shows is remembered over about so many slices
GONE_PX = 0.75  # neighbours that have gone so far, ...
FOLLOWS = 0.6  # ... of which a dot has gone less than this along with them, ...
ONE_RIM_PX = 0.5  # ... while one of its rims shows so much of it: fewer events are chance or a passing edge
GONE_AROUND_PX = 1.5  # neighbours all around that have gone so far, ...
STAYS = 0.25  # ... and a dot amid them less than this of it: next to a contact that slides, gel goes 0.4 of it and more
INSIDE_EVENTS = 100  # so many events of a slice near a dot and not in its ring, ...
INSIDE = 2.0  # ... so many times those in the ring: an edge across the middle of a dot makes 1.4 times as many
FLICKERS = 8.0  # light that changes once, or is switched on, does so in fewer slices (fit.py)


@njit(cache=True)
def update(state: np.void, moved: bool, ring_events: NDArray[np.int32], shift_px: NDArray[np.float64]) -> None:
    """Flag the lost dots when something moved; put them back after `rest_slices` slices of rest.

    state: tracker.STATE; ring_events: (dots + 1,) of this slice; shift_px: (dots, 2) of the dots that moved in it.
    """
    dots = state["dots"]
    centre_xy_px, rest_xy_px = state["centre_xy_px"][: dots + 1], state["rest_xy_px"][:dots]
    neighbours, lost, left_behind = state["neighbours"][:dots], state["lost"][:dots], state["left_behind"][:dots]
    if moved:
        if state["fit"]:
            _find_left_behind(state, ring_events, shift_px, left_behind)
        _find_lost(centre_xy_px, rest_xy_px, neighbours, left_behind, lost)
        if state["light_slices"] > FLICKERS:
            lost[:] = 1
    if state["rest_slices"] == 0:
        return
    total = 0
    for i in range(dots):
        total += ring_events[i]
    at_rest = state["slices_at_rest"] + 1 if 2 * total < dots else 0
    state["slices_at_rest"] = at_rest
    if at_rest >= state["rest_slices"]:
        _put_back(state, centre_xy_px, rest_xy_px, neighbours, lost)


@njit(cache=True)
def _find_left_behind(
    state: np.void, ring_events: NDArray[np.int32], shift_px: NDArray[np.float64], left_behind: NDArray[np.uint8]
) -> None:
    """Flag the dots that stay where their neighbours go, or that go farther than a slice may follow."""
    dots = left_behind.shape[0]
    neighbours, neighbour_count = state["neighbours"][:dots], state["neighbour_count"][:dots]
    one_rim_px, too_far, events = state["one_rim_px"][:dots], state["too_far"][:dots], state["events"][:dots]
    own_way_px, near_way_px = state["own_way_px"][:dots], state["near_way_px"][:dots]
    min_events = state["min_events"]
    for i in range(dots):
        near_x = 0.0
        near_y = 0.0
        count = 0
        for entry in range(neighbour_count[i]):
            j = neighbours[i, entry]
            if not left_behind[j]:
                count += 1
                if ring_events[j] > min_events:
                    near_x += shift_px[j, 0]
                    near_y += shift_px[j, 1]
        near_x /= max(count, 1)
        near_y /= max(count, 1)
        keep = WAY_PX / (WAY_PX + sqrt(near_x * near_x + near_y * near_y))
        moved = ring_events[i] > min_events
        own_x = own_way_px[i, 0] = keep * own_way_px[i, 0] + (shift_px[i, 0] if moved else 0.0)
        own_y = own_way_px[i, 1] = keep * own_way_px[i, 1] + (shift_px[i, 1] if moved else 0.0)
        near_x = near_way_px[i, 0] = keep * near_way_px[i, 0] + near_x
        near_y = near_way_px[i, 1] = keep * near_way_px[i, 1] + near_y
        one_rim_px[i, 0] *= 1.0 - 1.0 / ONE_RIM_SLICES
        one_rim_px[i, 1] *= 1.0 - 1.0 / ONE_RIM_SLICES
        gone_px2 = near_x * near_x + near_y * near_y
        along_px2 = own_x * near_x + own_y * near_y
        shown_px2 = one_rim_px[i, 0] * near_x + one_rim_px[i, 1] * near_y
        hidden = (
            gone_px2 > GONE_PX * GONE_PX and along_px2 < FOLLOWS * gone_px2 and shown_px2 > ONE_RIM_PX * sqrt(gone_px2)
        )
        vanished = (
            neighbour_count[i] == MAX_NEIGHBOURS
            and gone_px2 > GONE_AROUND_PX * GONE_AROUND_PX
            and along_px2 < STAYS * gone_px2
        )
        inside = events[i] - ring_events[i]
        jumped = too_far[i] or (inside >= INSIDE_EVENTS and inside > INSIDE * ring_events[i])
        if jumped or (count > 0 and (hidden or vanished)):
            left_behind[i] = 1


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
    left_behind: NDArray[np.uint8],
    lost: NDArray[np.uint8],
) -> None:
    """Flag the dots that are left behind, or more than LOST_PX from the mean displacement of all their neighbours."""
    furthest_px2 = 0.0
    for i in range(lost.shape[0]):
        displacement_x = centre_xy_px[i, 0] - rest_xy_px[i, 0]
        displacement_y = centre_xy_px[i, 1] - rest_xy_px[i, 1]
        furthest_px2 = max(furthest_px2, displacement_x * displacement_x + displacement_y * displacement_y)
    lost[:] = left_behind
    if 4.0 * furthest_px2 <= LOST_PX * LOST_PX:  # then no two are further apart
        return
    none = np.zeros_like(lost)
    for i in range(lost.shape[0]):
        displacement_x, displacement_y, count = _mean_displacement(i, centre_xy_px, rest_xy_px, neighbours, none)
        if count == 0:
            continue
        displacement_x = centre_xy_px[i, 0] - rest_xy_px[i, 0] - displacement_x
        displacement_y = centre_xy_px[i, 1] - rest_xy_px[i, 1] - displacement_y
        far = displacement_x * displacement_x + displacement_y * displacement_y > LOST_PX * LOST_PX
        lost[i] = far or left_behind[i]


@njit(cache=True)
def _put_back(
    state: np.void,
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
            state["left_behind"][i] = 0
            state["one_rim_px"][i, :] = 0.0
            state["own_way_px"][i, :] = 0.0
            state["near_way_px"][i, :] = 0.0
