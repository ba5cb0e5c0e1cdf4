"""The gel step: closed forms, convergence, energy, invariances, stiff and extreme cases."""

import dataclasses
import math

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

from evetac_cli.sim.gel.contact import cell_area, gap_profile, pad_nodes, pressure
from evetac_cli.sim.gel.dots import displacement_at, interpolation
from evetac_cli.sim.gel.force_balance import friction_projection
from evetac_cli.sim.gel.gel import Friction, GelMaterial, energy, start, step

GRAVITY = 9.81
X_RANGE_M, Y_RANGE_M = (-10e-3, 10e-3), (-7.5e-3, 7.5e-3)
PLAIN = GelMaterial(squeezes=False)  # closed forms leave out that pressure moves gel aside
DRY = dataclasses.replace(PLAIN, viscous_time_s=0.0, maxwell_share=0.0, with_mass=False)
COULOMB = Friction(0.8, 0.8)
SLIPPERY = Friction(0.8, 0.5, 0.01)


def pad(columns=8, rows=6):
    return pad_nodes(columns, rows, X_RANGE_M, Y_RANGE_M)


def even(state, force_n):
    """A flat punch: the same force on every node."""
    return np.full(state.stuck.shape, force_n / state.stuck.size)


def dome(nodes):
    """Shares of a paraboloid's pressure on an ellipse that touches the sides of the pad; nothing in the corners."""
    shares = np.clip(1 - ((nodes / [10e-3, 7.5e-3]) ** 2).sum(-1), 0, None)
    return shares / shares.sum()


def held(nodes=None, material=None, mass_kg=0.1, inertia=4e-5, **changes):
    return start(pad() if nodes is None else nodes, material or PLAIN, mass_kg, inertia, **changes)


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_partial_slip_on_a_winkler_layer():
    """Assert that a paraboloid on uncoupled springs follows F = mu P (1 - (1 - k d / mu p0)^2) within 2e-4."""
    radius_m, load_n = 5e-3, 5.0
    nodes = pad_nodes(80, 80, (-radius_m, radius_m), (-radius_m, radius_m))
    shares = np.clip(1 - ((nodes / radius_m) ** 2).sum(-1), 0, None)
    nodal = load_n * shares / shares.sum()
    material = dataclasses.replace(DRY, coupled=False)
    state = start(nodes, material, 0.1, 1e-5, pads=1)
    peak_pa = 2 * load_n / (math.pi * radius_m**2)
    stiffness = material.shear_modulus_pa / material.height_m
    full_m = COULOMB.static * peak_pa / stiffness  # at which the centre slips too
    for part in np.arange(1, 21) / 21:
        speed = full_m / 21
        info = step(state, nodal, (0, 0, 0), COULOMB, 1.0, theta=1.0, prescribed_twist=(speed, 0, 0))
        expected_n = COULOMB.static * load_n * (1 - (1 - part) ** 2)
        assert info.converged
        assert info.friction_n[0] == pytest.approx(expected_n, rel=2e-4)
        # the stuck disc has shrunk to radius^2 (1 - part), counted to within two rings of nodes
        stick_m = math.sqrt(state.stuck.sum() * state.cell_area_m2 / math.pi)
        assert stick_m == pytest.approx(radius_m * math.sqrt(1 - part), abs=2 * radius_m / 40)


def cerruti(x_m, y_m, pitch_m, shear_modulus_pa, poisson):
    """Displacement (2 m, 2 m) of a half space at m places by unit tractions on the square cells around them.

    Integrals of Cerruti's solution over a cell (Kalker, Three-Dimensional Elastic Bodies in Rolling Contact, 1990).
    """

    def over_cell(primitive, x, y):
        half = pitch_m / 2
        upper = primitive(x + half, y + half) - primitive(x - half, y + half)
        return (upper - primitive(x + half, y - half) + primitive(x - half, y - half)) / (2 * np.pi * shear_modulus_pa)

    def along(x, y):
        radius = np.hypot(x, y)
        return (1 - poisson) * x * np.log(y + radius) + y * np.log(x + radius)

    across_x, across_y = x_m[:, None] - x_m, y_m[:, None] - y_m
    influence = np.empty((len(x_m), 2, len(x_m), 2))
    influence[:, 0, :, 0] = over_cell(along, across_x, across_y)
    influence[:, 1, :, 1] = over_cell(lambda x, y: along(y, x), across_x, across_y)
    influence[:, 0, :, 1] = over_cell(lambda x, y: -poisson * np.hypot(x, y), across_x, across_y)
    influence[:, 1, :, 0] = influence[:, 0, :, 1]
    return influence.reshape(2 * len(x_m), -1)


