"""What scenes share: the time step, the pad of gel nodes, and the gel of a sensor."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.sim.gel import contact, gel

STEP_S = 1e-3
THETA = 0.55  # of the time step: second order but for a trace, and no ringing after a stick event
LOSS_AT_HZ = 100.0  # where a sensor's loss tangent is meant
PAD_M = (20e-3, 15e-3)  # the part of a cut gel that can touch, along x and y


def pad(scene: Mapping[str, Any], sensor_row: Mapping[str, Any]) -> NDArray[np.float64]:
    """Gel nodes (rows, columns, 2) in m: a cut gel ends at the window, a closed one at the edge of the frame."""
    columns, rows = scene["gel"]["nodes"]
    mm_per_px = float(sensor_row["mm_per_px"])
    cut_m = (sensor_row["window_px"][0] - FRAME_PX[0] / 2) * mm_per_px * 1e-3
    end_m = cut_m if scene["gel"]["cut"] else FRAME_PX[0] / 2 * mm_per_px * 1e-3
    more = (end_m - cut_m) / PAD_M[0]
    return contact.pad_nodes(
        round(columns * (1 + more)), rows, (cut_m - PAD_M[0], end_m), (-PAD_M[1] / 2, PAD_M[1] / 2)
    )


def material(sensor_row: Mapping[str, Any]) -> gel.GelMaterial:
    """The gel of a sensor: `GelMaterial` but for its shear modulus, and its loss_tangent where the row names one.

    The loss tangent of spring, dashpot tau and Maxwell arm (share g, time t) at w is
    (w tau + g wt / (1 + wt^2)) / (1 + g wt^2 / (1 + wt^2)); it is met by the choice of tau.
    """
    usual = gel.GelMaterial(shear_modulus_pa=float(sensor_row["shear_modulus_pa"]))
    if "loss_tangent" not in sensor_row:
        return usual
    omega = 2 * np.pi * LOSS_AT_HZ
    turn = omega * usual.maxwell_time_s
    stored = 1 + usual.maxwell_share * turn**2 / (1 + turn**2)
    lost_in_arm = usual.maxwell_share * turn / (1 + turn**2)
    viscous_time_s = (float(sensor_row["loss_tangent"]) * stored - lost_in_arm) / omega
    return replace(usual, viscous_time_s=viscous_time_s)
