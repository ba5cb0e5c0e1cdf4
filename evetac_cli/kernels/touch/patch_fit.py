"""One linear estimate from several patches that are thought possible: gain, deviations, and what patches disagree in.

The dots tell the cut of the largest pressure only roughly, so each cut's posterior is kept, weighted by how well its
patch explains the dots; differences between patches are part of the deviations. Gaussians are surer of a patch than the
truth allows, so their likelihoods are tempered, and deviations are multiplied by factors that were fitted to known
contacts.
"""

from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats, Ints, Singles
from evetac_cli.kernels.touch.dot_modes import DotModes
from evetac_cli.kernels.touch.dot_motion import CELL_MM, KINDS, PRESSURE
from evetac_cli.kernels.touch.patch import CUTS, patch_of
from evetac_cli.kernels.touch.posterior import posterior

# Sums over the tractions: forces in N; torque about the fit's point from x towards y, and moments of pressure, in N mm.
FORCE_X, FORCE_Y, TORSION, NORMAL, MOMENT_X, MOMENT_Y = range(6)
OF_SHEAR = 3  # sums that need no pressure
TEMPER = 0.1  # of the log likelihoods of patches, chosen on seeds 6000-6011 with CUTS
# Factors on the deviations, with which coverage is least off 68 and 95 %: fitted to simulated contacts of seeds
# 6000-6049, 400 of eight shapes (scripts/touch_contacts.py --calibrate); those of sums are for FORCE_X and so on.
SUM_FACTORS = np.array([1.07, 1.07, 1.23, 2.18, 1.06, 1.06])
TRACTION_FACTORS = np.array([0.82, 0.82, 1.62])
AREA_FACTOR = 1.86  # on how much patches differ in it; against cells above 5 % of the largest pressure
SINCE_FACTOR = 1.06  # on those of forces, for fits without pressure
N_PER_PA = CELL_MM**2 * 1e-6


class PatchFit(NamedTuple):
    """What tells tractions from the modes of dots while a patch lasts; U cells may bear some.

    cells: (U,). patch: (rows, columns), the cells that at least half of the patches have. about_mm: (2,), where torque
    and moments are about; away_mm: (U, 2), of the cells from there. gain: (kinds U + sums, modes), tractions in Pa and
    the sums, per mm. traction_sd_pa: (kinds, rows, columns). sum_sd: (sums,).
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
    """The fit to the patches that tractions (KINDS, rows, columns) within friction tell, for modes (modes,) of dots.

    kinds: KINDS, or without pressure the two of shear, for changes of shear since the dots were pressed.
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
        told = one.gain @ data_mm
        mean[:, patch] += part * told
        square[:, patch] += part * (told**2 + one.variance)
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
    """What the tractions of cells at (cells, 2) from a point count in each sum: (sums, KINDS, cells)."""
    weights = np.zeros((6, KINDS, len(away_mm)))
    x, y = away_mm.T
    weights[FORCE_X, 0] = weights[FORCE_Y, 1] = weights[NORMAL, PRESSURE] = 1.0
    weights[TORSION, 0], weights[TORSION, 1] = -y, x
    weights[MOMENT_X, PRESSURE], weights[MOMENT_Y, PRESSURE] = x, y
    return weights * N_PER_PA
