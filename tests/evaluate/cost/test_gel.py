"""Error against run time of the mechanics: convergence, an independent solver, the explicit integrator, the rows."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.evaluate.cost import gel as cost
from evetac_cli.evaluate.cost.gel import (
    EXPLICIT_US,
    NODES,
    REFERENCE_US,
    STEPS_US,
    errors_um,
    explicit_row,
    implicit_row,
    layer_rows,
    mechanics_rows,
    node_rows,
    row,
    row_count,
    time_reference,
    time_step_text,
)
from evetac_cli.evaluate.cost.gel_reference import dense_layer, simulate_dense, simulate_explicit
from evetac_cli.evaluate.cost.gel_trial import GelMotion, draw_trial, simulate
from evetac_cli.evaluate.rows import Extent
from evetac_cli.kernels.gel_layer import SPRING, compliance
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.contact import pad_nodes
from evetac_cli.sim.gel.sheet import pull_sheet, relax_sheet

COARSE = replace(draw_trial(0), columns=12, rows=9)
SHORT = replace(COARSE, seconds=0.05)
# Held so fast that nothing slips: the motion is smooth.
STICK = replace(SHORT, first_n=50.0, last_n=50.0, friction=gel.Friction(10, 10))


def slope(steps_us, errors):
    return np.polyfit(np.log(steps_us), np.log(errors), 1)[0]


@pytest.fixture(scope="module")
def falling():
    """The whole trial, its reference, and the bound of the reference's own error."""
    return COARSE, *time_reference(COARSE)


# -- convergence -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_trial_sticks_slips_and_turns(falling):
    """Assert that the trial does all that is to be compared: hangs within 0.1 mm, falls by 1 mm later, and turns."""
    trial, reference, _ = falling
    hangs_m = reference.pose[4, 0] - trial.centre_m[0]
    assert 0 < hangs_m < 1e-4
    assert reference.pose[-1, 0] - trial.centre_m[0] > 1e-3
    assert abs(reference.pose[-1, 2]) > 0.01


def test_the_reference_is_bounded(falling):
    """Assert that step doubling puts the reference's error below a tenth of that of theta 0.51 at 0.1 ms."""
    trial, reference, bound = falling
    least = implicit_row(trial, reference, 0.51, 100)
    for name in ("error_um_object_rms", "error_um_gel_rms"):
        assert 0 < bound[name] < least[name] / 10


def test_first_order_while_slipping(falling):
    """Assert a slope of at least 0.9 for theta 1 and 0.51 over 2 to 0.1 ms, by the object and, at 0.51, by the gel."""
    trial, reference, _ = falling
    steps_us = (2000, 1000, 500, 200, 100)
    for theta in (1.0, 0.51):
        rows = [implicit_row(trial, reference, theta, dt_us) for dt_us in steps_us]
        assert slope(steps_us, [entry["error_um_object_rms"] for entry in rows]) >= 0.9
        if theta == 0.51:
            assert slope(steps_us, [entry["error_um_gel_rms"] for entry in rows]) >= 0.9


def test_gel_at_theta_1_needs_small_steps(falling):
    """Assert that theta 1, which damps the gel's bounce away, reaches a slope of 0.9 by the gel below 50 us."""
    trial, _, _ = falling
    trial = replace(trial, seconds=0.05)
    reference, _ = time_reference(trial, 2.5)
    steps_us = (50, 40, 25, 20)
    errors = [errors_um(simulate(trial, 1e-6 * dt_us, 1.0, tolerance=1e-8), reference)[1] for dt_us in steps_us]
    assert slope(steps_us, errors) >= 0.9


@pytest.mark.parametrize(("theta", "least"), [(1.0, 0.9), (0.51, 0.9), (0.5, 1.8)])
def test_order_in_a_smooth_phase(theta, least):
    """Assert the slopes where everything sticks, by object and gel: 0.9 for theta 1 and 0.51, 1.8 for theta 0.5."""
    reference = simulate(STICK, 2.5e-6, 0.5, tolerance=1e-10)
    # theta 1 is of first order only where a step is short against the bounce's damping
    steps_us = (40, 25, 20, 12.5) if theta == 1.0 else (500, 250, 200, 100)
    errors = [errors_um(simulate(STICK, 1e-6 * us, theta, tolerance=1e-10), reference) for us in steps_us]
    assert slope(steps_us, [error[0] for error in errors]) >= least
    assert slope(steps_us, [error[1] for error in errors]) >= least


def pushed(dt_s, theta):
    """COARSE, held fast, pushed and let go within 0.2 s: position and displacement of the gel every 20 ms.

    The push begins with its first five derivatives at zero, so that nothing rings which a step of 2 ms cannot follow;
    nor does the grip squeeze the gel aside, as it is there from the first step.
    """
    state = replace(COARSE, material=replace(COARSE.material, squeezes=False)).start()
    nodal_n = 50.0 * COARSE.shares(state)
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


