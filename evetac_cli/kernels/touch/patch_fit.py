"""One linear estimate from several candidate patches: gain, deviations, and the disagreement of the patches.

The dots determine the cut of the largest pressure only roughly. So the posterior of each cut is kept, weighted by how
well its patch explains the dots, and differences between patches are part of the deviations. Gaussian likelihoods are
too certain about the patch, so they are tempered. Deviations are multiplied by factors that were fitted to contacts
with known forces.
"""

from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats, Ints, Singles
from evetac_cli.kernels.touch.dot_modes import DotModes
from evetac_cli.kernels.touch.dot_motion import CELL_MM, KINDS, PRESSURE
from evetac_cli.kernels.touch.patch import CUTS, patch_of
from evetac_cli.kernels.touch.posterior import posterior

# Sums over the tractions: forces in N; torque from x towards y, and moments of pressure, in N mm about one point.
FORCE_X, FORCE_Y, TORSION, NORMAL, MOMENT_X, MOMENT_Y = range(6)
OF_SHEAR = 3  # sums that need no pressure
TEMPER = 0.1  # factor on the patches' log likelihoods, chosen on seeds 6000-6011 together with CUTS
# Factors on the deviations that bring coverage closest to 68 and 95 %. Fitted to 400 simulated contacts of eight
# shapes, seeds 6000-6049 (scripts/touch_contacts.py --calibrate). Those of sums are in the order FORCE_X, FORCE_Y, ...
SUM_FACTORS = np.array([1.07, 1.07, 1.23, 2.18, 1.06, 1.06])
TRACTION_FACTORS = np.array([0.82, 0.82, 1.62])
AREA_FACTOR = 1.86  # on the patches' sd of the area; truth: cells above 5 % of the largest pressure
SINCE_FACTOR = 1.06  # further factor on the deviations of forces for fits without pressure
N_PER_PA = CELL_MM**2 * 1e-6  # force on a cell per traction


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
