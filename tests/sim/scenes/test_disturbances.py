"""What is off unless a scene names it: each against a closed form, and against the same trial without."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.devices.simulated import rig
from evetac_cli.sim.scenes import shared
from evetac_cli.sim.scenes.finger_drive import Command, LateCommands
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.scenes.pressing import Pressing
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.setup import sampling
from evetac_cli.sim.setup.parts import PARTS
from evetac_cli.sim.setup.sensor import GelFriction, SensorGripper
from tests.make import play_trial
from tests.sim.scenes.trials import NONE, Changes, grasp_of, quiet_plan

Rows = dict[str, NDArray[Any]]


def held(changes: Changes = NONE) -> GraspSimulation:
    """An object held by a current."""
    return grasp_of(quiet_plan("slip", changes))


def columns(rows: list[dict[str, Any]]) -> Rows:
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def truth_of(trial: Any, slices: int) -> Rows:
    """Truth of some slices."""
    return columns(play_trial(trial, slices)[0])


def test_friction_to_a_tenth_lets_go() -> None:
    """Assert that m a = m g - 2 mu_k N / 10 once it slides, within 2 %, and nothing before the change is another."""
    plain, changed = held(), held({"friction_change": {"at_s": 0.6, "factor": 0.1}})
    before, after = truth_of(plain, 800), truth_of(changed, 800)
    for name in before:
        np.testing.assert_array_equal(before[name][:600], after[name][:600])
    assert not before["truth/slip"].any()
    assert 600 <= np.flatnonzero(after["truth/slip"])[0] < 620
    metres = after["truth/object_xy_px"][:, 0].astype(float) * plain.gel_camera.mm_per_px * 1e-3
    times = np.arange(700, 760)
    measured = 2 * np.polyfit(times * 1e-3, metres[times], 2)[0]
    sampled = changed.sampled
    force_n = after["truth/normal_force_n"][700:760].mean()
    expected = GRAVITY_M_S2 - 2 * 0.1 * sampled.kinetic_friction * force_n / sampled.mass_kg
    assert measured == pytest.approx(expected, rel=0.02)


def test_jerk_of_the_hand() -> None:
    """Assert that half a sine of speed V and time T raises the hand by 2 V T / pi: what stands on the table sinks."""
    jerk = {"hand": {"jerk": {"at_s": 0.1, "speed_mm_s": 80.0, "lasts_s": 0.05}}}
    hand = quiet_plan("lift", jerk).scene.hand.jerk
    assert hand is not None
    raised_mm = sum(hand.at(now) for now in np.arange(1, 400) * 1e-3)
    assert raised_mm == pytest.approx(2 * 80.0 * 0.05 / math.pi, rel=1e-3)
    sunk_mm = []
    for changes in (NONE, jerk):
        trial = grasp_of(quiet_plan("lift", changes), lift_s=1.5, balance_s=0.0)
        rows = truth_of(trial, 300)
        assert np.abs(rows["truth/table_gap_mm"]).max() < 0.01
        sunk_mm.append(rows["truth/object_xy_px"][-1, 0] * trial.gel_camera.mm_per_px)
    assert sunk_mm[0] == pytest.approx(0.0, abs=0.01)
    assert sunk_mm[1] == pytest.approx(raised_mm, abs=0.01)


def test_a_stiffer_gel_shears_less() -> None:
    """Assert that with 10 times the stiffness the same shear force moves the dots a tenth as far."""
    moved = {}
    for factor in (1.0, 10.0):
        motion = {"count": 1, "move_s": [0.4, 0.4]}
        plan = quiet_plan("shear", {"gel": {"stiffness_factor": factor}, "motion": motion})
        trial = Pressing(plan, np.random.default_rng(3), np.random.default_rng(4))
        rows = {"truth/dot_xy_px": []}
        pressed = round(1000 * (plan.scene.time.rest_s + plan.scene.motion.press_s))
        while not trial.finished:
            trial.step()
            rows["truth/dot_xy_px"].append(trial.truth()["truth/dot_xy_px"])
        dots = np.array(rows["truth/dot_xy_px"], float)
        moved[factor] = np.linalg.norm(dots[-150] - dots[pressed + 1], axis=1).max()
    assert moved[1.0] > 1.0
    assert moved[10.0] == pytest.approx(moved[1.0] / 10, rel=0.02)


@pytest.mark.parametrize("mass_g", [5.0, 2000.0])
def test_mass_of_the_object(mass_g: float) -> None:
    """Assert that the mass is the scene's, times the factor of its trial, and that nothing else is sampled anew."""
    plain, changed = quiet_plan("slip"), quiet_plan("slip", {"object": {"mass_g": mass_g}})
    samples = [
        vars(sampling.sample_trial(plan.scene, plan.object, plan.sensor, np.random.default_rng(5)))
        for plan in (plain, changed)
    ]
    ratio = mass_g / plain.object.mass_g
    assert samples[1]["mass_kg"] == pytest.approx(samples[0]["mass_kg"] * ratio, rel=1e-12)
    assert {**samples[0], "mass_kg": 0} == {**samples[1], "mass_kg": 0}
    # above the limit, as the rim of a heavy contact lets go first, and then holds by kinetic friction alone
    hanging = held({"object": {"mass_g": mass_g}, "gripper": {"start_factor": [1.6, 1.6]}})
    rows = truth_of(hanging, 700)
    assert not rows["truth/slip"].any()
    weight_n = hanging.sampled.mass_kg * GRAVITY_M_S2
    assert 2 * rows["truth/shear_force_n"][-1, 0] == pytest.approx(weight_n, rel=0.05)


