"""The simulated gel in stiff and extreme cases: energy gained from nothing, unbalanced forces, onset of slip.

Energy gained is the largest value, over the steps of a case, of the energy less that at the start and less the work of
outer forces. These act on the object; pressure also squeezes the gel aside. The value is relative to the largest energy
or work of the case; it is negative if energy is always lost.

The onset is that of gross slip, as in the truth of a recording (sim.scenes.true_slip): the object has slid by half a
pixel as one body. All of the pad is visible here. The grip falls evenly within a slice, and the force on the object is
constant within a slice, as in scenes. It is found with the scenes' default steps and with fifty per slice. If friction
falls with the slip speed, a node lets go within some ten microseconds. So the onset is the first quantity to suffer
from steps that are too long.
"""

import math
from dataclasses import replace
from functools import partial

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.common.gel_case import X_RANGE_M, Y_RANGE_M, GelCase, solved_slices, under_cylinder
from evetac_cli.evaluate.stability.cases import (
    BALANCE,
    ENERGY,
    ONSET,
    RESOLVED,
    Bound,
    case_rows,
    in_nodes,
    run_case,
)
from evetac_cli.jobs import Rows
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.contact import gap_profile, pressure
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.scenes.true_slip import SLIP_PX
from evetac_cli.sim.setup.scene import Solver
from evetac_cli.store.recordings import slip_grid

AREA_M2 = 300e-6
SLIPPERY = gel.Friction(0.8, 0.5)
UNDAMPED = gel.GelMaterial(viscous_time_s=0.0, maxwell_share=0.0, with_mass=False)
REFERENCE_MS = (0.02, 0.04)  # steps of the reference, and of a coarser run that shows the reference's own error
WEAKENING = gel.Friction(0.8, 0.64, 0.010)  # as in the scenes ...
CORNER = gel.Friction(0.8, 0.60, 0.005)  # ... and at the corner of their ranges with the steepest fall
TO_A_TENTH = gel.Friction(0.8, 0.08, 0.010)
WEIGHT_ON_S = 0.08  # duration of handing over the weight, if the grip falls slowly
FAST_S, SLOW_S, SLICE_S = 0.2, 0.45, 1e-3


def stiff(factor: float) -> gel.GelMaterial:
    """Return the default gel with `factor` times its stiffness."""
    return gel.GelMaterial(shear_modulus_pa=factor * gel.GelMaterial().shear_modulus_pa)


def dome(nodes: Floats) -> Floats:
    """Return shares of a paraboloid's pressure on an ellipse that touches the sides of the pad, zero in the corners."""
    shares = np.clip(1 - ((nodes / (X_RANGE_M[1], Y_RANGE_M[1])) ** 2).sum(-1), 0, None)
    return np.asarray(shares / shares.sum())


