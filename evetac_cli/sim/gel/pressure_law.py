"""Friction that grows less than in proportion to pressure: what becomes of the friction of each node.

At a spot under the pressure p friction holds a shear of up to c p^(1 - m). m = 0 is Coulomb's law, with m = 1 the gel
holds as much wherever it touches. A node holds what its cell does, in the mean over its points, and c is such that all
nodes together hold mu N, whatever m: the law says where friction is, not how much. So the edge of a contact, where
pressure vanishes, is as strong as its middle, or nearly, and slips later.

Why so: on smooth silicone the local shear stress does not depend on pressure (m = 1), on rough glass it grows strongly
less than pressure (Nguyen et al., Non Amontons-Coulomb local friction law of randomly rough contact interfaces with
rubber; Trejo et al., arXiv 1701.08013; both read as abstracts). m of this gel is not known. With a constant c in place
of a constant mu, mu would fall with N, too (N^(-2m/3) under a cylinder on this foundation): left out.
"""

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.checks import check_range
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.cell_gaps import MEAN, MOST, VARIANCE, CellGaps

ENTRIES = 1024  # of the table of powers, over depths as shares of the largest
# A cell whose depths lie within this share of their mean has the power of the mean, corrected by a variance. With both,
# a node is within 0.3 % of the strongest at an exponent of 0.67, within 0.01 % at 0.33.
EVEN = 0.25


class PressureLaw:
    """Friction under a pressure p goes with p^(1 - exponent); see the module."""

    def __init__(self, exponent: float) -> None:
        """For an exponent above 0 and up to 1; 0 is Coulomb's law, and needs none of this."""
        check_range("pressure_exponent", exponent, 0.0, 1.0, above=True)
        self._power = 1.0 - exponent
        self._powers = np.linspace(0.0, 1.0, ENTRIES + 1) ** self._power
        self._powers[0] = 0.0  # nothing holds where nothing presses, with an exponent of 1 too

    def factor(self, indentation_m: float, gaps: CellGaps, shares: Floats) -> Floats:
        """Factor on the friction of each node, (rows, columns), 1 where nothing is borne.

        shares: of the nodes in the normal force at this indentation, as from `contact.pressure`; weighted by them the
        mean of the factor is 1.
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
    falls = 0.5 * power * (1.0 - power)  # of the mean of a power against the power of the mean, per relative variance
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
    """The value of a table at a place within it, linear between its entries."""
    entry = min(int(place), len(powers) - 2)
    return float(powers[entry] + (place - entry) * (powers[entry + 1] - powers[entry]))
