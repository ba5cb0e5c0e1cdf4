"""The share of each gel cell that a face covers: a rectangle, a disc, an ellipse, or an ellipse with a hole.

As in gel/cell_gaps.py, each cell is sampled at points. Here the face's edge is soft over the distance of two points, so
that a moving face covers and uncovers each cell evenly.
"""

import math

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.cell_gaps import SAMPLES

NO_HOLE = np.zeros(0)


def covered(node_xy_m: Floats, centre_m: Floats, half_m: Floats, *, is_round: bool, hole_m: Floats = NO_HOLE) -> Floats:
    """Return the share of each cell of a grid of nodes, (rows, columns), that a face about centre_m covers, 0 to 1.

    half_m (2,): half sides of a rectangle, or half axes of an ellipse, along x and y; hole_m: half axes of its hole.
    """
    shares: Floats = _covered(node_xy_m, centre_m, half_m, hole_m, is_round)
    return shares


@njit(cache=True)
def _covered(nodes: Floats, centre: Floats, half: Floats, hole: Floats, is_round: bool) -> Floats:
    rows, columns, _ = nodes.shape
    pitch_x = nodes[0, 1, 0] - nodes[0, 0, 0]
    pitch_y = nodes[1, 0, 1] - nodes[0, 0, 1]
    soft = math.sqrt(pitch_x * pitch_y) / SAMPLES
    reach = 0.5 * math.hypot(pitch_x, pitch_y) + soft
    shares = np.empty((rows, columns))
    for row in range(rows):
        for column in range(columns):
            x = nodes[row, column, 0] - centre[0]
            y = nodes[row, column, 1] - centre[1]
            inside = _inside(x, y, half, hole, is_round)
            if abs(inside) >= reach:
                shares[row, column] = 1.0 if inside > 0.0 else 0.0
                continue
            total = 0.0
            for i in range(SAMPLES):
                for j in range(SAMPLES):
                    at_x = x + ((i + 0.5) / SAMPLES - 0.5) * pitch_x
                    at_y = y + ((j + 0.5) / SAMPLES - 0.5) * pitch_y
                    total += min(max(_inside(at_x, at_y, half, hole, is_round) / soft + 0.5, 0.0), 1.0)
            shares[row, column] = total / (SAMPLES * SAMPLES)
    return shares


@njit(cache=True, _nrt=False)
def _inside(x: float, y: float, half: Floats, hole: Floats, is_round: bool) -> float:
    """Return how far a point, relative to the face's centre, is inside the face and outside its hole; else negative."""
    if not is_round:
        return float(min(half[0] - abs(x), half[1] - abs(y)))
    inside = _inside_ellipse(x, y, half)
    return float(min(inside, -_inside_ellipse(x, y, hole))) if len(hole) else float(inside)


@njit(cache=True, _nrt=False)
def _inside_ellipse(x: float, y: float, half: Floats) -> float:
    """Return how far a point is inside an ellipse of half axes (2,), to first order at its edge."""
    if half[0] == half[1]:
        return float(half[0] - math.hypot(x, y))
    scaled = math.sqrt((x / half[0]) * (x / half[0]) + (y / half[1]) * (y / half[1]))
    if scaled == 0.0:
        return float(min(half[0], half[1]))
    steep_x = x / (half[0] * half[0])
    steep_y = y / (half[1] * half[1])
    return scaled * (1.0 - scaled) / max(math.sqrt(steep_x * steep_x + steep_y * steep_y), 1e-9)
