"""Friction with a memory: closed forms of one node, and the trial of a cylinder that is let go."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.kernels.gel_layer import ACROSS, SPRING, compliance
from evetac_cli.sim.gel import contact, dots, gel
from evetac_cli.sim.gel.friction import FrictionLaw, coefficient_after, half_wavelength_m, varied

LAW = FrictionLaw(0.8, 0.64, 0.01, 20e-6)
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
        coefficient = coefficient_after(coefficient, speed, seconds, LAW)
        assert 0.64 - 1e-12 <= coefficient <= 0.8 + 1e-12


@pytest.mark.parametrize("steps", [1, 3, 100])
def test_a_jump_of_speed_is_followed_exactly(steps: int) -> None:
    """Assert that a coefficient follows exp(-(s + v_s) t / D) after a jump, in one step as in many."""
    speed, seconds = 3e-3, 2e-3
    steady = 0.64 + 0.16 * math.exp(-((speed / 0.01) ** 2))
    expected = steady + (0.8 - steady) * math.exp(-(speed + 0.01) * seconds / 20e-6)
    coefficient = 0.8
    for _ in range(steps):
        coefficient = coefficient_after(coefficient, speed, seconds / steps, LAW)
    assert coefficient == pytest.approx(expected, rel=1e-12)


def test_without_memory_the_law_is_that_of_the_speed() -> None:
    """Assert that a coefficient without memory is the steady one at once."""
    assert coefficient_after(0.8, 0.01, 1e-9, FrictionLaw(0.8, 0.64, 0.01, 0.0)) == pytest.approx(0.64 + 0.16 / math.e)


@pytest.mark.parametrize("ratio", [0.0, 20.0, 27.0, 27.29, 27.3, 28.0, 28.1, 1e3])
def test_a_coefficient_at_high_speed_is_that_of_the_formula(ratio: float) -> None:
    """Assert that where the exponential is left out, as it is 0, the coefficient is that of the formula."""
    static, kinetic, stribeck, memory, seconds = 0.9, 0.6, 0.01, 2e-5, 1e-3
    speed = ratio * stribeck
    steady = kinetic + (static - kinetic) * math.exp(-((speed / stribeck) ** 2))
    kept = math.exp(-(speed + stribeck) * seconds / memory)
    found = coefficient_after(0.7, speed, seconds, FrictionLaw(static, kinetic, stribeck, memory))
    assert found == pytest.approx(steady + (0.7 - steady) * kept, rel=1e-15)


@pytest.mark.parametrize("load_mn", [5.0, 6.0, 7.0, 8.0])
def test_a_slider_grows_as_its_cubic_says(load_mn: float) -> None:
    """Assert that a disturbance of a steady slide grows with the largest root of its characteristic cubic, within 5 %.

    m L^3 + (c + m r) L^2 + (k + (c + w) r) L + k r = 0 with r = (V + v_s) / D and w = N dmu/dV < 0: without mass and
    damping the slide is steady while k > r |w| (Ruina 1983; Rice and Ruina 1983).
    """
    static, kinetic, stribeck, memory = LAW
    load_n, speed = 1e-3 * load_mn, 3e-3
    material = gel.GelMaterial(squeezes=False, maxwell_share=0.0)
    state = one_node(speed, material)
    k, m = state.constant("shear"), state.constant("node_mass")
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
    state.sheet_m[0] = rest_m * (1 + 1e-6)
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
    """Assert that at the half wavelength friction takes away what the gel resists across a wave.

    Infinite where slip is stable, 0 where patterns of any length grow.
    """
    shear_pa, height_m, pressure_pa, memory_m = 145e3, 4e-3, 22e3, 20e-6
    half_m = half_wavelength_m(0.16, pressure_pa, memory_m, shear_pa, height_m)
    x = (math.pi / half_m * height_m) ** 2
    stiffness = shear_pa / height_m * (1 + ACROSS * x / (1 + ACROSS * x / SPRING))
    assert 0.16 * pressure_pa / memory_m == pytest.approx(stiffness)
    exact = compliance(np.array([math.pi / half_m]), height_m, shear_pa).across[0]
    assert stiffness * exact == pytest.approx(1, rel=0.1)
    assert half_wavelength_m(0.16, 1e3, memory_m, shear_pa, height_m) == math.inf
    assert half_wavelength_m(0.16, 1e3, 0.0, shear_pa, height_m) == 0.0
    assert half_wavelength_m(0.16, 1e5, memory_m, shear_pa, height_m) == 0.0


def pad(columns: int, rows: int, **more: np.ndarray) -> gel.GelState:
    """A pad of 20 x 15 mm under a face that is driven."""
    nodes = contact.pad_nodes(columns, rows, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
    return gel.start(nodes, gel.GelMaterial(squeezes=False), 1.0, 1.0, pads=1, **more)


@pytest.mark.parametrize("node", range(12))
def test_a_factor_on_the_friction_of_a_node(node: int) -> None:
    """Assert that a node holds up to factor * static * N, and slides against factor * kinetic * N, memory included."""
    factor = 0.5 + np.arange(12.0).reshape(3, 4) / 10
    state = pad(4, 3, friction_factor=factor)
    nodal = np.zeros((3, 4))
    nodal.flat[node] = 2e-3
    friction = gel.Friction(*LAW)
    largest_n = 0.0
    for _ in range(3000):  # so slowly that its friction is still that of rest when it lets go
        info = gel.step(state, nodal, (0, 0, 0), friction, 1e-3, theta=1.0, prescribed_twist=(0.2e-3, 0, 0))
        largest_n = max(largest_n, info.friction_n[0])
        if info.slip_fraction == 1.0:
            break
    assert largest_n == pytest.approx(factor.flat[node] * 0.8 * 2e-3, rel=2e-3)
    for _ in range(100):
        info = gel.step(state, nodal, (0, 0, 0), friction, 1e-3, theta=1.0, prescribed_twist=(0.1, 0, 0))
    assert info.friction_n[0] == pytest.approx(factor.flat[node] * 0.64 * 2e-3, rel=1e-9)
    assert state.friction_coefficient.flat[node] == pytest.approx(0.64, rel=1e-9)
    assert info.friction_heat_j == pytest.approx(info.friction_n[0] * 0.1 * 1e-3, rel=1e-6)


def test_a_factor_of_1_changes_no_bit() -> None:
    """Assert that a gel whose friction has the factor 1 everywhere moves as one without a factor."""
    plain, even = pad(8, 6), pad(8, 6, friction_factor=np.ones((6, 8)))
    nodal = np.linspace(0.0, 5e-3, 48).reshape(6, 8)
    partial = 0
    for k in range(60):
        twist = (2e-3 * math.sin(k / 10), 1e-3, 0.1)
        infos = [gel.step(s, nodal, (0, 0, 0), gel.Friction(*LAW), 1e-3, prescribed_twist=twist) for s in (plain, even)]
        assert infos[0] == infos[1]
        partial += 0.0 < infos[0].slip_fraction < 1.0
    assert np.array_equal(plain.displacement_m, even.displacement_m)
    assert partial > 10


def test_friction_that_varies_over_a_gel() -> None:
    """Assert mean 1, the spread and the correlation that are named, and the same gel on a finer grid."""
    nodes = pad(40, 30).node_xy_m
    gels = np.array([varied(nodes, 0.1, 1.5e-3, np.random.default_rng(seed)) for seed in range(200)])
    np.testing.assert_allclose(gels.mean(axis=(1, 2)), 1.0, rtol=1e-12)
    logs = np.log(gels) - np.log(gels).mean()
    spread = logs.std()
    assert 0.093 < spread < 0.102  # the mean of each gel is taken out, and with it 5 % of the variance
    apart = (logs[:, :, :-3] * logs[:, :, 3:]).mean() / (logs * logs).mean()  # 3 nodes are 1.5 mm
    assert apart == pytest.approx(math.exp(-0.5), abs=0.04)
    coarse, fine = (
        dots.field_at(
            varied(p.node_xy_m, 0.2, 5e-3, np.random.default_rng(3))[..., None],
            *dots.interpolation(p.node_xy_m, np.array([[0.0, 0.0], [4e-3, -3e-3], [-6e-3, 2e-3]])),
        )
        for p in (pad(24, 18), pad(96, 72))
    )
    np.testing.assert_allclose(coarse, fine, rtol=0.01)


@pytest.mark.parametrize(
    ("spread", "length"), [(-0.1, 3e-3), (math.nan, 3e-3), (1.5, 3e-3), (0.1, 0.0), (0.1, math.nan)]
)
def test_friction_that_varies_by_nonsense_is_refused(spread: float, length: float) -> None:
    """Assert that a spread or a length out of range is a ValueError."""
    with pytest.raises(ValueError, match="friction"):
        varied(pad(4, 3).node_xy_m, spread, length, np.random.default_rng(0))
