"""Touch for other simulators: the dots of a scene under its forces, balanced forces, and inputs of every kind."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.sim.gel.contact import cell_area
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.scenes.pressing import Pressing
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.sim.touch_sensor import PUSHER_N_S_M, Touch, TouchSensor

BOX = {"shape": "flat", "static_friction": 1.0}
BALL = {"shape": "sphere", "width_mm": 40.0, "static_friction": 1.0}
COARSE = {"node_pitch_mm": 1.667}


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def touched(held_object: Any = BOX, seed: int = 0, **more: Any) -> TouchSensor:
    return TouchSensor(object=held_object, rng=rng(seed), solver=COARSE, **more)


def same_events(ones: tuple[Events, ...], others: tuple[Events, ...]) -> bool:
    return len(ones) == len(others) and all(
        np.array_equal(one, other)
        for first, second in zip(ones, others, strict=True)
        for one, other in zip(first, second, strict=True)
    )


def test_dots_are_those_of_the_shear_scene() -> None:
    """Assert that a face pressed and moved as in the scene moves the dots as there, within 1e-6 px, and as hard."""
    shear = first_plan("shear", solver=COARSE)
    scene = shear.scene
    short = replace(
        scene,
        motion=replace(scene.motion, count=2, move_s=(0.05, 0.1), pause_s=0.03, press_s=0.1, offset_mm=0.0),
        randomise=replace(scene.randomise, static_friction=(1.0, 1.0)),
        time=replace(scene.time, rest_s=0.02),
    )
    trial = Pressing(replace(shear, scene=short), rng(), rng(1))
    box = {**BOX, "static_friction": trial.sampled.static_friction}
    sensor = TouchSensor(object=box, rng=rng(), gel="closed", solver=COARSE)
    off_px, force_n = [], []
    while not trial.finished:
        place_m, normal_n = trial.timeline.at((trial.slices + 1) * 1e-3)
        trial.step()
        touch = sensor.step(1e-3, normal_n=normal_n, place_m=(place_m[0], place_m[1]))
        off_px.append(np.abs(touch.dot_xy_px - trial.gel_camera.dot_xy_px).max())
        force_n.append(np.abs(np.subtract(touch.shear_n, trial.truth()["truth/shear_force_n"])).max())
    assert len(off_px) > 200
    assert np.abs(touch.displacement_px).max() < 1000
    assert np.linalg.norm(trial.truth()["truth/shear_force_n"]) > 0.5
    assert max(off_px) < 1e-6
    assert max(force_n) < 1e-6


def held() -> tuple[GraspSimulation, dict[str, Any]]:
    """Object 8 as it hangs in the gripper, and its contact as a sensor is told of it."""
    slip = first_plan("slip", solver=COARSE)
    scene = slip.scene
    middle = replace(
        scene,
        randomise=replace(scene.randomise, touch_mm=0.0, lever_mm=0.0),
        roughness=None,
        time=replace(scene.time, rest_s=0.02, load_s=0.05, hold_s=1.0),
    )
    trial = GraspSimulation(replace(slip, scene=middle), rng(3), rng(4))
    sampled = trial.sampled
    contact = {
        "shape": "cylinder",
        "width_mm": slip.object.width_mm,
        "static_friction": sampled.static_friction,
        "kinetic_share": sampled.kinetic_friction / sampled.static_friction,
        "tilt_deg": math.degrees(sampled.tilt_rad),
    }
    return trial, contact


def pressed_on(sensor: TouchSensor, trial: GraspSimulation) -> None:
    """Press as a ramp's gripper did before its trial: within half a second, and rest on a free object as long."""
    sensor.step(0.5, normal_n=trial.finger.state.force_n)
    sensor.step(0.5, normal_n=trial.finger.state.force_n, shear_n=(0.0, 0.0))