@njit
def drag(influence, traction, bound, along_x_m, sweeps):
    """Projected Gauss-Seidel sweeps over the tractions under a rigid body dragged along x, by the projection of `gel`.

    Returns the largest change of a traction in the last sweep, as a share of the largest bound.
    """
    change = 0.0
    for _ in range(sweeps):
        change = 0.0
        for node in range(len(bound)):
            ease = 1.0 / influence[2 * node, 2 * node]
            x = traction[2 * node] + ease * (along_x_m - influence[2 * node] @ traction)
            y = traction[2 * node + 1] - ease * (influence[2 * node + 1] @ traction)
            held = 1.0 - friction_projection(x, y, bound[node])
            change = max(change, abs(held * x - traction[2 * node]), abs(held * y - traction[2 * node + 1]))
            traction[2 * node] = held * x
            traction[2 * node + 1] = held * y
    return change / bound.max()


@pytest.mark.slow
def test_partial_slip_on_a_half_space():
    """Assert that a sphere dragged over a half space obeys Cattaneo and Mindlin: force to 0.3 %, stick radius to 1 %.

    The projection is the gel's, the layer is not: a dense influence matrix. The theory leaves out the small friction
    across the drag, which is solved for here, so that the two do not meet exactly.
    """
    count, poisson, mu, load_n, radius_m, modulus_pa = 40, 0.48, 0.8, 5.0, 5e-3, 145e3
    pitch_m = 2 * radius_m / count
    line = (np.arange(count) + 0.5) * pitch_m - radius_m
    x, y = (side.ravel() for side in np.meshgrid(line, line))
    x, y = x[np.hypot(x, y) < radius_m], y[np.hypot(x, y) < radius_m]
    influence = cerruti(x, y, pitch_m, modulus_pa, poisson)
    nodal_pa = np.sqrt(1 - (x**2 + y**2) / radius_m**2)
    nodal_pa *= load_n / (nodal_pa.sum() * pitch_m**2)
    traction = np.zeros(2 * len(x))
    for part in (0.3, 0.6, 0.9):  # of the force at which all slips
        slide_m = 3 * mu * load_n * (2 - poisson) / (16 * modulus_pa * radius_m) * (1 - (1 - part) ** (2 / 3))
        assert drag(influence, traction, mu * nodal_pa, slide_m, 100) < 1e-6
        force_n = traction[::2].sum() * pitch_m**2
        assert force_n == pytest.approx(part * mu * load_n, rel=3e-3)
        stuck = np.hypot(traction[::2], traction[1::2]) < mu * nodal_pa * (1 - 1e-6)
        stick_m = math.sqrt(stuck.sum() * pitch_m**2 / math.pi)
        assert stick_m == pytest.approx(radius_m * (1 - part) ** (1 / 3), abs=0.01 * radius_m)


@pytest.mark.slow
def test_linear_stick_against_radau():
    """Assert that an object on the viscoelastic layer follows an independent stiff integrator: 0.6 % at 0.5 ms."""
    material = GelMaterial(squeezes=False, with_mass=False)
    stiffness = 2 * material.shear_modulus_pa * 20e-3 * 15e-3 / material.height_m
    mass_kg, seconds = 0.1, 0.05

    def fall(_, y):
        rate = y[1]
        force = stiffness * (y[0] + material.viscous_time_s * rate) + y[2]
        arm = material.maxwell_share * stiffness * rate - y[2] / material.maxwell_time_s
        return [rate, GRAVITY - force / mass_kg, arm]

    reference = solve_ivp(fall, (0, seconds), [0, 0, 0], "Radau", rtol=1e-11, atol=1e-14).y[0, -1]
    errors = []
    for dt_s in (1e-3, 5e-4, 2.5e-4):
        state = held(pad(4, 4), material)
        for _ in range(round(seconds / dt_s)):
            step(
                state, even(state, 50.0), (mass_kg * GRAVITY, 0, 0), Friction(10, 10), dt_s, theta=0.5, tolerance=1e-10
            )
        errors.append(abs(state.pose[0] / reference - 1))
    assert errors[1] < 0.006
    assert errors[2] < errors[0] / 12


@pytest.mark.slow
@pytest.mark.parametrize(
    "material", [dataclasses.replace(DRY, shear_modulus_pa=1e12), GelMaterial(squeezes=False, shear_modulus_pa=1e12)]
)
def test_stop_distance_of_a_block(material):
    """Assert that a block on a rigid layer stops after v^2 / 2 mu g, to the first order of the time step."""
    friction, speed = Friction(0.5, 0.5), 0.3
    for dt_s, tolerated in ((1e-2, 0.17), (1e-3, 0.017), (1e-4, 0.0017)):
        state = held(pad(4, 4), material, pads=1)
        state.twist[0] = speed
        state.velocity_m_s[..., 0] = 0.0
        steps = 0
        while abs(state.twist[0]) > 1e-6 and steps < 2000:
            info = step(state, even(state, 0.1 * GRAVITY), (0, 0, 0), friction, dt_s, theta=1.0)
            assert info.converged
            steps += 1
        assert state.pose[0] == pytest.approx(speed**2 / (2 * 0.5 * GRAVITY), rel=tolerated)
        assert steps * dt_s == pytest.approx(speed / (0.5 * GRAVITY), abs=2 * dt_s)
        assert abs(state.pose[1]) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(("dt_s", "tolerated"), [(1e-4, 2e-3), (1e-5, 2.5e-4)])
