"""How far all dots moved in a slice, solved for from what their rims' events say: the preset `stable` of the tracker.

An event of a dot's ring at distance d from its centre, in direction n, says three things:
- The rim is there. beyond = d - rim is how far the dot has to go along n; a least-squares problem over all of its
  events (Gauss-Newton of the paper's data term), damped by 1 / (2 step_size) so that few events move a dot as the
  paper's step would.
- Which side it is on. A dark dot makes events that get darker on its leading rim and brighter ones on its trailing rim,
  so the sum of +n and -n points where it goes, and grows with the way: `event_px` for each event, the motion seen.
- It came late. A pixel fires when its level has changed by the contrast threshold, so the rim of either side is found
  `rim_lag_px` behind the motion; knowing the side takes that away.

Events come evenly during the slice, so the rims are found where they were half way: with H = sum w n n^T,
s = sum w beyond n and f the motion seen, the correction c to f solves H c = s - H f / 2.

Why so:
- What neighbours share is the correction, not the motion: next to a gel that slips, a dot without events stands still
  because it has seen no motion, and yet eight dots find together what the few events of one leave open.
- H and s are scaled down to `most_events`: a bar over the gel may make 1,000 events on a dot, and is outvoted by
  neighbours that have seen nothing. Motion of the dots themselves makes few events less or more than all neighbours,
  and is in f already.
- w = (1 - (beyond / half ring)^2)^2 falls to zero at the sides of the ring: events that fit the rim badly, badly count.
- Every sweep takes a mean of bounded values with weights that are not negative, or a damped solution of a positive
  definite system, for any finite constants; the step is limited to `trust_px` in the end.

Measured on simulated slip and shear; there the paper's preset stands still below 11 events a dot and slice.
"""

from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_NEIGHBOURS = 8
UNITS = 2.0**36  # a sum's integer for 1
SUMS = 7  # of every dot: w beyond n (2), w n n^T (xx, xy, yy), w n where it leads less where it trails (2)
SOLVER = 8  # numbers of every dot: inverse matrix (xx, xy, yy), right side (2), correction (2), weight of a neighbour
LEAST_DAMPING = 1e-9  # of the matrix: below this, rounding would decide
MOST_WEIGHT = 1e12  # beyond this, neighbours are one body to the last bit


@njit(cache=True)
def solve(
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    neighbours: NDArray[np.int32],
    min_events: int,
    step_size: float,
    regulariser_weight: float,
    sweeps: int,
    trust_px: float,
    event_px: float,
    most_events: float,
    solver: NDArray[np.float64],
    shift_px: NDArray[np.float64],
) -> bool:
    """Fill shift_px (n, 2) with every dot's motion; tell whether a dot has more than min_events events, else do not."""
    dots = shift_px.shape[0]
    moves = False
    for i in range(dots):
        moves |= ring_events[i] > min_events
    if not moves:
        return False
    damping = 0.5 / step_size
    for i in range(dots):
        _set_up(i, sums, neighbours, damping, regulariser_weight, trust_px, event_px, most_events, solver, shift_px)
    for _ in range(sweeps):
        for i in range(dots):
            right_x = solver[i, 3]
            right_y = solver[i, 4]
            weight = solver[i, 7]
            for entry in range(MAX_NEIGHBOURS):
                j = neighbours[i, entry]
                if j < 0:
                    break
                right_x += weight * solver[j, 5]
                right_y += weight * solver[j, 6]
            solver[i, 5] = solver[i, 0] * right_x + solver[i, 1] * right_y
            solver[i, 6] = solver[i, 1] * right_x + solver[i, 2] * right_y
    for i in range(dots):
        correction_x, correction_y = _limited(solver[i, 5], solver[i, 6], trust_px)
        shift_px[i, 0] += correction_x
        shift_px[i, 1] += correction_y
    return True


@njit(cache=True)
def _set_up(
    i: int,
    sums: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    damping: float,
    regulariser_weight: float,
    trust_px: float,
    event_px: float,
    most_events: float,
    solver: NDArray[np.float64],
    shift_px: NDArray[np.float64],
) -> None:
    """The motion seen by dot i, into shift_px, and its row of the system for the correction, which starts at 0."""
    xx = sums[i, 2] / UNITS
    xy = sums[i, 3] / UNITS
    yy = sums[i, 4] / UNITS
    seen_x, seen_y = _limited(event_px * (sums[i, 5] / UNITS), event_px * (sums[i, 6] / UNITS), trust_px)
    scale = min(1.0, most_events / max(xx + yy, 1e-12))
    damping += LEAST_DAMPING * (1.0 + scale * (xx + yy))
    count = 0
    while count < MAX_NEIGHBOURS and neighbours[i, count] >= 0:
        count += 1
    weight = MAX_NEIGHBOURS * min(regulariser_weight, MOST_WEIGHT) / max(count, 1)
    a = scale * xx + damping + weight * count
    b = scale * xy
    c = scale * yy + damping + weight * count
    # Divided by a, not by the determinant: that of huge numbers is infinite.
    rest = c - b * (b / a)
    solver[i, 2] = 1.0 / rest
    solver[i, 1] = -(b / a) / rest
    solver[i, 0] = 1.0 / a + (b / a) * (b / a) / rest
    solver[i, 3] = scale * (sums[i, 0] / UNITS - 0.5 * (xx * seen_x + xy * seen_y))
    solver[i, 4] = scale * (sums[i, 1] / UNITS - 0.5 * (xy * seen_x + yy * seen_y))
    solver[i, 5] = 0.0
    solver[i, 6] = 0.0
    solver[i, 7] = weight
    shift_px[i, 0] = seen_x
    shift_px[i, 1] = seen_y


@njit(cache=True)
def _limited(x: float, y: float, most: float) -> tuple[float, float]:
    """A vector, shortened to a length of `most` if it is longer."""
    length = sqrt(x * x + y * y)
    if length <= most:
        return x, y
    return x * (most / length), y * (most / length)