def gel_cases() -> list[GelCase]:
    """Return the extreme cases."""
    stiffness = (1e-2, 1e2, 1e4, 1e6)
    cases = [GelCase(f"gel {x:g} times as stiff", material=stiff(x)) for x in stiffness]
    cases += [GelCase(f"object of {m:g} kg", mass_kg=m, inertia_kg_m2=4e-4 * m) for m in (1e-6, 1e-3, 1.0, 1e3)]
    cases += [GelCase(f"mu {mu:g}", friction=gel.Friction(mu, mu)) for mu in (0.0, 1e-3, 10.0, 1e3)]
    cases += [GelCase(f"grip of {n:g} N", load=lambda _, n=n: n) for n in (0.0, 1e6)]  # type: ignore[misc]
    cases += [GelCase(f"time step {dt:g} s", dt_s=dt) for dt in (1e-7, 1e-6, 1e-5, 1e-4, 1e-2, 1e-1)]
    cases += [
        GelCase(f"force of 498 Hz, time step {dt * 1e3:g} ms", dt_s=dt, load=lambda _: 5.0, force=_shaken)
        for dt in (1e-3, 1e-4)
    ]
    cases += [GelCase(f"Maxwell time {s:g} s", material=gel.GelMaterial(maxwell_time_s=s)) for s in (1e-9, 1e9)]
    cases += [GelCase(f"grid of {n} x {m} nodes", columns=n, rows=m) for n, m in ((1, 1), (1, 6), (64, 48))]
    cases += [
        GelCase("grip falls, then lost", load=lambda t: max(2 - 25 * t, 0.0)),
        GelCase("grip lost and regained", load=lambda t: 2.0 if int(50 * t) % 2 == 0 else 0.0),
        GelCase("friction falls with speed", load=lambda t: max(1 - 9 * t, 0.1), friction=SLIPPERY),
        GelCase(
            "contact with corners that bear nothing",
            shares=dome,
            load=lambda t: max(1.5 - 12 * t, 0.1),
            friction=SLIPPERY,
            force=lambda _: (0.9, 0.2, 0.002),
        ),
        GelCase("torque of 20 mN m", force=lambda _: (0.3, -0.5, 0.02)),
        GelCase("impact at 100 m/s", twist=(100.0, -30.0, 0.0)),
        GelCase("impact at 1e4 m/s", twist=(1e4, 0.0, 0.0), mass_kg=1.0, inertia_kg_m2=4e-4),
        GelCase("spin of 1e4 rad/s", twist=(0.0, 0.0, 1e4)),
        # At theta 0.5 nothing is lost here, and the residuals of the search add up: with residuals of 1e-6, up to 4e-6
        # of the energy were gained in 100 steps; with 1e-8, at most 3e-9. So the search continues for longer here, and
        # the bound tests the scheme.
        GelCase("gel without mass and without losses", material=UNDAMPED, residual=1e-8),
        GelCase("stiff gel, friction falls with speed", material=stiff(1e6), load=lambda t: 1 - t, friction=SLIPPERY),
        GelCase("all at once", material=stiff(1e4), mass_kg=1e-3, inertia_kg_m2=1e-9, twist=(10, -5, 1e3), dt_s=1e-2),
    ]
    return cases


def _shaken(time_s: float) -> tuple[float, float, float]:
    return 2 * math.sin(2 * math.pi * 498 * time_s), 0.98, 0.0


def random_case(seed: int, number: int) -> GelCase:
    """Return a random case by seed and number: objects of 1 g to 10 kg on gels of 1 kPa to 1 GPa, shaken and turned."""
    rng = np.random.default_rng([seed, number])

    def between(low: float, high: float) -> float:
        """Draw a number, uniform in the logarithm."""
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    columns, rows = (int(count) for count in rng.integers(1, 20, 2))
    material = gel.GelMaterial(
        shear_modulus_pa=145e3 * between(1e-2, 1e4),
        density_kg_m3=between(1e2, 1e4),
        viscous_time_s=between(1e-6, 1e-2),
        maxwell_share=float(rng.uniform(0, 0.5)),
        maxwell_time_s=between(1e-5, 10),
        coupled=bool(rng.random() < 0.8),
        with_mass=bool(rng.random() < 0.8),
    )
    mass_kg, mu = between(1e-3, 10), between(0.1, 3)
    shape, radius_m = rng.choice(["flat", "cylinder", "sphere"]), between(5e-3, 0.1)
    tilt_rad, depth_m = float(rng.normal(0, 0.01)), between(1e-5, 5e-4)
    force = mass_kg * np.array([GRAVITY_M_S2, rng.normal(), 0.1 * rng.normal()])
    grip_n, rate = mass_kg * GRAVITY_M_S2 / mu * float(rng.uniform(0.2, 3)), float(rng.uniform(5, 100))
    return GelCase(
        f"random case {number}",
        columns=columns,
        rows=rows,
        material=material,
        mass_kg=mass_kg,
        inertia_kg_m2=mass_kg * between(1e-6, 1e-2),
        centre_m=(float(rng.normal(0, 5e-3)), float(rng.normal(0, 5e-3))),
        friction=gel.Friction(mu, mu * float(rng.uniform(0.3, 1)), between(1e-4, 0.1)),
        load=lambda t: grip_n * (1 + 0.9 * math.sin(rate * t)),
        force=lambda _: force,
        shares=lambda nodes: pressure(depth_m, gap_profile(nodes, shape, radius_m, tilt_rad), 1.0),
        dt_s=between(3e-5, 1e-2),
    )


