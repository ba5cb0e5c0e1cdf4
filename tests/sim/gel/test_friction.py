"""Friction with a memory: closed forms of one node, and the trial of a cylinder that is let go."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.friction import coefficient_after, half_wavelength_m

LAW = (0.8, 0.64, 0.01, 20e-6)
CELL_M2 = 1e-6


def one_node(speed_m_s: float, material: gel.GelMaterial) -> gel.GelState:
    """A gel of one node under a face that moves at a speed."""
    state = gel.start(np.zeros((1, 1, 2)), material, 1.0, 1.0, pads=1, cell_area_m2=CELL_M2)
    state.twist[0] = speed_m_s
    return state


@given(st.floats(0.64, 0.8), st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(1e-6, 1.0)), min_size=1, max_size=8))
def test_a_coefficient_never_leaves_its_range(first: float, pieces: list[tuple[float, float]]) -> None:
    """Assert that it stays between kinetic and static, whatever the speeds and however long they last."""
    coefficient = first
    for speed, seconds in pieces:
        coefficient = coefficient_after(coefficient, speed, seconds, *LAW)
        assert 0.64 - 1e-12 <= coefficient <= 0.8 + 1e-12


@pytest.mark.parametrize("steps", [1, 3, 100])
def test_a_jump_of_speed_is_followed_exactly(steps: int) -> None:
    """Assert that a coefficient follows exp(-(s + v_s) t / D) after a jump, in one step as in many."""
    speed, seconds = 3e-3, 2e-3
    steady = 0.64 + 0.16 * math.exp(-((speed / 0.01) ** 2))
    expected = steady + (0.8 - steady) * math.exp(-(speed + 0.01) * seconds / 20e-6)
    coefficient = 0.8
    for _ in range(steps):
        coefficient = coefficient_after(coefficient, speed, seconds / steps, *LAW)
    assert coefficient == pytest.approx(expected, rel=1e-12)


def test_without_memory_the_law_is_that_of_the_speed() -> None:
    """Assert that a coefficient without memory is the steady one at once."""
    assert coefficient_after(0.8, 0.01, 1e-9, 0.8, 0.64, 0.01, 0.0) == pytest.approx(0.64 + 0.16 / math.e)


@pytest.mark.parametrize("load_mn", [5.0, 6.0, 7.0, 8.0])
def test_a_slider_grows_as_its_cubic_says(load_mn: float) -> None:
    """Assert that a disturbance of a steady slide grows with the largest root of its characteristic cubic, within 5 %.

    m L^3 + (c + m r) L^2 + (k + (c + w) r) L + k r = 0 with r = (V + v_s) / D and w = N dmu/dV < 0: without mass and
    damping the slide is steady while k > r |w| (Ruina 1983; Rice and Ruina 1983).
    """
    static, kinetic, stribeck, memory = LAW
    load_n, speed = 1e-3 * load_mn, 3e-3
    material = gel.GelMaterial(maxwell_share=0.0)
    state = one_node(speed, material)
    k, m = state._layer.shear, state._layer.node_mass
    c = k * material.viscous_time_s
    ratio = speed / stribeck
    w = -2 * ratio / stribeck * (static - kinetic) * math.exp(-ratio * ratio) * load_n
    r = (speed + stribeck) / memory
    theory = max(np.roots([m, c + m * r, k + (c + w) * r, k * r]).real)

    steady = kinetic + (static - kinetic) * math.exp(-ratio * ratio)
    rest_m = steady * load_n / k
    state.friction_coefficient[:] = steady
    state.slip_m_s[:] = speed
    state.displacement_m[0, 0, 0] = rest_m * (1 + 1e-6)
    nodal, friction, dt_s = np.full((1, 1), load_n), gel.Friction(*LAW), 2e-6
    away_m = np.empty(10_000)
    for step in range(len(away_m)):
        gel.step(
            state,
            nodal,
            (0.0, 0.0, 0.0),
            friction,
            dt_s,
            theta=0.5,
            tolerance=1e-13,
            prescribed_twist=(speed, 0.0, 0.0),
        )
        away_m[step] = abs(state.displacement_m[0, 0, 0] - rest_m)
    growth = math.log(away_m[5000:].max() / away_m[:5000].max()) / (5000 * dt_s)
    assert growth == pytest.approx(theory, rel=0.05)


def test_the_half_wavelength_is_where_growth_begins() -> None:
    """Assert that at the half wavelength friction takes away what the gel resists; infinite where slip is stable."""
    shear_pa, height_m, pressure_pa, memory_m = 145e3, 4e-3, 22e3, 20e-6
    half_m = half_wavelength_m(0.16, pressure_pa, memory_m, shear_pa, height_m)
    k = math.pi / half_m
    assert 0.16 * pressure_pa / memory_m == pytest.approx(shear_pa / height_m + shear_pa * height_m * k**2 / 3)
    assert half_m / 0.833e-3 == pytest.approx(4.4, abs=0.1)
    assert half_wavelength_m(0.16, 1e3, memory_m, shear_pa, height_m) == math.inf
    assert half_wavelength_m(0.16, 1e3, 0.0, shear_pa, height_m) == 0.0