def test_stick_slip_oscillator(dt_s, tolerated):
    """Assert that a node dragged by a belt sticks and slips with the exact period, within 0.2 % at 0.1 ms."""
    mass_kg, stiffness, belt, load_n = 0.1, 1000.0, 0.02, 1.0
    friction = Friction(0.8, 0.5, 1e-9, 0.0)
    area = stiffness * 4e-3 / 145e3
    density = mass_kg * math.pi**2 / (4 * 4e-3 * area)
    material = GelMaterial(squeezes=False, viscous_time_s=0.0, maxwell_share=0.0, density_kg_m3=density)
    state = start(np.zeros((1, 1, 2)), material, 1.0, 1.0, cell_area_m2=area)
    rate = math.sqrt(stiffness / mass_kg)
    drop_m = (friction.static - friction.kinetic) * load_n / stiffness
    period_s = 2 * (math.pi - math.atan(drop_m * rate / belt)) / rate + 2 * drop_m / belt
    nodal, slips, was_stuck = np.full((1, 1), load_n), [], False
    for k in range(round(0.35 / dt_s)):
        step(state, nodal, (0, 0, 0), friction, dt_s, tolerance=1e-10, prescribed_twist=(belt, 0, 0))
        if was_stuck and not state.stuck[0, 0]:
            slips.append(k * dt_s)
        was_stuck = state.stuck[0, 0]
    assert len(slips) == 5
    # the first slip follows another stick, of a spring at rest; the last three periods are the cycle
    assert (slips[4] - slips[1]) / 3 == pytest.approx(period_s, rel=tolerated)


def test_onset_of_gross_slip():
    """Assert that gross slip begins within 1 ms of 2 mu N = m g on a falling force, at a step of 1 ms."""
    state = held(pad(24, 18))
    weight_n = 0.1 * GRAVITY
    expected_s = 0.2 * (2 - weight_n / (2 * 0.8)) / 1.8
    onset_s = math.nan
    for k in range(200):
        load_n = 2.0 - 1.8 * (k + 0.55) * 1e-3 / 0.2
        info = step(state, even(state, load_n), (weight_n, 0, 0), COULOMB, 1e-3)
        assert info.converged
        if info.slip_fraction == 1.0 and math.isnan(onset_s):
            onset_s = (k + 1) * 1e-3
    assert onset_s == pytest.approx(expected_s, abs=1e-3)


@pytest.mark.parametrize(("part", "turns"), [(0.97, False), (1.05, True)])
def test_torque_limit(part, turns):
    """Assert that a flat punch resists a moment up to 2 sum of mu p r, and turns with the rest of one above it."""
    nodes = pad(16, 12)
    limit_nm = 2 * 0.8 * 2.0 * np.hypot(nodes[..., 0], nodes[..., 1]).mean()
    state = held(nodes, inertia=1e-3)
    for k in range(1500):
        moment_nm = part * limit_nm * min(1.0, k / 500)
        info = step(state, even(state, 2.0), (0, 0, moment_nm), COULOMB, 1e-3)
        assert info.converged
        if k == 1000:
            earlier = state.twist[2]
    np.testing.assert_allclose(state.pose[:2], 0, atol=1e-10)
    if turns:
        assert info.slip_fraction == 1.0
        assert (state.twist[2] - earlier) / 0.499 == pytest.approx((part - 1) * limit_nm / 1e-3, rel=0.02)
    else:
        assert abs(state.twist[2]) < 0.01  # against 0.5 rad/s gained in the other case: only swinging


def test_friction_follows_the_stribeck_curve():
    """Assert that steady slip meets mu(v) = mu_k + (mu_s - mu_k) exp(-(v / v_s)^2), against the motion."""
    for speed in (0.0, 2e-3, 1e-2, 0.1):
        state = held(material=DRY, pads=1)
        for _ in range(50):
            twist = (0.6 * speed, -0.8 * speed, 0)
            info = step(state, even(state, 2.0), (0, 0, 0), SLIPPERY, 0.1, theta=1.0, prescribed_twist=twist)
        if speed == 0.0:
            assert info.slip_fraction == 0.0
            continue
        mu = 0.5 + 0.3 * math.exp(-((speed / 0.01) ** 2))
        assert info.slip_fraction == 1.0
        np.testing.assert_allclose(info.friction_n[:2], [0.6 * mu * 2.0, -0.8 * mu * 2.0], rtol=1e-5)
        np.testing.assert_allclose(info.slip_velocity_m_s, twist[:2], rtol=1e-4)
        assert np.allclose(state.slip_m_s, speed, rtol=1e-4)