def test_dots_are_those_of_the_slip_scene_under_its_motion() -> None:
    """Assert that dots move as under a hanging cylinder, within 0.1 px, told its normal force and how far it sank.

    The scene begins with a gel that has been pressed slowly, in longer steps than the sensor is: where dots are hangs
    a little on which nodes slipped when.
    """
    trial, contact = held()
    sensor = touched(contact)
    pressed_on(sensor, trial)
    off_px: list[Any] = []
    moved_px = 0.0
    for _ in range(200):
        trial.step()
        x_m, y_m, _ = trial.pads.first.pose.tolist()
        touch = sensor.step(1e-3, normal_n=trial.finger.state.force_n, place_m=(x_m, y_m))
        off_px.append(touch.dot_xy_px - trial.gel_camera.dot_xy_px)
        moved_px = max(moved_px, float(np.abs(touch.displacement_px).max()))
    assert moved_px > 1.0
    assert np.abs(off_px).max() < 0.1


def test_dots_are_those_of_the_slip_scene_under_its_force() -> None:
    """Assert dots at rest within 0.05 px of those under a hanging cylinder, told its normal force and half its weight.

    Half, since the other finger bears the other half.
    """
    trial, contact = held()
    sensor = touched(contact)
    pressed_on(sensor, trial)
    for _ in range(300):
        trial.step()
        pull_n = 0.5 * trial.held.load(trial.slices) * trial.sampled.mass_kg * GRAVITY_M_S2
        touch = sensor.step(1e-3, normal_n=trial.finger.state.force_n, shear_n=(pull_n, 0.0))
    assert np.abs(touch.displacement_px).max() > 1.0
    assert np.abs(touch.dot_xy_px - trial.gel_camera.dot_xy_px).max() < 0.05
    assert touch.shear_n == pytest.approx((pull_n, 0.0), abs=1e-4)


def test_forces_balance() -> None:
    """Assert that the gel answers with the shear force that was asked for, and that this is its own stiffness times u.

    The sum over the pad of G a / H u is the force of a layer at rest, whatever its pattern.
    """
    sensor = touched()
    sensor.step(0.02, normal_n=5.0, shear_n=(1.0, -0.5))
    touch = sensor.step(0.4, shear_n=(1.0, -0.5))
    assert touch.normal_n == 5.0
    assert touch.shear_n == pytest.approx((1.0, -0.5), abs=1e-4)
    gel = sensor._gel
    stiffness = gel.material.shear_modulus_pa * gel.cell_area_m2 / gel.material.height_m
    assert stiffness * gel.displacement_m.sum(axis=(0, 1)) == pytest.approx((1.0, -0.5), abs=1e-3)
    assert not touch.slip


def test_indentation_is_force_by_the_closed_form() -> None:
    """Assert E/H times area times depth under a flat face, and the same dots whether depth or force was given."""
    ones, others = touched(), touched()
    touch = ones.step(0.01, indentation_m=1e-4)
    nodes = ones._gel.node_xy_m
    area_m2 = nodes.shape[0] * nodes.shape[1] * cell_area(nodes)
    assert touch.normal_n == pytest.approx(1.0e6 / 4e-3 * area_m2 * 1e-4, rel=1e-9)
    again = others.step(0.01, normal_n=touch.normal_n)
    assert again.indentation_m == pytest.approx(1e-4, rel=1e-9)
    assert np.abs(again.dot_xy_px - touch.dot_xy_px).max() < 1e-9


def test_a_surface_moves_with_its_object() -> None:
    """Assert that a ball moved by whole nodes is pressed as hard, that the contact goes along, and that it leaves."""
    pitch_m = float(touched()._gel.node_xy_m[0, 1, 0] - touched()._gel.node_xy_m[0, 0, 0])
    sensor = touched(BALL)
    first = sensor.step(0.005, indentation_m=2e-4)
    middle_m = (sensor._shares[..., None] * sensor._gel.node_xy_m).sum(axis=(0, 1))
    moved = sensor.step(0.02, place_m=(-2 * pitch_m, 0.0))
    went_m = (sensor._shares[..., None] * sensor._gel.node_xy_m).sum(axis=(0, 1)) - middle_m
    assert moved.normal_n == pytest.approx(first.normal_n, rel=1e-6)
    assert went_m == pytest.approx((-2 * pitch_m, 0.0), abs=1e-9)
    assert moved.slip  # 3 mm is more than the gel follows
    turned = sensor.step(0.05, turn_rad=math.pi)
    assert turned.normal_n == pytest.approx(first.normal_n, rel=1e-6)
    gone = sensor.step(0.05, place_m=(0.0, 0.05))
    assert gone.normal_n == 0.0
    assert not gone.slip
    with pytest.raises(InputError, match="normal_n"):
        sensor.step(0.05, normal_n=1.0)


