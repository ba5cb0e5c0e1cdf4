"""Response to shear and pressure of a soft layer bonded to a stiff back: the exact one, and a sheet model of it.

Exact: a traction of wave number k acts on the surface of an incompressible layer of height H and shear modulus G, and
the response is a vector. Shear along the wave (L) moves the layer less than shear across it (T), because gel must then
be pushed up where it is thin. Pressure also moves it sideways. `compliance` is the closed form; across the wave it is
tanh(kH) / (G k).

Sheet: a simulator needs the inverse of the response, on a grid from node to node. Each surface node is held by a spring
G/H to the back, and by a spring SPRING G/H to a sheet inside the layer. The sheet resists stretching with ALONG G H
along a wave and with ACROSS G H across it. In equilibrium the sheet is the smoothed surface. The stiffness of the
surface to a pattern is then G/H (1 + a x / (1 + a x / SPRING)), with x = (kH)^2 and a = ALONG or ACROSS. This is a Pade
approximant of the exact one. `sheet_stiffness` is its matrix on a grid.

Pressure acts like a push of the surface by -H/2 grad p, with p smoothed by a Gaussian of SMOOTHING H. The exact motion
under pressure, times the layer's stiffness along the wave, is equal to this push within 5 % of its maximum.

The constants were fitted to the exact layer at wavelengths of 2 to 30 heights (8 to 120 mm), where the sheet is off by
at most 2 %. It is too soft for shorter waves: along the wave by 14 % at 6 mm, a quarter at 5 mm, and half at 4 mm, the
shortest wave that dots 2 mm apart resolve.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats

if TYPE_CHECKING:  # takes 0.2 s to load, and callers that only need the constants of a gel do not use it
    from scipy import sparse

SPRING = 8.25  # stiffness of the spring between surface and sheet, over G/H
ALONG = 1.675  # stretching stiffness of the sheet along a wave, over G H
ACROSS = 0.305  # ... and across it
SMOOTHING = 0.82  # standard deviation of the smoothing of pressure, over H


class Compliance(NamedTuple):
    """Motion of a layer at a number of wave numbers (n,), at its surface or below it, in m per Pa.

    `across`, `along`: in the plane of the layer, under shear across and along the wave. `aside`: in the plane along the
    wave, under pressure, as a factor on the pressure's slope over the wave number. It is negative, because gel moves
    away from high pressure. `down`: into the layer under pressure. `dip`: into the layer under shear along the wave, as
    a factor on the shear's slope over the wave number. At the surface it is -aside, by reciprocity.
    """

    across: Floats
    along: Floats
    aside: Floats
    down: Floats
    dip: Floats


def compliance(
    wave_number_per_m: Floats,
    height_m: float,
    shear_modulus_pa: float = 1.0,
    poisson: float = 0.5,
    depth_m: float = 0.0,
) -> Compliance:
    """Return the exact response of a bonded layer to tractions on its surface: the closed form in Fourier space.

    wave_number_per_m: (n,) above 0. poisson: up to 0.5, which is incompressible. depth_m: depth below the surface of
    the motion, for example of dots printed under a coat. The displacement is a sum of four functions of depth, two of
    which have the depth as a factor. Zero displacement at the back and the given traction at the surface are four
    equations for each wave number.
    """
    wave = np.asarray(wave_number_per_m, dtype=np.float64) * height_m  # all lengths in heights
    ratio = 3.0 - 4.0 * poisson
    fades = np.exp(-wave)

    def displacement(depth: float) -> tuple[Floats, Floats]:
        """Return the parts along the wave and up of the four functions, (n, 4), at a depth below the surface."""
        rise, fall, below = np.exp(-wave * depth), np.exp(-wave * (1.0 - depth)), -depth
        along = np.stack([rise, wave * below * rise, fall, wave * (1.0 - depth) * fall], -1)
        up = np.stack([rise, (wave * below - ratio) * rise, -fall, -(wave * (1.0 - depth) + ratio) * fall], -1)
        return along, up

    top, back = displacement(0.0), displacement(1.0)
    slope_along = np.stack([wave, wave, -wave * fades, wave * (1.0 - wave) * fades], -1)
    slope_up = np.stack([wave, wave * (1.0 - ratio), wave * fades, -wave * (1.0 - (wave + ratio)) * fades], -1)
    swelling = np.stack([0 * wave, -4 * poisson * wave, 0 * wave, 4 * poisson * wave * fades], -1)
    equations = np.stack([*back, slope_along + wave[:, None] * top[1], swelling + 2 * slope_up], axis=1)
    right_sides = np.zeros((len(wave), 4, 2))
    right_sides[:, 2, 0], right_sides[:, 3, 1] = 1.0, -1.0
    weights = np.linalg.solve(equations, right_sides)
    depth = depth_m / height_m
    along, up = (np.einsum("ni,nij->nj", part, weights) for part in displacement(depth))
    scale = height_m / shear_modulus_pa
    across = np.exp(-wave * depth) * -np.expm1(-2 * wave * (1.0 - depth)) / (1.0 + fades**2) / wave
    return Compliance(*(scale * part for part in (across, along[:, 0], along[:, 1], -up[:, 1], up[:, 0])))


def sheet_stiffness(node_xy_m: Floats, height_m: float) -> "sparse.csr_matrix":
    """Return stiffness over shear modulus, in m, of a pad of nodes (rows, columns, 2) and its sheet, with free edges.

    (4 n, 4 n) for n nodes: displacements of the surface along x, along y, then those of the sheet.
    """
    from scipy import sparse

    rows, columns, _ = node_xy_m.shape
    pitch_x, pitch_y = node_xy_m[0, 1, 0] - node_xy_m[0, 0, 0], node_xy_m[1, 0, 1] - node_xy_m[0, 0, 1]
    one = sparse.eye(rows * columns)

    def step(count: int) -> "sparse.csr_matrix":
        """Return the differences of neighbours along a line."""
        return sparse.diags([-np.ones(count), np.ones(count - 1)], [0, 1], shape=(count - 1, count))

    def middle(count: int) -> "sparse.csr_matrix":
        """Return the means of neighbours along a line."""
        return sparse.diags([np.full(count, 0.5), np.full(count - 1, 0.5)], [0, 1], shape=(count - 1, count))

    across, down = sparse.kron(sparse.eye(rows), step(columns)), sparse.kron(step(rows), sparse.eye(columns))
    bends_x, bends_y = across.T @ across * (height_m / pitch_x) ** 2, down.T @ down * (height_m / pitch_y) ** 2
    wide_x, wide_y = sparse.kron(middle(rows), step(columns)), sparse.kron(step(rows), middle(columns))
    swells = (ALONG - ACROSS) * height_m**2 / (pitch_x * pitch_y) * (wide_x.T @ wide_y)
    blocks = [
        [(1 + SPRING) * one, None, -SPRING * one, None],
        [None, (1 + SPRING) * one, None, -SPRING * one],
        [-SPRING * one, None, SPRING * one + ALONG * bends_x + ACROSS * bends_y, swells],
        [None, -SPRING * one, swells.T, SPRING * one + ACROSS * bends_x + ALONG * bends_y],
    ]
    return sparse.csr_matrix(pitch_x * pitch_y / height_m * sparse.bmat(blocks))


class Squeeze:
    """The force on each surface node by which pressure moves a layer aside: -H/2 grad p, smoothed."""

    def __init__(self, node_xy_m: Floats, height_m: float) -> None:
        """For a regular grid of nodes (rows, columns, 2); normal forces on nodes are spread over their cells."""
        self._smooth_x, slope_x = _gaussian(node_xy_m[0, :, 0], height_m)
        self._slope_x = np.ascontiguousarray(slope_x.T)
        self._smooth_y, self._slope_y = _gaussian(node_xy_m[:, 0, 1], height_m)

    def of(self, normal: Floats) -> Floats:
        """Return the force (rows, columns, 2) in the unit of the nodes' normal forces (rows, columns)."""
        aside = np.empty((*normal.shape, 2))
        np.matmul(self._smooth_y @ normal, self._slope_x, out=aside[..., 0])
        np.matmul(self._slope_y @ normal, self._smooth_x, out=aside[..., 1])
        return aside

    def transposed(self, weights: Floats) -> Floats:
        """Return weights on pressures (..., rows, columns) with the effect of given weights on the resulting forces.

        weights: (..., rows, columns, 2), for example the effect of the forces on a dot.
        """
        of_x = self._smooth_y.T @ weights[..., 0] @ self._slope_x.T
        of_y = self._slope_y.T @ weights[..., 1] @ self._smooth_x.T
        pressed: Floats = of_x + of_y
        return pressed


