"""The gel's steps converge, and its layer agrees with dense matrices and with the exact layer."""

import math
from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.evaluate.cost.simulator import draw_trial, falling
from evetac_cli.kernels.gel_layer import SPRING, compliance
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.contact import pad_nodes
from evetac_cli.sim.gel.sheet import SheetStencil, pull_sheet, relax_sheet
from tests.quick import few
from tests.sim.gel.dense_layer import dense_layer, simulate, simulate_dense

COARSE = replace(draw_trial(0), columns=12, rows=9)
SHORT = replace(COARSE, load=falling(2.0, 0.2, 0.05), seconds=0.05)
# Held so fast that nothing slips: the motion is smooth.
STICK = replace(SHORT, load=lambda _: 50.0, friction=gel.Friction(10, 10))


def slope(steps_us, errors):
    return np.polyfit(np.log(steps_us), np.log(errors), 1)[0]


def test_first_order_while_slipping():
    """Assert a slope of at least 0.9 over 2 to 0.1 ms, by the object and, at theta 0.51, by the gel."""
    reference = simulate(SHORT, 5e-6, 0.51, tolerance=1e-8)
    steps_us = (2000, 1000, 500, 200, 100)
    for theta, columns in ((1.0, (0,)), (0.51, (0, 1))):
        errors = [simulate(SHORT, 1e-6 * dt_us, theta).errors_um(reference) for dt_us in steps_us]
        for column in columns:
            assert slope(steps_us, [error[column] for error in errors]) >= 0.9


@pytest.mark.parametrize(("theta", "least"), few([(1.0, 0.9), (0.51, 0.9), (0.5, 1.8)], (1.0, 0.9), (0.5, 1.8)))
def test_order_in_a_smooth_phase(theta, least):
    """Assert the slopes where everything sticks, by object and gel: 0.9 for theta 1 and 0.51, 1.8 for theta 0.5."""
    reference = simulate(STICK, 2.5e-6, 0.5, tolerance=1e-10)
    # theta 1 is of first order only where a step is short against the bounce's damping
    steps_us = (40, 25, 20, 12.5) if theta == 1.0 else (500, 250, 200, 100)
    errors = [simulate(STICK, 1e-6 * us, theta, tolerance=1e-10).errors_um(reference) for us in steps_us]
    assert slope(steps_us, [error[0] for error in errors]) >= least
    assert slope(steps_us, [error[1] for error in errors]) >= least


def pushed(dt_s, theta):
    """COARSE, held fast, pushed and let go within 0.2 s: position and displacement of the gel every 20 ms.

    The push begins with its first five derivatives at zero, so that nothing rings which a step of 2 ms cannot follow;
    nor does the grip squeeze the gel aside, as it is there from the first step.
    """
    state, shares = replace(COARSE, material=replace(COARSE.material, squeezes=False)).start()
    nodal_n = 50.0 * shares
    rows = []
    for k in range(round(0.2 / dt_s)):
        push_n = 0.981 * math.sin(math.pi * (k + theta) * dt_s / 0.2) ** 6
        force = (push_n, 0.3 * push_n, 0.0)
        gel.step(state, nodal_n, force, STICK.friction, dt_s, theta=theta, tolerance=1e-11, max_sweeps=4000)
        if (k + 1) % round(0.02 / dt_s) == 0:
            rows.append((state.pose[:2].copy(), state.displacement_m.copy()))
    return [np.array(column) for column in zip(*rows, strict=True)]


def test_order_under_a_slow_push():
    """Assert the slopes over 2 to 0.25 ms where all that moves is resolved, and that 0.51 beats 1 up to 1 ms."""
    reference = pushed(5e-5, 0.5)
    steps_us = (2000, 1000, 500, 250)
    errors = {}
    for theta in (1.0, 0.51, 0.5):
        runs = [pushed(1e-6 * dt_us, theta) for dt_us in steps_us]
        square = [
            [((ours - true) ** 2).sum(-1).mean() for ours, true in zip(run, reference, strict=True)] for run in runs
        ]
        errors[theta] = np.sqrt(square)
    for theta, least in ((1.0, 0.9), (0.51, 0.9), (0.5, 1.8)):
        for column in range(2):
            assert slope(steps_us, errors[theta][:, column]) >= least
    assert (errors[0.51][1:] < errors[1.0][1:]).all()


@pytest.mark.parametrize("order", [0, 1])
def test_an_independent_search_finds_the_same_motion(order):
    """Assert that alternating directions on a dense matrix agree with `gel.step` to 0.1 nm, through stick and slip."""
    trial = replace(SHORT, material=replace(SHORT.material, coupled=order == 1))
    ours = simulate(trial, 1e-3, 0.51, tolerance=1e-10)
    theirs = simulate_dense(SHORT, order, 1e-3, 0.51, tolerance=1e-10)
    assert max(ours.errors_um(theirs)) < 1e-4
    assert abs(ours.pose[-1, 0] - ours.pose[1, 0]) > 1e-4
    np.testing.assert_allclose(ours.pose, theirs.pose, atol=1e-8)


