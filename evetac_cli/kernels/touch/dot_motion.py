"""Seen motion of the dots when cells of the gel are sheared and pressed: the forward operator of touch maps.

The layer is the exact bonded one (kernels/gel_layer.py), in Fourier space. A cell is a square with uniform traction.
Dots may be printed under a coat. A dot that comes nearer to the lens is seen farther from the axis (parallax).

Beyond the end of a gel, as at the window of a cut gel, nothing is dragged along. A free edge is modelled as a mirror:
the images of the cells add to the cells' effect, so that uniform shear moves a uniform gel uniformly, as it must.
Pressure pushes a gel aside (kernels/gel_layer.py, `Squeeze`); of this push only the part inside the gel counts, so that
pressed gel bulges out at the edge. This is not an exact solution; no closed form is known near a free edge.

Reason for a Fourier transform per dot: one transform gives the effect of all cells of a grid on one dot, in a fifth of
a millisecond. Cell by cell, each cell would need a sum over all waves.

`DotModes` are the motion of all dots, reduced to modes whose errors are independent. The error of the dots has three
parts: one per dot, one common to all dots, and the deviation of a real gel from the layer model. An event-based tracker
integrates motion, so its error drifts, mostly by the same amount for all dots. The first two modes are the mean of the
dots along x and y; they alone contain the common error.

Reason for modes: with many dots, most patterns of motion are patterns that no traction causes. For 256 dots, 126 modes
keep the information of all 512 numbers, up to less than the error of one dot, at a quarter of the computing time.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.errors import check_range
from evetac_cli.kernels.gel_layer import Squeeze, compliance

CELL_MM = 1.0  # half of the dots' pitch: shear finer than two pitches is aliased, not damped
SHEAR_X, SHEAR_Y, PRESSURE = 0, 1, 2  # order of the tractions
KINDS = 3  # kinds of traction
MM_PER_M = 1e3
# The response of a layer is 0 some heights away, but a sum of waves is periodic, with this period in heights.
APART_HEIGHTS = 8
# Points of the transform per cell. More points change the effect of a cell on the dot above it by 5 %, and the effect
# of a contact of many cells by at most 0.5 %.
POINTS_PER_CELL = 2
IMAGES_HEIGHTS = 4  # images of cells more than this many heights beyond an edge have no effect
ENDLESS_MM = (-math.inf, -math.inf, math.inf, math.inf)  # edges of a gel that is large compared with the view


class GelLayer(NamedTuple):
    """A gel layer on its stiff back, with what the camera sees of its dots.

    `print_depth_mm`: depth of the dots below the surface. `lens_mm`: distance from the lens to the dots, infinite for
    no parallax; 25 mm is the assumption of the simulation (sim/gel/dots.py). `edges_mm`: ends of the gel, x0, y0, x1,
    y1 from the axis of the lens, accurate to half a cell, and infinite for ends far away.
    """

    height_mm: float = 4.0
    shear_modulus_pa: float = 145e3
    poisson: float = 0.5
    print_depth_mm: float = 0.0
    lens_mm: float = 25.0
    edges_mm: tuple[float, float, float, float] = ENDLESS_MM

    def check(self) -> None:
        """Raise ValueError for impossible numbers."""
        check_range("height_mm", self.height_mm, 0.0, 1e3, "mm", above=True)
        check_range("shear_modulus_pa", self.shear_modulus_pa, 0.0, unit="Pa", above=True)
        check_range("poisson", self.poisson, 0.0, 0.5)
        check_range("print_depth_mm", self.print_depth_mm, 0.0, self.height_mm, "mm", below=True)
        if self.lens_mm != math.inf:
            check_range("lens_mm", self.lens_mm, 0.0, unit="mm", above=True)
        x0, y0, x1, y1 = self.edges_mm
        if not (x0 + CELL_MM < x1 and y0 + CELL_MM < y1):
            raise ValueError(f"edges_mm: expected x0, y0, x1, y1 in mm, x0 < x1, y0 < y1, found {self.edges_mm}")


class CellGrid(NamedTuple):
    """Square cells of CELL_MM: their centres along x and along y, in mm from the axis of the lens."""

    x_mm: Floats
    y_mm: Floats

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self.y_mm), len(self.x_mm)

    @property
    def middle_mm(self) -> Floats:
        """Centres of the cells, (cells, 2), row by row."""
        return np.stack(np.meshgrid(self.x_mm, self.y_mm), -1).reshape(-1, 2)


def cells_about(dot_mm: Floats, margin_mm: float, edges_mm: tuple[float, float, float, float] = ENDLESS_MM) -> CellGrid:
    """Return the cells that cover the dots (n, 2) and a margin around them, as far as there is gel.

    Centres are whole multiples of a cell. ValueError for dots beyond the edges of the gel.
    """
    half = CELL_MM / 2
    if (dot_mm < np.array(edges_mm[:2]) - half).any() or (dot_mm > np.array(edges_mm[2:]) + half).any():
        raise ValueError(f"dots are beyond the edges of the gel: {edges_mm} mm")
    low = np.maximum(dot_mm.min(axis=0) - margin_mm, np.array(edges_mm[:2]) + half)
    high = np.minimum(dot_mm.max(axis=0) + margin_mm, np.array(edges_mm[2:]) - half)
    lines = [np.arange(round(a / CELL_MM), round(b / CELL_MM) + 1) * CELL_MM for a, b in zip(low, high, strict=True)]
    return CellGrid(lines[0], lines[1])


def dot_motion(layer: GelLayer, cells: CellGrid, dot_mm: Floats) -> Floats:
    """Return the seen motion of each dot per traction on each cell: (dots, 2, KINDS, cells) in mm per Pa.

    dot_mm: (dots, 2) at rest, from the axis of the lens. Tractions act on the gel: shear along x and y, and pressure
    into it. ValueError for an impossible layer.
    """
    layer.check()
    moved = _motion_by_cells(layer, cells, dot_mm, _images(layer, cells))
    seen: Floats = moved[:, :2] + dot_mm[:, :, None, None, None] / layer.lens_mm * moved[:, 2:]
    return seen.reshape(len(dot_mm), 2, KINDS, -1)


def _images(layer: GelLayer, cells: CellGrid) -> list[tuple[int, int]]:
    """Return the number of image cells beyond the grid's low and high end, along x and along y."""
    count = math.ceil(IMAGES_HEIGHTS * layer.height_mm / CELL_MM)

    def beyond(line: Floats, end_mm: float, edge_mm: float) -> int:
        return min(count, len(line)) if abs(end_mm - edge_mm) <= CELL_MM / 2 + 1e-9 else 0

    return [
        (beyond(line, line[0] - CELL_MM / 2, low), beyond(line, line[-1] + CELL_MM / 2, high))
        for line, low, high in zip(cells, layer.edges_mm[:2], layer.edges_mm[2:], strict=True)
    ]