def test_commands_that_come_late() -> None:
    """Assert that a command given with a delay of 7 ms does what the same does that is given 7 ms later."""
    late, plain = held({"gripper": {"command_delay_ms": 7.0}}), held()
    given = {400: ("current", 3), 430: ("current", 40), 431: ("position", plain.finger.state.position_ticks + 1)}
    for k in range(500):
        late.finger.command = given.get(k, late.finger.command)
        plain.finger.command = given.get(k - 7, plain.finger.command)
        for one in (late, plain):
            one.step()
        if k % 10 == 0 or k > 400:
            for name, value in late.truth().items():
                np.testing.assert_array_equal(value, plain.truth()[name])
    jitters = [held({"gripper": {"command_jitter_ms": 20.0}}) for _ in range(2)]
    for one in jitters:
        one.finger.command = ("current", 60)
    forces = [truth_of(one, 40)["truth/normal_force_n"] for one in (*jitters, held())]
    np.testing.assert_array_equal(forces[0], forces[1])
    assert 0 <= np.flatnonzero(forces[0] != forces[2])[0] <= 20


def test_faults_of_a_gripper() -> None:
    """Assert that a scene's faults stand above those of the sensor's gripper, and that what none names is 0."""
    planned = quiet_plan("slip", {"gripper": {"backlash_ticks": 0.0}})
    own = SensorGripper(backlash_ticks=1.0, command_delay_ms=3.0)
    planned = replace(planned, sensor=replace(planned.sensor, gripper=own))
    keys = ("backlash_ticks", "command_delay_ms", "command_jitter_ms", "encoder_noise_ticks")
    assert [planned.of_gripper(key) for key in keys] == [0.0, 3.0, 0.0, 0.0]
    named = ("backlash of the gripper", "commands that come late", "noise of the gripper's encoder")
    assert [part.name for part in PARTS if part.name in named and part.is_in(planned)] == ["commands that come late"]


def late_commands(first: Command, delay_ms: float, jitter_ms: float) -> LateCommands:
    """Commands that are delayed, with one in effect."""
    return LateCommands(delay_ms, jitter_ms, first, np.random.default_rng(3))