@pytest.mark.slow
def test_theta_055_is_better_than_1(falling):
    """Assert that theta 0.51 has the smaller error at every time step of 1 ms or less, slipping or not."""
    smooth = simulate(STICK, 2.5e-6, 0.5, tolerance=1e-10)
    for trial, reference in (falling[:2], (STICK, smooth)):
        for dt_us in (1000, 500, 200, 100, 50):
            damped, usual = (implicit_row(trial, reference, theta, dt_us) for theta in (1.0, 0.51))
            for name in ("error_um_object_rms", "error_um_gel_rms"):
                assert usual[name] < damped[name]


# -- another solver, other layers --------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [0, 1])
def test_an_independent_search_finds_the_same_motion(order):
    """Assert that alternating directions on a dense matrix agree with `gel.step` to 0.1 nm, through stick and slip."""
    trial = replace(SHORT, material=replace(SHORT.material, coupled=order == 1))
    ours = simulate(trial, 1e-3, 0.51, tolerance=1e-10)
    theirs = simulate_dense(SHORT, order, 1e-3, 0.51, tolerance=1e-10)
    assert max(errors_um(ours, theirs)) < 1e-4
    assert abs(ours.pose[-1, 0] - ours.pose[1, 0]) > 1e-4
    np.testing.assert_allclose(ours.pose, theirs.pose, atol=1e-8)


def wide_pad():
    """The layer on 32 x 24 nodes of 40 mm by 30 mm, of which the middle is far from all edges."""
    nodes = pad_nodes(32, 24, (-20e-3, 20e-3), (-15e-3, 15e-3))
    return gel.start(nodes, gel.GelMaterial(), 0.1, 1e-5)


@pytest.mark.parametrize("wavelength_m", [8e-3, 12e-3, 20e-3])
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
    state = COARSE.start()
    for order, goes_on in ((0, False), (1, False), (1, True), (2, True)):
        layer = dense_layer(state, order, goes_on=goes_on)
        np.testing.assert_allclose(layer.stiffness, layer.stiffness.T, atol=1e-9 * layer.stiffness.max())
        shear = state._layer.shear
        softest, stiffest = np.linalg.eigvalsh(layer.stiffness)[[0, -1]] / shear
        assert softest == pytest.approx(1, rel=1e-9) if not goes_on else softest > 1.2
        least, most = ((1 - 1e-9, 1 + 1e-9), (4.0, 1 + SPRING), (1 + SPRING, np.inf))[order]
        assert least < stiffest < most


def test_the_dense_sheet_is_that_of_the_gel():
    """Assert that a displacement stores the energy that order 1 says, and that pressure squeezes as in the gel."""
    state = COARSE.start()
    layer = dense_layer(state, 1)
    rng = np.random.default_rng(0)
    state.displacement_m[:] = rng.normal(0, 1e-5, state.displacement_m.shape)
    after, source = np.zeros(11 * 14), np.zeros((2, 9 * 14))
    pull_sheet(state.displacement_m, source)
    for _ in range(200):
        relax_sheet(state.sheet_m, source, state._layer.stretch, state._sheet_rule, after)
    moved = np.moveaxis(state.displacement_m, 2, 0).ravel()
    assert gel.energy(state) == pytest.approx(0.5 * state.pads * moved @ layer.stiffness @ moved, rel=1e-9)
    normal = COARSE.shares(state)
    squeezed = np.moveaxis(state.squeezed(normal), 2, 0).ravel()
    np.testing.assert_allclose(layer.squeeze @ normal.ravel(), squeezed, atol=1e-9 * squeezed.max())


def test_orders_of_the_layer():
    """Assert that order 1 is nearer to the exact layer than order 0, and within a tenth of it where both go on."""
    winkler, sheet, wide, exact = layer_rows(SHORT)
    for name in ("error_um_object_rms", "error_um_gel_rms"):
        assert sheet[name] < winkler[name]
        assert wide[name] < winkler[name] / 10
        assert exact[name] is None


def test_layer_order_is_checked():
    """Assert that there is no order 3."""
    with pytest.raises(ValueError, match="order must be 0, 1 or 2, found 3"):
        dense_layer(COARSE.start(), 3)


def test_a_search_without_end_is_reported():
    """Assert that the search on a dense matrix says so where its rounds are used up."""
    with pytest.raises(RuntimeError, match="no balance within 2 rounds"):
        simulate_dense(SHORT, 1, 1e-3, 0.51, max_rounds=2)


def test_finer_grids_are_nearer():
    """Assert that errors fall from 8 x 6 over 16 x 12 to 24 x 18 nodes, and the finest is the reference."""
    coarse, middle, fine, finest = node_rows(SHORT, ((8, 6), (16, 12), (24, 18)), (48, 36))
    for name in ("error_um_object_rms", "error_um_gel_rms"):
        assert coarse[name] > middle[name] > fine[name] > 0
        assert finest[name] is None


