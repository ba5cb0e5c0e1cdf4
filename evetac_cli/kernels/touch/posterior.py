"""Tractions on a known patch, from dots: mean and covariance of a Gaussian that knows how patches tend to look.

Before the dots are seen, each kind of traction has a part that is common to the patch and one that varies over it, with
an exponential covariance; pressure is twice as large as shear. By how much all of it is to be multiplied, and by how
much the errors of the dots, if they are larger than told, the dots decide (largest marginal likelihood): what no even
field on the patch explains is error, and makes no wild field. What comes out is linear in the dots: a gain, kept as
long as the patch is.

The constants are those of a study of simulated contacts (seeds 58000-58105), where other lengths gave the same fields.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.touch.dot_modes import DotModes
from evetac_cli.kernels.touch.dot_motion import PRESSURE

LENGTH_MM = 1.5  # of the exponential covariance
COMMON = 4.0  # sd of the common part over that of the varying one
PRESSURE_RATIO = 2.0  # of pressure over shear
SIZES_PA = np.geomspace(3e2, 2e5, 40)  # sd of the varying part: from less than dots show to more than gels bear


class PatchPosterior(NamedTuple):
    """What modes of dots tell of the tractions on a patch of c cells, of `kinds` kinds each.

    gain: (kinds, c, modes) in Pa per mm. variance: (kinds, c) in Pa^2. of_sums (sums, modes), sums_covariance (sums,
    sums): of the sums asked for. log_likelihood: of the data, up to a constant that all patches share.
    """

    gain: Floats
    variance: Floats
    of_sums: Floats
    sums_covariance: Floats
    log_likelihood: float


def posterior(
    modes: DotModes, cell_mm: Floats, patch: Flags, data_mm: Floats, variance_mm2: Floats, sums: Floats
) -> PatchPosterior:
    """The posterior on a patch (cells,) of one cell or more, from modes (modes,) and the variance of their errors.

    cell_mm: (cells, 2). sums: (sums, kinds, cells), weights of sums over the tractions that are asked for, of all kinds
    or of shear alone: what it leaves out is taken to be 0.
    """
    chosen = np.nonzero(patch)[0]
    kinds, count = sums.shape[1], len(chosen)
    away = cell_mm[chosen, None] - cell_mm[chosen]
    varies = np.exp(-np.hypot(away[..., 0], away[..., 1]) / LENGTH_MM) + COMMON**2
    weight = np.where(np.arange(kinds) == PRESSURE, PRESSURE_RATIO**2, 1.0)
    whiten = 1 / np.sqrt(variance_mm2)
    white = modes.motion[:, :kinds, chosen] * whiten[:, None, None]
    # Single precision halves the time of what takes longest; sums that dots tell well need double, see below.
    single = white.astype(np.float32)
    shared = ((single @ varies.astype(np.float32)) * weight[:, None].astype(np.float32)).reshape(len(white), -1)
    told_by = shared @ single.reshape(len(white), -1).T  # covariance of the data, but for their errors
    values, vectors = linalg.eigh(told_by, driver="evd", check_finite=False)
    values = np.maximum(values.astype(np.float64), 0.0)
    turned = vectors.T @ (whiten * data_mm)
    spread = SIZES_PA[:, None] ** 2 * values + 1.0
    misfits = np.maximum(1.0, (turned**2 / spread).mean(axis=1))
    likelihood = -0.5 * (turned**2 / (misfits[:, None] * spread) + np.log(misfits[:, None] * spread)).sum(axis=1)
    best = int(np.argmax(likelihood))
    size, spread, misfit = SIZES_PA[best] ** 2, spread[best], misfits[best]
    turned_shared = vectors.T @ shared
    told = (size / spread).astype(np.float32)[:, None] * turned_shared
    gain = told.T @ (vectors.T * whiten.astype(np.float32))
    before = size * np.repeat(weight * varies[0, 0], count)
    variance = misfit * np.maximum(before - size * (told * turned_shared).sum(axis=0), 0.0)

    picked = sums[:, :, chosen]
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