def test_without_contact_there_is_noise_alone() -> None:
    """Assert that an object that moves off the gel changes no event, and that as many come as the camera's noise."""
    still, moved = touched(), touched()
    first = still.step(0.2)
    second = moved.step(0.2, indentation_m=-1e-3, place_m=(5e-3, 2e-3))
    assert same_events(first.slices, second.slices)
    assert not second.displacement_px.any()
    assert (second.normal_n, second.shear_n, second.slip) == (0.0, (0.0, 0.0), False)
    expected = (0.03 * 640 * 480 + 6 * 100) * 0.2
    assert first.events.size == pytest.approx(expected, rel=0.35)


def course(sensor: TouchSensor, parts: int) -> list[Touch]:
    """A course of 20 ms in steps of 5 ms, each cut into as many parts, with the numbers that lie between."""
    corners = [(0.0, 0.0), (4.0, 0.0), (4.0, 1.5), (2.0, 1.5), (2.0, 1.5)]
    touches = []
    for (n0, t0), (n1, t1) in zip(corners, corners[1:], strict=False):
        for part in range(1, parts + 1):
            share = part / parts
            ends = (n1, t1) if part == parts else (n0 + share * (n1 - n0), t0 + share * (t1 - t0))
            touches.append(sensor.step(0.005 / parts, normal_n=ends[0], shear_n=(ends[1], 0.0)))
    return touches


def test_a_step_may_be_cut() -> None:
    """Assert the same bits where steps of 5 ms are ones of 1 ms, and slices that end between steps of 0.625 ms."""
    whole, cut, finer = (course(touched(), parts) for parts in (1, 5, 8))
    for parts in (cut, finer):
        assert sum(len(touch.slices) for touch in parts) == 20
        assert same_events(
            tuple(events for touch in whole for events in touch.slices),
            tuple(events for touch in parts for events in touch.slices),
        )
    assert np.array_equal(whole[-1].dot_xy_px, cut[-1].dot_xy_px)
    assert whole[-1][3:] == cut[-1][3:]
    assert [len(touch.slices) for touch in finer[:8]] == [0, 1, 0, 1, 1, 0, 1, 1]


def test_force_beyond_friction_slides_and_stays_bounded() -> None:
    """Assert that an excess of shear force slides the object by excess over damping, and that it stops when it ends."""
    sensor = touched({**BOX, "kinetic_share": 1.0})
    sensor.step(0.01, normal_n=2.0)
    sensor.step(0.02, shear_n=(2.5, 0.0))
    before = sensor.step(0.05, shear_n=(2.5, 0.0))
    after = sensor.step(0.1, shear_n=(2.5, 0.0))
    assert after.slip
    assert after.slip_share == 1.0
    assert after.shear_n[0] == pytest.approx(2.0, abs=0.01)  # friction 1.0 times 2 N
    speed_m_s = (after.place_m[0] - before.place_m[0]) / 0.1
    assert speed_m_s == pytest.approx(0.5 / PUSHER_N_S_M, rel=0.05)
    sensor.step(0.02, shear_n=(0.5, 0.0))
    first, second = (sensor.step(0.1, shear_n=(0.5, 0.0)) for _ in range(2))
    assert not second.slip
    assert second.place_m == pytest.approx(first.place_m, abs=1e-6)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"dt_s": 0.0}, "no duration"),
    ({"dt_s": -1.0}, "no duration"),
    ({"dt_s": math.nan}, "dt_s"),
    ({"dt_s": 11.0}, "dt_s"),
    ({"dt_s": None}, "dt_s"),
    ({"normal_n": -1.0}, "normal_n"),
    ({"normal_n": 1e6}, "would press the gel flat"),
    ({"normal_n": math.inf}, "normal_n"),
    ({"indentation_m": 5e-3}, "flat"),
    ({"normal_n": 1.0, "indentation_m": 1e-4}, "one of the two"),
    ({"normal_n": 1.0, "shear_n": (1e9, 0.0)}, "shear_n"),
    ({"normal_n": 1.0, "shear_n": (0.0,)}, "2 numbers"),
    ({"normal_n": 1.0, "shear_n": "ab"}, "2 numbers"),
    ({"shear_n": (0.1, 0.0)}, "needs a normal force"),
    ({"normal_n": 1.0, "shear_n": (0.1, 0.0), "place_m": (0.0, 0.0)}, "a force or a position"),
    ({"place_m": (1.0, 0.0)}, "place_m"),
    ({"dt_s": 1e-3, "place_m": (0.05, 0.0)}, "too fast"),
    ({"dt_s": 1e-3, "turn_rad": 3.0}, "too fast"),
]


