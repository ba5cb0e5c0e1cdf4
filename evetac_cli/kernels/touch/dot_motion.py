"""How dots are seen to move when cells of the gel are sheared and pressed: the forward operator of touch maps.

The layer is the exact bonded one (kernels/gel_layer.py), in Fourier space; a cell is a square on which the traction is
even. Dots may lie under a coat, and a dot that comes nearer to the lens is seen farther from the axis.

Why by a Fourier transform per dot: what all cells of a grid do to one dot is one transform, which takes a fifth of a
millisecond; cell by cell, it would be a sum over all waves for each.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.checks import check_range
from evetac_cli.kernels.gel_layer import compliance

CELL_MM = 1.0  # half of the dots' pitch: shear finer than two pitches is aliased, not damped
SHEAR_X, SHEAR_Y, PRESSURE = 0, 1, 2  # order of the tractions
KINDS = 3
MM_PER_M = 1e3
# A layer's answer is 0 some heights away, and a sum of waves repeats itself: so far its images lie apart.
APART_HEIGHTS = 8
# Points of the transform per cell: more change what a cell does to the dot over it by 5 %, and what a contact of many
# cells does to dots by 0.5 % at most.
POINTS_PER_CELL = 2


class GelLayer(NamedTuple):
    """A gel layer on its stiff back, and how its dots are seen.

    print_depth_mm: of the dots below the surface. lens_mm: from the lens to the dots, infinite for no parallax; 25 mm
    is the guess of the simulation (sim/gel/dots.py).
    """

    height_mm: float = 4.0
    shear_modulus_pa: float = 145e3
    poisson: float = 0.5
    print_depth_mm: float = 0.0
    lens_mm: float = 25.0

    def check(self) -> None:
        """ValueError for numbers that no layer has."""
        check_range("height_mm", self.height_mm, 0.0, 1e3, "mm", above=True)
        check_range("shear_modulus_pa", self.shear_modulus_pa, 0.0, unit="Pa", above=True)
        check_range("poisson", self.poisson, 0.0, 0.5)
        check_range("print_depth_mm", self.print_depth_mm, 0.0, self.height_mm, "mm", below=True)
        if self.lens_mm != math.inf:
            check_range("lens_mm", self.lens_mm, 0.0, unit="mm", above=True)


class CellGrid(NamedTuple):
    """Square cells of CELL_MM: their middles along x and along y, in mm from the axis of the lens."""

    x_mm: Floats
    y_mm: Floats

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self.y_mm), len(self.x_mm)

    @property
    def middle_mm(self) -> Floats:
        """Middles of the cells, (cells, 2), row by row."""
        return np.stack(np.meshgrid(self.x_mm, self.y_mm), -1).reshape(-1, 2)


def cells_about(dot_mm: Floats, margin_mm: float) -> CellGrid:
    """The cells that cover the dots (n, 2) and a margin around them; middles lie at whole multiples of a cell."""
    low, high = dot_mm.min(axis=0) - margin_mm, dot_mm.max(axis=0) + margin_mm
    lines = [np.arange(round(a / CELL_MM), round(b / CELL_MM) + 1) * CELL_MM for a, b in zip(low, high, strict=True)]
    return CellGrid(lines[0], lines[1])


def dot_motion(layer: GelLayer, cells: CellGrid, dot_mm: Floats) -> Floats:
    """Motion of each dot as seen, per traction on each cell: (dots, 2, KINDS, cells) in mm per Pa.

    dot_mm: (dots, 2) at rest, from the axis of the lens. Tractions are those on the gel: shear along x and y, and
    pressure into it. ValueError for a layer that cannot be.
    """
    layer.check()
    reach_mm = max(
        float(np.abs(dot_mm[:, axis, None] - line[None]).max(initial=0.0)) for axis, line in enumerate(cells)
    )
    box_mm = math.ceil((reach_mm + APART_HEIGHTS * layer.height_mm) / CELL_MM) * CELL_MM
    points = round(box_mm / CELL_MM) * POINTS_PER_CELL
    waves: Floats = np.asarray(2 * math.pi * np.fft.fftfreq(points, CELL_MM / POINTS_PER_CELL), np.float64)
    answer = _answer(layer, waves, box_mm)
    rows, columns = cells.shape
    picked = np.ix_(np.arange(rows) * POINTS_PER_CELL, np.arange(columns) * POINTS_PER_CELL)
    motion = np.empty((len(dot_mm), 2, KINDS, rows, columns))
    for dot, (x, y) in enumerate(dot_mm):
        phase = np.exp(1j * (waves * (y - cells.y_mm[0])))[:, None] * np.exp(1j * waves * (x - cells.x_mm[0]))
        for axis, place in enumerate((x, y)):
            seen = (answer[axis] + (place / layer.lens_mm) * answer[2]) * phase
            motion[dot, axis] = np.fft.fft2(seen).real[:, picked[0], picked[1]]
    return motion.reshape(len(dot_mm), 2, KINDS, rows * columns)


def _answer(layer: GelLayer, waves_per_mm: Floats, box_mm: float) -> np.ndarray:
    """Waves of the motion along x, y and into the layer (3) per traction on a cell (KINDS), over ky and kx."""
    kx, ky = np.meshgrid(waves_per_mm, waves_per_mm)
    k = np.hypot(kx, ky)
    distinct, which = np.unique(k, return_inverse=True)
    exact = compliance(
        distinct[1:] * MM_PER_M,
        layer.height_mm / MM_PER_M,
        layer.shear_modulus_pa,
        layer.poisson,
        layer.print_depth_mm / MM_PER_M,
    )
    below_mm = layer.height_mm - layer.print_depth_mm
    shifts = below_mm / layer.shear_modulus_pa  # a wave without end
    thins = shifts * (1 - 2 * layer.poisson) / (2 * (1 - layer.poisson))
    first = (shifts, shifts, 0.0, thins, 0.0)
    across, along, aside, down, dip = (
        np.concatenate([[at_zero], part * MM_PER_M])[which].reshape(k.shape)
        for at_zero, part in zip(first, exact, strict=True)
    )
    k[0, 0] = 1.0
    x, y = kx / k, ky / k
    answer = np.empty((3, KINDS, *k.shape), np.complex128)
    answer[0, SHEAR_X] = along * x * x + across * y * y
    answer[1, SHEAR_Y] = along * y * y + across * x * x
    answer[0, SHEAR_Y] = answer[1, SHEAR_X] = (along - across) * x * y
    answer[:2, PRESSURE] = 1j * aside * np.stack([x, y])
    answer[2, :2] = 1j * dip * np.stack([x, y])
    answer[2, PRESSURE] = down
    answer[0, :, 0, 0] = answer[1, :, 0, 0] = 0.0
    answer[0, SHEAR_X, 0, 0] = answer[1, SHEAR_Y, 0, 0] = shifts
    half = len(waves_per_mm) // 2  # the wave whose two directions are one: it has no slope
    answer[..., half, :] = answer[..., :, half] = 0.0
    spread = np.sinc(kx * CELL_MM / (2 * math.pi)) * np.sinc(ky * CELL_MM / (2 * math.pi))
    return answer * (spread * (CELL_MM / box_mm) ** 2)
