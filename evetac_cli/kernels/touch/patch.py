"""Find the touched cells of a gel, and the tractions on them with their deviations, from the motion of dots.

`tractions` finds the cells: tractions within friction that explain the dots with the least pressure. Dots determine two
of the three unknowns per wave, so the patch must be found first. The tractions minimise the misfit, plus the
differences of neighbours, plus a cost on pressure; the shear of each cell is limited by friction times its pressure.
The cost makes the patch small, and the friction cone keeps pressure where there is shear. This makes the pressure too
low: the result shows where the gel is pressed, not how hard. The method is accelerated proximal gradient (FISTA, Beck
and Teboulle 2009) with the projection on the cone in closed form. Its unit is the traction that moves a uniform layer
twice as far as the dots have moved (rms).

FRICTION and SMOOTHNESS come from a study, where they were the best of some 25 settings on 40 simulated contacts (seeds
58000-58004). PRESSURE_COST (3 in the study), CUTS and the filling of holes were chosen on contacts of seeds 6000-6014,
by the fit of the patches.

`fit` makes one linear estimate from several candidate patches. The dots determine the cut of the largest pressure only
roughly. So the posterior of each cut is kept, weighted by how well its patch explains the dots, and differences between
patches are part of the deviations. Gaussian likelihoods are too certain about the patch, so they are tempered.
Deviations are multiplied by factors that were fitted to contacts with known forces.

`posterior` is a Gaussian of the tractions on a known patch, with a prior on their fields. In the prior, each kind of
traction has a part that is common to the patch and one that varies over it, with an exponential covariance; pressure is
twice as large as shear. Two scales are chosen by the dots (largest marginal likelihood): the size of all tractions, and
the size of the dots' errors if these are larger than assumed. Motion that no smooth field on the patch explains is thus
treated as error and does not cause rough fields. The result is linear in the dots: a gain that is kept as long as the
patch lasts.

The constants come from a study of simulated contacts (seeds 58000-58105); other lengths gave the same fields.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy import linalg

from evetac_cli.arrays import Flags, Floats, Ints, Singles
from evetac_cli.kernels.touch.dot_motion import CELL_MM, KINDS, PRESSURE, DotModes

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


LENGTH_MM = 1.5  # correlation length of the exponential covariance
COMMON = 4.0  # standard deviation of the common part over that of the varying part
PRESSURE_RATIO = 2.0  # of pressure over shear
# candidate sd of the varying part: from below what dots resolve to above what gels bear
SIZES_PA = np.geomspace(3e2, 2e5, 40)


class PatchPosterior(NamedTuple):
    """Posterior of the tractions on a patch of c cells, of `kinds` kinds each.

    `gain`: (kinds, c, modes) in Pa per mm. `variance`: (kinds, c) in Pa^2. `of_sums` (sums, modes), `sums_covariance`
    (sums, sums): for the requested sums. `log_likelihood`: of the data, up to a constant that all patches share.
    """

    gain: Floats
    variance: Floats
    of_sums: Floats
    sums_covariance: Floats
    log_likelihood: float


def posterior(
    modes: DotModes, cell_mm: Floats, patch: Flags, data_mm: Floats, variance_mm2: Floats, sums: Floats
) -> PatchPosterior:
    """Return the posterior on a patch (cells,) of at least one cell, from modes (modes,) and their error variance.

    cell_mm: (cells, 2). sums: (sums, kinds, cells), weights of the requested sums over the tractions. `kinds` is all
    kinds, or shear alone: omitted tractions are taken to be 0.
    """
    cells = np.nonzero(patch)[0]
    kinds, count = sums.shape[1], len(cells)
    place = np.round((cell_mm[cells] - cell_mm[0]) / CELL_MM).astype(np.intp)
    x, y = np.abs(place[:, None] - place).transpose(2, 0, 1)
    varies = _variation(int(place.max()) + 1)[y, x]
    weight = np.where(np.arange(kinds) == PRESSURE, PRESSURE_RATIO**2, 1.0)
    whiten = 1 / np.sqrt(variance_mm2)
    white = modes.motion[:, :kinds, cells] * whiten[:, None, None]
    # Single precision halves the time of the slowest part; accurate sums need double precision, see below.
    single = white.astype(np.float32)
    shared = ((single @ varies.astype(np.float32)) * weight[:, None].astype(np.float32)).reshape(len(white), -1)
    told_by = shared @ single.reshape(len(white), -1).T  # covariance of the data without their errors
    values, vectors = linalg.eigh(told_by, driver="evd", check_finite=False)
    values = np.maximum(values.astype(np.float64), 0.0)
    turned = vectors.T @ (whiten * data_mm)
    spread = SIZES_PA[:, None] ** 2 * values + 1.0
    misfits = np.maximum(1.0, (turned**2 / spread).mean(axis=1))
    likelihood = -0.5 * (turned**2 / (misfits[:, None] * spread) + np.log(misfits[:, None] * spread)).sum(axis=1)
    best = int(np.argmax(likelihood))
    size, spread, misfit = SIZES_PA[best] ** 2, spread[best], misfits[best]
    turned_shared = vectors.T @ shared
    scaled_shared = (size / spread).astype(np.float32)[:, None] * turned_shared
    gain = scaled_shared.T @ (vectors.T * whiten.astype(np.float32))
    before = size * np.repeat(weight * varies[0, 0], count)
    variance = misfit * np.maximum(before - size * (scaled_shared * turned_shared).sum(axis=0), 0.0)

    picked = sums[:, :, cells]
    flat = picked.reshape(len(sums), -1)
    weighed = ((picked @ varies) * weight[:, None]).reshape(len(sums), -1)
    seen = white.reshape(len(white), -1) @ weighed.T
    left = np.linalg.solve(size * told_by.astype(np.float64) + np.eye(len(data_mm)), seen)
    covariance = misfit * size * (weighed @ flat.T - size * seen.T @ left)
    return PatchPosterior(
        gain.reshape(kinds, count, -1),
        variance.reshape(kinds, count),
        flat @ gain,
        covariance,
        float(likelihood[best]),
    )


# Sums over the tractions: forces in N; torque from x towards y, and moments of pressure, in N mm about one point.
FORCE_X, FORCE_Y, TORSION, NORMAL, MOMENT_X, MOMENT_Y = range(6)
OF_SHEAR = 3  # sums that need no pressure
TEMPER = 0.1  # factor on the patches' log likelihoods, chosen on seeds 6000-6011 together with CUTS
# Factors on the deviations that bring coverage closest to 68 and 95 %. Fitted to 400 simulated contacts of eight
# shapes, seeds 6000-6049 (scripts/studies/touch/contacts.py --calibrate). Those of sums are in the order FORCE_X,
# FORCE_Y, ...
SUM_FACTORS = np.array([1.07, 1.07, 1.23, 2.18, 1.06, 1.06])
TRACTION_FACTORS = np.array([0.82, 0.82, 1.62])
AREA_FACTOR = 1.86  # on the patches' sd of the area; truth: cells above 5 % of the largest pressure
SINCE_FACTOR = 1.06  # further factor on the deviations of forces for fits without pressure
N_PER_PA = CELL_MM**2 * 1e-6  # force on a cell per traction


@cache
def _variation(cells: int) -> Floats:
    """Return the prior covariance of tractions that are this many rows and columns apart, (cells, cells)."""
    away_mm = np.arange(cells) * CELL_MM
    variation: Floats = np.exp(-np.hypot(away_mm[:, None], away_mm) / LENGTH_MM) + COMMON**2
    return variation


class PatchFit(NamedTuple):
    """Linear estimate of tractions from the modes of dots, valid while the patch lasts; U cells may bear traction.

    `cells`: (U,). `patch`: (rows, columns), cells in at least half of the weighted candidates. `about_mm`: (2,),
    reference point of torque and moments. `away_mm`: (U, 2), cells relative to that point. `gain`: (kinds U + sums,
    modes), tractions in Pa and the sums, per mm. `traction_sd_pa`: (kinds, rows, columns). `sum_sd`: (sums,).
    """

    cells: Ints
    patch: Flags
    area_mm2: float
    area_sd_mm2: float
    about_mm: Floats
    away_mm: Singles
    gain: Singles
    traction_sd_pa: Floats
    sum_sd: Floats


def fit(
    modes: DotModes, cell_mm: Floats, found_pa: Floats, data_mm: Floats, variance_mm2: Floats, kinds: int = KINDS
) -> PatchFit:
    """Fit the patches given by tractions within friction (KINDS, rows, columns) to the modes (modes,) of dots.

    kinds: KINDS; or the two of shear without pressure, for changes of shear since the dots were pressed.
    """
    patches = np.stack([patch_of(found_pa, cut).ravel() for cut in CUTS])
    pressure = found_pa[PRESSURE].ravel()
    about_mm = pressure @ cell_mm / pressure.sum()
    weights = weights_of_sums(cell_mm - about_mm)[: OF_SHEAR if kinds < KINDS else None, :kinds]
    each = [posterior(modes, cell_mm, patch, data_mm, variance_mm2, weights) for patch in patches]
    likely = np.array([one.log_likelihood for one in each])
    share = np.exp(TEMPER * (likely - likely.max()))
    share /= share.sum()

    cells = np.nonzero(patches.any(axis=0))[0]
    gain = np.zeros((kinds, len(cells), len(data_mm)), np.float32)
    mean, square = np.zeros((2, kinds, len(cells)))
    for patch, one, part in zip(patches[:, cells], each, share.astype(np.float32), strict=True):
        gain[:, patch] += part * one.gain
        estimate = one.gain @ data_mm
        mean[:, patch] += part * estimate
        square[:, patch] += part * (estimate**2 + one.variance)
    sums = np.stack([one.of_sums @ data_mm for one in each])
    spread = sums - share @ sums
    variance = share @ (np.stack([np.diag(one.sums_covariance) for one in each]) + spread**2)
    areas = patches.sum(axis=1) * CELL_MM**2
    shape, patch = found_pa.shape[1:], np.asarray(share @ patches >= 0.5)
    traction_sd = np.zeros((kinds, len(cell_mm)))
    traction_sd[:, cells] = np.sqrt(np.maximum(square - mean**2, 0.0)) * TRACTION_FACTORS[:kinds, None]
    sums_gain = np.tensordot(share, [one.of_sums for one in each], axes=1).astype(np.float32)
    return PatchFit(
        cells,
        patch.reshape(shape),
        float(patch.sum() * CELL_MM**2),
        AREA_FACTOR * float(np.sqrt(share @ (areas - share @ areas) ** 2)),
        about_mm,
        (cell_mm[cells] - about_mm).astype(np.float32),
        np.concatenate([gain.reshape(-1, len(data_mm)), sums_gain]),
        traction_sd.reshape(kinds, *shape),
        np.sqrt(np.maximum(variance, 0.0)) * SUM_FACTORS[: len(variance)] * (SINCE_FACTOR if kinds < KINDS else 1.0),
    )


def weights_of_sums(away_mm: Floats) -> Floats:
    """Return the weights of the tractions of cells at (cells, 2) from a point in each sum: (sums, KINDS, cells)."""
    weights = np.zeros((6, KINDS, len(away_mm)))
    x, y = away_mm.T
    weights[FORCE_X, 0] = weights[FORCE_Y, 1] = weights[NORMAL, PRESSURE] = 1.0
    weights[TORSION, 0], weights[TORSION, 1] = -y, x
    weights[MOMENT_X, PRESSURE], weights[MOMENT_Y, PRESSURE] = x, y
    return weights * N_PER_PA
