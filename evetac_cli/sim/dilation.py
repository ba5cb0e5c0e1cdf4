"""How dots move when the gel is pressed, without any shear: squeezed outwards, and seen larger because nearer.

Two effects of an indentation s (metres), both small against shear and the only ones of a purely normal touch:

- Squeeze. The layer is bonded and nearly incompressible, so a patch pushes gel out to where it is thin: a disc of
  half width a moves its gel by u_r = 0.75 r s / (2 H), a long strip only across. Under a face that sticks, 0.3 of it
  is left. Outside the patch it decays over H / sqrt(3), as all motion of the layer does.
- Lens. A dot that comes nearer by s moves away from the image's centre by r s / Z, with Z = 25 mm.

The shape of the first is derived; its share under a sticking face and Z are guesses, not to be trusted.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.sim.gel import DECAY_M

SQUEEZE = 0.75
STICKING_SHARE = 0.3
CAMERA_DISTANCE_M = 25e-3

Floats = NDArray[np.float64]


def dilation(
    points_m: Floats, node_xy_m: Floats, indentation_m: Floats, at_points_m: Floats, height_m: float
) -> Floats:
    """Shift in m of points on the gel (points, 2), by how deep each node is pressed (rows, columns).

    at_points_m (points,): indentation at the points themselves, for the lens. Zero where nothing is pressed.
    """
    pressed = indentation_m > 0
    if not pressed.any():
        return np.zeros_like(points_m)
    place = node_xy_m[pressed]
    depth = indentation_m[pressed]
    low, high = place.min(axis=0), place.max(axis=0)
    pitch = np.array([node_xy_m[0, 1, 0] - node_xy_m[0, 0, 0], node_xy_m[1, 0, 1] - node_xy_m[0, 0, 1]])
    centre, half = (low + high) / 2, (high - low + pitch) / 2
    across = half[::-1] ** 2 / np.sum(half**2)  # gel leaves by the shorter way; 1/2 each on a disc
    inside = np.clip(points_m - centre, -half, half)
    beyond = np.hypot(*(np.abs(points_m - centre) - np.abs(inside)).T)
    strength = STICKING_SHARE * SQUEEZE / height_m * depth.mean()
    squeeze = strength * across * inside * np.exp(-beyond / DECAY_M)[:, None]
    shift_m: Floats = squeeze + points_m * (at_points_m / CAMERA_DISTANCE_M)[:, None]
    return shift_m