def gel_rows(case: GelCase, steps: int = 100, theta: float = 0.51) -> Rows:
    """Run a case for its duration, or some steps of `gel.step`, at a theta.

    Outer forces do work: the force on the object, and that with which pressure squeezes the gel of all pads aside.
    """
    return run_case(case.name, lambda: _gel_rows(case, steps, theta), part="gel")


def _gel_rows(case: GelCase, steps: int, theta: float) -> Rows:
    if case.seconds:
        steps = round(case.seconds / case.dt_s)
    state, shares = case.start(_cell_area_m2(case))
    first = largest = gel.energy(state)
    work, gained = 0.0, -math.inf
    sweeps, residuals, finite = [], [], True
    for number in range(steps):
        time_s = (number + theta) * case.dt_s
        force, nodal = case.force_at(time_s), case.load(time_s) * shares
        before, before_m = state.pose.copy(), state.displacement_m.copy()
        friction = case.friction_at(time_s)
        info = gel.step(state, nodal, force, friction, case.dt_s, theta=theta, tolerance=case.residual)
        now = gel.energy(state)
        squeezing_j = state.pads * float((state.squeezed(nodal) * (state.displacement_m - before_m)).sum())
        work += float(np.dot(force, state.pose - before)) + squeezing_j
        largest = max(largest, abs(work), now)
        gained = max(gained, now - first - work)
        sweeps.append(info.sweeps)
        residuals.append(info.residual)
        finite &= math.isfinite(now) and bool(np.isfinite(np.hstack(info)).all() and np.isfinite(state.pose).all())
    share = gained / largest if largest > 0.0 else gained  # an object that is never moved has no energy
    measured = [(ENERGY, share), (BALANCE, max(residuals))] if finite else [(ENERGY, math.nan), (BALANCE, math.nan)]
    unbalanced = sum(residual > BALANCE.most for residual in residuals)
    outcome = "" if finite else "not finite, "
    outcome += f"{unbalanced} of {steps} steps without balance, " if unbalanced else ""
    outcome += f"{np.mean(sweeps):.3g} sweeps per step, at most {max(sweeps)}"
    rows = case_rows(case.name, outcome, measured, part="gel")
    if case.seconds:
        measured, words = onset_error(case, theta)
        rows += case_rows(case.name, words, measured, part="gel")
    return rows


def _cell_area_m2(case: GelCase) -> float:
    """Return the area of a cell, also of a single row or column."""
    return AREA_M2 / case.columns / case.rows


def onset_cases() -> list[GelCase]:
    """Return cases in which a tilted cylinder, held off its centre, begins to slide within their duration."""
    constant = GelCase(centre_m=(1e-3, 1.5e-3), shares=under_cylinder(0.01), seconds=FAST_S)
    scene, corner = replace(constant, friction=WEAKENING), replace(constant, friction=CORNER)
    fast, slow = (partial(_unloaded, fast) for fast in (True, False))
    steady = replace(scene, load=lambda _: 1.1, force=partial(_handed_over, 0.981))
    tenth = replace(WEAKENING, static=0.1 * WEAKENING.static, kinetic=0.1 * WEAKENING.kinetic)
    return [
        fast("grip falls at 9 N/s, friction constant", constant),
        fast("grip falls at 9 N/s, friction falls to 0.8 of it at 10 mm/s", scene),
        fast("grip falls at 9 N/s, friction falls to 0.75 of it at 5 mm/s", corner),
        slow("grip falls at 2 N/s, friction constant", constant),
        slow("grip falls at 2 N/s, friction falls to 0.8 of it at 10 mm/s", scene),
        slow("grip falls at 2 N/s, friction falls to 0.75 of it at 5 mm/s", corner),
        slow("slides, friction falls to a tenth with speed", replace(scene, friction=TO_A_TENTH)),
        slow("slides, gel 10 times as stiff", replace(scene, material=stiff(10.0))),
        slow("slides, gel a tenth as stiff", replace(scene, material=stiff(0.1))),
        slow("slides, object of 5 g", scene, 0.005),
        slow("slides, object of 2 kg", scene, 2.0),
        replace(steady, name="slides, friction falls to a tenth at 0.15 s", becomes=(0.15, tenth)),
        replace(steady, name="slides, hand jerks by 20 m/s2 for 30 ms", force=_jerked),
    ]


