"""Where dots are by themselves, from a flash under which the print gets brighter and bare gel does not.

Each pixel of a dot has an event when the flash comes on and one when it goes off, and no other has one but for motion
and noise: the middle of these pixels is the middle of the dot, whatever has happened before. A tracker that has drifted
is put there (`tracker.place`).

What a pixel has seen before decides by how much more light it has an event, and this differs between the side that a
dot came from and the one it went to. So there are two pulses, a bright one that sets the pixels of the dots and a
fainter one, and what counts is the slice in which the second goes off: the first alone is off by a pixel (simulated).
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit

REACH_PX = 4.0  # beyond the rim: pixels from there on are no part of a dot
LEAST_SHARE = 0.6  # of a dot's area in events: with fewer it is hidden in part, and its middle is not theirs
ROUNDS = 8  # the middle is taken anew about the last one, so that a dot may be found that is some pixels off
CONVERGED_PX = 1e-3


def dots_in_flash(x: NDArray[np.uint16], y: NDArray[np.uint16], near_xy_px: Floats, radius_px: float) -> Floats:
    """Middles of dots (n, 2) in px from the events that a flash made; NaN where too few show a dot.

    x, y: columns of the events of one slice and of the polarity of its change, in px. near_xy_px: (n, 2), where dots
    are thought to be, within a radius or so; NaN for a missing one. radius_px: of dots. ValueError for columns of
    different lengths.
    """
    if x.ndim != 1 or x.shape != y.shape:
        raise ValueError(f"expected two columns of equal length, found {x.shape} and {y.shape}")
    found: Floats = np.array(near_xy_px, np.float64)
    _find(x, y, found, radius_px)
    return found


@njit(cache=True)
def _find(x: NDArray[np.uint16], y: NDArray[np.uint16], dot_xy_px: Floats, radius_px: float) -> None:
    """Move dots (n, 2) to the middles of the events about them; NaN where there are too few."""
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