def test_thickness_resonance():
    """Assert that a free gel rings at sqrt(G / rho) / 4 H, within 0.1 %."""
    material = GelMaterial(squeezes=False, viscous_time_s=0.0, maxwell_share=0.0)
    state = held(material=material)
    state.displacement_m[..., 1] = 1e-5
    state.sheet_m[1] = 1e-5
    dt_s, trace = 1e-5, []
    for _ in range(1000):
        step(state, even(state, 0.0), (0, 0, 0), COULOMB, dt_s, theta=0.5, tolerance=1e-9)
        trace.append(state.displacement_m[2, 3, 1])
    signs = np.signbit(trace)
    falls = np.flatnonzero(~signs[:-1] & signs[1:])
    period_s = (falls[-1] - falls[0]) / (len(falls) - 1) * dt_s
    expected_hz = math.sqrt(material.shear_modulus_pa / material.density_kg_m3) / (4 * material.height_m)
    assert 1 / period_s == pytest.approx(expected_hz, rel=3e-3)
    assert max(trace) == pytest.approx(1e-5, rel=1e-3)  # theta 0.5 loses nothing


def test_free_fall_without_grip():
    """Assert that without normal force the object falls freely, exactly at theta 0.5, and the gel stays at rest."""
    state = held()
    for _ in range(100):
        info = step(state, even(state, 0.0), (0.1 * GRAVITY, 0, 4e-5), COULOMB, 1e-3, theta=0.5)
    np.testing.assert_allclose(state.pose, [0.5 * GRAVITY * 0.01, 0, 0.005], rtol=1e-12)
    np.testing.assert_allclose(state.twist, [GRAVITY * 0.1, 0, 0.1], rtol=1e-12)
    assert not state.displacement_m.any()
    assert info.slip_fraction == 1.0
    assert info.friction_n == (0.0, 0.0, 0.0)


def test_stuck_object_does_not_creep():
    """Assert that at 99 % of the limit the object hangs still for a second: sticking is exact."""
    state = held()
    nodal = even(state, 0.1 * GRAVITY / 2 / 0.8 / 0.99)
    for k in range(2000):
        load = min(1.0, k / 500) * 0.1 * GRAVITY
        step(state, nodal, (load, 0, 0), COULOMB, 1e-3, tolerance=1e-10)
        if k == 999:
            pose_before = state.pose.copy()
    np.testing.assert_allclose(state.pose, pose_before, atol=1e-11)
    assert state.stuck.all()
    stiffness = 2 * 145e3 * 20e-3 * 15e-3 / 4e-3
    assert state.pose[0] == pytest.approx(0.1 * GRAVITY / stiffness, rel=1e-6)


# -- convergence and energy --------------------------------------------------------------------------------------------


def slip_ramp(dt_s, theta=0.55):
    """100 g, force 2 -> 0.2 N in 0.2 s: position and mean gel displacement every 20 ms."""
    state = held()
    rows = []
    for k in range(round(0.2 / dt_s)):
        load_n = 2.0 - 1.8 * (k + theta) * dt_s / 0.2
        info = step(state, even(state, load_n), (0.1 * GRAVITY, 0, 0), COULOMB, dt_s, theta=theta, tolerance=1e-8)
        if round((k + 1) * dt_s * 1e3, 6) % 20 == 0:
            rows.append((state.pose[0], info.gel_displacement_m[0]))
    return np.array(rows)


def test_convergence_in_a_slip_ramp():
    """Assert that at theta 0.55 the rms error falls with a slope of at least 0.9 in the time step, 5 um at 1 ms."""
    reference = slip_ramp(2e-5)
    steps_s = np.array([4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4])
    errors = np.array([np.sqrt(((slip_ramp(dt_s) - reference) ** 2).mean(0)) for dt_s in steps_s])
    assert len(reference) == 10
    for column in range(2):
        assert np.polyfit(np.log(steps_s), np.log(errors[:, column]), 1)[0] >= 0.9
    assert (errors[2] < 5e-6).all()
    assert (reference[-1] > [1e-3, 1e-6]).all()


def squeezing_work(state, nodal, before_m):
    """Work in J of what pressure exerts on the surface of all pads aside, since it was displaced by before_m."""
    return state.pads * float((state.squeezed(nodal) * (state.displacement_m - before_m)).sum())


# -- invariances -------------------------------------------------------------------------------------------------------


