"""The normal force at which a held object slides, and whether the grid of nodes resolves the slip."""

import math

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.gel.cell_gaps import CellGaps
from evetac_cli.sim.gel.pressure_law import PressureLaw
from evetac_cli.sim.scenes.second_finger import SecondFinger
from evetac_cli.sim.setup.sampling import SampledTrial

GRAVITY_M_S2 = 9.81


def slip_limit_n(
    sampled: SampledTrial,
    curve: contact.ForceCurve,
    gaps: CellGaps,
    node_xy_m: Floats,
    friction_factor: Floats | None,
    second: SecondFinger | None,
    law: PressureLaw | None,
) -> float:
    """Return the normal force at which the object slides under its weight and, if it hangs off-centre, its moment.

    The forces and moments that friction can resist together form an ellipse (Howe and Cutkosky, Int. J. Robotics
    Research 15, 1996). The contact area is that under the force without the moment, which is smaller, and at least one
    node: a square resists a moment of 0.38 of its side. If friction varies over the gel, or differs on the second
    finger, the friction within this contact counts.
    """
    limit_n = sampled.mass_kg * GRAVITY_M_S2 / (2 * sampled.static_friction)
    if friction_factor is not None or second is not None:
        limit_n /= _friction_of_pads(limit_n, curve, gaps, friction_factor, second, law)
    if sampled.lever_m == 0.0:
        return limit_n
    arm_m = contact.turning_arm(node_xy_m, _gripping(limit_n, curve.force_n, curve.indentation_m, gaps, law))
    arm_m = max(arm_m, 0.38 * math.sqrt(contact.cell_area(node_xy_m)))
    return limit_n * math.hypot(1.0, sampled.lever_m / arm_m)


def nodes_of_slip(
    force_n: float,
    curve: contact.ForceCurve,
    gaps: CellGaps,
    state: gel.GelState,
    friction: gel.Friction,
    law: PressureLaw | None,
) -> float:
    """Return half the wavelength of unstable slip, in nodes, at the highest pressure under a normal force.

    Infinity if slip is stable there. A recording contains it for nodes that slipped (truth/slip_half_wavelength_nodes).
    """
    most_n = force_n * float(_gripping(force_n, curve.force_n, curve.indentation_m, gaps, law).max())
    return gel.slip_half_wavelength_nodes(state, friction, most_n)


def _friction_of_pads(
    force_n: float,
    curve: contact.ForceCurve,
    gaps: CellGaps,
    friction_factor: Floats | None,
    second: SecondFinger | None,
    law: PressureLaw | None,
) -> float:
    """Return the mean friction of both pads relative to the trial's, weighted by each node's holding force."""
    pads = [(friction_factor, curve.indentation_m)]
    if second is not None and curve.second_indentation_m is not None:
        pads.append((second.friction_factor, curve.second_indentation_m))
    means = []
    for factor, table_m in pads:
        shares = _gripping(force_n, curve.force_n, table_m, gaps, law)
        means.append(1.0 if factor is None else float((shares * factor).sum()) or 1.0)
    return float(np.mean(means)) or 1.0


def _gripping(force_n: float, forces_n: Floats, table_m: Floats, gaps: CellGaps, law: PressureLaw | None) -> Floats:
    """Return each node's share of the friction limit of a contact under a force, for uniform friction of the gel."""
    indentation_m = float(np.interp(force_n, forces_n, table_m))
    shares = contact.pressure(indentation_m, gaps, 1.0)
    return shares if law is None else shares * law.factor(indentation_m, gaps, shares)
