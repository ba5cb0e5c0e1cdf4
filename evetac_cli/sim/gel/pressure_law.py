"""Friction that grows less than in proportion to pressure: its effect on each node.

At a point under the pressure p, friction holds a shear stress of up to c p^(1 - m). With m = 0 this is Coulomb's law;
with m = 1 the gel holds the same stress wherever it touches. A node holds the mean over its cell's points, and c is set
such that all nodes together hold mu N for every m. So the law determines where friction acts, not how much. The edge of
a contact, where pressure vanishes, is then about as strong as its middle, and slips later.

On smooth silicone the local shear stress does not depend on pressure (m = 1). On rough glass it grows much less than
pressure. Sources: Nguyen et al., Non Amontons-Coulomb local friction law of randomly rough contact interfaces with
rubber; Trejo et al., arXiv 1701.08013; both read as abstracts. The m of this gel is unknown. With a constant c instead
of a constant mu, mu would also fall with N (as N^(-2m/3) under a cylinder on this foundation); this is left out.
"""

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.cell_gaps import MEAN, MOST, VARIANCE, CellGaps

ENTRIES = 1024  # entries of the table of powers, over depths relative to the largest
# A cell whose depths are within this share of their mean has the power of the mean, corrected by the variance. With
# both, a node is within 0.3 % of the strongest at an exponent of 0.67, and within 0.01 % at 0.33.
EVEN = 0.25


class PressureLaw:
    """Friction that grows as p^(1 - exponent) with the pressure p; see the module."""

    def __init__(self, exponent: float) -> None:
        """Build the law for an exponent above 0 and up to 1; 0 is Coulomb's law and needs no PressureLaw."""
        self._power = 1.0 - exponent
        self._powers = np.linspace(0.0, 1.0, ENTRIES + 1) ** self._power
        self._powers[0] = 0.0  # no friction without pressure, also for an exponent of 1

    def factor(self, indentation_m: float, gaps: CellGaps, shares: Floats) -> Floats:
        """Return the factor on the friction of each node, (rows, columns); 1 for unloaded nodes.

        shares: each node's share of the normal force at this indentation, as from `contact.pressure`. The mean of the
        factor, weighted by them, is 1.
        """
        if not gaps.least_m < indentation_m:
            return np.ones_like(shares)
        deepest_m = indentation_m - gaps.least_m
        law = (self._powers, self._power)
        factor: Floats = _factor(indentation_m, deepest_m, gaps.sample_m, gaps.summary, shares, law)
        return factor


@njit(cache=True)
def _factor(
    indentation_m: float,
    deepest_m: float,
    sample_m: Floats,
    summary: Floats,
    shares: Floats,
    law: tuple[Floats, float],
) -> Floats:
    rows, columns, count = sample_m.shape
    powers, power = law
    factor = np.ones((rows, columns))
    scale = (len(powers) - 1) / deepest_m
    falls = 0.5 * power * (1.0 - power)  # mean of a power relative to the power of the mean, per relative variance
    whole = 0.0
    for row in range(rows):
        for column in range(columns):
            if not shares[row, column] > 0.0:
                continue
            depth_m = indentation_m - summary[row, column, MEAN]
            if summary[row, column, MOST] - summary[row, column, MEAN] <= EVEN * depth_m:
                strength = _looked_up(powers, depth_m * scale)
                strength -= strength * falls * summary[row, column, VARIANCE] / (depth_m * depth_m)
            else:
                strength = 0.0
                for k in range(count):
                    point_m = indentation_m - sample_m[row, column, k]
                    if point_m > 0.0:
                        strength += _looked_up(powers, point_m * scale)
                strength /= count
            factor[row, column] = strength / shares[row, column]
            whole += strength
    if whole == 0.0:
        return factor
    even = 1.0 / whole
    for row in range(rows):
        for column in range(columns):
            if shares[row, column] > 0.0:
                factor[row, column] *= even
    return factor


@njit(cache=True, inline="always")
def _looked_up(powers: Floats, place: float) -> float:
    """Return the value of a table at a position, linear between its entries."""
    entry = min(int(place), len(powers) - 2)
    return float(powers[entry] + (place - entry) * (powers[entry + 1] - powers[entry]))