def run(nodes, shares, force, inertia=4e-5, friction=SLIPPERY, **changes):
    """A trial through stick, partial and gross slip in the frame given: pose, and displacement of the nodes."""
    state = start(nodes, PLAIN, 0.1, inertia, **changes)
    for k in range(60):
        load_n = 1.0 - 0.012 * k
        step(state, load_n * shares, force, friction, 1e-3, tolerance=1e-12, max_sweeps=5000)
    return state.pose, state.displacement_m, state.stuck


NODES = pad(9, 6)
SHARES = dome(NODES) * (1 + 30 * NODES[..., 0] - 20 * NODES[..., 1])
FORCE = np.array([0.9, 0.25, 1e-3])


@pytest.fixture(scope="module")
def plain():
    """The trial as it is."""
    return run(NODES, SHARES, FORCE)


def test_trial_slips_and_turns(plain):
    """Assert that the trial used for invariances moves along all of its freedoms."""
    assert (np.abs(plain[0]) > [1e-4, 1e-5, 1e-3]).all()


@pytest.mark.parametrize(("rows", "friction"), [(6, COULOMB), (7, COULOMB), (7, SLIPPERY)])
def test_mirror(rows, friction):
    """Assert that a trial mirrored in y gives the mirrored motion.

    With friction that falls with speed only on a grid whose nodes keep their turn in a sweep when it is mirrored:
    bounds are refreshed in the first rounds alone, so what they are then depends a little on the order of the nodes.
    """
    nodes = pad(9, rows)
    shares = dome(nodes) * (1 + 30 * nodes[..., 0] - 20 * nodes[..., 1])
    plain = run(nodes, shares, FORCE, friction=friction)
    pose, displacement, stuck = run(nodes, shares[::-1], FORCE * [1, -1, -1], friction=friction)
    np.testing.assert_allclose(pose * [1, -1, -1], plain[0], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(displacement[::-1] * [1, -1], plain[1], rtol=1e-7, atol=1e-12)
    assert (stuck[::-1] == plain[2]).all()


def test_quarter_turn():
    """Assert that a trial turned by 90 degrees, grid and all, gives the turned motion.

    Friction is constant, as the sheet's x comes before its y in a sweep: see `test_mirror`.
    """
    plain = run(NODES, SHARES, FORCE, friction=COULOMB)
    nodes = pad_nodes(6, 9, Y_RANGE_M, X_RANGE_M)  # (x, y) -> (y, -x): new x from old y, new y from old -x
    shares = SHARES.T[::-1]
    pose, displacement, _ = run(nodes, shares, [FORCE[1], -FORCE[0], FORCE[2]], friction=COULOMB)
    np.testing.assert_allclose([-pose[1], pose[0], pose[2]], plain[0], rtol=1e-7, atol=1e-12)
    old = np.stack([-displacement[..., 1], displacement[..., 0]], axis=-1)[::-1].transpose(1, 0, 2)
    np.testing.assert_allclose(old, plain[1], rtol=1e-7, atol=1e-12)


def test_shifted_origin(plain):
    """Assert that nothing depends on where the origin lies."""
    shift = np.array([0.03, -0.02])
    pose, displacement, _ = run(NODES + shift, SHARES, FORCE, body_xy_m=tuple(shift))
    np.testing.assert_allclose(pose - [*shift, 0], plain[0], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(displacement, plain[1], rtol=1e-7, atol=1e-12)


def test_one_pad_holds_half(plain):
    """Assert that one pad with half the mass, inertia and force moves as two pads do."""
    state = start(NODES, PLAIN, 0.05, 2e-5, pads=1)
    for k in range(60):
        step(state, (1.0 - 0.012 * k) * SHARES, FORCE / 2, SLIPPERY, 1e-3, tolerance=1e-12, max_sweeps=5000)
    np.testing.assert_allclose(state.pose, plain[0], rtol=1e-7, atol=1e-12)


def test_centre_of_mass_off_the_pad_turns():
    """Assert that an object held beside its centre of mass swings under gravity, towards the lower energy."""
    state = held(body_xy_m=(0.0, 12e-3), inertia=1e-4)
    for _ in range(1500):
        info = step(state, even(state, 2.0), (0.1 * GRAVITY, 0, 0), COULOMB, 1e-3, theta=1.0)
    moment_nm = 0.1 * GRAVITY * 12e-3  # about the pad's centre: gravity along x at y = 12 mm
    assert 2 * info.friction_n[2] == pytest.approx(-moment_nm, rel=1e-2)
    assert state.pose[2] < 0


# -- means, copies, prescribed motion ----------------------------------------------------------------------------------


def test_info_balances_forces():
    """Assert that friction, elastic force and weight of an object at rest are one and the same, and means are means."""
    state = held(pad(24, 18))
    shares = dome(pad(24, 18))
    for _ in range(500):
        info = step(state, 2.0 * shares, (0.1 * GRAVITY, 0, 0), COULOMB, 1e-3, tolerance=1e-8)
    assert info.friction_n[0] == pytest.approx(0.1 * GRAVITY / 2, rel=1e-4)
    assert info.friction_n[1:] == pytest.approx((0, 0), abs=1e-7)
    mean = (shares[..., None] * state.displacement_m).sum((0, 1))
    assert info.gel_displacement_m == pytest.approx(tuple(mean), rel=1e-12)
    assert info.slip_fraction == (state.slip_m_s[shares > 0] > 0).mean()
    assert ((state.slip_m_s == 0) == state.stuck)[shares > 0].all()


@pytest.mark.parametrize("twist", [(1e-3, -2e-3, 0.0), (0.0, 0.0, 0.05)])
def test_prescribed_motion_is_followed_exactly(twist):
    """Assert that a prescribed object moves as told whatever the forces, and drags the nodes that stick."""
    state = held()
    for _ in range(20):
        info = step(state, even(state, 50.0), (1e3, 1e3, 1e3), COULOMB, 1e-3, prescribed_twist=twist)
    np.testing.assert_allclose(state.pose, 0.02 * np.array(twist), rtol=1e-12)
    np.testing.assert_allclose(state.twist, twist)
    assert info.converged
    assert state.stuck.all()
    turned = np.stack([-pad()[..., 1], pad()[..., 0]], axis=-1)
    np.testing.assert_allclose(state.displacement_m, 0.02 * (np.array(twist[:2]) + twist[2] * turned), rtol=1e-9)


def test_restored_step_repeats_bit_for_bit():
    """Assert that copy and restore bring back all that a step depends on, and that a copy lives on its own."""
    state = held()
    nodal = even(state, 0.55)
    for _ in range(30):
        step(state, nodal, (0.1 * GRAVITY, 0.05, 1e-3), SLIPPERY, 1e-3)
    earlier = state.copy()
    first = step(state, nodal, (0.1 * GRAVITY, 0.05, 1e-3), SLIPPERY, 1e-3)
    after = state.copy()
    state.restore(earlier)
    step(state, nodal, (0, 0, 0), SLIPPERY, 1e-3, prescribed_twist=(0.1, 0, 0))
    state.restore(earlier)
    assert step(state, nodal, (0.1 * GRAVITY, 0.05, 1e-3), SLIPPERY, 1e-3) == first
    assert step(earlier, nodal, (0.1 * GRAVITY, 0.05, 1e-3), SLIPPERY, 1e-3) == first
    for name in ("pose", "twist", "displacement_m", "velocity_m_s", "maxwell_n", "slip_m_s", "stuck"):
        np.testing.assert_array_equal(getattr(state, name), getattr(after, name))
        np.testing.assert_array_equal(getattr(earlier, name), getattr(after, name))


def test_too_few_sweeps_are_reported():
    """Assert that a search cut short says so, keeps to its sweeps, and still makes a finite step."""
    for most in (1, 2, 3, 4, 5):
        state = held(pad(24, 18))
        info = step(state, 0.7 * dome(pad(24, 18)), (0.1 * GRAVITY, 0.1, 2e-3), SLIPPERY, 1e-3, max_sweeps=most)
        assert not info.converged
        assert info.sweeps == most
        assert info.residual > 1e-6
        assert np.isfinite(state.displacement_m).all()


# -- interpolation -----------------------------------------------------------------------------------------------------


def test_interpolation_is_exact_for_linear_fields():
    """Assert that inside the nodes linear fields, and between neighbours products x * y, are met exactly."""
    nodes = pad(5, 4)
    state = held(nodes)
    rng = np.random.default_rng(1)
    points = rng.uniform([-8e-3, -5.6e-3], [8e-3, 5.6e-3], (200, 2))
    state.displacement_m[..., 0] = 1e-5 + 0.2 * nodes[..., 0] - 0.1 * nodes[..., 1]
    state.displacement_m[..., 1] = nodes[..., 0] * nodes[..., 1]
    indices, weights = interpolation(nodes, points)
    assert indices.shape == weights.shape == (200, 4)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-12)
    assert (weights >= 0).all()
    result = displacement_at(state, indices, weights)
    x, y = points.T
    np.testing.assert_allclose(result, np.stack([1e-5 + 0.2 * x - 0.1 * y, x * y], axis=-1), atol=1e-15)
    at_nodes = displacement_at(state, *interpolation(nodes, nodes.reshape(-1, 2)))
    np.testing.assert_allclose(at_nodes, state.displacement_m.reshape(-1, 2), atol=1e-18)


def test_interpolation_decays_outside():
    """Assert that beyond the pad's border the displacement there decays with exp(-distance / 2.3 mm)."""
    nodes = pad(5, 4)
    state = held(nodes)
    state.displacement_m[..., 0] = 1.0
    points = np.array([[10e-3, 0], [12.3e-3, 0], [-14.6e-3, 0], [0, 9.8e-3], [13e-3, 11.5e-3], [5.0, 5.0]])
    result = displacement_at(state, *interpolation(nodes, points))[:, 0]
    expected = [1, math.exp(-1), math.exp(-2), math.exp(-1), math.exp(-5 / 2.3), 0]
    np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-30)
    assert displacement_at(state, *interpolation(nodes, np.empty((0, 2)))).shape == (0, 2)