# -- the explicit integrator -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_explicit_blows_up_above_its_limit():
    """Assert that the explicit integrator holds below, and blows up above, the limit of the stiffest pattern."""
    state = COARSE.start()
    layer, stiffness = state._layer, float(np.linalg.eigvalsh(dense_layer(state, 1).stiffness)[-1])
    # semi-implicit Euler with a damper: dt (viscous_time K) + dt^2 K / 2 < 2 m; the Maxwell arm adds a little K
    lag = layer.viscous_time
    limit_s = -lag + math.sqrt(lag**2 + 4 * layer.node_mass / stiffness)
    below, above = (SHORT.seconds / math.ceil(SHORT.seconds / (part * limit_s) / 5) / 5 for part in (0.85, 1.2))
    assert below < limit_s < above
    assert math.isnan(simulate_explicit(SHORT, below).blown_up_s)
    lost = simulate_explicit(SHORT, above)
    assert 0 < lost.blown_up_s < 0.01
    assert len(lost.pose) == 0


@pytest.mark.slow
def test_explicit_rows():
    """Assert that a blow-up is said and has no error, and that at smaller steps the errors fall."""
    reference, _ = time_reference(SHORT, 10)
    lost, coarse, fine = (explicit_row(SHORT, reference, dt_us) for dt_us in (100, 5, 2))
    assert lost["outcome"].startswith("blew up after 0.")
    assert lost["error_um_object_rms"] is lost["error_um_gel_rms"] is None
    assert coarse["outcome"] == fine["outcome"] == "finished"
    assert fine["error_um_object_rms"] < coarse["error_um_object_rms"]


# -- rows --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rows_of_all_comparisons(monkeypatch):
    """Assert that every comparison gives rows of one shape, as many as announced, that JSON can hold."""
    small = {"STEPS_US": (10_000, 1_000), "EXPLICIT_US": (1_000, 10), "REFERENCE_US": 100.0, "NODES": ((8, 6),)}
    for name, amount in {**small, "FINEST_NODES": (16, 12)}.items():
        monkeypatch.setattr(cost, name, Extent(amount, amount))
    rows = list(mechanics_rows(3, False))
    assert len(rows) == row_count(False)
    assert all(list(entry) == list(rows[0]) for entry in rows)
    assert len({entry["setting"] for entry in rows}) == len(rows)
    json.dumps(rows, allow_nan=False)
    assert [entry["setting"] for entry in rows if entry["part"] != cost.PART] == []
    assert all(0 < entry["time_us_median"] <= entry["time_us_p99"] for entry in rows)
    assert {"theta 0.51, dt 1 ms", "explicit, dt 10 us", "8 x 6 nodes", "layer order 0"} <= {
        entry["setting"] for entry in rows
    }


def test_full_has_all_that_is_usual():
    """Assert that --full only adds, and all steps divide the 10 ms of a sample."""
    for extent in (STEPS_US, EXPLICIT_US, NODES):
        assert set(extent.full) > set(extent.quick)
    for dt_us in (*STEPS_US.full, *EXPLICIT_US.full, REFERENCE_US.full, 2 * REFERENCE_US.quick):
        assert 10_000 / dt_us == round(10_000 / dt_us)


def test_errors_by_hand():
    """Assert that errors are root mean square distances in the plane, in um, over all samples."""
    still = GelMotion(np.zeros((2, 3)), np.zeros((2, 2, 2)), np.array([500.0, 1500.0]))
    moved = GelMotion(np.array([[3e-6, 4e-6, 9.0], [0, 0, 0]]), np.full((2, 2, 2), 1e-6), still.block_us)
    assert errors_um(moved, still) == pytest.approx((5 / math.sqrt(2), math.sqrt(2)))
    shown = row("x", moved, still)
    assert (shown["time_us_median"], shown["times_real_time"]) == (1000.0, 1.0)


def test_trials_are_drawn():
    """Assert that a seed says the trial, and another seed another one."""
    assert draw_trial(7) == draw_trial(7) != draw_trial(8)


@pytest.mark.parametrize("dt_s", [3e-3, 7e-4, 0.02])
def test_steps_have_to_divide_a_sample(dt_s):
    """Assert that a step which does not divide 10 ms is refused."""
    with pytest.raises(ValueError, match="divide"):
        simulate(SHORT, dt_s, 0.51)


def test_time_step_text():
    """Assert that steps are written in ms from 0.1 ms up."""
    assert [time_step_text(dt_us) for dt_us in (10_000, 500, 100, 20, 0.25)] == [
        "10 ms",
        "0.5 ms",
        "0.1 ms",
        "20 us",
        "0.25 us",
    ]
