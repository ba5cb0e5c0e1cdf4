"""A cylinder that is let go, 24 x 18 nodes: the adaptive step against one of 10 us with the same memory of friction.

`fast`: the weight hangs at once and bounces, the grip falls from 2 N at 9 N/s. `slow`: the weight comes on within
80 ms, and the grip falls from 1.1 N at 2 N/s, the slip scene's rate near onset; `heavy` is slow with five times mass
and grip, and with the memory of the package's scenes: with the others' half a wavelength of its unstable slip is 2.5
nodes, and the onset hangs on the grid.
Onset is when the object slid by half a pixel with no node stuck. A case that a reference of 5 us moves by more than
0.2 ms is undecided, and only listed. Print the tables with `pytest -m slow -s tests/sim/gel/test_letting_go.py`.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from evetac_cli.evaluate.cost.simulator import draw_trial
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.setup.scene import Solver

pytestmark = pytest.mark.slow

SLID_M = 16.4e-6
EPISODE_S = 3e-3  # gross slip is over after this long with a stuck node
SEEDS = range(10_100, 10_108)
LAWS = {
    "0.8 at 10 mm/s": gel.Friction(0.8, 0.64, 0.01, 20e-6),
    "0.75 at 5 mm/s": gel.Friction(0.8, 0.6, 5e-3, 20e-6),
}
REFERENCE = Solver(step_ms=0.01, theta=0.51, residual=1e-8)
FINER = Solver(step_ms=0.005, theta=0.51, residual=1e-8)


class Plan(NamedTuple):
    """Grip on one pad: first_n until begin_s, then falling by rate_n_s; the weight comes on within hang_s."""

    first_n: float
    rate_n_s: float
    begin_s: float
    hang_s: float
    seconds: float
    times: float = 1.0  # mass and grip
    memory_times: float = 1.0  # of friction, that of the law


PLANS = {
    "fast": Plan(2.0, 9.0, 0.0, 0.0, 0.2),
    "slow": Plan(1.1, 2.0, 0.1, 0.08, 0.36),
    "heavy": Plan(1.1, 2.0, 0.1, 0.08, 0.36, 5.0, 2.5),
}


class Motion(NamedTuple):
    """The object's pose after each ms, (samples, 3), onset in ms, and the most energy gained in J."""

    pose: np.ndarray
    onset_ms: float
    gained_j: float


def let_go(
    seed: int,
    plan: Plan,
    friction: gel.Friction,
    solver: Solver,
    kick_m_s: float = 0.0,
    nodes: tuple[int, int] = (24, 18),
) -> Motion:
    """Simulate the trial of a seed; the object starts with a velocity."""
    friction = replace(friction, memory_m=plan.memory_times * friction.memory_m)
    trial = replace(draw_trial(seed), columns=nodes[0], rows=nodes[1])
    state, shares = trial.start()
    state.inertia *= plan.times
    state.twist[0] = kick_m_s
    stepper = Stepper(solver)
    squeeze = state.squeezed(shares)
    slid, since, onset_s, now_s, heat_j, work_j = 0.0, 1.0, math.nan, 0.0, 0.0, 0.0
    ends_n, before_m = (0.0, 0.0), state.displacement_m.copy()

    def follow(info: gel.StepInfo, dt_s: float) -> None:
        nonlocal slid, since, onset_s, now_s, heat_j, work_j
        before = slid
        part = (now_s + solver.theta * dt_s) / 1e-3 - number
        normal_n = ends_n[0] + part * (ends_n[1] - ends_n[0])
        work_j += state.pads * normal_n * float((squeeze * (state.displacement_m - before_m)).sum())
        before_m[:] = state.displacement_m
        now_s += dt_s
        heat_j += info.friction_heat_j
        since = 0.0 if info.slip_fraction >= 1.0 else since + dt_s
        if since == 0.0:
            slid += info.slip_velocity_m_s[0] * dt_s
        elif since > EPISODE_S:
            slid = 0.0
        if slid > SLID_M and math.isnan(onset_s):
            onset_s = now_s - dt_s * (slid - SLID_M) / (slid - before)

    def grip_n(at_s: float) -> float:
        return plan.times * max(plan.first_n - plan.rate_n_s * max(at_s - plan.begin_s, 0.0), 0.02)

    poses, gained_j, first_j = [], -math.inf, gel.energy(state)
    for number in range(round(1e3 * plan.seconds)):
        share = min(1.0, (number + 0.5) * 1e-3 / plan.hang_s) if plan.hang_s else 1.0
        force = np.array([share * plan.times * trial.mass_kg * GRAVITY_M_S2, 0.0, 0.0])
        before = state.pose.copy()
        ends_n = grip_n(1e-3 * number), grip_n(1e-3 * (number + 1))
        stepper.advance(state, shares, ends_n, force, friction, None, follow)
        work_j += float(force @ (state.pose - before))
        gained_j = max(gained_j, gel.energy(state) - first_j - work_j + heat_j)
        poses.append(state.pose.copy())
    return Motion(np.array(poses), 1e3 * onset_s, gained_j)


