"""Whether the simulated mechanics stay sane where they are stiff, extreme, or handed nonsense; the simulator's suite.

The suite also holds the cases of the camera, which are in `camera_stability`.

Every case is a row: `ok`, `outcome` in words, and for the gel what its steps cost and whether energy came from nowhere.
A case is ok when everything stays finite and no energy is gained beyond rounding, or when it is refused in words. Cases
of nonsense (NaN, infinite, negative) are ok only when refused.

Energy gained is the largest, over the steps of a case, of energy less that at the start, less the work of outer forces;
negative where some is always lost. Rounding here is that of the balance, found to 1e-6 of all forces: a gain counts
from GAIN_SHARE of the largest energy or work of the case.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.numerics.simulator.camera_stability import camera_cases, camera_row, wrong_models, wrong_slices
from evetac_cli.numerics.stability_rows import SIMULATOR, Row
from evetac_cli.sim import gripper
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.contact import ForceCurve, force_curve, gap_profile, pad_nodes, pressure

Floats = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
X_RANGE_M, Y_RANGE_M = (-10e-3, 10e-3), (-7.5e-3, 7.5e-3)
AREA_M2 = 300e-6
COULOMB = gel.Friction(0.8, 0.8)
SLIPPERY = gel.Friction(0.8, 0.5)
UNDAMPED = gel.GelMaterial(viscous_time_s=0.0, maxwell_share=0.0, with_mass=False)
GAIN_SHARE = 1e-6
DRAWN, DRAWN_FULL = 10, 200


# -- gel ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GelCase:
    """A pad, an object, and what is done to them; what is not named is ordinary: 100 g, held with 2 N a finger.

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


def drawn_case(seed: int, number: int) -> GelCase:
    """Anything from a crumb to a brick, on gels from jelly to glass, gripped anyhow, turned and shaken."""
    rng = np.random.default_rng([seed, number])

    def between(low: float, high: float) -> float:
        """Even in the logarithm."""
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
        f"drawn case {number}",
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
    """Run a case for some steps."""
    return SIMULATOR.in_words(case.name, lambda: _gel_row(case, steps, theta))


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
    return SIMULATOR.row(
        case.name,
        finite and rounding,
        outcome,
        sweeps_mean=float(np.mean(sweeps)),
        sweeps_most=max(sweeps),
        residual_most=max(residuals),
        energy_gained_j=gained,
    )


# -- gripper -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FingerCase:
    """A finger that closes with 60 mA on a cylinder, and the stiffness of its links."""

    name: str
    drive: gripper.Drive
    finger_n_m: float = 1.8e3
    dt_s: float = 1e-2


def finger_cases() -> list[FingerCase]:
    """The extremes, by name."""
    free = gripper.Drive(damping_n_s_m=0.0, mass_kg=0.0)
    return [
        FingerCase("gripper without damping and mass", free),
        FingerCase("gripper without damping and mass, fingers of 2e8 N/m", free, finger_n_m=2e8),
        FingerCase("gripper with damping of 1e-6 N s/m, fingers of 2e8 N/m", replace(free, damping_n_s_m=1e-6), 2e8),
        FingerCase("gripper of 1e6 kg", gripper.Drive(mass_kg=1e6)),
        FingerCase("gripper, time step 1e-7 s", gripper.Drive(), dt_s=1e-7),
    ]


def finger_row(case: FingerCase, steps: int = 200) -> Row:
    """Close a finger: ok where it never turns back and, if it came to rest, rests inside its band of friction."""
    return SIMULATOR.in_words(case.name, lambda: _finger_row(case, steps))


def _finger_curve(finger_n_m: float) -> ForceCurve:
    gap = gap_profile(pad_nodes(12, 9, X_RANGE_M, Y_RANGE_M), "cylinder", 0.03)
    return force_curve(gap, AREA_M2 / 108, 2e6, 4e-3, finger_n_m, gripper.metres_per_tick(0.06))


