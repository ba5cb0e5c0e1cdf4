"""A gradient step a slice: events pull dots by their rims, neighbours hold them (presets but `stable` of the tracker).

Every event in the ring of a dot pulls it until the event lies on its rim, and an elastic term keeps the dot at the
distance from its neighbours that it had at the start (paper, "Signal Processing - Dot Tracking").

Why so:
- The paper moves a dot only "if more than 10 events are triggered at its location". We count the events in the ring,
  those that pull: events inside the dot say nothing about where it is.
- Whether an event lies in a ring is close to a coin toss, and a wrong guess of the processor costs more than the pull.
  So every event adds its pull, times 0 or 1.
"""

from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.kernels.calibration.grid import MAX_NEIGHBOURS
from evetac_cli.kernels.tracking import buckets
from evetac_cli.kernels.tracking.buckets import UNITS


@njit(cache=True)
def pull_dots(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    fired: NDArray[np.uint16],
    hot: bool,
    centre_xy_px: NDArray[np.float64],
    first_dot: NDArray[np.uint32],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    events: NDArray[np.int32],
) -> None:
    """Give every event to the dots it is near: count it, and add its pull d - r d / |d|, d from centre to event."""
    room = buckets.BLOCK + centre_xy_px.shape[0]
    bucket = np.empty(buckets.BLOCK, np.uint16)
    near_dot = np.empty(room, np.uint32)
    near_px = np.empty((2, room))
    near_p = np.empty(0, np.uint8)
    pull = np.empty((2, room), np.int64)
    in_ring = np.empty(room, np.bool_)
    counts = np.empty(room, np.bool_)
    constants = radius_px, ring_inner_px, ring_outer_px, count_radius_px
    for begin in range(0, x.shape[0], buckets.BLOCK):
        end = min(begin + buckets.BLOCK, x.shape[0])
        xs = x[begin:end]
        ys = y[begin:end]
        crowd = buckets.look_up(xs, ys, fired, hot, centre_xy_px, first_dot, bucket, near_dot, near_px)
        _add_pulls(end - begin, near_dot, near_px, *constants, pull, in_ring, counts, sums, ring_events, events)
        k = 0 if crowd else len(xs)
        while k < len(xs):
            k, pairs = buckets.look_up_crowd(
                xs, ys, p, k, centre_xy_px, first_dot, bucket_start, bucket_dots, bucket, near_dot, near_px, near_p
            )
            _add_pulls(pairs, near_dot, near_px, *constants, pull, in_ring, counts, sums, ring_events, events)


@njit(cache=True)
def _add_pulls(
    pairs: int,
    near_dot: NDArray[np.uint32],
    near_px: NDArray[np.float64],
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    pull: NDArray[np.int64],
    in_ring: NDArray[np.bool_],
    counts: NDArray[np.bool_],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    events: NDArray[np.int32],
) -> None:
    """Count pairs of an event and a dot, and add the pulls; pull, in_ring and counts are work space."""
    ring_inner_px2 = ring_inner_px * ring_inner_px
    ring_outer_px2 = ring_outer_px * ring_outer_px
    count_radius_px2 = count_radius_px * count_radius_px
    for k in range(pairs):
        dx = near_px[0, k]
        dy = near_px[1, k]
        distance_px2 = dx * dx + dy * dy
        in_ring[k] = (distance_px2 > ring_inner_px2) & (distance_px2 < ring_outer_px2)
        # An event on the very centre has no direction and is in no ring: any finite stretch will do.
        stretch = (1.0 - radius_px / sqrt(max(distance_px2, 1e-12))) * (in_ring[k] * UNITS)
        pull[0, k] = int(stretch * dx)
        pull[1, k] = int(stretch * dy)
        counts[k] = distance_px2 < count_radius_px2
    for k in range(pairs):
        i = np.uint64(near_dot[k])
        sums[i, 0] += pull[0, k]
        sums[i, 1] += pull[1, k]
        ring_events[i] += in_ring[k]
        events[i] += counts[k]


@njit(cache=True)
def _regulariser_gradient(
    i: int, centre_xy_px: NDArray[np.float64], neighbours: NDArray[np.int32], rest_distance_px2: NDArray[np.float64]
) -> tuple[float, float]:
    """Gradient of (8 / n) sum_j (|c_i - c_j|^2 - d_ij)^2 over the n neighbours j of dot i, with respect to c_i."""
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
def gradient_step(
    centre_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    rest_distance_px2: NDArray[np.float64],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    shift_px: NDArray[np.float64],
    radius_px: float,
    step_size: float,
    regulariser_weight: float,
    min_events: int,
    gradient_clip: float,
    ascend: bool,
) -> bool:
    """Fill shift_px (n, 2) of the dots with enough events, all from the positions before; tell whether there is one."""
    moved = False
    # The data term's gradient is -2 times the sum of pulls.
    to_gradient = (2.0 if ascend else -2.0) / UNITS
    for i in range(shift_px.shape[0]):
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
