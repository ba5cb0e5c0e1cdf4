"""Slow creep of the gel: closed forms of a generalised Maxwell body."""

import math
from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.sim.gel import gel
from evetac_cli.sim.scenes.shared import GelSlices
from evetac_cli.sim.setup.scene import Solver

CELL_M2 = 1e-6
GLUED = gel.Friction(1.0, 1.0)
ONE = np.ones((1, 1))
SLOW = gel.GelMaterial(
    squeezes=False,
    viscous_time_s=0.0,
    maxwell_share=0.15,
    with_mass=False,
    creep_share=(0.05, 0.03),
    creep_time_s=(0.3, 5.0),
)


def one_node(material: gel.GelMaterial, mass_kg: float = 1e-12) -> gel.GelState:
    """A gel of one node that sticks to a face."""
    return gel.start(np.zeros((1, 1, 2)), material, mass_kg, 1.0, pads=1, cell_area_m2=CELL_M2)


def stiffness_n_m(material: gel.GelMaterial) -> float:
    """Of a node, after all creep."""
    return material.shear_modulus_pa * CELL_M2 / material.height_m


@pytest.mark.parametrize("dt_s", [1e-4, 1e-3, 0.1, 2.0, 60.0])
def test_relaxation_after_a_step_of_shear(dt_s: float) -> None:
    """Assert the Prony series k u (1 + sum g_j exp(-t / tau_j)) after a shear within one step, exact for any step."""
    state, moved_m = one_node(SLOW), 1e-4
    for k in range(200):
        twist = (moved_m / dt_s if k == 0 else 0.0, 0.0, 0.0)
        info = gel.step(state, ONE, (0, 0, 0), GLUED, dt_s, theta=1.0, tolerance=1e-14, prescribed_twist=twist)
        # an arm that is sheared evenly over dt has tau / dt (1 - exp(-dt / tau)) of its force left at the end
        left = sum(g * tau / dt_s * -math.expm1(-dt_s / tau) * math.exp(-k * dt_s / tau) for g, tau in SLOW.arms)
        assert info.friction_n[0] == pytest.approx(stiffness_n_m(SLOW) * moved_m * (1 + left), rel=1e-9)
    assert dt_s < 2.0 or info.friction_n[0] == pytest.approx(stiffness_n_m(SLOW) * moved_m, rel=1e-9)


@pytest.mark.parametrize("dt_s", [1e-3, 1e-4])
def test_creep_under_a_constant_force(dt_s: float) -> None:
    """Assert J(t) = (1 - g / (1 + g) exp(-t / (tau (1 + g)))) / k, and as slow a return, to first order in the step."""
    share, time_s, force_n, steps = 0.1, 0.5, 2e-3, 2000
    material = replace(SLOW, maxwell_share=0.0, creep_share=(share,), creep_time_s=(time_s,))
    state, stiffness = one_node(material), stiffness_n_m(material)
    fading = np.exp(-np.arange(1, steps + 1) * dt_s / (time_s * (1 + share)))
    moved_m = np.zeros((2, steps))
    for row, pull_n in enumerate((force_n, 0.0)):
        for k in range(steps):
            gel.step(state, ONE, (pull_n, 0, 0), GLUED, dt_s, theta=1.0, tolerance=1e-12)
            moved_m[row, k] = state.displacement_m[0, 0, 0]
    expected_m = force_n / stiffness * (1 - share / (1 + share) * fading)
    np.testing.assert_allclose(moved_m[0], expected_m, rtol=0.5 * dt_s)
    left_m = moved_m[0, -1] - force_n / stiffness / (1 + share)
    np.testing.assert_allclose(moved_m[1], left_m * fading, rtol=5 * dt_s)


def test_arms_without_a_share_change_no_bit() -> None:
    """Assert that a gel with creep of share 0 moves as one without."""
    silent = gel.GelMaterial(squeezes=False, creep_share=(0.0, 0.0), creep_time_s=(0.3, 5.0))
    states = [one_node(gel.GelMaterial(squeezes=False), 0.1), one_node(silent, 0.1)]
    for k in range(100):
        force = (1e-3 * math.sin(k / 5), 2e-4, 0.0)
        infos = [gel.step(state, ONE * 1e-3, force, gel.Friction(0.8, 0.6), 1e-3) for state in states]
        assert infos[0] == infos[1]
    assert np.array_equal(states[0].displacement_m, states[1].displacement_m)


def test_a_gel_that_creeps_does_not_rest() -> None:
    """Assert that a face held still goes on to feel the gel relax, where a gel without creep has come to rest."""
    forces = {}
    kinds = {
        "plain": gel.GelMaterial(squeezes=False),
        "creeps": gel.GelMaterial(squeezes=False, creep_share=(0.1,), creep_time_s=(1.0,)),
    }
    for name, material in kinds.items():
        state = one_node(material)
        slices = GelSlices(state, Solver())
        for k in range(1500):
            twist = (0.1 if k == 0 else 0.0, 0.0, 0.0)
            done = slices.advance(ONE, (1.0, 1.0), (0.0, 0.0, 0.0), GLUED, twist)
            forces[name, k] = done.friction_n[0]
        assert (slices.still_for > 0) == (name == "plain")
    assert forces["plain", 1499] == forces["plain", 1000]
    assert forces["creeps", 1499] < forces["creeps", 1000] * 0.995


def test_a_copy_keeps_its_creep() -> None:
    """Assert that a step from a restored copy gives the same creep, and that the copy is not changed by it."""
    state = one_node(SLOW)
    gel.step(state, ONE, (0, 0, 0), GLUED, 0.1, prescribed_twist=(1e-3, 0, 0))
    before = state.copy()
    after = []
    for _ in range(2):
        gel.step(state, ONE, (0, 0, 0), GLUED, 0.1, prescribed_twist=(0, 1e-3, 0))
        after.append(state.creep_n.copy())
        state.restore(before)
    assert np.array_equal(*after)
    assert np.array_equal(state.creep_n, before.creep_n)
    assert not np.array_equal(after[0], before.creep_n)
