"""Dots that have lost track: they are flagged, so that they are not trusted, and put back at rest.

A dot is lost if it is far from where its neighbours predict it. With `fit` there are four more signs, each of which
appears long before a dot is far off:
- Hidden: its neighbours move on and it stays, and only one of its rims shows the motion. The other rim is hidden behind
  the edge of the window or of the frame.
- Vanished: it stays in the middle of eight neighbours that all move on. At the edge of the grid this proves
  nothing, because gel next to a contact does stay.
- Jumped: both rims show more motion than may be followed in a slice, or most of many events are inside the dot. The dot
  and its rims have then moved faster than the tracker.
- Flicker: flickering light causes events at every rim, and all dots drift by 1 to 2 px per second. This flag ends with
  the flicker.

Putting back: a dot that has lost track cannot find its own rim again. When few events have come for a while and its
neighbours are back where they began, its position is known without events, and tracking restarts from there. This is
only done with `rest_slices`, so that the paper's presets remain unchanged.

The constants of these signs were chosen on fourteen simulated slips, rubs and shears with seeds below 10,000. Their
dots are followed within 2.3 px, including gel next to the contact of a heavy object, and none of them is flagged.
Examples of lost dots came from `evaluate stability track` and from the scene `press`.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.calibration.grid import MAX_NEIGHBOURS
from evetac_cli.kernels.compiled import njit

LOST_PX = 40.0  # error of a lost dot; with the paper's constants, a dot sees no event of its own edge from 35 px on
AT_REST_PX = 3.0  # neighbours with a smaller mean displacement are at rest
WAY_PX = 3.0  # distance constant: paths are remembered over about this much motion of the neighbours
ONE_RIM_SLICES = 100.0  # time constant in slices: motion shown by one rim alone is remembered about this long
# Hidden: all of the following.
GONE_PX = 0.75  # the neighbours have moved at least this far,
FOLLOWS = 0.6  # ... the dot has followed less than this share of their path,
BY_MOTION = 1.5  # ... has at most this multiple of the events of such a path (a rubbing edge makes more),
ONE_RIM_PX = 0.5  # ... one of its rims shows more than this share of it (followed dots: 0.3 at most),
TOGETHER = 0.35  # ... and each of its neighbours has moved at least this share of their mean path
# Vanished: all of the following.
GONE_AROUND_PX = 1.0  # eight neighbours have moved farther than this,
STAYS = 0.27  # ... the dot has moved less than this share of it, in any direction, with as few events as above,
ALL_TOGETHER = 0.5  # ... and each neighbour has moved at least this share (around gel held by an edge: 0.36)
# Jumped: events inside the dot exceed those in its ring times a factor, plus a number, in one slice. An edge across its
# centre makes 1.4 times as many inside; rubbing corners 2.1 times, up to 107; dots that jumped 1.6 to 3.6 times, up to
# 600.
INSIDE = ((2.0, 50), (2.7, 0))
INSIDE_EVENTS = 100  # smallest number of events inside for this sign
FLICKERS = 8.0  # slices with changing light (fit.py): one change, or switching the light, takes fewer


@njit(cache=True)
def update(state: np.void, moved: bool, ring_events: NDArray[np.int32], shift_px: NDArray[np.float64]) -> None:
    """Flag the lost dots if something moved; put them back after `rest_slices` slices of rest.

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
    """Flag the dots that stay while their neighbours move, or that move farther than a slice may follow."""
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
    """Update the recent paths of every dot and of the mean of its neighbours, and the dot's events along the path."""
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
    """Whether each neighbour of dot i that is not left behind has moved at least this share of their mean path."""
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
    """Return the mean displacement (x, y) of the neighbours of dot i that are not left out, and their number."""
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
    """Flag the dots that are left behind, or farther than LOST_PX from the mean displacement of their neighbours."""
    furthest_px2 = 0.0
    for i in range(lost.shape[0]):
        displacement_x = centre_xy_px[i, 0] - rest_xy_px[i, 0]
        displacement_y = centre_xy_px[i, 1] - rest_xy_px[i, 1]
        furthest_px2 = max(furthest_px2, displacement_x * displacement_x + displacement_y * displacement_y)
    for i in range(lost.shape[0]):  # element by element: assigning whole arrays compiles slowly
        lost[i] = left_behind[i]
    if 4.0 * furthest_px2 <= LOST_PX * LOST_PX:  # then no two displacements differ by more
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
    """Put lost dots where their neighbours predict them, if these are at rest, and clear their flags."""
    for i in range(lost.shape[0]):
        if not lost[i]:
            continue
        displacement_x, displacement_y, count = _mean_displacement(i, centre_xy_px, rest_xy_px, neighbours, lost)
        if count > 0 and displacement_x * displacement_x + displacement_y * displacement_y < AT_REST_PX * AT_REST_PX:
            centre_xy_px[i, 0] = min(max(rest_xy_px[i, 0] + displacement_x, 0.0), state["frame_px"][0] - 1.0)
            centre_xy_px[i, 1] = min(max(rest_xy_px[i, 1] + displacement_y, 0.0), state["frame_px"][1] - 1.0)
            start_anew(state, i)


@njit(cache=True)
def start_anew(state: np.void, i: int) -> None:
    """Clear the lost flag of dot i and all its signs; state: tracker.STATE."""
    state["lost"][i] = 0
    state["left_behind"][i] = 0
    for axis in range(2):
        state["one_rim_px"][i, axis] = 0.0
        state["own_way_px"][i, axis] = 0.0
        state["near_way_px"][i, axis] = 0.0
    state["way_events"][i] = 0.0
