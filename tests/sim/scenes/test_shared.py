"""Slices in which nothing can change are not solved again, and nothing is to be seen of that."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.scenes.shared import GelSlices
from evetac_cli.sim.setup.scene import Solver
from tests.sim.scenes.test_pressing import pressing

FRICTION = gel.Friction(0.8, 0.6)
STILL = (0.0, 0.0, 0.0)


def pad() -> tuple[gel.GelState, np.ndarray]:
    nodes = contact.pad_nodes(6, 5, (-5e-3, 5e-3), (-4e-3, 4e-3))
    return gel.start(nodes, gel.GelMaterial(), 0.1, 1e-4), np.full((5, 6), 1 / 30)


@pytest.mark.parametrize("step_ms", [None, 0.5])
def test_still_slices_change_nothing(step_ms: float | None) -> None:
    """Assert that a gel that is sheared, rests for long, and is pulled again does just as one solved in each slice."""
    solver = Solver(step_ms=step_ms)
    (state, shares), (other, _) = pad(), pad()
    slices, stepper = GelSlices(state, solver), Stepper(solver)
    skipped = 0
    for k in range(900):
        twist = (2e-3, 1e-3, 0.0) if k < 30 or 800 <= k < 830 else STILL
        done = slices.advance(shares, (5.0, 5.0), STILL, FRICTION, twist)
        same = stepper.advance(other, shares, (5.0, 5.0), STILL, FRICTION, twist)
        skipped += slices.still_for > 0
        assert (done.friction_n, done.slip_m, done.steps) == (same.friction_n, same.slip_m, same.steps)
        assert np.array_equal(state.displacement_m, other.displacement_m)
        assert np.array_equal(state.pose, other.pose)
    assert 200 < skipped < 800
    assert np.abs(state.velocity_m_s - other.velocity_m_s).max() < 1e-19


def test_what_acts_anew_is_solved() -> None:
    """Assert that a gel at rest moves again with another force, friction or inertia, or a push from outside."""
    for change in ("force", "friction", "shares", "twist"):
        state, shares = pad()
        slices = GelSlices(state, Solver())
        friction, weight_n = FRICTION, 0.0
        for _ in range(20):
            slices.advance(shares, (5.0, 5.0), (weight_n, 0.0, 0.0), friction, None)
        assert slices.still_for > 10
        if change == "force":
            weight_n = 1.0
        if change == "friction":
            friction = replace(FRICTION, static=0.7)
        if change == "shares":
            shares = shares.copy()
            shares[0, 0] = 0.0
        if change == "twist":
            state.twist[0] = 1e-3
        slices.advance(shares, (5.0, 5.0), (weight_n, 0.0, 0.0), friction, None)
        assert slices.still_for == 0


def test_camera_at_rest_sees_all_there_is(tmp_path: Path) -> None:
    """Assert that a scene at rest makes the events of one whose camera looks at every slice in full."""
    quick, full = (pressing("shear", tmp_path, motion={"count": 1, "pause_s": 1.2}) for _ in range(2))
    render = full.view.render
    full.view.render = lambda *given, **named: render(*given, **{**named, "still": False})
    seen_at_rest = 0
    while not quick.finished:
        one, other = quick.step(), full.step()
        seen_at_rest += quick.gel_camera._looked_at_rest
        assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
    assert seen_at_rest > 150


def test_still_slice_leaks_as_any_other() -> None:
    """Assert that leak and noise make the same events in a slice that is known to be still as in one that is looked at.

    Also after all dots have moved, so that most pixels are compared anew.
    """
    model = camera.CameraModel(frame_px=(160, 120), leak_hz=10.0, refractory_us=500.0, noise_rate_hz=2.0)
    at = np.array([[40.0, 40.0], [100.0, 80.0]])
    here = np.zeros(2)
    rngs = [np.random.default_rng(4) for _ in range(2)]
    states = [camera.start(model, at, None, rng) for rng in rngs]
    leaked = 0
    for k in range(160):
        places = (at, at + 3.0) if k == 100 else (at + 3.0 * (k > 100),) * 2
        full, quick = (
            camera.step(state, SliceMotion(*places, here, here, 0.0), 1000 * k, rng)
            if number == 0 or k in (0, 100, 101)
            else camera.step_still(state, 1000 * k, rng)
            for number, (state, rng) in enumerate(zip(states, rngs, strict=True))
        )
        assert all(np.array_equal(a, b) for a, b in zip(full, quick, strict=True))
        leaked += len(quick.t) if k != 100 else 0
    assert leaked > 25_000
