"""The motion of all dots, reduced to modes whose errors are independent, with the variance of those errors.

The error of the dots has three parts: one per dot, one common to all dots, and the deviation of a real gel from the
layer model. An event-based tracker integrates motion, so its error drifts, mostly by the same amount for all dots. The
first two modes are the mean of the dots along x and y; they alone contain the common error.

Reason for modes: with many dots, most patterns of motion are patterns that no traction causes. For 256 dots, 126 modes
keep the information of all 512 numbers, up to less than the error of one dot, at a quarter of the computing time.
"""

from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats

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