def before_um(one: Motion, other: Motion) -> np.ndarray:
    """Distances in um of two motions of the object, each ms until the other's onset."""
    apart: np.ndarray = 1e6 * np.hypot(*(one.pose - other.pose)[:, :2].T)
    return apart[: int(other.onset_ms)]


def after_um(one: Motion, other: Motion) -> float:
    """Their distance in um 8 ms after the other's onset."""
    at = min(int(other.onset_ms) + 8, len(other.pose) - 1)
    return float(1e6 * np.hypot(*(one.pose - other.pose)[at, :2]))


def rms(values: list[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("plan", PLANS)
def test_the_adaptive_step_against_a_reference(plan: str, law: str) -> None:
    """Assert the errors of the default step: onset 0.3 ms each and 0.2 ms rms, distances before it and 8 ms after."""
    onsets, before, far, undecided = [], [], [], []
    for seed in SEEDS:
        chosen = PLANS[plan], LAWS[law]
        reference, finer = (let_go(seed, *chosen, solver) for solver in (REFERENCE, FINER))
        if not abs(reference.onset_ms - finer.onset_ms) <= 0.2:
            undecided.append(seed)
            continue
        adaptive = let_go(seed, *chosen, Solver())
        onsets.append(adaptive.onset_ms - reference.onset_ms)
        before.append(rms(before_um(adaptive, reference)))
        far.append(after_um(adaptive, reference))
    print(
        f"\n{plan}, {law}: onset {rms(onsets):.3f} rms, {np.abs(onsets).max():.3f} most [ms]; before {rms(before):.2f},"
        f" after {np.median(far):.1f} median, {max(far):.1f} most [um]; undecided {undecided}"
    )
    assert len(undecided) <= 2
    assert np.abs(onsets).max() <= 0.3
    assert rms(onsets) <= 0.2
    if plan != "heavy":
        assert rms(before) <= (1.5 if plan == "fast" else 0.1)
    assert max(far) <= 15.0


@pytest.mark.parametrize("plan", ["fast", "slow"])
def test_steps_converge(plan: str) -> None:
    """Assert that the error before the onset falls at least with the 0.9th power of the step, from 1 to 0.1 ms."""
    slopes = []
    for seed in SEEDS[:4]:
        law = LAWS["0.75 at 5 mm/s"]
        reference = let_go(seed, PLANS[plan], law, REFERENCE)
        errors = [rms(before_um(let_go(seed, PLANS[plan], law, Solver(step_ms=ms)), reference)) for ms in (1.0, 0.1)]
        slopes.append(math.log10(errors[0] / errors[1]))
    print(f"\n{plan}: slopes", np.round(slopes, 2))
    assert np.mean(slopes) >= 0.9


@pytest.mark.parametrize("law", LAWS)
def test_a_finer_grid_has_the_same_onset(law: str) -> None:
    """Assert that twice as many nodes along and across move the onset by less than 0.2 ms (at 4 kPa)."""
    for seed in SEEDS[:4]:
        fine = Solver(step_ms=0.125)
        coarse, finer = (let_go(seed, PLANS["slow"], LAWS[law], fine, 0.0, nodes) for nodes in ((24, 18), (48, 36)))
        print(f"\n{law}, seed {seed}: {finer.onset_ms - coarse.onset_ms:+.3f} ms")
        assert abs(finer.onset_ms - coarse.onset_ms) < 0.2


@pytest.mark.parametrize("plan", PLANS)
def test_energy_is_never_gained(plan: str) -> None:
    """Assert that energy and heat, less what weight and pressure work, never exceed those at the start."""
    for law in LAWS.values():
        for solver in (Solver(), Solver(step_ms=1.0)):
            gained_j = max(let_go(seed, PLANS[plan], law, solver).gained_j for seed in SEEDS)
            print(f"\n{plan}: {gained_j:.2e} J")
            assert gained_j <= 1e-12
