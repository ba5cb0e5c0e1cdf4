"""Tractions on a known patch, from dots: mean and covariance of a Gaussian with a prior on the fields of patches.

In the prior, each kind of traction has a part that is common to the patch and one that varies over it, with an
exponential covariance; pressure is twice as large as shear. Two scales are chosen by the dots (largest marginal
likelihood): the size of all tractions, and the size of the dots' errors if these are larger than assumed. Motion that
no smooth field on the patch explains is thus treated as error and does not cause rough fields. The result is linear in
the dots: a gain that is kept as long as the patch lasts.

The constants come from a study of simulated contacts (seeds 58000-58105); other lengths gave the same fields.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.touch.dot_modes import DotModes
from evetac_cli.kernels.touch.dot_motion import PRESSURE

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
    away = cell_mm[cells, None] - cell_mm[cells]
    varies = np.exp(-np.hypot(away[..., 0], away[..., 1]) / LENGTH_MM) + COMMON**2
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