def _unloaded(fast: bool, name: str, case: GelCase, mass_kg: float = 0.1) -> GelCase:
    """Return the case with a grip that falls in proportion to a mass: 100 g from 2 N at 9 N/s, or 1.1 N at 2 N/s."""
    share = mass_kg / 0.1
    from_n, rate_n_s, since_s = (2.0, 9.0, 0.0) if fast else (1.1, 2.0, WEIGHT_ON_S)

    def load(time_s: float) -> float:
        return share * max(from_n - rate_n_s * max(time_s - since_s, 0.0), 0.0)

    force = None if fast else partial(_handed_over, mass_kg * GRAVITY_M_S2)
    loaded = replace(case, name=name, mass_kg=mass_kg, inertia_kg_m2=4e-4 * mass_kg, load=load, force=force)
    return loaded if fast else replace(loaded, seconds=SLOW_S)


def _handed_over(weight_n: float, time_s: float) -> tuple[float, float, float]:
    """Return a weight that is fully applied after WEIGHT_ON_S."""
    return weight_n * (0.5 - 0.5 * math.cos(math.pi * min(time_s / WEIGHT_ON_S, 1.0))), 0.0, 0.0


def _jerked(time_s: float) -> tuple[float, float, float]:
    """Return the weight of 100 g, plus the force of a hand that is jerked upwards for 30 ms at 0.12 s."""
    since = (time_s - 0.12) / 0.03
    jerk_n = 0.1 * 20.0 * math.sin(math.pi * since) if 0.0 <= since <= 1.0 else 0.0
    return _handed_over(0.1 * GRAVITY_M_S2, time_s)[0] + jerk_n, 0.0, 0.0


def onset_s(case: GelCase, solver: Solver) -> float:
    """Return the time of gross slip, interpolated within the slice of 1 ms; NaN if it does not begin in its time."""
    before_px = 0.0
    for number, (_, slip, _) in enumerate(solved_slices(case, solver, _cell_area_m2(case))):
        if slip.truth()["truth/slip"]:
            return SLICE_S * (number + max(SLIP_PX - before_px, 0.0) / (slip.slid_px - before_px))
        before_px = slip.slid_px
    return math.nan


def onset_error(case: GelCase, theta: float) -> tuple[list[tuple[Bound, float]], str]:
    """Return the largest error of the onset in ms, the nodes missing to resolve unstable slip, and a description.

    The error is the distance from the reference plus the reference's own error, on the same nodes.
    """
    solvers = [Solver(theta=theta), *(Solver(theta=theta, step_ms=step_ms) for step_ms in REFERENCE_MS)]
    onset, reference, coarser = (onset_s(case, solver) for solver in solvers)
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
    state, shares = case.start(_cell_area_m2(case))
    return gel.slip_half_wavelength_nodes(state, case.friction_at(time_s), float(shares.max()) * case.load(time_s))


def _at(time_s: float) -> str:
    return "never" if math.isnan(time_s) else f"at {1e3 * time_s:.2f} ms"
