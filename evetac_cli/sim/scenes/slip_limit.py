"""The normal force at which a held object slides, and whether the grid of nodes resolves how it does."""

import math

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.scenes.second_finger import SecondFinger
from evetac_cli.sim.setup.sampling import SampledTrial

GRAVITY_M_S2 = 9.81


def slip_limit_n(
    sampled: SampledTrial,
    curve: contact.ForceCurve,
    gap_m: Floats,
    node_xy_m: Floats,
    friction_factor: Floats | None,
    second: SecondFinger | None,
) -> float:
    """Normal force at which the object slides: its weight, and the moment of one that hangs beside the fingers.

    Force and moment that friction can resist together lie on an ellipse (Howe and Cutkosky, Int. J. Robotics Research
    15, 1996). The contact is that under the force without the moment, which is smaller, and at least one node: a square
    resists a moment of 0.38 of its side. Where friction varies over the gel or is another on the second finger, what
    counts is that of this contact.
    """
    limit_n = sampled.mass_kg * GRAVITY_M_S2 / (2 * sampled.static_friction)
    if friction_factor is not None or second is not None:
        limit_n /= _friction_of_pads(limit_n, curve, gap_m, friction_factor, second)
    if sampled.lever_m == 0.0:
        return limit_n
    indentation_m = float(np.interp(limit_n, curve.force_n, curve.indentation_m))
    arm_m = contact.turning_arm(node_xy_m, contact.pressure(indentation_m, gap_m, limit_n))
    arm_m = max(arm_m, 0.38 * math.sqrt(contact.cell_area(node_xy_m)))
    return limit_n * math.hypot(1.0, sampled.lever_m / arm_m)


def nodes_of_slip(
    limit_n: float, curve: contact.ForceCurve, gap_m: Floats, state: gel.GelState, friction: gel.Friction
) -> float:
    """Half the wavelength of unstable slip in nodes of the grid, where pressure is highest at the slip limit.

    Infinity where slip is stable there. A recording has it of nodes that slipped (truth/slip_half_wavelength_nodes).
    """
    indentation_m = float(np.interp(limit_n, curve.force_n, curve.indentation_m))
    most_n = float(contact.pressure(indentation_m, gap_m, limit_n).max())
    return gel.slip_half_wavelength_nodes(state, friction, most_n)


def _friction_of_pads(
    force_n: float,
    curve: contact.ForceCurve,
    gap_m: Floats,
    friction_factor: Floats | None,
    second: SecondFinger | None,
) -> float:
    """Friction of both pads over that of the trial, in the mean over their pressure under a force."""
    pads = [(friction_factor, curve.indentation_m)]
    if second is not None and curve.second_indentation_m is not None:
        pads.append((second.friction_factor, curve.second_indentation_m))
    means = []
    for factor, table_m in pads:
        shares = contact.pressure(float(np.interp(force_n, curve.force_n, table_m)), gap_m, 1.0)
        means.append(1.0 if factor is None else float((shares * factor).sum()) or 1.0)
    return float(np.mean(means)) or 1.0
