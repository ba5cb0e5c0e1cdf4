"""One gradient step per slice: events pull the rims of dots, and neighbours hold them (all presets except `stable`).

Every event in the ring of a dot pulls it until the event is on its rim. An elastic term keeps the dot at its initial
distance from its neighbours (paper, "Signal Processing - Dot Tracking").

Reasons:
- In the paper, a dot only moves "if more than 10 events are triggered at its location". This module counts the events
  in the ring, which are those that pull: events inside the dot carry no information about its position.
- Whether an event is in a ring is nearly random, and a mispredicted branch costs more than computing the pull. So every
  event adds its pull, times 0 or 1.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.calibration.grid import MAX_NEIGHBOURS
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.tracking import buckets
from evetac_cli.kernels.tracking.buckets import RING_EVENT, UNITS

SUMS = 3  # per dot: pull (x, y), counts (buckets.py)
COUNTS = 2  # index of the counts


@njit(cache=True)
def pull_dots(
    state: np.void, x: NDArray[np.uint16], y: NDArray[np.uint16], any_hot: bool, sums: NDArray[np.int64]
) -> None:
    """Add every event to the sums of the dots it is near: its pull d - r d / |d|, d from centre to event, and counts.

    state: tracker.STATE; sums: (dots + 1, SUMS), initially zero.
    """
    if x.shape[0] == 0:
        return
    constants = state["radius_px"], state["ring_inner_px"], state["ring_outer_px"], state["count_radius_px"]
    room = buckets.BLOCK + state["dots"] + 1
    bucket = np.empty(buckets.BLOCK, np.uint16)
    near_dot = np.empty(room, np.uint32)
    near_px = np.empty((2, room))
    near_event = np.empty(room, np.int64)
    terms = np.empty((SUMS, room), np.int64)
    for begin in range(0, x.shape[0], buckets.BLOCK):
        end = min(begin + buckets.BLOCK, x.shape[0])
        xs = x[begin:end]
        ys = y[begin:end]
        several = buckets.nearby_dot(state, xs, ys, any_hot, bucket, near_dot, near_px)
        _add_pulls(end - begin, near_dot, near_px, constants, terms, sums)
        k = 0 if several else len(xs)
        while k < len(xs):
            k, pairs = buckets.nearby_dots(state, xs, ys, k, bucket, near_dot, near_px, near_event)
            _add_pulls(pairs, near_dot, near_px, constants, terms, sums)


@njit(cache=True)
def _add_pulls(
    pairs: int,
    near_dot: NDArray[np.uint32],
    near_px: NDArray[np.float64],
    constants: tuple[float, float, float, float],
    terms: NDArray[np.int64],
    sums: NDArray[np.int64],
) -> None:
    """Add pairs of an event and a dot to the dots' sums; terms is workspace."""
    radius_px, ring_inner_px, ring_outer_px, count_radius_px = constants
    ring_inner_px2 = ring_inner_px * ring_inner_px
    ring_outer_px2 = ring_outer_px * ring_outer_px
    count_radius_px2 = count_radius_px * count_radius_px
    for k in range(pairs):
        dx = near_px[0, k]
        dy = near_px[1, k]
        distance_px2 = dx * dx + dy * dy
        in_ring = (distance_px2 > ring_inner_px2) & (distance_px2 < ring_outer_px2)
        # An event exactly on the centre has no direction and is in no ring: any finite stretch is correct.
        stretch = (1.0 - radius_px / sqrt(max(distance_px2, 1e-12))) * (in_ring * UNITS)
        terms[0, k] = int(stretch * dx)
        terms[1, k] = int(stretch * dy)
        terms[COUNTS, k] = in_ring * RING_EVENT + (distance_px2 < count_radius_px2)
    for k in range(pairs):
        i = np.uint64(near_dot[k])
        sums[i, 0] += terms[0, k]
        sums[i, 1] += terms[1, k]
        sums[i, COUNTS] += terms[COUNTS, k]


@njit(cache=True)
def _regulariser_gradient(
    i: int, centre_xy_px: NDArray[np.float64], neighbours: NDArray[np.int32], rest_distance_px2: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the gradient of (8 / n) sum_j (|c_i - c_j|^2 - d_ij)^2, over n neighbours j of dot i, by c_i."""
    gradient_x = 0.0
    gradient_y = 0.0
    count = 0
    for entry in range(MAX_NEIGHBOURS):
        j = neighbours[i, entry]
        if j < 0:
            break
        dx = centre_xy_px[i, 0] - centre_xy_px[np.uint64(j), 0]
        dy = centre_xy_px[i, 1] - centre_xy_px[np.uint64(j), 1]
        stretch = 4.0 * (dx * dx + dy * dy - rest_distance_px2[i, entry])
        gradient_x += stretch * dx
        gradient_y += stretch * dy
        count += 1
    scale = MAX_NEIGHBOURS / max(count, 1)
    return scale * gradient_x, scale * gradient_y


@njit(cache=True)
def gather(state: np.void, sums: NDArray[np.int64]) -> bool:
    """Whether a step is due; if so, sums (dots + 1, SUMS) become those of all slices since the last step.

    They are collected in `state`, tracker.STATE. `start` processes one empty slice, so the first real one is number 1.
    """
    gathered = state["gathered"]
    due = state["slices"] % state["slices_per_step"] == 0
    for i in range(sums.shape[0]):  # element by element: operations on whole arrays take seconds to compile
        for column in range(sums.shape[1]):
            so_far = gathered[i, column] + sums[i, column]
            gathered[i, column] = so_far
            if due:
                sums[i, column] = so_far
                gathered[i, column] = 0
    return bool(due)


@njit(cache=True)
def gradient_step(
    state: np.void, sums: NDArray[np.int64], ring_events: NDArray[np.int32], shift_px: NDArray[np.float64]
) -> bool:
    """Fill shift_px (dots, 2) for the dots with enough events; return whether there are any.

    All shifts are computed from the positions before the step. state: tracker.STATE.
    """
    dots = state["dots"]
    centre_xy_px = state["centre_xy_px"][: dots + 1]
    neighbours = state["neighbours"][:dots]
    rest_distance_px2 = state["rest_distance_px2"][:dots]
    radius_px, step_size, regulariser_weight = state["radius_px"], state["step_size"], state["regulariser_weight"]
    min_events, gradient_clip = state["min_events"], state["gradient_clip"]
    moved = False
    # The data term's gradient is -2 times the sum of pulls.
    to_gradient = (2.0 if state["ascend"] else -2.0) / UNITS
    for i in range(dots):
        if ring_events[i] <= min_events:
            continue
        moved = True
        elastic_x, elastic_y = _regulariser_gradient(i, centre_xy_px, neighbours, rest_distance_px2)
        data_x = _clip(to_gradient * sums[i, 0], gradient_clip)
        data_y = _clip(to_gradient * sums[i, 1], gradient_clip)
        shift_px[i, 0] = _clip(-step_size * (data_x + regulariser_weight * elastic_x), radius_px)
        shift_px[i, 1] = _clip(-step_size * (data_y + regulariser_weight * elastic_y), radius_px)
    return moved


@njit(cache=True)
def _clip(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)