def wide_pad():
    """The layer on 32 x 24 nodes of 40 mm by 30 mm, of which the middle is far from all edges."""
    nodes = pad_nodes(32, 24, (-20e-3, 20e-3), (-15e-3, 15e-3))
    return gel.start(nodes, gel.GelMaterial(), 0.1, 1e-5)


@pytest.mark.parametrize("wavelength_m", few([8e-3, 12e-3, 20e-3], 8e-3))
def test_the_exact_layer_answers_waves(wavelength_m):
    """Assert that order 2 answers waves of shear and pressure as the closed form does, in the middle of a large pad.

    Within 4 % (edges), where forces and displacements are means over cells of 1.25 mm.
    """
    state = wide_pad()
    height_m, modulus_pa = state.material.height_m, state.material.shear_modulus_pa
    k = 2 * math.pi / wavelength_m
    exact = compliance(np.array([k]), height_m, modulus_pa)
    layer = dense_layer(state, 2)
    nodes, count = state.node_xy_m, state.stuck.size
    wave, slope = np.cos(k * nodes[..., 0]).ravel(), np.sin(k * nodes[..., 0]).ravel()
    middle = ((np.abs(nodes[..., 0]) < 5e-3) & (np.abs(nodes[..., 1]) < 3e-3)).ravel()
    none = np.zeros(count)
    of_cells = np.sinc(1.25e-3 / wavelength_m) ** 2

    def answer(force, axis, pattern):
        moved = np.linalg.solve(layer.stiffness, state.cell_area_m2 * force)[axis * count : (axis + 1) * count]
        return moved[middle] @ pattern[middle] / (pattern[middle] @ pattern[middle]) / of_cells

    assert answer(np.concatenate([wave, none]), 0, wave) == pytest.approx(exact.along[0], rel=0.04)
    assert answer(np.concatenate([none, wave]), 1, wave) == pytest.approx(exact.across[0], rel=0.04)
    assert answer(layer.squeeze @ wave, 0, -slope) == pytest.approx(exact.aside[0], rel=0.04)


def test_dense_layers_are_symmetric():
    """Assert that layers are symmetric, resist an even displacement by a G/H or, going on, more, and others by more."""
    state, _ = COARSE.start()
    for order, goes_on in ((0, False), (1, False), (1, True), (2, True)):
        layer = dense_layer(state, order, goes_on=goes_on)
        np.testing.assert_allclose(layer.stiffness, layer.stiffness.T, atol=1e-9 * layer.stiffness.max())
        shear = state.constant("shear")
        softest, stiffest = np.linalg.eigvalsh(layer.stiffness)[[0, -1]] / shear
        assert softest == pytest.approx(1, rel=1e-9) if not goes_on else softest > 1.2
        least, most = ((1 - 1e-9, 1 + 1e-9), (4.0, 1 + SPRING), (1 + SPRING, np.inf))[order]
        assert least < stiffest < most


def test_the_dense_sheet_is_that_of_the_gel():
    """Assert that a displacement stores the energy that order 1 says, and that pressure squeezes as in the gel."""
    state, normal = COARSE.start()
    layer = dense_layer(state, 1)
    rng = np.random.default_rng(0)
    state.displacement_m[:] = rng.normal(0, 1e-5, state.displacement_m.shape)
    after, source = np.zeros(11 * 14), np.zeros((2, 9 * 14))
    pull_sheet(state.displacement_m, source)
    stretch = SheetStencil(*(state.constant(name) for name in SheetStencil._fields))
    for _ in range(200):
        relax_sheet(state.sheet_m, source, stretch, state.pad.sheet_rule, after)
    moved = np.moveaxis(state.displacement_m, 2, 0).ravel()
    assert gel.energy(state) == pytest.approx(0.5 * state.pads * moved @ layer.stiffness @ moved, rel=1e-9)
    squeezed = np.moveaxis(state.squeezed(normal), 2, 0).ravel()
    np.testing.assert_allclose(layer.squeeze @ normal.ravel(), squeezed, atol=1e-9 * squeezed.max())


def test_orders_of_the_layer():
    """Assert that order 1 is nearer to the exact layer than order 0, and within a tenth of it where both go on."""
    exact = simulate_dense(SHORT, 2, 1e-3, 0.51)
    springs = replace(SHORT, material=replace(SHORT.material, coupled=False))
    winkler, sheet = (simulate(trial, 1e-3, 0.51).errors_um(exact) for trial in (springs, SHORT))
    wide = simulate_dense(SHORT, 1, 1e-3, 0.51, goes_on=True).errors_um(exact)
    for column in range(2):
        assert sheet[column] < winkler[column]
        assert wide[column] < winkler[column] / 10
