"""The motion of all dots as a few numbers whose errors are independent, and how large these errors are.

What dots are off by has a part of each dot's own, a part that all share, and what the gel is not quite like the layer.
A tracker of events adds up motion, so its error drifts, most of it alike for all dots. In the modes below, the first
two are the dots' mean along x and y and take the common error alone.

Why modes: with many dots most patterns of their motion are ones that no traction makes. Of 256 dots, 126 modes keep
what 512 numbers tell, but for less than what a dot is off by, at a quarter of the cost.
"""

from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats

MOST_MODES = 126  # all that 63 dots have


class DotNoise(NamedTuple):
    """Standard deviations per axis: own_mm of each dot, common_mm of all dots together, and model_share.

    model_share: of the dots' motion (rms), for all that a gel is not quite like the layer. 0.05 px, 0.2 px and 5 % are
    those of a study of simulated contacts with the tracker `stable`, at 0.0329 mm per px.
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
        """How many dots these are of."""
        count: int = self.basis.shape[1] // 2
        return count

    def of(self, moved_mm: Floats) -> Floats:
        """The modes (modes,) of dots that moved (dots, 2), in mm."""
        data: Floats = self.basis @ moved_mm.ravel()
        return data

    def variance_mm2(self, noise: DotNoise, moved_mm: Floats) -> Floats:
        """The variance of each mode's error (modes,) after dots have moved so far (dots, 2)."""
        own_mm2 = noise.own_mm**2 + noise.model_share**2 * float(np.mean(moved_mm**2))
        variance = np.full(len(self.basis), own_mm2)
        variance[:2] += self.dots * noise.common_mm**2
        return variance


def modes_of(motion: Floats) -> DotModes:
    """The modes of dots whose motion per traction is (dots, 2, KINDS, cells): their mean, then what tractions move."""
    dots = len(motion)
    flat = motion.reshape(2 * dots, -1)
    mean = np.zeros((2, 2 * dots))
    mean[0, ::2] = mean[1, 1::2] = 1 / np.sqrt(dots)
    rest = flat - mean.T @ (mean @ flat)
    _, vectors = np.linalg.eigh(rest @ rest.T)  # smallest first: the mean is among those that nothing moves
    kept = min(2 * dots, MOST_MODES) - 2
    others = vectors[:, ::-1][:, :kept].T
    others = others - (others @ mean.T) @ mean
    basis = np.concatenate([mean, others])
    return DotModes(basis, (basis @ flat).reshape(len(basis), *motion.shape[2:]))
