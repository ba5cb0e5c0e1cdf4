"""The possible positions of a dot's ring while the dot moves: both cameras use them to leave out pixels.

A dot's level differs from ink and gel only in a finite ring (see optics). While the dot moves, the box of its path
bounds its distance to a pixel from both sides. Unlike a bound on path length, this takes the direction of motion into
account, and a dot that vibrates does not use it up. A box is (centre x, centre y, half width, half height) in px.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit


@njit(cache=True, _nrt=False)
def boxes(path: Floats, seen_xy: Floats, box: Floats) -> None:
    """Fill boxes (dots, 4) around each dot's path (dots, vertices, 2) and its last position (dots, 2)."""
    dots, vertices, _ = path.shape
    for dot in range(dots):
        for axis in range(2):
            low = seen_xy[dot, axis]
            high = low
            for vertex in range(vertices):
                low = min(low, path[dot, vertex, axis])
                high = max(high, path[dot, vertex, axis])
            box[dot, axis] = 0.5 * (low + high)
            box[dot, 2 + axis] = 0.5 * (high - low)


@njit(cache=True, _nrt=False)
def dots_near(dot: int, path: Floats, box: Floats, outer: float, near_path: Floats, near_box: Floats) -> int:
    """Collect the dots that may be the nearest dot of a pixel in this dot's ring; return their number.

    These are the dots that may darken a pixel that this dot may darken; dots further away show bare gel there.
    """
    near = 0
    for other in range(len(path)):
        reach_x = box[dot, 2] + box[other, 2] + 2.0 * outer
        reach_y = box[dot, 3] + box[other, 3] + 2.0 * outer
        if abs(box[dot, 0] - box[other, 0]) <= reach_x and abs(box[dot, 1] - box[other, 1]) <= reach_y:
            for shot in range(path.shape[1]):
                near_path[near, shot, 0] = path[other, shot, 0]
                near_path[near, shot, 1] = path[other, shot, 1]
            for side in range(4):
                near_box[near, side] = box[other, side]
            near += 1
    return near


@njit(cache=True, _nrt=False)
def crowded(box: Floats, outer: float, has_near: NDArray[np.uint8]) -> bool:
    """Mark the dots that have others near them, as in `dots_near`, in `has_near` (dots,), for boxes (dots, 4).

    Return whether there are any.
    """
    dots = len(box)
    has_near[:] = 0
    found = False
    for dot in range(dots):
        for other in range(dot):
            near_x = abs(box[dot, 0] - box[other, 0]) <= box[dot, 2] + box[other, 2] + 2.0 * outer
            near_y = abs(box[dot, 1] - box[other, 1]) <= box[dot, 3] + box[other, 3] + 2.0 * outer
            if near_x & near_y:
                has_near[dot] = 1
                has_near[other] = 1
                found = True
    return found


@njit(cache=True, _nrt=False)
def bounds(x: int, y: int, near_box: Floats) -> tuple[float, float]:
    """Return the least and largest squared distance of a pixel to the nearest dot; each dot is in its box (near, 4)."""
    least2 = np.inf
    greatest2 = np.inf
    for dot in range(len(near_box)):
        across = abs(x - near_box[dot, 0])
        down = abs(y - near_box[dot, 1])
        least2 = min(least2, max(across - near_box[dot, 2], 0.0) ** 2 + max(down - near_box[dot, 3], 0.0) ** 2)
        greatest2 = min(greatest2, (across + near_box[dot, 2]) ** 2 + (down + near_box[dot, 3]) ** 2)
    return least2, greatest2


@njit(cache=True, _nrt=False)
def ring_rows(box: Floats, outer: float, height: int) -> tuple[int, int]:
    """Return the rows of a frame, from and up to, that the ring of a dot in a box (4,) can touch."""
    first = max(0, math.ceil(box[1] - box[3] - outer))
    return first, max(first, min(height, math.floor(box[1] + box[3] + outer) + 1))


@njit(cache=True, _nrt=False)
def ring_runs(box: Floats, inner: float, outer: float, y: int, width: int) -> tuple[int, int, int, int]:
    """Return the pixels of a row that are ever between `inner` and `outer` from a dot in a box (4,).

    The pixels are those from the first column up to the second, and from the third up to the fourth. All other pixels
    keep the same level.
    """
    centre_x = box[0]
    half_x = box[2]
    down = abs(y - box[1])
    nearest_down = max(down - box[3], 0.0)
    farthest_down = down + box[3]
    rim_half = half_x + math.sqrt(max(0.0, outer * outer - nearest_down * nearest_down))
    left = max(0, math.ceil(centre_x - rim_half))
    right_end = max(left, min(width, math.floor(centre_x + rim_half) + 1))
    left_end = right_end
    right = right_end
    if inner > farthest_down:
        hole_half = math.sqrt(inner * inner - farthest_down * farthest_down) - half_x
        if hole_half > 0.0:
            left_end = max(left, min(right_end, math.floor(centre_x - hole_half) + 1))
            right = min(right_end, max(left_end, math.ceil(centre_x + hole_half)))
    return left, left_end, right, right_end
