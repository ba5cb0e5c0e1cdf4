"""What the tracker does with the events of one slice: count hot pixels, measure, move the dots, look after the lost.

By descent (presets `paper`, `official`, `unregularised`) and by fit (`stable`) differ in what an event says of its dot
and in what motion follows from all of them; the rest is the same. Arrays and constants are those of `TrackerState` and
`TrackerConstants` (tracker.py), one by one, as numba wants them.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.tracking import buckets, descent, fit, hot_pixels, lost_dots


@njit(cache=True)
def by_descent(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    centre_xy_px: NDArray[np.float64],
    events: NDArray[np.int32],
    lost: NDArray[np.bool_],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    quiet: NDArray[np.int64],
    shift_px: NDArray[np.float64],
    listed_xy_px: NDArray[np.float64],
    first_dot: NDArray[np.uint32],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    fired: NDArray[np.uint16],
    passed: NDArray[np.uint32],
    slices: int,
    hot_pixel_events: int,
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    step_size: float,
    regulariser_weight: float,
    min_events: int,
    rest_slices: int,
    rest_distance_px2: NDArray[np.float64],
    gradient_clip: float,
    ascend: bool,
) -> None:
    """One slice by the paper's gradient step; p is not looked at."""
    hot = hot_pixel_events > 0 and hot_pixels.count(x, y, fired, slices, hot_pixel_events, passed)
    reach_px = max(ring_outer_px, count_radius_px)
    _prepare(centre_xy_px, reach_px, listed_xy_px, first_dot, bucket_start, bucket_dots, sums, ring_events, events)
    descent.pull_dots(
        x,
        y,
        p,
        fired,
        hot,
        centre_xy_px,
        first_dot,
        bucket_start,
        bucket_dots,
        radius_px,
        ring_inner_px,
        ring_outer_px,
        count_radius_px,
        sums,
        ring_events,
        events,
    )
    moved = descent.gradient_step(
        centre_xy_px,
        neighbours,
        rest_distance_px2,
        sums,
        ring_events,
        shift_px,
        radius_px,
        step_size,
        regulariser_weight,
        min_events,
        gradient_clip,
        ascend,
    )
    if moved:
        _shift_dots(centre_xy_px, shift_px, ring_events, min_events)
    lost_dots.look_after(moved, rest_slices, centre_xy_px, rest_xy_px, neighbours, ring_events, quiet, lost)


@njit(cache=True)
def by_fit(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    centre_xy_px: NDArray[np.float64],
    events: NDArray[np.int32],
    lost: NDArray[np.bool_],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    quiet: NDArray[np.int64],
    shift_px: NDArray[np.float64],
    listed_xy_px: NDArray[np.float64],
    first_dot: NDArray[np.uint32],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    fired: NDArray[np.uint16],
    passed: NDArray[np.uint32],
    slices: int,
    hot_pixel_events: int,
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    step_size: float,
    regulariser_weight: float,
    min_events: int,
    rest_slices: int,
    told: NDArray[np.float64],
    solver: NDArray[np.float64],
    sweeps: int,
    trust_px: float,
    rim_lag_px: float,
    event_px: float,
    most_events: float,
) -> None:
    """One slice by solving for the motion that its events speak of."""
    hot = hot_pixel_events > 0 and hot_pixels.count(x, y, fired, slices, hot_pixel_events, passed)
    reach_px = max(ring_outer_px, count_radius_px)
    _prepare(centre_xy_px, reach_px, listed_xy_px, first_dot, bucket_start, bucket_dots, sums, ring_events, events)
    fit.measure_rims(
        x,
        y,
        p,
        fired,
        hot,
        centre_xy_px,
        first_dot,
        bucket_start,
        bucket_dots,
        radius_px,
        ring_outer_px - radius_px,
        rim_lag_px,
        count_radius_px,
        sums,
        ring_events,
        events,
    )
    moved = fit.solve(
        sums,
        ring_events,
        neighbours,
        min_events,
        step_size,
        regulariser_weight,
        sweeps,
        trust_px,
        event_px,
        most_events,
        told,
        solver,
        shift_px,
    )
    if moved:
        _shift_dots(centre_xy_px, shift_px, ring_events, min_events)
    lost_dots.look_after(moved, rest_slices, centre_xy_px, rest_xy_px, neighbours, ring_events, quiet, lost)


@njit(cache=True)
def _prepare(
    centre_xy_px: NDArray[np.float64],
    reach_px: float,
    listed_xy_px: NDArray[np.float64],
    first_dot: NDArray[np.uint32],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    events: NDArray[np.int32],
) -> None:
    """Buckets that fit where the dots are, and sums at zero."""
    if buckets.left_margin(centre_xy_px, listed_xy_px):
        buckets.fill(centre_xy_px, reach_px, listed_xy_px, first_dot, bucket_start, bucket_dots)
    sums[:] = 0
    ring_events[:] = 0
    events[:] = 0


@njit(cache=True)
def _shift_dots(
    centre_xy_px: NDArray[np.float64],
    shift_px: NDArray[np.float64],
    ring_events: NDArray[np.int32],
    min_events: int,
) -> None:
    """Shift the dots with enough events, inside the frame."""
    for i in range(shift_px.shape[0]):
        if ring_events[i] > min_events:
            centre_xy_px[i, 0] = min(max(centre_xy_px[i, 0] + shift_px[i, 0], 0.0), FRAME_PX[0] - 1.0)
            centre_xy_px[i, 1] = min(max(centre_xy_px[i, 1] + shift_px[i, 1], 0.0), FRAME_PX[1] - 1.0)
