"""A second finger that is no mirror image of the first: pressure, slip limit, weight, and the mirrored trial."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evetac_cli.evaluate.stability.cases import merge
from evetac_cli.kernels.grip import paper as grip
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.scenes.pads import FINGER_STIFFNESS_N_M
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.setup.plan import NamedSensor, first_plan, one_sensor
from evetac_cli.sim.setup.sensor import GelFriction
from tests.sim.scenes.trials import NONE, grasp_of, quiet_plan


def with_second_finger(name: str, second: dict[str, float] | None, **durations: float) -> GraspSimulation:
    """A trial of a scene, with a second finger of its own or mirrored ones."""
    changes = NONE if second is None else {"gripper": {"second_finger": second}}
    return grasp_of(quiet_plan(name, changes), **durations)


def both_n(one: GraspSimulation) -> tuple[float, float]:
    """Friction along gravity on the first and on the second pad, in the slice made last."""
    done: Any = one.pads._slices._done
    return done.friction_n[0], done.second_friction_n[0]


@pytest.mark.slow
def test_a_second_finger_that_does_not_differ() -> None:
    """Assert that it makes the trial of mirrored fingers, from hold to loss, within 0.01 px and 1 ms of slip."""
    mirrored, own = (with_second_finger("slip", second) for second in (None, {"friction_factor": 1.0}))
    held_ma = mirrored.finger.command[1]
    slips: dict[int, list[bool]] = {0: [], 1: []}
    for k in range(1500):
        for number, one in enumerate((mirrored, own)):
            one.finger.command = ("current", held_ma - max(0, k - 600) * 0.06)
            one.step()
            slips[number].append(bool(one.truth()["truth/slip"]))
        if not slips[0][-1]:
            np.testing.assert_allclose(
                own.truth()["truth/dot_xy_px"], mirrored.truth()["truth/dot_xy_px"], atol=0.01, rtol=0
            )
    assert any(slips[0])
    assert abs(slips[0].index(True) - slips[1].index(True)) <= 1


@pytest.mark.parametrize("stiffness", [0.5, 2.0])
def test_both_fingers_press_with_one_force(stiffness: float) -> None:
    """Assert that both gels are pressed in as their stiffness says, and that these and the links make the closing."""
    one = with_second_finger("slip", {"stiffness_factor": stiffness})
    finger, pads = one.finger.state, one.pads
    curve, gaps, second = pads.curve, pads.gaps, pads.second
    node_n_m = one_sensor("evetac").normal_modulus_pa / pads.first.material.height_m * pads.first.cell_area_m2
    assert curve.second_indentation_m is not None
    second_m = float(np.interp(finger.force_n, curve.force_n, curve.second_indentation_m))
    pressed_n = [
        factor * node_n_m * gaps.depth_m(depth_m).sum()
        for factor, depth_m in ((1.0, finger.indentation_m), (stiffness, second_m))
    ]
    assert pressed_n == pytest.approx([finger.force_n] * 2, rel=2e-4)
    assert (second_m > finger.indentation_m) == (stiffness < 1.0)
    closing_m = finger.indentation_m + second_m + finger.force_n / FINGER_STIFFNESS_N_M
    assert finger.closing_ticks * curve.metres_per_tick == pytest.approx(closing_m, rel=1e-4)
    assert second is not None
    assert second.shares.sum() == pytest.approx(1.0)
    assert ((second.shares > 0).sum() > (pads.shares > 0).sum()) == (stiffness < 1.0)


def test_slip_limit_of_different_fingers() -> None:
    """Assert that a second finger of a share f of the friction needs 2 / (1 + f) times the force."""
    mirrored, half = (with_second_finger("slip", second) for second in (None, {"friction_factor": 0.5}))
    assert half.pads.slip_limit_n == pytest.approx(mirrored.pads.slip_limit_n * 2 / 1.5, rel=1e-12)
    assert half.sampled == mirrored.sampled


@pytest.mark.slow
def test_a_lift_with_different_fingers() -> None:
    """Assert that both fingers together carry the object once it hangs, the stiffer one more, and that it is lifted."""
    one = with_second_finger("lift", {"stiffness_factor": 3.0}, lift_s=2.5)
    law = grip.start()
    carried_n = []
    for k in range(2600):
        if k % 2 == 0:
            phase = grip.GraspPhase(int(k >= 1500))
            ticks = one.finger.state.position_ticks
            one.finger.command = ("position", grip.step(law, phase, one.view.slip._slips, ticks))
        one.step()
        carried_n.append(both_n(one))
    assert one.truth()["truth/table_gap_mm"] > 3.0
    assert not one.truth()["truth/slip"]
    assert one.truth()["truth/shear_force_n"][0] == carried_n[-1][0]
    first_n, second_n = np.mean(carried_n[-400:], axis=0)  # it swings by some 25 Hz
    assert first_n + second_n == pytest.approx(one.sampled.mass_kg * GRAVITY_M_S2, rel=0.02)
    assert second_n > 1.2 * first_n


def test_fingers_differ_where_friction_varies() -> None:
    """Assert that over a second finger friction varies otherwise than over the first, about its own mean."""
    planned = merge(first_plan("slip"), {"gripper": {"second_finger": {"friction_factor": 0.6}}})
    patchy = replace(planned.sensor, friction=GelFriction(patch_spread=0.2, patch_mm=3.0))
    one = grasp_of(replace(planned, sensor=patchy))
    assert one.pads.second is not None
    first, second = one.pads.friction_factor, one.pads.second.friction_factor
    assert first is not None
    assert second.mean() == pytest.approx(0.6)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.5


def test_the_second_camera_sees_the_mirror_image() -> None:
    """Assert that of fingers that are alike the second camera sees what the first does, y the other way round."""
    plan = quiet_plan("slip")
    rows_px = tuple(240.0 + 60.0 * row for row in range(-3, 4))  # dots that are each other's mirror images
    sensor = replace(plan.sensor, dot_rows_px=rows_px, dot_jitter_px=0.0, turned_deg=0.0)
    one = GraspSimulation(
        replace(plan, sensor=sensor, second=NamedSensor(plan.sensor_name, sensor)),
        *(np.random.default_rng(part) for part in range(2)),
        second_optics_rng=np.random.default_rng(2),
    )
    held_ma = one.finger.command[1]
    for k in range(60):
        one.finger.command = ("current", held_ma - k)
        events = one.step()
    assert one.second_events is not None
    assert one.second_events.size == pytest.approx(events.size, rel=0.5, abs=20)
    first, second = one.truth(), one.second_truth()
    grid_px = one.gel_camera.grid_xy_px
    moved_px, mirrored_px = (each["truth/dot_xy_px"].reshape(grid_px.shape) - grid_px for each in (first, second))
    assert np.abs(moved_px).max() > 0.3
    np.testing.assert_allclose(mirrored_px[::-1] * [1, -1], moved_px, atol=1e-3)
    for name in ("truth/slip_share", "truth/visible_slip_share"):
        assert second[name] == pytest.approx(first[name], abs=1e-6)
    np.testing.assert_allclose(second["truth/object_xy_px"], first["truth/object_xy_px"] * [1, -1], atol=1e-6)
