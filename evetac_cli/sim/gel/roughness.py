"""Friction that varies over the surface of an object, by which sliding is heard.

A rough surface touches a gel at asperities, so the friction of one spot differs from that of its neighbours. A node of
the gel that sticks keeps its spot, and holds more or less than the mean: static friction is patchy in place. A node
that slides at a speed v passes over spot after spot. Its friction then fluctuates in a band up to v / (2 pi length),
and the gel vibrates with it. Without roughness steady sliding is silent: the gel rests while the object moves.

The field belongs to the object, and moves and turns with it. It is log-normal with mean 1; the logarithms of points at
a distance r have the correlation exp(-(r / length)^2 / 2). A node feels the mean over its cell. That mean is exact on
every grid, so the force on an area does not depend on the grid. In a slice of 1 ms a node feels the mean along the path
that it is expected to slide, so a fast node does not see spots that it could only sample (aliasing).

The mechanism is that of the noise of rough sliding contacts (Akay, Acoustics of friction, J. Acoust. Soc. Am. 111,
2002, read as abstract). Values for this gel are not known: see [roughness] in data/scenes/slip.toml.
"""

import math

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.gel import GelState

POINTS = 256  # of the field, along each of its sides; beyond them it repeats
FINE = 4  # points per length
MOST_SPOTS = 8  # looked up along the path of one node in one slice


class Roughness:
    """The friction of each node of a pad on the surface of an object, relative to its mean."""

    def __init__(self, state: GelState, friction_sd: float, length_m: float, rng: np.random.Generator) -> None:
        """Draw the field; friction_sd: standard deviation of friction at a point, relative to the mean."""
        nodes = state.node_xy_m
        pitch_m = (float(np.ptp(nodes[0, :2, 0])), float(np.ptp(nodes[:2, 0, 1])))
        self._state, self._spacing_m = state, length_m / FINE
        self._field = cell_means(friction_sd, length_m, pitch_m, rng)
        self._factor = np.ones(nodes.shape[:2])

    def factor(self, slice_s: float) -> Floats:
        """Return each node's factor, (rows, columns), in the slice that begins; the array is used again."""
        state = self._state
        moves = (state.node_xy_m, state.displacement_m, state.mean_m_s, state.slip_m_s, state.pose, state.twist)
        _look_up(self._field, self._spacing_m, moves, slice_s, self._factor)
        return self._factor


def cell_means(sd: float, length_m: float, pitch_m: tuple[float, float], rng: np.random.Generator) -> Floats:
    """Return the means over the cells of a grid of a field of mean 1 and standard deviation sd, (POINTS, POINTS).

    From the same random stream, grids of other pitches are given means of the same field.
    """
    wave = 2.0 * np.pi * np.fft.fftfreq(POINTS, length_m / FINE)
    x, y = wave[:, None], wave
    amplitude = np.exp(-0.25 * length_m**2 * (x**2 + y**2))
    amplitude *= POINTS / math.sqrt(float((amplitude**2).sum()))
    noise = np.fft.fft2(rng.standard_normal((POINTS, POINTS)))
    spread = math.sqrt(math.log1p(sd * sd))
    field = np.exp(spread * np.fft.ifft2(noise * amplitude).real)
    field /= field.mean()
    of_cell = np.sinc(x * pitch_m[0] / (2.0 * np.pi)) * np.sinc(y * pitch_m[1] / (2.0 * np.pi))
    return np.maximum(np.fft.ifft2(np.fft.fft2(field) * of_cell).real, 0.0)


@njit(cache=True)
def _look_up(
    field: Floats,
    spacing_m: float,
    moves: tuple[Floats, Floats, Floats, Floats, Floats, Floats],
    slice_s: float,
    factor: Floats,
) -> None:
    """Fill in the mean of the field along the path of each node over the object; moves: as in `Roughness.factor`."""
    node_m, moved_m, gel_m_s, slip_m_s, pose, twist = moves
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    points = field.shape[0]
    for row in range(node_m.shape[0]):
        for column in range(node_m.shape[1]):
            x = node_m[row, column, 0] + moved_m[row, column, 0] - pose[0]
            y = node_m[row, column, 1] + moved_m[row, column, 1] - pose[1]
            path_x = path_y = 0.0
            if slip_m_s[row, column] > 0.0:
                path_x = (gel_m_s[row, column, 0] - twist[0] + twist[2] * y) * slice_s
                path_y = (gel_m_s[row, column, 1] - twist[1] - twist[2] * x) * slice_s
            spots = min(1 + int(2.0 * math.hypot(path_x, path_y) / spacing_m), MOST_SPOTS)
            total = 0.0
            for spot in range(spots):
                part = (spot + 0.5) / spots
                at_x, at_y = x + part * path_x, y + part * path_y
                u, v = (cosine * at_x + sine * at_y) / spacing_m, (cosine * at_y - sine * at_x) / spacing_m
                left, low = math.floor(u), math.floor(v)
                u, v = u - left, v - low
                i, j = int(left) % points, int(low) % points
                right, high = (i + 1) % points, (j + 1) % points
                total += (1.0 - u) * ((1.0 - v) * field[i, j] + v * field[i, high])
                total += u * ((1.0 - v) * field[right, j] + v * field[right, high])
            factor[row, column] = total / spots
