"""The simulated gripper where its drive has no damping or mass, or its links are stiff: whether it closes sanely."""

import math
from dataclasses import dataclass, replace

from evetac_cli.numerics.bounds import FINITE, SURPLUS, TURNS, case_rows, run_case
from evetac_cli.numerics.gel.case import AREA_M2, X_RANGE_M, Y_RANGE_M
from evetac_cli.sim import gripper
from evetac_cli.sim.gel.contact import ForceCurve, force_curve, gap_profile, pad_nodes
from evetac_cli.stages.evaluate import Rows


@dataclass(frozen=True)
class FingerCase:
    """A finger that closes with 60 mA on a cylinder, and the stiffness of its links."""

    name: str
    drive: gripper.Drive
    finger_n_m: float = 1.8e3
    dt_s: float = 1e-2


def finger_cases() -> list[FingerCase]:
    """The extremes, by name."""
    usual = gripper.Drive()
    free = gripper.Drive(damping_n_s_m=0.0, mass_kg=0.0)
    return [
        FingerCase("gripper without damping and mass", free),
        FingerCase("gripper without damping and mass, fingers of 2e8 N/m", free, finger_n_m=2e8),
        FingerCase("gripper with damping of 1e-6 N s/m, fingers of 2e8 N/m", replace(free, damping_n_s_m=1e-6), 2e8),
        FingerCase("gripper of 1e6 kg", gripper.Drive(mass_kg=1e6)),
        FingerCase("gripper, time step 1e-7 s", usual, dt_s=1e-7),
        FingerCase("gripper with 0.7 of its dry friction", replace(usual, friction_n=0.7 * usual.friction_n)),
        FingerCase("gripper with 1.3 of its dry friction", replace(usual, friction_n=1.3 * usual.friction_n)),
    ]


def finger_curve(finger_n_m: float) -> ForceCurve:
    """Force over the fingers' place on a cylinder of 6 cm, with links of this stiffness."""
    gap = gap_profile(pad_nodes(12, 9, X_RANGE_M, Y_RANGE_M), "cylinder", 0.03)
    return force_curve(gap, AREA_M2 / 108, 2e6, 4e-3, finger_n_m, gripper.metres_per_tick(0.06))


def finger_rows(case: FingerCase, steps: int = 200) -> Rows:
    """Close a finger: how often it turns back and, where it came to rest, what pushes it beyond its dry friction."""
    return run_case(case.name, lambda: _finger_rows(case, steps), part="gripper")


def _finger_rows(case: FingerCase, steps: int) -> Rows:
    drive, current_ma = case.drive, 60.0
    curve = finger_curve(case.finger_n_m)
    state = gripper.start(drive, curve, gripper.ticks_at_gap(0.06))
    wrong, turns, sign = 0, 0, 0.0
    for _ in range(steps):
        gripper.step(state, drive, curve, "current", current_ma, case.dt_s)
        wrong += sum(not math.isfinite(value) for value in vars(state).values())
        turns += sign * state.speed_m_s < 0
        sign = state.speed_m_s or sign
    rests = state.speed_m_s == 0.0
    outcome = f"rests at {state.force_n:.3g} N" if rests else f"still closing at {state.force_n:.3g} N"
    measured = [(FINITE, float(wrong)), (TURNS, float(turns))]
    if rests:
        pushed_n = abs(drive.force_per_current_n_ma * current_ma - state.force_n)
        band_n = drive.friction_n + drive.friction_share * state.force_n
        measured.append((SURPLUS, max(pushed_n - band_n, 0.0) / band_n))
    return case_rows(case.name, outcome, measured, part="gripper")