@pytest.mark.parametrize(("delay", "jitter"), [(0.0, 0.0), (3.0, 0.0), (2.5, 0.0), (0.0, 6.0), (1.0, 20.0)])
def test_late_commands_keep_their_order(delay: float, jitter: float) -> None:
    """Assert that each command takes effect within its delay and jitter, in order, and the last one for good."""
    commands = late_commands(("current", 0.0), delay, jitter)
    seen = np.array([commands.at(k, ("current", float(min(k // 2, 100))))[1] for k in range(300)])
    assert (np.diff(seen) >= 0).all()
    assert seen[-1] == 100
    first = np.array([np.flatnonzero(seen >= number)[0] for number in range(1, 101)])
    late = first - 2 * np.arange(1, 101)
    assert late.min() >= np.ceil(delay)
    assert late.max() <= np.ceil(delay + jitter)
    if jitter == 0.0:
        assert np.ptp(late) == 0
    else:
        assert np.ptp(late) > jitter / 3


def test_a_command_given_again_is_no_new_one() -> None:
    """Assert that a goal that is repeated in each slice arrives once, its delay after it was first given."""
    commands = late_commands(("position", 10.0), 5.0, 0.0)
    seen = [commands.at(k, ("position", 20.0)) for k in range(10)]
    assert seen == [("position", 10.0)] * 5 + [("position", 20.0)] * 5


def test_noise_of_the_encoder() -> None:
    """Assert that readings scatter as named about the motor's place, which under a current is as without noise."""
    noisy, plain = held({"gripper": {"encoder_noise_ticks": 2.0}}), held()
    readings = []
    for _ in range(600):
        for one in (noisy, plain):
            one.step()
        readings.append(noisy.finger.state.position_ticks)
        assert noisy.finger.state.motor_ticks == plain.finger.state.motor_ticks
    off = np.array(readings) + 0.5 - noisy.finger.state.touch_ticks - noisy.finger.state.motor_ticks
    assert off.mean() == pytest.approx(0.0, abs=0.25)
    assert off.std() == pytest.approx(math.sqrt(4.0 + 1 / 12), rel=0.08)
    for one in (noisy, plain):  # the servo reads its encoder too: its current scatters by its gain
        one.finger.command = ("position", plain.finger.state.position_ticks)
    currents = []
    for _ in range(300):
        noisy.step()
        currents.append(noisy.finger.state.current_ma)
    assert np.std(currents) == pytest.approx(2.0 * noisy.finger.drive.gain_ma_tick, rel=0.15)


def test_a_calibration_that_is_off() -> None:
    """Assert that the sensor tells a grid turned about the frame's middle and moved, with equal events and truth."""
    changes = {"calibration": {"offset_px": [3.0, -1.0], "turned_deg": 1.0}}
    off, true = (rig(quiet_plan("slip", c), np.random.SeedSequence(7)) for c in (changes, NONE))
    at, expected = off.camera.sensor["sensor/dot_xy_px"], true.camera.sensor["sensor/dot_xy_px"]
    turn = np.exp(1j * np.deg2rad(1.0))
    from_middle = (expected[..., 0] - 320) + 1j * (expected[..., 1] - 240)
    np.testing.assert_allclose(at[..., 0] + 1j * at[..., 1], from_middle * turn + 320 + 240j + 3 - 1j, atol=1e-9)
    for _ in range(50):
        for left, right in zip(off.camera.read(), true.camera.read(), strict=True):
            np.testing.assert_array_equal(left, right)
        np.testing.assert_array_equal(off.truth()["truth/dot_xy_px"], true.truth()["truth/dot_xy_px"])


@pytest.mark.parametrize("bandwidth_hz", [0.0, 500.0])
def test_dots_that_vanish(bandwidth_hz: float) -> None:
    """Assert that a dot brightens once where it was, makes no events afterwards, and goes on in the truth."""
    gone = {"vanishing_dots": {"dots": [[3, 4], [0, 0]], "at_s": 0.3}}
    results = []
    for changes in (NONE, gone):
        plan = quiet_plan("slip", changes)
        sensor = replace(plan.sensor, bandwidth_hz=bandwidth_hz)
        results.append(play_trial(grasp_of(replace(plan, sensor=sensor)), 450))
    (rows_plain, plain), (rows_gone, events) = results
    rows, rows_gone = columns(rows_plain), columns(rows_gone)
    np.testing.assert_array_equal(rows["truth/dot_xy_px"], rows_gone["truth/dot_xy_px"])

    def near(parts: list[Any], dot: int) -> list[tuple[int, NDArray[np.bool_]]]:
        measured = []
        for k, part in enumerate(parts):
            at = rows["truth/dot_xy_px"][k, dot]
            inside = np.hypot(part.x - at[0], part.y - at[1]) < 25
            measured.append((int(inside.sum()), part.p[inside] > 0))
        return measured

    for dot in (3 * 8 + 4, 0):
        counts = near(events, dot)
        assert counts[300][0] > 0.85 * np.pi * plan.sensor.dot_radius_px**2  # nearly all of its pixels
        assert counts[300][1].all()
        assert sum(count for count, _ in counts[301:]) == 0
        assert sum(count for count, _ in near(plain, dot)[301:]) > 0
    other = 3 * 8 + 5
    assert sum(count for count, _ in near(events, other)[301:]) > 0


@pytest.mark.slow
def test_flicker_reaches_the_camera() -> None:
    """Assert that a deep flicker makes all pixels fire both ways in each of its periods, and equally in all."""
    lit = held({"light": {"flicker": {"frequency_hz": 100.0, "depth": 0.3}}})
    events = play_trial(lit, 60)[1]
    sizes = np.array([[int(part.p.sum()), int((part.p == 0).sum())] for part in events[20:]])
    periods = sizes.reshape(4, 10, 2).sum(axis=1)
    assert (periods > 0.9 * 640 * 480).all()
    assert np.ptp(periods, axis=0).max() == 0


def test_friction_that_varies_belongs_to_the_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a sensor with uneven friction has the same in all trials, in which other nodes slip first."""
    plan = quiet_plan("slip")
    patchy = replace(plan.sensor, friction=GelFriction(patch_spread=0.3, patch_mm=2.0))
    uneven = replace(plan, sensor=patchy)
    trials = [
        GraspSimulation(each, np.random.default_rng(seed), np.random.default_rng(9))
        for each, seed in ((plan, 5), (uneven, 5), (uneven, 6))
    ]
    assert trials[0].sampled == trials[1].sampled
    assert trials[0].pads.friction_factor is None
    factors = [trial.pads.friction_factor for trial in trials[1:]]
    np.testing.assert_array_equal(*factors)
    even, varied = (truth_of(trial, 800) for trial in trials[:2])
    assert not even["truth/slip"].any()
    assert not varied["truth/slip"].any()
    assert (even["truth/slip_share"] != varied["truth/slip_share"]).any()
    other = replace(plan, sensor=replace(patchy, seed=77))
    elsewhere = GraspSimulation(other, np.random.default_rng(5), np.random.default_rng(9))
    assert np.abs(elsewhere.pads.friction_factor - factors[0]).max() > 0.1
    monkeypatch.setattr(shared, "friction_factor", lambda _, nodes: np.full(nodes.shape[:2], 2.0))
    double = GraspSimulation(uneven, np.random.default_rng(5), np.random.default_rng(9))
    assert double.pads.slip_limit_n == pytest.approx(trials[0].pads.slip_limit_n / 2, rel=1e-12)
