"""The part `sim` of `evaluate stability`: the simulated gel, gripper and camera in extreme cases.

The gripper cases are drives without damping or mass, and stiff links; they check that a finger closes properly.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from evetac_cli.evaluate.rows import Extent
from evetac_cli.evaluate.stability.bounds import (
    FINITE,
    SURPLUS,
    TURNS,
    case_rows,
    refusal,
    run_case,
)
from evetac_cli.evaluate.stability.camera import camera_cases, camera_rows, wrong_models, wrong_slices
from evetac_cli.evaluate.stability.gel import gel_cases, gel_rows, random_case
from evetac_cli.evaluate.stability.gel_case import AREA_M2, COULOMB, X_RANGE_M, Y_RANGE_M
from evetac_cli.evaluate.stability.onset import onset_cases
from evetac_cli.jobs import Rows
from evetac_cli.sim import gripper
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.contact import ForceCurve, force_curve, gap_profile, pad_nodes

THETAS = Extent[tuple[float, ...]](quick=(0.51,), full=(0.51, 1.0, 0.5))
GEL_STEPS = Extent(quick=100, full=1000)
CAMERA_SLICES = 10
RANDOM_CASES = Extent(quick=10, full=200)


def cases(seed: int, full: bool) -> list[Callable[[], Rows]]:
    """Return every case of gel, gripper and camera; `full` uses every theta, ten times the steps, more random cases."""
    timed_cases = [(case, 0.0) for case in gel_cases()] + onset_cases()
    timed_cases += [(random_case(seed, number), 0.0) for number in range(RANDOM_CASES.pick(full))]
    runs: list[Callable[[], Rows]] = []
    for theta in THETAS.pick(full):
        for case, slides_within_s in timed_cases:
            renamed = replace(case, name=f"{case.name}, theta {theta:g}") if full else case
            runs.append(partial(gel_rows, renamed, GEL_STEPS.pick(full), theta, slides_within_s))
    runs += [partial(finger_rows, case) for case in finger_cases()]
    runs += [partial(camera_rows, case, CAMERA_SLICES, seed) for case in camera_cases()]
    runs += [partial(refusal, name, call, part="nonsense") for name, call in nonsense()]
    return runs


def nonsense() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield calls with invalid values, by name; every one must be refused."""
    bad = (math.nan, math.inf, -1.0)
    nodes = pad_nodes(8, 6, X_RANGE_M, Y_RANGE_M)

    def gel_state() -> gel.GelState:
        return gel.start(nodes, gel.GelMaterial(), 0.1, 4e-5)

    def step(**changes: Any) -> object:
        arguments: dict[str, Any] = {"nodal_force_n": np.full((6, 8), 0.04), "body_force_n": (0.98, 0.0, 0.0)}
        arguments |= {"friction": COULOMB, "dt_s": 1e-3}
        return gel.step(gel_state(), **(arguments | changes))

    parts: tuple[tuple[str, Any, dict[str, float]], ...] = (
        ("gel", gel.GelMaterial, {}),
        ("friction", gel.Friction, {"static": 0.8, "kinetic": 0.5}),
        ("gripper", gripper.Drive, {}),
    )
    for what, kind, required in parts:
        for item in fields(kind):
            if item.type is float:
                for value in bad:
                    yield f"{what}, {item.name} {value:g}", partial(kind, **{**required, item.name: value})
    for value in (*bad, 0.0):
        yield f"object of {value:g} kg", partial(gel.start, nodes, gel.GelMaterial(), value, 4e-5)
        yield f"moment of inertia {value:g}", partial(gel.start, nodes, gel.GelMaterial(), 0.1, value)
        yield f"time step {value:g} s", partial(step, dt_s=value)
    for value in bad:
        yield f"grip of {value:g} N", partial(step, nodal_force_n=np.full((6, 8), value))
        yield f"theta {value:g}", partial(step, theta=value)
        yield f"gripper, time step {value:g} s", partial(_step_gripper, 10.0, value)
        yield from wrong_models(value)
    for value in (math.nan, math.inf, -math.inf):
        yield f"force of {value:g} N on the object", partial(step, body_force_n=(value, 0.0, 0.0))
        yield f"prescribed speed {value:g} m/s", partial(step, prescribed_twist=(value, 0.0, 0.0))
        yield f"gripper, command {value:g}", partial(_step_gripper, value, 1e-3)
        yield from wrong_slices(value)
    yield "nodes that are no regular grid", partial(gel.start, nodes**2 + nodes, gel.GelMaterial(), 0.1, 4e-5)
    yield "a state overwritten with NaN", partial(_step_from_nan, gel_state())


def _step_from_nan(state: gel.GelState) -> object:
    state.displacement_m[2, 3] = math.nan
    return gel.step(state, np.full((6, 8), 0.1), (0.98, 0.0, 0.0), COULOMB, 1e-3)


def _step_gripper(command: float, dt_s: float) -> object:
    drive, curve = gripper.Drive(), finger_curve(1.8e3)
    return gripper.step(gripper.start(drive, curve, gripper.ticks_at_gap(0.06)), drive, curve, "current", command, dt_s)


@dataclass(frozen=True)
class FingerCase:
    """A finger that closes on a cylinder with 60 mA, and the stiffness of its links."""

    name: str
    drive: gripper.Drive
    finger_n_m: float = 1.8e3
    dt_s: float = 1e-2


def finger_cases() -> list[FingerCase]:
    """Return the extreme cases."""
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
    """Return force over the fingers' position on a cylinder of 6 cm, with links of this stiffness."""
    gap = gap_profile(pad_nodes(12, 9, X_RANGE_M, Y_RANGE_M), "cylinder", 0.03)
    return force_curve(gap, AREA_M2 / 108, 2e6, 4e-3, finger_n_m, gripper.metres_per_tick(0.06))


def finger_rows(case: FingerCase, steps: int = 200) -> Rows:
    """Close a finger and measure how often it turns back.

    If it comes to rest, also measure the force beyond its dry friction.
    """
    return run_case(case.name, lambda: _finger_rows(case, steps), part="gripper")


def _finger_rows(case: FingerCase, steps: int) -> Rows:
    drive, current_ma = case.drive, 60.0
    curve = finger_curve(case.finger_n_m)
    state = gripper.start(drive, curve, gripper.ticks_at_gap(0.06))
    wrong, turns, sign = 0, 0, 0.0
    for _ in range(steps):
        gripper.step(state, drive, curve, "current", current_ma, case.dt_s)
        wrong += sum(isinstance(value, float) and not math.isfinite(value) for value in vars(state).values())
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
