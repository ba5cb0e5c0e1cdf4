"""Slices in as many steps as they need."""

import numpy as np
import pytest

from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.gel.contact import gap_profile, pad_nodes, pressure
from evetac_cli.sim.gel.time_step import STEP, TOO_LONG, Allowed, Load, StepRule, step_nodes
from evetac_cli.sim.setup.scene import Solver

FRICTION = gel.Friction(0.8, 0.64, 0.01, 20e-6)
WEIGHT_N = np.array([0.981, 0.0, 0.0])


def cylinder(columns: int = 12, rows: int = 9) -> tuple[gel.GelState, np.ndarray]:
    """A pad that holds a cylinder of 100 g, tilted, and the shares of its nodes in the normal force."""
    nodes = pad_nodes(columns, rows, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
    state = gel.start(nodes, gel.GelMaterial(squeezes=False), 0.1, 4e-5, body_xy_m=(1e-3, 1e-3))
    return state, pressure(0.4e-3, gap_profile(nodes, "cylinder", 0.06, 0.01), 1.0)


def let_go(solver: Solver, slices: int = 215, friction: gel.Friction = FRICTION) -> tuple[gel.GelState, np.ndarray]:
    """A grip that falls from 2 N at 9 N/s until the cylinder slips: state, and steps of each slice."""
    state, shares = cylinder()
    stepper = Stepper(solver)
    steps = []
    for number in range(slices):
        force_n = (2.0 - 9e-3 * number, 2.0 - 9e-3 * (number + 1))
        steps.append(stepper.advance(state, shares, force_n, WEIGHT_N, friction).steps)
    return state, np.array(steps)


@pytest.mark.parametrize("steps", [1, 3, 8])
def test_a_fixed_step_is_so_many_steps_of_the_gel(steps: int) -> None:
    """Assert that a slice at a fixed step is the gel stepped by hand, bit for bit, at forces linear in time."""
    state, shares = cylinder()
    twin = state.copy()
    stepper = Stepper(Solver(step_ms=1 / steps))
    for number in range(20):
        first_n, last_n = 2.0 - 0.01 * number, 1.99 - 0.01 * number
        done = stepper.advance(state, shares, (first_n, last_n), WEIGHT_N, FRICTION)
        assert done.steps == steps
        heat_j = 0.0
        for step in range(steps):
            part = step / steps + Solver().theta * (1 / steps)
            nodal_n = shares * (first_n + part * (last_n - first_n))
            heat_j += gel.step(twin, nodal_n, WEIGHT_N, FRICTION, 1e-3 * (1 / steps)).friction_heat_j
        assert done.friction_heat_j == heat_j
    assert (state.displacement_m == twin.displacement_m).all()
    assert (state.pose == twin.pose).all()


def test_slices_take_one_step_at_rest_and_more_while_they_let_go() -> None:
    """Assert that a held object takes one step a slice, and one that begins to slip the most that are allowed."""
    state, shares = cylinder()
    stepper = Stepper(Solver())
    held = [stepper.advance(state, shares, (2.0, 2.0), np.zeros(3), FRICTION).steps for _ in range(20)]
    assert held == [1] * 20
    _, steps = let_go(Solver())
    assert steps.max() == 8
    assert let_go(Solver(tolerance_um=0.02))[1].sum() > steps.sum()


@pytest.mark.slow
def test_a_slice_that_is_too_coarse_is_taken_back_whole() -> None:
    """Assert that a step above its error changes nothing of the state, and that it is then made in halves."""
    state, shares = cylinder()
    before = state.copy()
    state.press(2.0 * shares)
    load, squeeze = Load(gel.three(100.0 * WEIGHT_N), False, (0.0, 0.0, 0.0)), (state.squeezed(2.0 * shares), 1.0)
    rule = StepRule(1e-3, 0.51, 1e-6, 400, Allowed(error_m=1e-9, shortest=False))
    assert step_nodes(state.pad, squeeze, None, load, FRICTION.law, rule, np.zeros(1, STEP)) == TOO_LONG
    assert (state.pad.state == before.pad.state).all()
    assert (state.stuck == before.stuck).all()


def test_constant_friction_keeps_every_coefficient() -> None:
    """Assert that with equal coefficients memory and Stribeck speed change no bit."""
    runs = [
        let_go(Solver(step_ms=1.0), friction=gel.Friction(0.8, 0.8, speed, memory))[0]
        for speed, memory in ((0.01, 20e-6), (0.005, 0.0), (1.0, 1e-3))
    ]
    for run in runs[1:]:
        assert (run.displacement_m == runs[0].displacement_m).all()
        assert (run.pose == runs[0].pose).all()
