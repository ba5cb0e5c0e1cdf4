"""The print on a gel under two lights: one shows the print; the other does not pass the print and washes it out.

A pixel that receives a share r of the first light's full brightness (1 on bare gel, exp(-log_contrast) on ink) and all
of the second has the log brightness ln(first * r + second). Relative to bare gel, which is the zero of a camera's
tables, that is ln((first * r + second) / (first + second)).
"""

import math

import numpy as np
from numpy.typing import NDArray


class PrintContrast:
    """A camera's tables of dots, rewritten in place for each pair of lights."""

    def __init__(self, levels: list[NDArray[np.float32]]) -> None:
        """Take tables of log brightness under the first light alone; they are changed in place afterwards."""
        self._tables = levels
        self._shares = [np.exp(level.astype(np.float64)) for level in levels]

    def show(self, first: float, second: float) -> float:
        """Write the tables for two lights, the second above 0; return the log brightness of bare gel."""
        for table, share in zip(self._tables, self._shares, strict=True):
            table[:] = np.log((first * share + second) / (first + second))
        return math.log(first + second)
