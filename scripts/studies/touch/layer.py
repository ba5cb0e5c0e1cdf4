"""An independent model of the bonded gel layer to evaluate touch maps: finite elements in depth, waves along it.

It shares no code with kernels/gel_layer.py, on which the inverse is based. For each wave number the displacement in
depth minimises the elastic energy over quadratic elements that grow from the surface down; no closed form is used. The
Poisson ratio must be below 0.5. Tractions are given on cells with their own pitch.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from evetac_cli.arrays import Floats

CELL_MM = 0.5
ELEMENTS = 24
GROWTH = 1.15  # size of an element relative to the one above it
WAVE_STEPS = 240  # wave numbers that are solved; cubic splines in between
BOX_MM = 64.0
POINTS = 256  # of the transform along each side: one cell of CELL_MM is two points
# Gauss points and weights on -1 to 1: three for shear, two for the volume change, which avoids locking.
_THREE = np.array([-math.sqrt(0.6), 0.0, math.sqrt(0.6)]), np.array([5.0, 8.0, 5.0]) / 9.0
_TWO = np.array([-1.0, 1.0]) / math.sqrt(3.0), np.ones(2)


class ElasticLayer(NamedTuple):
    """An elastic layer with a free surface: height in mm, moduli in Pa."""

    height_mm: float = 4.0
    shear_modulus_pa: float = 145e3
    poisson: float = 0.49


class DepthAnswer(NamedTuple):
    """Displacement in mm per Pa at wave numbers (n,); components as in `kernels.gel_layer.Compliance`."""

    across: Floats
    along: Floats
    aside: Floats
    down: Floats
    dip: Floats


def depth_answer(layer: ElasticLayer, wave_per_mm: Floats, depth_mm: float = 0.0) -> DepthAnswer:
    """Return the response to waves (n,), including 0, at a depth below the surface, by finite elements in depth."""
    sizes = GROWTH ** np.arange(ELEMENTS)[::-1]
    ends = np.concatenate([[0.0], np.cumsum(sizes)]) * (layer.height_mm / sizes.sum())
    nodes = 2 * ELEMENTS + 1
    lame = 2 * layer.poisson / (1 - 2 * layer.poisson)  # over the shear modulus
    stiffness = np.zeros((len(wave_per_mm), 2 * nodes, 2 * nodes))  # U along the wave, then V up
    across = np.zeros((len(wave_per_mm), nodes, nodes))
    k = wave_per_mm[:, None, None]
    for element in range(ELEMENTS):
        at = np.arange(2 * element, 2 * element + 3)
        both = np.concatenate([at, nodes + at])
        half = (ends[element + 1] - ends[element]) / 2
        block, single = np.zeros((len(wave_per_mm), 6, 6)), np.zeros((len(wave_per_mm), 3, 3))
        for (points, weights), volume in ((_THREE, False), (_TWO, True)):
            for s, weight in zip(points, weights, strict=True):
                value = np.array([s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2])
                slope = np.array([s - 0.5, -2 * s, s + 0.5]) / half
                none = np.zeros(3)
                of_u, of_v = np.concatenate([value, none]), np.concatenate([none, value])
                slope_u, slope_v = np.concatenate([slope, none]), np.concatenate([none, slope])
                if volume:
                    swell = k[..., 0] * of_u + slope_v
                    block += (weight * half * lame) * swell[:, :, None] * swell[:, None, :]
                    continue
                shear = slope_u - k[..., 0] * of_v
                block += (weight * half) * shear[:, :, None] * shear[:, None, :]
                block += (2 * weight * half) * (k**2 * np.outer(of_u, of_u) + np.outer(slope_v, slope_v))
                single += (weight * half) * (k**2 * np.outer(value, value) + np.outer(slope, slope))
        stiffness[:, both[:, None], both] += block
        across[:, at[:, None], at] += single
    free = np.concatenate([np.arange(1, nodes), nodes + np.arange(1, nodes)])
    loads = np.zeros((2 * nodes, 2))
    loads[nodes - 1, 0], loads[-1, 1] = 1.0, -1.0  # shear along the wave; pressure
    moved = np.linalg.solve(stiffness[:, free[:, None], free], loads[free])
    alone = np.zeros((nodes - 1, 1))
    alone[-1] = 1.0
    sideways = np.linalg.solve(across[:, 1:, 1:], alone)[..., 0]
    at_depth = _at_height(ends, layer.height_mm - depth_mm)
    u, v = (np.einsum("a,naf->nf", at_depth, part) for part in (moved[:, : nodes - 1], moved[:, nodes - 1 :]))
    # In the energy u = U sin(kx) if pressure varies as cos(kx); for a wave exp(ikx) this is -i U.
    parts = (sideways @ at_depth, u[:, 0], -u[:, 1], -v[:, 1], -v[:, 0])
    return DepthAnswer(*(np.asarray(part / layer.shear_modulus_pa, np.float64) for part in parts))


def _at_height(ends_mm: Floats, height_mm: float) -> Floats:
    """Return the weight of each node except the lowest at a height within the elements."""
    element = min(int(np.searchsorted(ends_mm, height_mm, side="right")) - 1, len(ends_mm) - 2)
    low, high = ends_mm[element : element + 2]
    s = 2 * (height_mm - low) / (high - low) - 1
    weights = np.zeros(2 * len(ends_mm) - 1)
    weights[2 * element : 2 * element + 3] = s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2
    return weights[1:]


class SurfaceAnswer:
    """Response of any point on the surface, or below it, to a traction on one cell of CELL_MM, in a box of waves."""

    def __init__(
        self, layer: ElasticLayer, depth_mm: float = 0.0, box_mm: float = BOX_MM, points: int = POINTS
    ) -> None:
        """The box is periodic: points of interest must be well inside it. points: along a side."""
        self.layer, self.box_mm, self.points = layer, box_mm, points
        self._waves = 2 * math.pi * np.fft.fftfreq(points, box_mm / points)
        kx, ky = np.meshgrid(self._waves, self._waves)
        k = np.hypot(kx, ky)
        wave_numbers = np.concatenate([[0.0], np.geomspace(self._waves[1] / 2, k.max(), WAVE_STEPS)])
        exact = depth_answer(layer, wave_numbers, depth_mm)
        across, along, aside, down, dip = (CubicSpline(wave_numbers, part)(k) for part in exact)
        k[0, 0] = 1.0
        x, y = kx / k, ky / k
        answer = np.empty((3, 3, *k.shape), np.complex128)  # x, y and into the layer; per shear x, y and pressure
        answer[0, 0], answer[1, 1] = across + (along - across) * x * x, across + (along - across) * y * y
        answer[0, 1] = answer[1, 0] = (along - across) * x * y
        answer[0, 2], answer[1, 2] = 1j * aside * x, 1j * aside * y
        answer[2, 0], answer[2, 1] = 1j * dip * x, 1j * dip * y
        answer[2, 2] = down
        answer[..., points // 2, :] = answer[..., :, points // 2] = 0.0
        cell = np.sinc(kx * CELL_MM / (2 * math.pi)) * np.sinc(ky * CELL_MM / (2 * math.pi))
        self._answer = answer * (cell * (CELL_MM / box_mm) ** 2)

    def at(self, point_mm: Floats, first_mm: float, count: int) -> Floats:
        """Return displacements of points (n, 2) per traction on the cells of a square lattice.

        The result is (n, 3, 3, count, count) in mm per Pa. The centre of the first cell is (first_mm, first_mm); rows
        run along y.
        """
        every = round(CELL_MM * self.points / self.box_mm)
        moved = np.empty((len(point_mm), 3, 3, count, count))
        for number, (x, y) in enumerate(point_mm - first_mm):
            phase = np.exp(1j * self._waves * y)[:, None] * np.exp(1j * self._waves * x)
            whole = np.fft.fft2(self._answer * phase).real
            moved[number] = whole[..., : count * every : every, : count * every : every]
        return moved

    def between_cells(self, count: int) -> Floats:
        """Return displacements of cells per traction on one cell by their distance: (3, 3, 2 count - 1, 2 count - 1).

        Cell a due to cell b: [..., count - 1 + row of a - row of b, count - 1 + column of a - column of b].
        """
        every = round(CELL_MM * self.points / self.box_mm)
        whole = np.fft.ifft2(self._answer).real * self.points**2
        apart = np.arange(1 - count, count) * every
        return whole[:, :, apart[:, None], apart[None, :]]
