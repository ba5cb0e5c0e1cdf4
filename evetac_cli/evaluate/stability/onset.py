"""Time at which the object of a case begins to slip, with the scenes' default steps and with fifty per slice.

The onset is that of gross slip, as in the truth of a recording (sim.scenes.true_slip): the object has slid by half a
pixel as one body. All of the pad is visible here. The grip falls evenly within a slice, and the force on the object is
constant within a slice, as in scenes.

Reason: if friction falls with the slip speed, a node lets go within some ten microseconds. So the onset is the first
quantity to suffer from steps that are too long.
"""

import math
from dataclasses import replace
from functools import partial

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.cost.gel_trial import GRAVITY_M_S2
from evetac_cli.evaluate.stability.bounds import ONSET, RESOLVED, Bound, in_nodes
from evetac_cli.evaluate.stability.gel_case import COULOMB, GelCase, stiff
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.gel.contact import gap_profile, pressure
from evetac_cli.sim.scenes.true_slip import SLIP_PX, GroundTruthSlip
from evetac_cli.sim.setup.solver import Solver
from evetac_cli.store.recordings import slip_grid

MM_PER_PX = 0.0329  # of the default sensor
REFERENCE_MS = (0.02, 0.04)  # steps of the reference, and of a coarser run that shows the reference's own error
WEAKENING = gel.Friction(0.8, 0.64, 0.010)  # as in the scenes ...
CORNER = gel.Friction(0.8, 0.60, 0.005)  # ... and at the corner of their ranges with the steepest fall
TO_A_TENTH = gel.Friction(0.8, 0.08, 0.010)
WEIGHT_ON_S = 0.08  # duration of handing over the weight, if the grip falls slowly
FAST_S, SLOW_S = 0.2, 0.45


def onset_cases() -> list[tuple[GelCase, float]]:
    """Return cases in which a tilted cylinder, held off its centre, begins to slide, and the duration of each in s."""
    constant = GelCase("", friction=COULOMB, centre_m=(1e-3, 1.5e-3), shares=_under_cylinder)
    scene, corner = replace(constant, friction=WEAKENING), replace(constant, friction=CORNER)
    fast, slow = (partial(_unloaded, fast) for fast in (True, False))
    steady, wet = partial(_constant_grip, 1.1), replace(scene, becomes=(0.15, _tenth(WEAKENING)))
    return [
        (fast("grip falls at 9 N/s, friction constant", constant), FAST_S),
        (fast("grip falls at 9 N/s, friction falls to 0.8 of it at 10 mm/s", scene), FAST_S),
        (fast("grip falls at 9 N/s, friction falls to 0.75 of it at 5 mm/s", corner), FAST_S),
        (slow("grip falls at 2 N/s, friction constant", constant), SLOW_S),
        (slow("grip falls at 2 N/s, friction falls to 0.8 of it at 10 mm/s", scene), SLOW_S),
        (slow("grip falls at 2 N/s, friction falls to 0.75 of it at 5 mm/s", corner), SLOW_S),
        (slow("slides, friction falls to a tenth with speed", replace(scene, friction=TO_A_TENTH)), SLOW_S),
        (slow("slides, gel 10 times as stiff", replace(scene, material=stiff(10.0))), SLOW_S),
        (slow("slides, gel a tenth as stiff", replace(scene, material=stiff(0.1))), SLOW_S),
        (slow("slides, object of 5 g", scene, 0.005), SLOW_S),
        (slow("slides, object of 2 kg", scene, 2.0), SLOW_S),
        (steady("slides, friction falls to a tenth at 0.15 s", wet), FAST_S),
        (steady("slides, hand jerks by 20 m/s2 for 30 ms", replace(scene, force=_jerked)), FAST_S),
    ]


def _under_cylinder(nodes: Floats) -> Floats:
    return np.asarray(pressure(0.4e-3, gap_profile(nodes, "cylinder", 0.06, 0.01), 1.0))


