"""How dots move when the gel is pressed, without any shear: squeezed outwards, and seen larger because nearer.

Two effects of an indentation s (metres), both small against shear and the only ones of a purely normal touch:

- Squeeze. The layer is bonded and nearly incompressible, so a patch pushes gel out to where it is thin: a disc of
  half width a moves its gel by u_r = 0.75 r s / (2 H), a long strip only across. Under a face that sticks, 0.3 of it
  is left. Outside the patch it decays over H / sqrt(3), as all motion of the layer does.
- Lens. A dot that comes nearer by s moves away from the image's centre by r s / Z, with Z = 25 mm.

The shape of the first is derived; its share under a sticking face and Z are guesses, not to be trusted.
"""

import math

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.gel import DECAY_M

SQUEEZE = 0.75
STICKING_SHARE = 0.3
CAMERA_DISTANCE_M = 25e-3


def dilation(
    points_m: Floats, node_xy_m: Floats, indentation_m: Floats, at_points_m: Floats, height_m: float
) -> Floats:
    """Shift in m of points on the gel (points, 2), by how deep each node is pressed (rows, columns).

    at_points_m (points,): indentation at the points themselves, for the lens. Zero where nothing is pressed.
    """
    shift_m: Floats = _shift(
        np.asarray(points_m, np.float64), node_xy_m, indentation_m, np.asarray(at_points_m, np.float64), float(height_m)
    )
    return shift_m


@njit(cache=True)
def _shift(points: Floats, nodes: Floats, indentation: Floats, at_points: Floats, height: float) -> Floats:
    rows, columns = indentation.shape
    shift = np.zeros((len(points), 2))
    pressed = 0
    depth = 0.0
    low = np.full(2, np.inf)
    high = np.full(2, -np.inf)
    for row in range(rows):
        for column in range(columns):
            if indentation[row, column] > 0.0:
                pressed += 1
                depth += indentation[row, column]
                for axis in range(2):
                    low[axis] = min(low[axis], nodes[row, column, axis])
                    high[axis] = max(high[axis], nodes[row, column, axis])
    if pressed == 0:
        return shift
    centre = (low + high) / 2
    half_x = (high[0] - low[0] + nodes[0, 1, 0] - nodes[0, 0, 0]) / 2
    half_y = (high[1] - low[1] + nodes[1, 0, 1] - nodes[0, 0, 1]) / 2
    strength = STICKING_SHARE * SQUEEZE / height * depth / pressed
    # gel leaves over the shorter distance; 1/2 each on a disc
    across_x = strength * half_y * half_y / (half_x * half_x + half_y * half_y)
    across_y = strength * half_x * half_x / (half_x * half_x + half_y * half_y)
    for point in range(len(points)):
        x = points[point, 0] - centre[0]
        y = points[point, 1] - centre[1]
        inside_x = min(max(x, -half_x), half_x)
        inside_y = min(max(y, -half_y), half_y)
        decay = math.exp(-math.hypot(x - inside_x, y - inside_y) / DECAY_M)
        lens = at_points[point] / CAMERA_DISTANCE_M
        shift[point, 0] = across_x * inside_x * decay + points[point, 0] * lens
        shift[point, 1] = across_y * inside_y * decay + points[point, 1] * lens
    return shift