def _motion_by_cells(layer: GelLayer, cells: CellGrid, dot_mm: Floats, images: list[tuple[int, int]]) -> Floats:
    """Return dot motion along x, y and into the layer, (dots, 3, KINDS, rows, columns), with images beyond edges."""
    (left, right), (above, below) = images
    if not (left or right or above or below):
        return _endless_motion(layer, cells, dot_mm)
    lines = [
        line[0] + CELL_MM * np.arange(-low, len(line) + high) for line, (low, high) in zip(cells, images, strict=True)
    ]
    wide = CellGrid(lines[0], lines[1])
    whole = _endless_motion(layer, wide, dot_mm)
    folded = _folded(_folded(whole, left, right), above, below, axis=-2)
    inside = np.s_[..., above : above + len(cells.y_mm), left : left + len(cells.x_mm)]
    with_edges, without = (
        Squeeze(grid.middle_mm.reshape(*grid.shape, 2) / MM_PER_M, layer.height_mm / MM_PER_M).transposed(
            np.moveaxis(moved[:, :2, :PRESSURE], 2, -1)
        )
        for grid, moved in ((cells, folded), (wide, whole))
    )
    # Only the push of pressure changes at the edges, so far from them the result stays exact.
    folded[:, :2, PRESSURE] = whole[:, :2, PRESSURE][inside] + with_edges - without[inside]
    return folded


def _folded(moved: Floats, low: int, high: int, axis: int = -1) -> Floats:
    """Return the effect of the cells, with the images beyond the low and high end of an axis added."""
    turned = np.moveaxis(moved, axis, -1)
    inside = turned[..., low : turned.shape[-1] - high].copy()
    if low:
        inside[..., :low] += turned[..., low - 1 :: -1][..., :low]
    if high:
        inside[..., -high:] += turned[..., : -high - 1 : -1]
    return np.moveaxis(inside, -1, axis)


