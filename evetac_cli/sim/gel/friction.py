"""The law of friction of a node: its coefficient falls with slip speed, and follows over a memory length.

At a steady slip speed s the coefficient is mu(s) = kinetic + (static - kinetic) exp(-(s / stribeck speed)^2). A node's
own coefficient m follows it: dm/dt = (s + stribeck speed) / memory * (mu(s) - m). It forgets over the memory length
when it slides and heals within memory / stribeck speed, 2 to 4 ms, at rest; without memory m is mu(s) at once.

Why so: a law of the speed alone is no law for a simulator. Nodes let go within 10 to 30 us, the step has several
solutions, and the onset of slip does not converge on finer grids. Rough elastomers do follow laws of state and rate
(Ronsin and Labastie Coeyrehourcq 2001), and one of the rate alone makes slow sliding unstable on every spring (Ruina
1983, Baumberger 2004). The memory length of this gel is not known: 20 um, a contact of two asperities, is a guess, and
it shifts onset.

Over a gel friction need not be even: `varied` gives each node a factor on both coefficients, and with them on its own.
"""

import math

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.checks import check_range
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.gel_layer import ACROSS, SPRING

WAVES = 256  # that make up a smooth random field
NONE_LEFT = 28.0  # beyond it exp(-x^2) is 0 in double precision, and to find that out takes long


@njit(cache=True, _nrt=False)
def coefficient_after(
    coefficient: float, slip_speed: float, seconds: float, static: float, kinetic: float, stribeck: float, memory: float
) -> float:
    """Friction coefficient of a node after so many seconds of slip at a constant speed in m/s: exact."""
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
    """Half the wavelength of the shortest pattern of slip that grows where a gel slides; infinity where none does.

    A pattern of wave number k grows where coefficient_drop * pressure / memory is above the gel's stiffness to it, at
    the least G/H (1 + a x / (1 + a x / s)), x = (kH)^2 (see kernels/gel_layer): friction that falls over the memory
    length beats the gel (Rice 1993). A grid has to resolve it: ask for 6 nodes, and do not trust the onset of slip
    below 4. 0 without memory, and where patterns of any length grow.
    """
    if memory_m == 0.0:
        return 0.0 if coefficient_drop * pressure_pa > 0.0 else math.inf
    surplus = coefficient_drop * pressure_pa / memory_m * height_m / shear_modulus_pa - 1.0
    if not 0.0 < surplus < SPRING:
        return math.inf if surplus <= 0.0 else 0.0
    return math.pi * height_m * math.sqrt(ACROSS * (1.0 / surplus - 1.0 / SPRING))


def varied(node_xy_m: Floats, spread: float, length_m: float, rng: np.random.Generator) -> Floats:
    """Factor on the friction of each node, (rows, columns), that varies smoothly over the gel; its mean is 1.

    Log-normal with a relative standard deviation `spread`; places a distance r apart are correlated by about
    exp(-(r / length_m)^2 / 2). A sum of random waves, so that a gel is the same on any grid of nodes. ValueError where
    a value is out of range.
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
