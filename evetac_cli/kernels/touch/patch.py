"""Find the touched cells of a gel: tractions within friction that explain the dots with the least pressure.

Dots determine two of the three unknowns per wave, so the patch must be found first. The tractions minimise the misfit,
plus the differences of neighbours, plus a cost on pressure; the shear of each cell is limited by friction times its
pressure. The cost makes the patch small, and the friction cone keeps pressure where there is shear. This makes the
pressure too low: the result shows where the gel is pressed, not how hard. The method is accelerated proximal gradient
(FISTA, Beck and Teboulle 2009) with the projection on the cone in closed form. Its unit is the traction that moves a
uniform layer twice as far as the dots have moved (rms).

FRICTION and SMOOTHNESS come from a study, where they were the best of some 25 settings on 40 simulated contacts (seeds
58000-58004). PRESSURE_COST (3 in the study), CUTS and the filling of holes were chosen on contacts of seeds 6000-6014,
by the fit of the patches.
"""

from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.kernels.touch.dot_modes import DotModes
from evetac_cli.kernels.touch.dot_motion import KINDS, PRESSURE

FRICTION = 0.9  # largest shear over pressure of a cell
SMOOTHNESS = 1.0  # weight of the squared differences of neighbours
PRESSURE_COST = 1.5  # weight of the pressure
COLD, WARM = 150, 20  # iterations from zero, and from the previous tractions
CUTS = (0.25, 0.35, 0.45)  # candidate patches: cells above these shares of the largest pressure
_MOST_NEIGHBOURS = 8.0  # largest eigenvalue of the squared differences on a grid


class PatchFinder(NamedTuple):
    """Constants for finding patches from some dots: motion (modes, KINDS cells) in mm per Pa, and its squared norm."""

    motion: Singles
    squared_norm: float
    shape: tuple[int, int]
    unit_pa_per_mm: float  # see the module's docstring


def finder(modes: DotModes, shape: tuple[int, int], even_mm_per_pa: float) -> PatchFinder:
    """Return the constants for some modes and a grid's shape; even_mm_per_pa: layer motion under uniform shear."""
    flat = modes.motion.reshape(len(modes.motion), -1)
    squared = float(np.linalg.eigvalsh(flat @ flat.T)[-1])
    return PatchFinder(flat.astype(np.float32), squared, shape, 2.0 / even_mm_per_pa)


def tractions(
    patch_finder: PatchFinder, data_mm: Floats, variance_mm2: Floats, rms_mm: float, before_pa: Floats | None = None
) -> Floats:
    """Return tractions (KINDS, rows, columns) in Pa within the cone, from the modes of dots (modes,).

    They show where the gel is touched, not how hard. rms_mm: of the dots' motion, above 0. before_pa: a slightly
    earlier result to start from; then fewer iterations are enough.
    """
    unit_pa = patch_finder.unit_pa_per_mm * rms_mm
    own_mm = float(np.sqrt(variance_mm2.min()))
    scale = np.float32(unit_pa / own_mm)
    weight = (variance_mm2.min() / variance_mm2).astype(np.float32)
    data = (data_mm / own_mm).astype(np.float32)
    step = np.float32(1.0 / (patch_finder.squared_norm * float(scale) ** 2 + _MOST_NEIGHBOURS * SMOOTHNESS))
    field = np.zeros((KINDS, *patch_finder.shape), np.float32)
    if before_pa is not None:
        field[:] = before_pa / unit_pa
    ahead, momentum = field, 1.0
    for _ in range(COLD if before_pa is None else WARM):
        misfit = ((patch_finder.motion @ ahead.ravel()) * scale - data) * weight
        slope = ((misfit @ patch_finder.motion) * scale).reshape(field.shape)
        slope += np.float32(SMOOTHNESS) * roughness(ahead)
        slope[PRESSURE] += np.float32(PRESSURE_COST)
        after = within_friction(ahead - step * slope)
        grown = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
        ahead = after + np.float32((momentum - 1) / grown) * (after - field)
        field, momentum = after, grown
    return field.astype(np.float64) * unit_pa


def roughness(field: Singles) -> Singles:
    """Return the gradient of half the summed squared differences of neighbours; the last two axes are the grid."""
    result = np.zeros_like(field)
    across = field[..., 1:] - field[..., :-1]
    result[..., 1:] += across
    result[..., :-1] -= across
    down = field[..., 1:, :] - field[..., :-1, :]
    result[..., 1:, :] += down
    result[..., :-1, :] -= down
    return result


def within_friction(field: Singles) -> Singles:
    """Return the nearest tractions (KINDS, ...) whose shear is at most FRICTION times their pressure."""
    pressure = field[PRESSURE]
    shear = np.hypot(field[0], field[1])
    on_cone = np.maximum((FRICTION * shear + pressure) / (1 + FRICTION**2), 0.0)
    kept = np.where(shear <= FRICTION * pressure, pressure, on_cone)
    result = np.empty_like(field)
    result[:PRESSURE] = field[:PRESSURE] * np.minimum(FRICTION * kept / np.maximum(shear, 1e-30), 1.0)
    result[PRESSURE] = kept
    return result


def patch_of(found_pa: Floats, cut: float) -> Flags:
    """Return the cells (rows, columns) above a share of the largest pressure, and the cells that they enclose."""
    # here: scipy.ndimage takes 0.2 s to load, and commands that only open files load this module
    from scipy import ndimage

    pressure = found_pa[PRESSURE]
    above = (pressure > cut * pressure.max(initial=0.0)) & (pressure > 0)
    return np.asarray(ndimage.binary_fill_holes(above))