# -- stiff and extreme cases -------------------------------------------------------------------------------------------

EXTREMES = {
    **{
        f"gel x {factor:g}": {"material": GelMaterial(squeezes=False, shear_modulus_pa=145e3 * factor)}
        for factor in (1e-2, 1e4, 1e6)
    },
    **{f"mass {mass:g}": {"mass_kg": mass, "inertia": mass * 4e-4} for mass in (1e-6, 1e-3, 1.0, 1e3)},
    **{f"mu {mu:g}": {"friction": Friction(mu, mu)} for mu in (0.0, 1e-3, 10.0, 1e3)},
    "stribeck": {"load": lambda t: 1 - 3 * t, "friction": SLIPPERY},
    "dome": {
        "nodes": pad(),
        "shares": dome(pad()),
        "material": GelMaterial(),
        "load": lambda t: 1.5 - 5 * t,
        "friction": SLIPPERY,
        "force": lambda t: (0.9, 0.2, 0.002),
    },
    "no grip": {"load": lambda t: 0.0},
    "grip of 1e6 N": {"load": lambda t: 1e6},
    "grip lost and regained": {"load": lambda t: 2.0 if int(50 * t) % 2 == 0 else 0.0},
    **{f"dt {dt:g}": {"dt_s": dt} for dt in (1e-7, 1e-2, 1e-1, 10.0)},
    "impact 100 m/s": {"twist": (100.0, 0, 0)},
    "impact 1e4 m/s": {"twist": (1e4, 0, 0), "mass_kg": 1.0},
    "spin 1e4 rad/s": {"twist": (0, 0, 1e4)},
    "torque": {"force": lambda t: (0, 0, 0.02)},
    "shaking 498 Hz": {"force": lambda t: (2 * math.sin(2 * math.pi * 498 * t), 0.98, 0), "load": lambda t: 5.0},
    "no mass, no damping": {"material": DRY},
    "maxwell 1e-9 s": {"material": GelMaterial(squeezes=False, maxwell_time_s=1e-9)},
    "maxwell 1e9 s": {"material": GelMaterial(squeezes=False, maxwell_time_s=1e9)},
    "one column": {"nodes": pad(1, 6), "area": 50e-6},
    "one node": {"nodes": pad(1, 1), "area": 300e-6},
    "64 x 48 nodes": {"nodes": pad(64, 48), "steps": 40},
}


