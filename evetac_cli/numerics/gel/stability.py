"""The simulated gel where it is stiff, extreme, or both: whether it stays finite and energy comes from nowhere.

A case is ok when everything stays finite and no energy is gained beyond rounding, or when it is refused in words.

Energy gained is the largest, over the steps of a case, of energy less that at the start, less the work of outer forces;
negative where some is always lost. Rounding here is that of the balance, which is solved to 1e-6 of all forces: a gain
counts from GAIN_SHARE of the largest energy or work of the case.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from evetac_cli.numerics.gel.trial import GRAVITY_M_S2
from evetac_cli.numerics.rows import Row, case_row, run_case
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.contact import gap_profile, pad_nodes, pressure

Floats = NDArray[np.float64]

X_RANGE_M, Y_RANGE_M = (-10e-3, 10e-3), (-7.5e-3, 7.5e-3)
AREA_M2 = 300e-6
COULOMB = gel.Friction(0.8, 0.8)
SLIPPERY = gel.Friction(0.8, 0.5)
UNDAMPED = gel.GelMaterial(viscous_time_s=0.0, maxwell_share=0.0, with_mass=False)
GAIN_SHARE = 1e-6


@dataclass(frozen=True)
class GelCase:
    """A pad, an object, and the load on them; by default 100 g, held with 2 N a finger.

    load: normal force in N over time in s. force: on the object, x, y in N and moment in N m, over time; None is its
    weight. shares: of the load on each node; None is even.
    """

    name: str
    columns: int = 24
    rows: int = 18
    material: gel.GelMaterial = gel.GelMaterial()
    mass_kg: float = 0.1
    inertia_kg_m2: float = 4e-5
    centre_m: tuple[float, float] = (0.0, 0.0)
    friction: gel.Friction = COULOMB
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    load: Callable[[float], float] = lambda _: 2.0
    force: Callable[[float], Sequence[float] | Floats] | None = None
    shares: Callable[[Floats], Floats] | None = None
    dt_s: float = 1e-3


def dome(nodes: Floats) -> Floats:
    """Shares of a paraboloid's pressure on an ellipse that touches the sides of the pad; nothing in the corners."""
    shares = np.clip(1 - ((nodes / (X_RANGE_M[1], Y_RANGE_M[1])) ** 2).sum(-1), 0, None)
    return np.asarray(shares / shares.sum())


def gel_cases() -> list[GelCase]:
    """The extremes, by name."""
    stiffness = (1e-2, 1e2, 1e4, 1e6)
    cases = [GelCase(f"gel {x:g} times as stiff", material=_stiff(x)) for x in stiffness]
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
        GelCase("gel without mass and without losses", material=UNDAMPED),
        GelCase("stiff gel, friction falls with speed", material=_stiff(1e6), load=lambda t: 1 - t, friction=SLIPPERY),
        GelCase("all at once", material=_stiff(1e4), mass_kg=1e-3, inertia_kg_m2=1e-9, twist=(10, -5, 1e3), dt_s=1e-2),
    ]
    return cases


def _constant(value: float, _: float) -> float:
    return value


def _shaken(time_s: float) -> tuple[float, float, float]:
    return 2 * math.sin(2 * math.pi * 498 * time_s), 0.98, 0.0


def _stiff(factor: float) -> gel.GelMaterial:
    return gel.GelMaterial(shear_modulus_pa=factor * gel.GelMaterial().shear_modulus_pa)


def random_case(seed: int, number: int) -> GelCase:
    """A case drawn by seed and number: objects of 1 g to 10 kg on gels of 1 kPa to 1 GPa, held, turned and shaken."""
    rng = np.random.default_rng([seed, number])

    def between(low: float, high: float) -> float:
        """A number drawn evenly in the logarithm."""
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


def gel_row(case: GelCase, steps: int = 100, theta: float = 0.55) -> Row:
    """Run a case for some steps of `gel.step` at a theta."""
    return run_case(case.name, lambda: _gel_row(case, steps, theta))


def _gel_row(case: GelCase, steps: int, theta: float) -> Row:
    nodes = pad_nodes(case.columns, case.rows, X_RANGE_M, Y_RANGE_M)
    state = gel.start(
        nodes,
        case.material,
        case.mass_kg,
        case.inertia_kg_m2,
        body_xy_m=case.centre_m,
        cell_area_m2=AREA_M2 / case.columns / case.rows,
    )
    state.twist[:] = case.twist
    shares = np.full(state.stuck.shape, 1 / state.stuck.size) if case.shares is None else case.shares(nodes)
    weight = (case.mass_kg * GRAVITY_M_S2, 0.0, 0.0)
    first = largest = gel.energy(state)
    work, gained = 0.0, -math.inf
    sweeps, residuals, finite = [], [], True
    for k in range(steps):
        time_s = (k + theta) * case.dt_s
        force = weight if case.force is None else case.force(time_s)
        before = state.pose.copy()
        info = gel.step(state, case.load(time_s) * shares, force, case.friction, case.dt_s, theta=theta)
        now = gel.energy(state)
        work += float(np.dot(force, state.pose - before))
        largest = max(largest, abs(work), now)
        gained = max(gained, now - first - work)
        sweeps.append(info.sweeps)
        residuals.append(info.residual)
        finite &= math.isfinite(now) and bool(np.isfinite(np.hstack(info)).all() and np.isfinite(state.pose).all())
    rounding = gained <= GAIN_SHARE * largest
    outcome = "finite" if finite else "not finite"
    outcome += "" if rounding else ", energy gained"
    unbalanced = sum(residual > 1e-6 for residual in residuals)
    outcome += f", {unbalanced} of {steps} steps without balance" if unbalanced else ""
    return case_row(
        case.name,
        finite and rounding,
        outcome,
        sweeps_mean=float(np.mean(sweeps)),
        sweeps_max=max(sweeps),
        residual_max=max(residuals),
        energy_gained_j=gained,
    )