def moved_by(node_xy_m: Floats, height_m: float, sticks: Flags, squeezed_m2: Floats) -> Floats:
    """Return the equilibrium of a pad whose nodes partly stick to an object: (rows, columns, 2, 3), along x and y.

    sticks: (rows, columns). squeezed_m2: (rows, columns, 2), force of pressure over the shear modulus, see `Squeeze`.
    The last index: displacement in m by pressure with the object at rest; displacement per unit of the object's motion
    along x; and along y.
    """
    from scipy.sparse.linalg import splu

    rows, columns = sticks.shape
    count = rows * columns
    stiffness = sheet_stiffness(node_xy_m, height_m).tocsc()
    is_held = np.concatenate([np.tile(sticks.ravel(), 2), np.zeros(2 * count, np.bool_)])
    moved, pushed = np.zeros((4 * count, 3)), np.zeros((4 * count, 3))
    moved[:count, 1], moved[count : 2 * count, 2] = is_held[:count], is_held[count : 2 * count]
    pushed[: 2 * count, 0] = np.moveaxis(squeezed_m2, 2, 0).ravel()
    loose = stiffness[~is_held]
    moved[~is_held] = splu(loose[:, ~is_held]).solve(pushed[~is_held] - loose[:, is_held] @ moved[is_held])
    fields: Floats = moved[: 2 * count].reshape(2, rows, columns, 3).transpose(1, 2, 0, 3)
    return np.ascontiguousarray(fields)


def _gaussian(line_m: Floats, height_m: float) -> tuple[Floats, Floats]:
    """Return matrices that smooth along a line of nodes, and that smooth and take -H/2 of the slope; see `Squeeze`."""
    pitch_m = line_m[1] - line_m[0] if len(line_m) > 1 else height_m
    sd_m = SMOOTHING * height_m
    apart = (line_m[:, None] - line_m[None, :]) / sd_m
    smooth: Floats = np.exp(-0.5 * apart**2) * (pitch_m / (sd_m * math.sqrt(2 * math.pi)))
    slope: Floats = 0.5 * height_m / sd_m * apart * smooth
    return smooth, slope