@pytest.fixture(scope="module")
def unchanged() -> TouchSensor:
    return touched()


@pytest.mark.parametrize(("asked", "said"), REFUSED)
def test_extreme_steps_are_refused(asked: dict[str, Any], said: str, unchanged: TouchSensor) -> None:
    """Assert that a step that cannot be is refused in words, and changes nothing."""
    with pytest.raises(InputError, match=said):
        unchanged.step(**{"dt_s": 0.005, **asked})
    assert unchanged._slices == unchanged._now_ns == 0


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"sensor": "evetack"}, "did you mean evetac"),
    ({"object": 21}, "no such object"),
    ({"object": {"shape": "flat"}}, "keys are missing\n  expected: static_friction"),
    ({"object": {"shape": "sphere", "static_friction": 1.0}}, "keys are missing\n  expected: width_mm"),
    ({"object": {**BOX, "widht_mm": 3}}, "did you mean width_mm"),
    ({"object": {**BOX, "shape": "torus"}}, "cylinder, flat, sphere"),
    ({"object": {**BOX, "static_friction": math.nan}}, "static_friction"),
    ({"object": {**BOX, "kinetic_share": 1.5}}, "kinetic_share"),
    ({"object": {**BOX, "width_mm": "66"}}, "width_mm: invalid value"),
    ({"object": {**BOX, 3: 66}}, "unknown key 3"),
    ({"object": {**BOX, "shape": "cylindre"}}, "did you mean cylinder"),
    ({"object": "nowhere.toml"}, "nowhere.toml: cannot be read"),
    ({"gel": "sliced"}, "cut or closed"),
    ({"solver": {"tolerance": 1.0}}, "solver"),
    ({"at_m": (math.nan, 0.0)}, "at_m"),
]


@pytest.mark.parametrize(("given", "said"), WRONG)
def test_what_cannot_be_built_is_refused(given: dict[str, Any], said: str) -> None:
    """Assert that a sensor that cannot be is refused in words."""
    with pytest.raises(InputError, match=said):
        TouchSensor(**{"object": BOX, "rng": rng(), **given})


@pytest.mark.slow
@pytest.mark.parametrize("held_object", [BOX, BALL, 14, 20, {**BALL, "shape": "cylinder", "tilt_deg": 5.0}])
def test_any_course_stays_finite(held_object: Any) -> None:
    """Assert finite dots and forces within friction's bound under 15 random steps over the whole range of inputs."""
    drawn = rng(7)
    for options in ({}, {"gel": "closed"}, {"sensor": "randomized"}):
        sensor = touched(held_object, **options)
        for _ in range(15):
            asked: dict[str, Any] = {"normal_n": float(drawn.uniform(0.01, 60.0)) * drawn.integers(2)}
            if drawn.uniform() < 0.5:
                asked |= {"place_m": tuple(drawn.uniform(-0.01, 0.01, 2)), "turn_rad": float(drawn.uniform(-1, 1))}
            elif asked["normal_n"]:
                asked |= {"shear_n": tuple(drawn.uniform(-50, 50, 2))}
            try:
                touch = sensor.step(float(drawn.uniform(2e-3, 12e-3)), **asked)
            except InputError:  # too much for where the object is now
                continue
            assert np.isfinite(touch.dot_xy_px).all()
            assert math.hypot(*touch.shear_n) <= 5.0 * 60.0