@pytest.mark.parametrize("theta", [0.5, 0.55, 1.0])
@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_cases_stay_finite(name, theta):
    """Assert that every step converges, stays finite, and that no energy is gained."""
    case = EXTREMES[name]
    nodes = case.get("nodes", pad(12, 9))
    mass_kg, dt_s = case.get("mass_kg", 0.1), case.get("dt_s", 1e-3)
    state = start(nodes, case.get("material", PLAIN), mass_kg, case.get("inertia", 4e-5), cell_area_m2=case.get("area"))
    state.twist[:] = case.get("twist", (0, 0, 0))
    load = case.get("load", lambda t: 2.0)
    force = case.get("force", lambda t: (mass_kg * GRAVITY, 0, 0))
    first = energy(state)
    work, largest = 0.0, max(first, 1e-12)
    for k in range(case.get("steps", 100)):
        time_s = (k + theta) * dt_s
        before, before_m = state.pose.copy(), state.displacement_m.copy()
        nodal = load(time_s) * case.get("shares", even(state, 1.0))
        info = step(state, nodal, force(time_s), case.get("friction", COULOMB), dt_s, theta=theta)
        assert info.converged, (k, info)
        work += np.dot(force(time_s), state.pose - before) + squeezing_work(state, nodal, before_m)
        largest = max(largest, abs(work), energy(state))
        assert energy(state) - first - work <= 1e-5 * largest
    for array in (state.pose, state.twist, state.displacement_m, state.velocity_m_s, state.maxwell_n):
        assert np.isfinite(array).all()
    assert all(np.isfinite(np.hstack(info)))


