"""Absolute positions of the dots, from a flash of light that brightens the print but not the bare gel.

Each pixel of a dot has an event when the flash comes on and one when it goes off. Other pixels have none, except for
motion and noise. So the mean position of these pixels is the centre of the dot, independently of its history. A tracker
that has drifted can be reset there (`place`).

The change of light at which a pixel makes an event depends on its history, which differs between the side that a dot
came from and the side it moved to. So there are two pulses: a bright one that sets the pixels of the dots, and a
fainter one. The slice in which the second pulse goes off is used. The first pulse alone is off by a pixel (simulated).
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.tracking import lost_dots
from evetac_cli.kernels.tracking.tracker import TrackerState

REACH_PX = 4.0  # beyond the rim: pixels farther away are not part of a dot
LEAST_SHARE = 0.6  # of a dot's area in events: with less, the dot is partly hidden and the centre is wrong
ROUNDS = 8  # the centre is computed again around the previous one, so that dots some pixels off are found
CONVERGED_PX = 1e-3  # change of the centre, summed over both axes, that ends the rounds


def dots_in_flash(x: NDArray[np.uint16], y: NDArray[np.uint16], near_xy_px: Floats, radius_px: float) -> Floats:
    """Return the centres of dots (n, 2) in px from the events of a flash; NaN for dots with too few events.

    `x`, `y`: columns of the events of one slice with the polarity of the change, in px. `near_xy_px`: (n, 2),
    approximate positions, within a radius or so; NaN for a missing dot. `radius_px`: of the dots.
    """
    assert x.ndim == 1 and x.shape == y.shape
    found: Floats = np.array(near_xy_px, np.float64)
    _find(x, y, found, radius_px)
    return found


@njit(cache=True)
def _find(x: NDArray[np.uint16], y: NDArray[np.uint16], dot_xy_px: Floats, radius_px: float) -> None:
    """Move dots (n, 2) to the centres of the events around them; NaN for dots with too few."""
    reach_px2 = (radius_px + REACH_PX) ** 2
    least = LEAST_SHARE * np.pi * radius_px**2
    for i in range(dot_xy_px.shape[0]):
        count = 0
        for _ in range(ROUNDS):
            count = 0
            sum_x = 0.0
            sum_y = 0.0
            for k in range(x.shape[0]):
                across = x[k] - dot_xy_px[i, 0]
                down = y[k] - dot_xy_px[i, 1]
                if across * across + down * down < reach_px2:
                    count += 1
                    sum_x += across
                    sum_y += down
            if count == 0:
                break
            dot_xy_px[i, 0] += sum_x / count
            dot_xy_px[i, 1] += sum_y / count
            if abs(sum_x) + abs(sum_y) < CONVERGED_PX * count:
                break
        if count < least:
            dot_xy_px[i, 0] = np.nan
            dot_xy_px[i, 1] = np.nan


def place(state: TrackerState, dot_xy_px: Floats, share: float = 1.0) -> None:
    """Move the dots of a tracker to positions (n, 2) in px, or by a share of the way; dots with NaN stay as they are.

    They are followed from the new position and are no longer lost.
    """
    assert dot_xy_px.shape == state.dot_xy_px.shape and 0.0 <= share <= 1.0
    seen = ~np.isnan(dot_xy_px).any(axis=1)
    most_px = state.record["frame_px"][0] - 1.0
    moved = state.dot_xy_px[seen] + share * (dot_xy_px[seen] - state.dot_xy_px[seen])
    state.dot_xy_px[seen] = np.clip(moved, 0.0, most_px)
    _start_anew(state.record, seen)


@njit(cache=True)
def _start_anew(record: NDArray[np.void], which: NDArray[np.bool_]) -> None:
    state = record[0]
    for i in range(which.shape[0]):
        if which[i]:
            lost_dots.start_anew(state, i)