def _endless_motion(layer: GelLayer, cells: CellGrid, dot_mm: Floats) -> Floats:
    """Return dot motion along x, y and into a layer without edges, per traction, (dots, 3, KINDS, rows, columns)."""
    reach_mm = max(
        float(np.abs(dot_mm[:, axis, None] - line[None]).max(initial=0.0)) for axis, line in enumerate(cells)
    )
    box_mm = math.ceil((reach_mm + APART_HEIGHTS * layer.height_mm) / CELL_MM) * CELL_MM
    points = round(box_mm / CELL_MM) * POINTS_PER_CELL
    waves: Floats = np.asarray(2 * math.pi * np.fft.fftfreq(points, CELL_MM / POINTS_PER_CELL), np.float64)
    answer = _answer(layer, waves, box_mm)
    rows, columns = cells.shape
    picked = np.ix_(np.arange(rows) * POINTS_PER_CELL, np.arange(columns) * POINTS_PER_CELL)
    motion = np.empty((len(dot_mm), 3, KINDS, rows, columns))
    for dot, (x, y) in enumerate(dot_mm):
        phase = np.exp(1j * (waves * (y - cells.y_mm[0])))[:, None] * np.exp(1j * waves * (x - cells.x_mm[0]))
        motion[dot] = np.fft.fft2(answer * phase).real[:, :, picked[0], picked[1]]
    return motion


def _answer(layer: GelLayer, waves_per_mm: Floats, box_mm: float) -> np.ndarray:
    """Return the waves of motion along x, y and into the layer (3) per traction on a cell (KINDS), over ky and kx."""
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
    shifts = below_mm / layer.shear_modulus_pa  # the wave of zero frequency
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
    half = len(waves_per_mm) // 2  # the Nyquist wave, whose two directions coincide: it has no slope
    answer[..., half, :] = answer[..., :, half] = 0.0
    spread = np.sinc(kx * CELL_MM / (2 * math.pi)) * np.sinc(ky * CELL_MM / (2 * math.pi))
    return answer * (spread * (CELL_MM / box_mm) ** 2)


MOST_MODES = 126  # all modes of 63 dots


class DotNoise(NamedTuple):
    """Standard deviations per axis: own_mm of each dot, common_mm of all dots together, and model_share.

    model_share: error because a gel is not exactly the layer model, as a share of the dots' rms motion. The defaults,
    0.05 px, 0.2 px and 5 %, come from a study of simulated contacts with the tracker `stable`, at 0.0329 mm per px.
    """

    own_mm: float = 0.05 * 0.0329
    common_mm: float = 0.2 * 0.0329
    model_share: float = 0.05


class DotModes(NamedTuple):
    """Modes of some dots: basis (modes, 2 dots) of unit rows, and their motion per traction (modes, KINDS, cells)."""

    basis: Floats
    motion: Floats

    @property
    def dots(self) -> int:
        """Number of dots."""
        count: int = self.basis.shape[1] // 2
        return count

    def of(self, moved_mm: Floats) -> Floats:
        """Return the modes (modes,) of displacements (dots, 2), in mm."""
        data: Floats = self.basis @ moved_mm.ravel()
        return data

    def variance_mm2(self, noise: DotNoise, moved_mm: Floats) -> Floats:
        """Return the error variance of each mode (modes,) for dots with displacements (dots, 2)."""
        own_mm2 = noise.own_mm**2 + noise.model_share**2 * float(np.mean(moved_mm**2))
        variance = np.full(len(self.basis), own_mm2)
        variance[:2] += self.dots * noise.common_mm**2
        return variance


def modes_of(motion: Floats) -> DotModes:
    """Return the modes of dots whose motion per traction is (dots, 2, KINDS, cells): mean first, then by motion."""
    dots = len(motion)
    flat = motion.reshape(2 * dots, -1)
    mean = np.zeros((2, 2 * dots))
    mean[0, ::2] = mean[1, 1::2] = 1 / np.sqrt(dots)
    rest = flat - mean.T @ (mean @ flat)
    _, vectors = np.linalg.eigh(rest @ rest.T)  # smallest first; the mean is among those without motion
    kept = min(2 * dots, MOST_MODES) - 2
    others = vectors[:, ::-1][:, :kept].T
    others = others - (others @ mean.T) @ mean
    basis = np.concatenate([mean, others])
    return DotModes(basis, (basis @ flat).reshape(len(basis), *motion.shape[2:]))