def hard_case(seed, squeezes):
    """Anything from a crumb to a brick, on gels from jelly to glass, gripped anyhow and shaken, for 40 steps."""
    rng = np.random.default_rng(seed)

    def logarithmic(low, high):
        return 10 ** rng.uniform(low, high)

    columns, rows = (int(count) for count in rng.integers(1, 20, 2))
    nodes = pad(columns, rows)
    material = GelMaterial(
        squeezes=squeezes,
        shear_modulus_pa=145e3 * logarithmic(-2, 4),
        density_kg_m3=logarithmic(2, 4),
        viscous_time_s=logarithmic(-6, -2),
        maxwell_share=rng.uniform(0, 0.5),
        maxwell_time_s=logarithmic(-5, 1),
        coupled=bool(rng.random() < 0.8),
        with_mass=bool(rng.random() < 0.8),
    )
    mass_kg, mu = logarithmic(-3, 1), logarithmic(-1, 0.5)
    friction = Friction(mu, mu * rng.uniform(0.3, 1), logarithmic(-4, -1))
    centre_m = tuple(rng.normal(0, 5e-3, 2))
    state = start(
        nodes,
        material,
        mass_kg,
        mass_kg * logarithmic(-6, -2),
        body_xy_m=centre_m,
        cell_area_m2=300e-6 / columns / rows,
    )
    gap = gap_profile(nodes, rng.choice(["flat", "cylinder", "sphere"]), logarithmic(-2.3, -1), rng.normal(0, 0.01))
    depth_m, dt_s = logarithmic(-5, -3.3), logarithmic(-4.5, -2)
    force = mass_kg * np.array([GRAVITY, rng.normal(), 0.1 * rng.normal()])
    grip_n, rate = mass_kg * GRAVITY / mu * rng.uniform(0.2, 3), rng.uniform(5, 100)
    loads = [pressure(depth_m, gap, grip_n * (1 + 0.9 * math.sin(rate * k * dt_s))) for k in range(40)]
    return state, loads, force, friction, dt_s, float(rng.choice([0.5, 0.55, 0.75, 1.0]))


@pytest.mark.parametrize("squeezes", [False, True])
@pytest.mark.parametrize("seed", [*range(30), 192, 279])
def test_random_hard_cases_find_their_balance(seed, squeezes):
    """Assert that whatever is held, every step finds its balance within 400 sweeps and gains no energy."""
    state, loads, force, friction, dt_s, theta = hard_case(seed, squeezes)
    work, largest = 0.0, 1e-12
    for nodal in loads:
        before, before_m = state.pose.copy(), state.displacement_m.copy()
        info = step(state, nodal, force, friction, dt_s, theta=theta)
        assert info.converged, info
        work += force @ (state.pose - before) + squeezing_work(state, nodal, before_m)
        largest = max(largest, abs(work), energy(state))
        assert energy(state) - work <= 1e-5 * largest


# -- refusals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {"static": np.nan, "kinetic": 0.1},
        {"static": -0.1, "kinetic": -0.1},
        {"static": 0.5, "kinetic": 0.6},
        {"static": 0.8, "kinetic": 0.5, "stribeck_speed_m_s": 0.0},
    ],
)
def test_friction_of_nonsense(values):
    """Assert that coefficients below 0 or that rise with speed are refused."""
    with pytest.raises(ValueError, match="found"):
        Friction(**values)


@pytest.mark.parametrize(
    ("changes", "spoilt"),
    [
        *(({"nodal_force_n": np.full((6, 8), value)}, None) for value in (np.nan, np.inf, -1e-9)),
        ({"dt_s": np.nan}, None),
        ({"theta": 0.4}, None),
        ({"body_force_n": (np.inf, 0, 0)}, None),
        ({"prescribed_twist": (np.nan, 0, 0)}, None),
        *(({}, name) for name in ("pose", "twist", "displacement_m", "inertia")),
    ],
)
def test_step_refuses_nonsense_and_changes_nothing(changes, spoilt):
    """Assert that values that make no sense, and a state spoilt with NaN, are refused before anything is changed."""
    state = held()
    good = {"nodal_force_n": even(state, 0.6), "body_force_n": (0.98, 0, 0), "friction": SLIPPERY, "dt_s": 1e-3}
    for _ in range(5):
        step(state, **good)
    if spoilt is not None:
        getattr(state, spoilt)[0] = np.nan
    before = state.copy()
    with pytest.raises(ValueError, match=r"must|not finite|expected"):
        step(state, **(good | changes))
    for name in ("pose", "twist", "displacement_m", "velocity_m_s", "maxwell_n", "slip_m_s", "stuck", "inertia"):
        np.testing.assert_array_equal(getattr(state, name), getattr(before, name))


def test_cell_area_is_read_off_the_grid():
    """Assert that start finds the area of a cell, and that the stiffness of the pad does not depend on the grid."""
    for columns, rows in ((4, 4), (24, 18)):
        state = held(pad(columns, rows), pads=1)
        assert state.cell_area_m2 == pytest.approx(cell_area(pad(columns, rows)))
        state.displacement_m[..., 0] = 1e-4
        state.sheet_m[0] = 1e-4
        assert energy(state) == pytest.approx(0.5 * 145e3 * 300e-6 / 4e-3 * 1e-8, rel=1e-12)