def _finger_row(case: FingerCase, steps: int) -> Row:
    drive, current_ma = case.drive, 60.0
    curve = _finger_curve(case.finger_n_m)
    state = gripper.start(drive, curve, gripper.ticks_at_gap(0.06))
    finite, turns, sign = True, 0, 0.0
    for _ in range(steps):
        gripper.step(state, drive, curve, "current", current_ma, case.dt_s)
        finite &= all(math.isfinite(value) for value in vars(state).values())
        turns += sign * state.speed_m_s < 0
        sign = state.speed_m_s or sign
    surplus_n = abs(drive.force_per_current_n_ma * current_ma - state.force_n)
    band_n = drive.friction_n + drive.friction_share * state.force_n
    rests = state.speed_m_s == 0.0
    sane = finite and turns == 0 and (surplus_n <= band_n * (1 + 1e-9) or not rests)
    outcome = "finite" if finite else "not finite"
    outcome += f", turned back {turns} times" if turns else ""
    outcome += f", rests at {state.force_n:.3g} N" if rests else f", still closing at {state.force_n:.3g} N"
    return SIMULATOR.row(case.name, sane, outcome)


# -- nonsense ----------------------------------------------------------------------------------------------------------


def nonsense() -> Iterator[tuple[str, Callable[[], object]]]:
    """Calls with values that make no sense, by name; every one has to be refused."""
    bad = (math.nan, math.inf, -1.0)
    nodes = pad_nodes(8, 6, X_RANGE_M, Y_RANGE_M)

    def gel_state() -> gel.GelState:
        return gel.start(nodes, gel.GelMaterial(), 0.1, 4e-5)

    def step(**changes: Any) -> object:
        given: dict[str, Any] = {"nodal_force_n": np.full((6, 8), 0.04), "body_force_n": (0.98, 0.0, 0.0)}
        given |= {"friction": COULOMB, "dt_s": 1e-3}
        return gel.step(gel_state(), **(given | changes))

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
        yield f"gripper, time step {value:g} s", partial(_wrong_finger, 10.0, value)
        yield from wrong_models(value)
    for value in (math.nan, math.inf, -math.inf):
        yield f"force of {value:g} N on the object", partial(step, body_force_n=(value, 0.0, 0.0))
        yield f"prescribed speed {value:g} m/s", partial(step, prescribed_twist=(value, 0.0, 0.0))
        yield f"gripper, command {value:g}", partial(_wrong_finger, value, 1e-3)
        yield from wrong_slices(value)
    yield "nodes that are no regular grid", partial(gel.start, nodes**2 + nodes, gel.GelMaterial(), 0.1, 4e-5)
    yield "a state overwritten with NaN", partial(_spoilt, gel_state())


def _spoilt(state: gel.GelState) -> object:
    state.displacement_m[2, 3] = math.nan
    return gel.step(state, np.full((6, 8), 0.1), (0.98, 0.0, 0.0), COULOMB, 1e-3)


def _wrong_finger(command: float, dt_s: float) -> object:
    drive, curve = gripper.Drive(), _finger_curve(1.8e3)
    return gripper.step(gripper.start(drive, curve, gripper.ticks_at_gap(0.06)), drive, curve, "current", command, dt_s)


# -- the suite ---------------------------------------------------------------------------------------------------------


def suite(seed: int = 0, *, full: bool = False, steps: int = 100) -> list[Callable[[], Row]]:
    """Every case, to be run one at a time; `full` takes every theta, ten times the steps, many more drawn cases."""
    cases = gel_cases() + [drawn_case(seed, number) for number in range(DRAWN_FULL if full else DRAWN)]
    thetas, gel_steps = ((0.55, 1.0, 0.5), 10 * steps) if full else ((0.55,), steps)
    runs: list[Callable[[], Row]] = []
    for theta in thetas:
        named = [replace(case, name=f"{case.name}, theta {theta:g}") if full else case for case in cases]
        runs += [partial(gel_row, case, gel_steps, theta) for case in named]
    runs += [partial(finger_row, case) for case in finger_cases()]
    runs += [partial(camera_row, case, min(steps, 10), seed) for case in camera_cases()]
    runs += [partial(SIMULATOR.refusal, name, call) for name, call in nonsense()]
    return runs


def stability(seed: int = 0, *, full: bool = False, steps: int = 100) -> list[Row]:
    """The rows of all cases."""
    return [run() for run in suite(seed, full=full, steps=steps)]
