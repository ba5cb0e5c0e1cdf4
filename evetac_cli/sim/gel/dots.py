"""Motion of points on the gel's surface, as a camera sees it: interpolated from nodes, and magnified by depth.

A dot that comes nearer to the lens by s moves away from the image's centre by r s / Z, with r its distance from the
centre. Z is a guess: the rounded distance of a GelSight Mini's camera.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.gel import GelState

# Distance over which the motion of a layer 4 mm high decays beyond a border, for motion along the border:
# H sqrt(ACROSS (1 + 1/SPRING)). Motion normal to the border reaches 5.5 mm.
DECAY_M = 2.3e-3
CAMERA_DISTANCE_M = 25e-3  # Z above


def nearer_by(points_m: Floats, depth_m: Floats) -> Floats:
    """Return the apparent shift (points, 2) in m of points (points, 2) from the axis that come nearer by depth_m."""
    shift_m: Floats = points_m * (depth_m / CAMERA_DISTANCE_M)[:, None]
    return shift_m


def interpolation(node_xy_m: Floats, points_xy_m: Floats, decay_m: float = DECAY_M) -> tuple[NDArray[np.intp], Floats]:
    """Return nodes and weights, (points, 4) each, that interpolate the displacement of points from that of the nodes.

    Bilinear between nodes, and constant up to the border of the pad (the outer sides of its cells). Beyond, the value
    at the border decays with exp(-distance / decay_m), like the motion of a bonded layer outside a contact.
    """
    points = np.asarray(points_xy_m, dtype=np.float64)
    assert points.ndim == 2 and points.shape[1] == 2 and np.isfinite(points).all()
    rows, columns, _ = node_xy_m.shape
    low = np.empty((2, len(points)), dtype=np.intp)
    high = np.empty_like(low)
    part = np.empty((2, len(points)))
    beyond = np.empty((2, len(points)))
    for axis, line in enumerate((node_xy_m[0, :, 0], node_xy_m[:, 0, 1])):
        half = (line[1] - line[0]) / 2 if len(line) > 1 else 0.0
        place = points[:, axis]
        beyond[axis] = np.maximum(0.0, np.maximum(line[0] - half - place, place - line[-1] - half))
        index = np.interp(place, line, np.arange(len(line)))
        low[axis] = np.minimum(index.astype(np.intp), len(line) - 1)
        high[axis] = np.minimum(low[axis] + 1, len(line) - 1)
        part[axis] = index - low[axis]
    reach = np.exp(-np.hypot(*beyond) / decay_m)
    corners = [(low, low, 1 - part[0], 1 - part[1]), (high, low, part[0], 1 - part[1])]
    corners += [(low, high, 1 - part[0], part[1]), (high, high, part[0], part[1])]
    indices = np.stack([at_y[1] * columns + at_x[0] for at_x, at_y, _, _ in corners], axis=-1)
    weights = np.stack([reach * share_x * share_y for _, _, share_x, share_y in corners], axis=-1)
    return indices, weights


def displacement_at(state: GelState, indices: NDArray[np.intp], weights: Floats) -> Floats:
    """Return the displacement in m, (points, 2), of the points with these indices and weights (`interpolation`)."""
    displacement: Floats = field_at(state.displacement_m, indices, weights)
    return displacement


@njit(cache=True)
def field_at(field: Floats, indices: NDArray[np.intp], weights: Floats) -> Floats:
    """Return values (points, parts) of a node field, (rows, columns, parts), at the points of `interpolation`."""
    parts = field.shape[2]
    nodes = field.reshape(field.shape[0] * field.shape[1], parts)
    values = np.zeros((len(indices), parts))
    for point in range(len(indices)):
        for corner in range(indices.shape[1]):
            for part in range(parts):
                values[point, part] += nodes[indices[point, corner], part] * weights[point, corner]
    return values
