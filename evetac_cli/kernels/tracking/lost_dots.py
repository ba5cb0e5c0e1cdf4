"""Dots that have lost track: flagged, so that nobody trusts them, and put back at rest.

A dot is lost where it is far from where its neighbours place it. With `fit` there are four more signs, of which each
comes long before a dot is far:
- Its neighbours go on and it stays, and one of its rims shows the motion alone: the other is hidden, behind the edge of
  the window or of the frame.
- It lies amid eight neighbours that all go on, and stays: it has vanished. At the edge of the grid this is no sign, as
  gel beside a contact does stay.
- Both rims show more motion in a slice than a slice may follow, or most of many events lie inside of the dot: it has
  gone faster than that, and its rims with it.
- The light flickers, which makes events at every rim, and all dots drift by 1 to 2 px a second. This flag goes when the
  flicker does.

Why so: a dot that has lost track finds no rim of its own. When few events have come for a while and its neighbours are
back where they began, its place is known without events, and it starts anew from there (only with `rest_slices`, so
that the paper's presets stay what they are).

The constants of these signs were chosen on fourteen simulated slips, rubs and shears with seeds below 10,000, none of
whose dots they flag: these are followed within 2.3 px, gel beside the contact of a heavy object among them. Beside them
stand what was lost in `evaluate stability track` and in the scene `press`.
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
BY_MOTION = 1.5  # ... its events no more than this much of what their way makes, as those of an edge that rubs are, ...
ONE_RIM_PX = 0.5  # ... and one of its rims shows so much of it: of dots that were followed, 0.3 at the most
TOGETHER = 0.35  # ... each of these neighbours having gone so much of the way
GONE_AROUND_PX = 1.0  # neighbours all around that have gone so far, ...
STAYS = 0.27  # ... and a dot amid them less than this of it, in any direction, with as few events, ...
ALL_TOGETHER = 0.5  # ... each having gone so much of the way: gel that an edge holds had neighbours that went 0.36
# So many times as many events inside of a dot as in its ring, and so many more, in a slice: an edge across its middle
# makes 1.4 times as many, corners that rubbed 2.1 times, up to 107; dots that jumped 1.6 to 3.6 times, up to 600.
INSIDE = ((2.0, 50), (2.7, 0))
INSIDE_EVENTS = 100  # at the least
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
            for i in range(dots):
                lost[i] = not np.isnan(rest_xy_px[i, 0])
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
    one_rim_px, too_far, events = state["one_rim_px"][:dots], state["too_far"][:dots], state["events"][:dots]
    own_way_px, near_way_px = state["own_way_px"][:dots], state["near_way_px"][:dots]
    way_events, neighbour_count = state["way_events"][:dots], state["neighbour_count"][:dots]
    _follow_ways(state, ring_events, shift_px, left_behind)
    for i in range(dots):
        inside = events[i] - ring_events[i]
        jumped = too_far[i] > 0
        for times, more in INSIDE:
            jumped |= inside >= INSIDE_EVENTS and inside > times * ring_events[i] + more
        if jumped:
            left_behind[i] = 1
            continue
        if left_behind[i]:
            continue
        near_x = near_way_px[i, 0]
        near_y = near_way_px[i, 1]
        gone_px2 = near_x * near_x + near_y * near_y
        along_px2 = own_way_px[i, 0] * near_x + own_way_px[i, 1] * near_y
        if gone_px2 < GONE_PX * GONE_PX or along_px2 > FOLLOWS * gone_px2:
            continue
        gone_px = sqrt(gone_px2)
        if way_events[i] * state["event_px"] > BY_MOTION * gone_px:
            continue
        hidden = one_rim_px[i, 0] * near_x + one_rim_px[i, 1] * near_y > ONE_RIM_PX * gone_px
        own_px2 = own_way_px[i, 0] * own_way_px[i, 0] + own_way_px[i, 1] * own_way_px[i, 1]
        stays = gone_px > GONE_AROUND_PX and own_px2 < STAYS * STAYS * gone_px2
        vanished = stays and neighbour_count[i] == MAX_NEIGHBOURS
        if hidden or vanished:
            left_behind[i] = _go_together(i, state, left_behind, TOGETHER if hidden else ALL_TOGETHER)


@njit(cache=True)
def _follow_ways(
    state: np.void, ring_events: NDArray[np.int32], shift_px: NDArray[np.float64], left_behind: NDArray[np.uint8]
) -> None:
    """How far every dot and the mean of its neighbours have gone lately, and how many events it has had on the way."""
    dots = left_behind.shape[0]
    neighbours, neighbour_count = state["neighbours"][:dots], state["neighbour_count"][:dots]
    own_way_px, near_way_px, one_rim_px = state["own_way_px"][:dots], state["near_way_px"][:dots], state["one_rim_px"]
    way_events, min_events = state["way_events"][:dots], state["min_events"]
    for i in range(dots):
        near_x = 0.0
        near_y = 0.0
        count = 0
        for entry in range(neighbour_count[i]):
            j = neighbours[i, entry]
            if left_behind[j]:
                continue
            count += 1
            if ring_events[j] > min_events:
                near_x += shift_px[j, 0]
                near_y += shift_px[j, 1]
        near_x /= max(count, 1)
        near_y /= max(count, 1)
        keep = WAY_PX / (WAY_PX + sqrt(near_x * near_x + near_y * near_y))
        moved = ring_events[i] > min_events
        own_way_px[i, 0] = keep * own_way_px[i, 0] + (shift_px[i, 0] if moved else 0.0)
        own_way_px[i, 1] = keep * own_way_px[i, 1] + (shift_px[i, 1] if moved else 0.0)
        near_way_px[i, 0] = keep * near_way_px[i, 0] + near_x
        near_way_px[i, 1] = keep * near_way_px[i, 1] + near_y
        way_events[i] = keep * way_events[i] + ring_events[i]
        one_rim_px[i, 0] *= 1.0 - 1.0 / ONE_RIM_SLICES
        one_rim_px[i, 1] *= 1.0 - 1.0 / ONE_RIM_SLICES


@njit(cache=True)
def _go_together(i: int, state: np.void, left_behind: NDArray[np.uint8], share: float) -> bool:
    """Whether each neighbour of dot i but those that are left behind has gone this share of the mean way or more."""
    near_x = state["near_way_px"][i, 0]
    near_y = state["near_way_px"][i, 1]
    least_px2 = share * (near_x * near_x + near_y * near_y)
    count = 0
    for entry in range(state["neighbour_count"][i]):
        j = state["neighbours"][i, entry]
        if left_behind[j]:
            continue
        count += 1
        if state["own_way_px"][j, 0] * near_x + state["own_way_px"][j, 1] * near_y < least_px2:
            return False
    return count > 0


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
    for i in range(lost.shape[0]):  # assigned as a whole, arrays bring along errors about shapes, slow to compile
        lost[i] = left_behind[i]
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
            start_anew(state, i)


@njit(cache=True)
def start_anew(state: np.void, i: int) -> None:
    """Forget that dot i was lost, and by what signs; state: tracker.STATE."""
    state["lost"][i] = 0
    state["left_behind"][i] = 0
    for axis in range(2):
        state["one_rim_px"][i, axis] = 0.0
        state["own_way_px"][i, axis] = 0.0
        state["near_way_px"][i, axis] = 0.0
    state["way_events"][i] = 0.0
