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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from evetac_cli.arrays import Floats
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
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.gel.contact import gap_profile, pad_nodes, pressure
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.scenes.true_slip import SLIP_PX, GroundTruthSlip
from evetac_cli.sim.setup.scene import Solver
from evetac_cli.store.recordings import slip_grid

X_RANGE_M, Y_RANGE_M = (-10e-3, 10e-3), (-7.5e-3, 7.5e-3)
AREA_M2 = 300e-6
COULOMB = gel.Friction(0.8, 0.8)
SLIPPERY = gel.Friction(0.8, 0.5)
UNDAMPED = gel.GelMaterial(viscous_time_s=0.0, maxwell_share=0.0, with_mass=False)
MM_PER_PX = 0.0329  # of the default sensor
REFERENCE_MS = (0.02, 0.04)  # steps of the reference, and of a coarser run that shows the reference's own error
WEAKENING = gel.Friction(0.8, 0.64, 0.010)  # as in the scenes ...
CORNER = gel.Friction(0.8, 0.60, 0.005)  # ... and at the corner of their ranges with the steepest fall
TO_A_TENTH = gel.Friction(0.8, 0.08, 0.010)
WEIGHT_ON_S = 0.08  # duration of handing over the weight, if the grip falls slowly
FAST_S, SLOW_S = 0.2, 0.45


@dataclass(frozen=True)
class GelCase:
    """A pad, an object, and their load; by default 100 g, held with 2 N per finger.

    - load: normal force in N over time in s;
    - force: on the object, x, y in N and moment in N m, over time; None is its weight;
    - shares: of the load on each node; None is even;
    - becomes: a time in s and the friction from then;
    - residual: the residual at which the search for a step's balance stops.
    """

    name: str
    columns: int = 24
    rows: int = 18
    material: gel.GelMaterial = gel.GelMaterial()
    mass_kg: float = 0.1
    inertia_kg_m2: float = 4e-5
    centre_m: tuple[float, float] = (0.0, 0.0)
    friction: gel.Friction = COULOMB
    becomes: tuple[float, gel.Friction] | None = None
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    load: Callable[[float], float] = lambda _: 2.0
    force: Callable[[float], Sequence[float] | Floats] | None = None
    shares: Callable[[Floats], Floats] | None = None
    dt_s: float = 1e-3
    residual: float = 1e-6

    def start(self) -> tuple[gel.GelState, Floats]:
        """Return the state before the first step, and the share of the load on each node."""
        nodes = pad_nodes(self.columns, self.rows, X_RANGE_M, Y_RANGE_M)
        area_m2 = AREA_M2 / self.columns / self.rows
        at_m = self.centre_m
        state = gel.start(nodes, self.material, self.mass_kg, self.inertia_kg_m2, body_xy_m=at_m, cell_area_m2=area_m2)
        state.twist[:] = self.twist
        shares = np.full(state.stuck.shape, 1 / state.stuck.size) if self.shares is None else self.shares(nodes)
        return state, shares

    def force_at(self, time_s: float) -> Sequence[float] | Floats:
        """Return the force on the object, x, y in N and moment in N m."""
        return (self.mass_kg * GRAVITY_M_S2, 0.0, 0.0) if self.force is None else self.force(time_s)

    def friction_at(self, time_s: float) -> gel.Friction:
        """Return the friction at a time."""
        return self.friction if self.becomes is None or time_s < self.becomes[0] else self.becomes[1]

    def step(
        self, state: gel.GelState, shares: Floats, number: int, dt_s: float, theta: float
    ) -> tuple[gel.StepInfo, float]:
        """Compute step `number`; return its step info and the work of outer forces in J.

        Outer forces are the force on the object, and that with which pressure squeezes the gel of all pads aside.
        """
        time_s = (number + theta) * dt_s
        force, friction = self.force_at(time_s), self.friction_at(time_s)
        nodal = self.load(time_s) * shares
        before, before_m = state.pose.copy(), state.displacement_m.copy()
        info = gel.step(state, nodal, force, friction, dt_s, theta=theta, tolerance=self.residual)
        squeezing_j = state.pads * float((state.squeezed(nodal) * (state.displacement_m - before_m)).sum())
        return info, float(np.dot(force, state.pose - before)) + squeezing_j


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
    cases += [GelCase(f"grip of {n:g} N", load=partial(_constant, n)) for n in (0.0, 1e6)]
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


def _constant(value: float, _: float) -> float:
    return value


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


def gel_rows(case: GelCase, steps: int = 100, theta: float = 0.51, slides_within_s: float = 0.0) -> Rows:
    """Run a case for some steps of `gel.step` at a theta.

    slides_within_s: if not 0, the case is run for this time, within which the object should begin to slide.
    """
    return run_case(case.name, lambda: _gel_rows(case, steps, theta, slides_within_s), part="gel")


def _gel_rows(case: GelCase, steps: int, theta: float, slides_within_s: float) -> Rows:
    if slides_within_s:
        steps = round(slides_within_s / case.dt_s)
    state, shares = case.start()
    first = largest = gel.energy(state)
    work, gained = 0.0, -math.inf
    sweeps, residuals, finite = [], [], True
    for number in range(steps):
        info, done = case.step(state, shares, number, case.dt_s, theta)
        now = gel.energy(state)
        work += done
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
    if slides_within_s:
        measured, words = onset_error(case, slides_within_s, theta)
        rows += case_rows(case.name, words, measured, part="gel")
    return rows


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