def _unloaded(fast: bool, name: str, case: GelCase, mass_kg: float = 0.1) -> GelCase:
    """Return the case with a grip that falls in proportion to a mass: 100 g from 2 N at 9 N/s, or 1.1 N at 2 N/s."""
    share = mass_kg / 0.1
    load = partial(_falling, share, 2.0, 9.0, 0.0) if fast else partial(_falling, share, 1.1, 2.0, WEIGHT_ON_S)
    force = None if fast else partial(_handed_over, mass_kg * GRAVITY_M_S2)
    return replace(case, name=name, mass_kg=mass_kg, inertia_kg_m2=4e-4 * mass_kg, load=load, force=force)


def _constant_grip(grip_n: float, name: str, case: GelCase) -> GelCase:
    return replace(case, name=name, load=lambda _: grip_n, force=case.force or partial(_handed_over, 0.981))


def _falling(share: float, from_n: float, rate_n_s: float, since_s: float, time_s: float) -> float:
    return share * max(from_n - rate_n_s * max(time_s - since_s, 0.0), 0.0)


def _handed_over(weight_n: float, time_s: float) -> tuple[float, float, float]:
    """Return a weight that is fully applied after WEIGHT_ON_S."""
    return weight_n * (0.5 - 0.5 * math.cos(math.pi * min(time_s / WEIGHT_ON_S, 1.0))), 0.0, 0.0


def _jerked(time_s: float) -> tuple[float, float, float]:
    """Return the weight of 100 g, plus the force of a hand that is jerked upwards for 30 ms at 0.12 s."""
    since = (time_s - 0.12) / 0.03
    jerk_n = 0.1 * 20.0 * math.sin(math.pi * since) if 0.0 <= since <= 1.0 else 0.0
    return _handed_over(0.1 * GRAVITY_M_S2, time_s)[0] + jerk_n, 0.0, 0.0


def _tenth(friction: gel.Friction) -> gel.Friction:
    return replace(friction, static=0.1 * friction.static, kinetic=0.1 * friction.kinetic)


def onset_s(case: GelCase, within_s: float, solver: Solver) -> float:
    """Return the time of gross slip, interpolated within the slice of 1 ms; NaN if it does not begin in this time."""
    state, shares = case.start()
    stepper, slip = Stepper(solver), GroundTruthSlip(state, MM_PER_PX, None)
    for number in range(round(within_s / stepper.slice_s)):
        begin_s, before_px = number * stepper.slice_s, slip.slid_px
        grip_n = case.load(begin_s), case.load(begin_s + stepper.slice_s)
        force = case.force_at(begin_s + 0.5 * stepper.slice_s)
        stepper.advance(state, shares, grip_n, force, case.friction_at(begin_s))
        slip.follow(state, shares, grip_n[1])
        if slip.truth()["truth/slip"]:
            return begin_s + stepper.slice_s * max(SLIP_PX - before_px, 0.0) / (slip.slid_px - before_px)
    return math.nan


def onset_error(case: GelCase, within_s: float, theta: float) -> tuple[list[tuple[Bound, float]], str]:
    """Return the largest error of the onset in ms, the nodes missing to resolve unstable slip, and a description.

    The error is the distance from the reference plus the reference's own error, on the same nodes.
    """
    solvers = [Solver(theta=theta), *(Solver(theta=theta, step_ms=step_ms) for step_ms in REFERENCE_MS)]
    onset, reference, coarser = (onset_s(case, within_s, solver) for solver in solvers)
    own_ms = 1e3 * abs(reference - coarser)
    words = f"slips {_at(onset)}, reference {_at(reference)} (within {own_ms:.2g} ms)"
    measured = [(ONSET, 1e3 * abs(onset - reference) + own_ms)]
    half = _half_wavelength_nodes(case, reference)
    if math.isfinite(half):
        measured.append((RESOLVED, max(slip_grid.FEWEST_NODES - half, 0.0)))
        words += in_nodes(half) or f"; half a wavelength of unstable slip is {half:.3g} nodes"
    return measured, words


def _half_wavelength_nodes(case: GelCase, time_s: float) -> float:
    """Return half the wavelength in nodes where the pressure is highest; infinity if slip is stable or absent."""
    if math.isnan(time_s):
        return math.inf
    state, shares = case.start()
    return gel.slip_half_wavelength_nodes(state, case.friction_at(time_s), float(shares.max()) * case.load(time_s))


def _at(time_s: float) -> str:
    return "never" if math.isnan(time_s) else f"at {1e3 * time_s:.2f} ms"
