"""The friction law of a node: its coefficient falls with slip speed, with a delay over a memory length.

At a steady slip speed s the coefficient is mu(s) = kinetic + (static - kinetic) exp(-(s / stribeck speed)^2). The
coefficient m of a node follows it: dm/dt = (s + stribeck speed) / memory * (mu(s) - m). It adapts over the memory
length when the node slides, and heals within memory / stribeck speed, 2 to 4 ms, at rest. Without memory m is mu(s) at
once.

A law that depends only on the speed is ill-posed for a simulator. Nodes let go within 10 to 30 us, the step has several
solutions, and the onset of slip does not converge on finer grids. Rough elastomers follow rate-and-state laws (Ronsin
and Labastie Coeyrehourcq 2001), and a pure rate law makes slow sliding unstable on every spring (Ruina 1983, Baumberger
2004). The memory length of this gel is unknown: 20 um, a contact of two asperities, is a guess, and it shifts the
onset.

Friction may vary over a gel: `varied` returns each node's factor on both coefficients, and so on its own coefficient.

Friction may grow less than in proportion to pressure (`PressureLaw`). At a point under the pressure p, it then holds a
shear stress of up to c p^(1 - m). With m = 0 this is Coulomb's law; with m = 1 the gel holds the same stress wherever
it touches. A node holds the mean over its cell's points, and c is set such that all nodes together hold mu N for every
m. So the law determines where friction acts, not how much. The edge of a contact, where pressure vanishes, is then
about as strong as its middle, and slips later. On smooth silicone the local shear stress does not depend on pressure
(m = 1). On rough glass it grows much less than pressure. Sources: Nguyen et al., Non Amontons-Coulomb local friction
law of randomly rough contact interfaces with rubber; Trejo et al., arXiv 1701.08013; both read as abstracts. The m of
this gel is unknown. With a constant c instead of a constant mu, mu would also fall with N (as N^(-2m/3) under a
cylinder on this foundation); this is left out.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.errors import check_range
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.gel_layer import ACROSS, SPRING
from evetac_cli.sim.gel.cell_gaps import MEAN, MOST, VARIANCE, CellGaps

WAVES = 256  # number of waves that make up a smooth random field
NONE_LEFT = 28.0  # beyond it exp(-x^2) is 0 in double precision, and computing it is slow


class FrictionLaw(NamedTuple):
    """Static and kinetic coefficient, the Stribeck velocity in m/s, and the memory length in m."""

    static: float
    kinetic: float
    stribeck: float
    memory: float


@njit(cache=True, _nrt=False)
def coefficient_after(coefficient: float, slip_speed: float, seconds: float, law: FrictionLaw) -> float:
    """Return a node's friction coefficient after some seconds of slip at a constant speed in m/s; exact."""
    if slip_speed == 0.0 and coefficient == law.static:  # as for most nodes; short, so that no call is left of it
        return coefficient
    return float(_adapted(coefficient, slip_speed, seconds, law))


@njit(cache=True, _nrt=False)
def _adapted(coefficient: float, slip_speed: float, seconds: float, law: FrictionLaw) -> float:
    static, kinetic, stribeck, memory = law
    ratio = slip_speed / stribeck
    steady = kinetic
    if not ratio >= NONE_LEFT:
        steady = kinetic + (static - kinetic) * math.exp(-ratio * ratio)
    if memory == 0.0:
        return steady
    return steady + (coefficient - steady) * math.exp(-(slip_speed + stribeck) * seconds / memory)


def half_wavelength_m(
    coefficient_drop: float, pressure_pa: float, memory_m: float, shear_modulus_pa: float, height_m: float
) -> float:
    """Return half the wavelength of the shortest slip pattern that grows while a gel slides; infinity if none grows.

    A pattern of wave number k grows if coefficient_drop * pressure / memory exceeds the gel's stiffness for it. That is
    at least G/H (1 + a x / (1 + a x / s)), with x = (kH)^2 (see kernels/gel_layer). Friction that falls over the memory
    length then overcomes the gel (Rice 1993). A grid must resolve the pattern: use at least 6 nodes, and do not trust
    the onset of slip below 4. The result is 0 without memory, or if patterns of any length grow.
    """
    if memory_m == 0.0:
        return 0.0 if coefficient_drop * pressure_pa > 0.0 else math.inf
    surplus = coefficient_drop * pressure_pa / memory_m * height_m / shear_modulus_pa - 1.0
    if not 0.0 < surplus < SPRING:
        return math.inf if surplus <= 0.0 else 0.0
    return math.pi * height_m * math.sqrt(ACROSS * (1.0 / surplus - 1.0 / SPRING))


def varied(node_xy_m: Floats, spread: float, length_m: float, rng: np.random.Generator) -> Floats:
    """Return a factor on the friction of each node, (rows, columns), that varies smoothly over the gel; its mean is 1.

    Log-normal with a relative standard deviation `spread`; the correlation of points at a distance r is about
    exp(-(r / length_m)^2 / 2). It is a sum of random waves, so a gel is the same on any grid of nodes. ValueError if a
    value is out of range.
    """
    check_range("spread of friction over a gel", spread, 0.0, 1.0)
    check_range("length over which friction varies", length_m, 1e-4, 0.1, "m")
    field = np.zeros(node_xy_m.shape[:2])
    waves = zip(rng.normal(0.0, 1.0 / length_m, (WAVES, 2)), rng.uniform(0.0, 2 * np.pi, WAVES), strict=True)
    for wave_number, phase in waves:
        field += np.cos(node_xy_m @ wave_number + phase)
    factor: Floats = np.exp(math.sqrt(math.log1p(spread * spread) * 2.0 / WAVES) * field)
    factor /= factor.mean()
    return factor


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
