"""A simulated trial, from gripper current to events: that the scene does what scenes.md says of it."""

import dataclasses
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.commands.record import Record
from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.stability.cases import merge
from evetac_cli.events import concatenate
from evetac_cli.resources import SCENES
from evetac_cli.sim import gripper
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.cell_gaps import MEAN
from evetac_cli.sim.scenes import gripped
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2, material
from evetac_cli.sim.setup import sampling
from evetac_cli.sim.setup.plan import first_plan, one_sensor
from evetac_cli.sim.setup.sensor import GelCreep
from evetac_cli.store.recordings.read import open_recording, ramp_start, true_onset
from evetac_cli.text_files import as_toml
from evetac_cli.trials import record
from evetac_cli.trials.record import simulated
from evetac_cli.trials.trial import SimulatedTrial
from tests.make import play_trial, run_stage
from tests.quick import few
from tests.sim.scenes.trials import grasp_of


def world(object_number: int, seed: int = 0, name: str = "slip", sensor: str = "evetac") -> GraspSimulation:
    """A trial of a smooth object touched in its middle: off it, a hanging object swings for seconds, as a pendulum."""
    built = first_plan(name, str(object_number), sensor)
    built = merge(built, {"randomise": {"touch_mm": None, "lever_mm": None}, "roughness": None})
    built = dataclasses.replace(built, object=dataclasses.replace(built.object, lever_mm=0.0))
    return grasp_of(built, seed, lift_s=1.5, balance_s=0.0)


@pytest.mark.parametrize("number", few([1, 6, 12, 14, 18, 19, 20], 1, 14, 20))
def test_object_hangs_still(number: int) -> None:
    """Assert that a held object comes to rest: no slip, friction carries the weight, no dot moves any more."""
    held = world(number)
    rows, _ = play_trial(held, 1100)
    assert not any(row["truth/slip"] for row in rows)
    assert held.finger.state.force_n > held.sampled.mass_kg * GRAVITY_M_S2 / (2 * held.sampled.static_friction)
    dots = np.array([rows[at]["truth/dot_xy_px"] for at in (1000, 1099)])
    assert np.abs(dots[1] - dots[0]).max() < 0.01
    assert dots[1][:, 0].max() - held.gel_camera.grid_xy_px[..., 0].max() >= 0  # hangs along +x
    assert (dots[1] - held.gel_camera.grid_xy_px.reshape(-1, 2))[:, 0].max() > 0.5


def test_quasi_static_onset(short_scene: Path) -> None:
    """Assert that slip begins within 40 ms of the moment when twice the friction limit no longer carries the weight.

    The limit is that of the spots of the rough object which touch the gel at first.
    """
    for number in range(3):
        plan = first_plan(str(short_scene), "8")
        devices, slices = simulated.play(SimulatedTrial((), Path(), number, 0, plan))
        limit_n = devices.camera._simulation.pads.slip_limit_n
        rows = [row for _, row in slices]
        force = np.array([row["truth/normal_force_n"] for row in rows])
        slip = np.flatnonzero([row["truth/slip"] for row in rows])
        lost = np.flatnonzero(force < limit_n)[0]
        assert len(slip)
        assert abs(int(slip[0]) - int(lost)) <= 40


def test_object_falls_when_released() -> None:
    """Assert that after the grip is opened the object falls freely: half g t^2, within 2 %."""
    fallen = world(8)
    play_trial(fallen, 600)
    fallen.finger.command = ("current", -60)
    rows, _ = play_trial(fallen, 400)
    free = [index for index, row in enumerate(rows) if row["truth/normal_force_n"] == 0.0]
    assert len(free) > 60
    x_mm = np.array([row["truth/object_xy_px"][0] for row in rows])[free[5] : free[5] + 50] * 0.0329  # type: ignore[index]
    t = np.arange(50) * 1e-3
    acceleration = 2 * np.polyfit(t, x_mm * 1e-3, 2)[0]
    assert acceleration == pytest.approx(GRAVITY_M_S2, rel=0.02)


def test_table_carries_the_object() -> None:
    """Assert that before the hand rises an object on the table stays on it, and that it is never below it."""
    grasp = world(11, name="lift")
    rows, _ = play_trial(grasp, 3000)
    gaps = np.array([row["truth/table_gap_mm"] for row in rows])
    assert gaps.min() >= -1e-9
    assert np.abs(gaps[:1999]).max() < 1e-9
    assert max(abs(row["truth/object_xy_px"][0]) for row in rows[:1999]) == 0  # type: ignore[index]


@pytest.mark.parametrize("creep", [None, GelCreep(share=(0.05, 0.1), time_s=(0.003, 5.0))])
@pytest.mark.parametrize("tangent", [0.08, 0.12, 0.2])
def test_loss_tangent(tangent: float, creep: GelCreep | None) -> None:
    """Assert that a gel's complex stiffness at 100 Hz has the named loss tangent, and that none named is the usual."""
    sensor = one_sensor("evetac")
    assert material(sensor) == gel.GelMaterial(shear_modulus_pa=sensor.shear_modulus_pa)
    made = material(dataclasses.replace(sensor, loss_tangent=tangent, creep=creep))
    turn = 2j * np.pi * 100
    assert len(made.arms) == (1 if creep is None else 1 + len(creep.share))
    stiffness = 1 + turn * made.viscous_time_s
    stiffness += sum(share * turn * time_s / (1 + turn * time_s) for share, time_s in made.arms)
    assert stiffness.imag / stiffness.real == pytest.approx(tangent, rel=1e-12)


def test_a_loss_tangent_that_cannot_be() -> None:
    """Assert that a gel cannot lose less than its arms do, and that this is said in the sensor's own words."""
    with pytest.raises(ValueError, match="loss_tangent of the sensor must be at least"):
        material(dataclasses.replace(one_sensor("evetac"), loss_tangent=1e-4))


def test_gripper_of_a_sensor() -> None:
    """Assert that a drawn gripper pushes with its servo's stiffness, at two ticks as hard as named."""
    assert gripper.make_drive(one_sensor("evetac").gripper) == gripper.Drive()
    for number in range(20):
        own = one_sensor(f"randomized:{number}").gripper
        drive = gripper.make_drive(own)
        servo_n_tick = drive.gain_ma_tick * drive.force_per_current_n_ma
        assert servo_n_tick == pytest.approx(own.servo_n_tick)
        friction_n = drive.friction_n / own.friction_factor
        assert 0.08 <= 2 * servo_n_tick - friction_n <= 0.18
        assert 0.67 <= drive.kinetic_share == own.kinetic_share <= 1.0
        assert gripper.make_drive(own, 0.5).friction_n == pytest.approx(0.5 * drive.friction_n)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_sampled_sensors_hold(number: int) -> None:
    """Assert that a drawn sensor and gripper hold an object, whose weight moves a softer gel farther."""
    held = world(8, sensor=f"randomized:{number}")
    rows, _ = play_trial(held, 900)
    assert not any(row["truth/slip"] for row in rows)
    assert rows[-1]["truth/shear_force_n"][0] == pytest.approx(held.sampled.mass_kg * GRAVITY_M_S2 / 2, rel=1e-3)  # type: ignore[index]
    sensor = one_sensor(f"randomized:{number}")
    sinks_px = rows[-1]["truth/object_xy_px"][0] * sensor.mm_per_px * sensor.shear_modulus_pa  # type: ignore[index]
    assert 80 < sinks_px / held.sampled.mass_kg / 1e3 < 1e4  # arms of creep hold up to a fifth at first
    assert held.gel_camera.grid_xy_px.shape == (7, 8, 2)


def test_every_drawn_grid_is_whole() -> None:
    """Assert that the cut gel of 50 sampled sensors keeps 7 rows of 8 dots, in the frame and off the window."""
    for number in range(50):
        sensor = one_sensor(f"randomized:{number}")
        grid = dot_grid(sensor, cut=True)
        assert grid.shape == (7, 8, 2)
        assert grid[..., 0].max() + sensor.dot_radius_px < 540
        assert grid.min() - sensor.dot_radius_px > 0
        assert grid[..., 1].max() + sensor.dot_radius_px < 480


def off_middle(monkeypatch: pytest.MonkeyPatch, number: int, **changes: Any) -> GraspSimulation:
    """A held object with some of what is sampled replaced."""
    sample = sampling.sample_trial
    with monkeypatch.context() as patch:
        patch.setattr(
            gripped, "sample_trial", lambda *given: dataclasses.replace(sample(*given), tilt_rad=0.0, **changes)
        )
        return world(number)


def test_lever_turns_the_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a flat object held off its centre of mass turns that side down, both ways alike, then hangs still."""
    turned = {}
    for lever_m in (-2e-3, 0.0, 2e-3):
        held = off_middle(monkeypatch, 16, lever_m=lever_m)
        rows, _ = play_trial(held, 1100)
        assert not any(row["truth/slip"] for row in rows)
        turned[lever_m] = held.pads.first.pose[2]
        assert rows[-1]["truth/object_xy_px"] == pytest.approx(rows[-2]["truth/object_xy_px"], abs=1e-3)
    assert abs(turned[0.0]) < 1e-9
    assert turned[2e-3] < -1e-4  # from x (down) to y (aside): the centre of mass, at +y, goes down
    assert turned[-2e-3] == pytest.approx(-turned[2e-3], rel=1e-6)


@pytest.mark.parametrize("seed", few(range(4), 0, 1))
def test_object_whose_weight_hangs_beside_the_fingers_is_held(seed: int) -> None:
    """Assert that object 20, 12 mm off its centre of mass, does not turn in the grip before the current falls."""
    held = grasp_of(merge(first_plan("slip", "20"), {"gripper": {"start_factor": [1.9, 1.9]}}), seed)
    assert not any(row["truth/slip"] for row in play_trial(held, 900)[0])
    assert abs(held.pads.first.pose[2]) < 0.15  # the gel gives way; without a hold it turns by half a radian and more


def test_touched_beside_the_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that an object touched 3 mm aside presses there, and moves the dots there most."""
    held = off_middle(monkeypatch, 8, touch_m=(0.0, 3e-3))
    gap_m = held.pads.gaps.summary[..., MEAN]
    nearest = held.pads.first.node_xy_m[np.unravel_index(gap_m.argmin(), gap_m.shape)]
    assert nearest[1] == pytest.approx(3e-3, abs=0.5e-3)
    rows, _ = play_trial(held, 900)
    sunk_px = rows[-1]["truth/dot_xy_px"][:, 0] - held.gel_camera.grid_xy_px[..., 0].ravel()  # type: ignore[index, call-overload]
    weighted_m = (sunk_px * held.gel_camera.rest_m[:, 1]).sum() / sunk_px.sum()
    assert weighted_m == pytest.approx(3e-3, abs=1e-3)


def test_pushes_and_grip_of_the_data_rate_scene() -> None:
    """Assert that a push is a half sine of its force, and that the grip is the same force for every object."""
    planned = first_plan("data-rate", "18")
    pushed = grasp_of(planned)
    push, drive = planned.scene.push, pushed.finger.drive
    lasts_s = push.lasts_s
    for after_s, share in ((-1e-3, 0.0), (lasts_s / 4, np.sqrt(0.5)), (lasts_s / 2, 1.0), (lasts_s + 1e-3, 0.0)):
        for at_s, force_n in zip(push.at_s, push.force_n, strict=True):
            assert push.at(at_s + after_s) == pytest.approx(share * force_n, abs=1e-9)
    force_n = (drive.force_per_current_n_ma * pushed.finger.holding_ma - drive.friction_n) / (1 + drive.friction_share)
    assert 0.0 <= force_n - planned.scene.gripper.start_n <= drive.force_per_current_n_ma  # whole mA
    assert pushed.finger.holding_ma == grasp_of(first_plan("data-rate", "1")).finger.holding_ma > 50


def test_a_grip_too_weak_for_its_object_is_refused() -> None:
    """Assert that a predefined force below that at which the object slides is refused with both forces."""
    weak = merge(first_plan("data-rate"), {"gripper": {"start_n": 0.5}})
    with pytest.raises(ValueError, match=r"gripper.start_n: 0.5 N cannot hold an object that slips below [0-9.]+ N"):
        grasp_of(weak)


RGB_BYTES_S = 540 * 480 * 3 * 25  # of the frame that is compared with, 25 times a second
EVENT_BYTES = 5


def ratios(path: Path) -> tuple[float, float, float, float]:
    """Bytes a second of 540 columns against an RGB sensor's: the whole recording, from touch to the end of contact, and
    0.5 s about slip; the largest slice in kB.
    """
    with open_recording(path) as recording:
        gel = np.concatenate([[0], np.cumsum(recording.read("events/x") < 540)])
        events = np.diff(gel[recording.read("ms_to_idx")])
        force = recording.read("truth/normal_force_n")
        slip = true_onset(recording)
        opens_ms = round(1000 * recording.header["parameters"]["scene"]["gripper"]["open_s"])
        assert opens_ms <= ramp_start(recording) <= opens_ms + 2
        assert slip is not None and opens_ms < slip < opens_ms + 250

    def ratio(part: NDArray[np.int64]) -> float:
        return float(part.mean()) * 1000 * EVENT_BYTES / RGB_BYTES_S

    touch, lost = np.flatnonzero(force >= 0.03)[0], np.flatnonzero(force > 0)[-1]
    most_kb = float(events.max()) * EVENT_BYTES / 1000
    return ratio(events), ratio(events[touch : lost + 1]), ratio(events[slip - 250 : slip + 250]), most_kb


def test_data_rate_about_slip(tmp_path: Path) -> None:
    """Assert that the data-rate scene, hurried, opens to where it was, has about the paper's rate, and drops it."""
    hurried = tomllib.loads((SCENES / "data-rate.toml").read_text())
    hurried["time"] |= {"rest_s": 0.9, "load_s": 0.2, "longest_s": 2.2}
    hurried["gripper"] |= {"open_ticks": 2.0, "close_s": 0.0, "grip_s": 0.15, "open_s": 1.5}
    del hurried["push"]
    path = tmp_path / "hurried.toml"
    path.write_text(as_toml(hurried))
    recipe = Record(scene=str(path), objects="1")
    output, _ = run_stage(record, [], recipe, tmp_path)
    _, _, about_slip, most_kb = ratios(output)
    assert about_slip == pytest.approx(0.119, abs=0.03)
    assert most_kb < 100
    with open_recording(output) as recording:
        x_mm = recording.read("truth/object_xy_px")[:, 0] * 0.0329
        floor_mm = json.loads(recording.read("truth/sampled_parameters"))["floor_m"] * 1e3
        place, target_ma = recording.read("gripper/position_ticks"), recording.read("gripper/current_target_ma")
    assert floor_mm <= x_mm[-1] < floor_mm + 1.1  # a step of 1 ms at 1 m/s
    assert x_mm[-1] == x_mm[-50]
    assert np.isnan(target_ma[-1])
    assert abs(place[-1] - place[0]) <= 2 < 50 < place.max() - place[0]  # the gear holds within two ticks of a goal


@pytest.mark.slow
def test_data_rates_are_about_the_papers(tmp_path: Path) -> None:
    """Assert that the paper's heaviest object makes between half and twice its events in all three intervals."""
    recipe = Record(scene="data-rate", objects="18", count=5)
    measured = []
    for job in record.jobs([], recipe, tmp_path):
        record.run(job, recipe)
        measured.append(ratios(job.output)[:3])
    for interval, mean in zip(("whole", "contact", "slip"), np.mean(measured, axis=0), strict=True):
        of_paper = PAPER.figures["data rate", interval].value
        assert of_paper / 2 < mean < 2 * of_paper, interval


def test_window_dots_do_not_exist() -> None:
    """Assert that the cut gel keeps 7 rows of 8 dots, all outside the window."""
    sensor = one_sensor("evetac")
    grid = dot_grid(sensor, cut=True)
    assert grid.shape == (7, 8, 2)
    assert grid[..., 0].max() < sensor.window_px[0]


@pytest.mark.parametrize("sensor", few(["evetac", "randomized:3"], "evetac"))
def test_a_texture_that_nobody_looks_at(sensor: str) -> None:
    """Assert that a grasp without texture has the gel's events and the truth of one with it, and none of the window."""
    seen = {}
    for texture in ("on", "off"):
        trial = grasp_of(first_plan("lift", "11", sensor, texture=texture), 5, lift_s=1.0)
        events, rows = [], []
        for ms in range(2300):  # closes, and the hand begins to rise
            if ms % 2 == 0:
                trial.finger.command = ("position", trial.finger.state.position_ticks + 2)
            events.append(trial.step())
            rows.append(trial.truth())
        seen[texture] = concatenate(events), rows
    (on, truth_on), (off, truth_off) = seen["on"], seen["off"]
    border = one_sensor(sensor).window_px[0] - 5  # the cut edge lies over both
    for name in on._fields:
        np.testing.assert_array_equal(getattr(on, name)[on.x < border], getattr(off, name)[off.x < border])
    assert (on.x > border + 10).sum() > (off.x > border + 10).sum() + 500
    for one, other in zip(truth_on, truth_off, strict=True):
        assert one.keys() == other.keys()
        for key, value in one.items():
            np.testing.assert_array_equal(value, other[key], err_msg=key)


def test_what_just_holds_follows_the_hand_and_the_weight() -> None:
    """Assert weight over twice the friction for a round object at rest, more as the hand starts and a weight falls."""
    world_ = world(11, name="drop-100g")
    world_.step()
    sampled = world_.sampled
    rest_n = sampled.mass_kg * GRAVITY_M_S2 / (2 * sampled.static_friction)
    if sampled.lever_m == 0.0:
        assert world_.holding_n == pytest.approx(rest_n, rel=1e-6)
    assert world_.truth()["truth/holding_force_n"] == world_.holding_n >= rest_n * (1 - 1e-6)
    before_n, before_kg = world_.holding_n, world_.pads.carried_kg
    world_.held.pulls = 1.1
    assert world_.holding_n == pytest.approx(1.1 * before_n)
    world_.held.pulls = 1.0
    world_.pads.catch(0.1, 1.0)
    assert world_.pads.carried_kg == pytest.approx(before_kg + 0.1)
    assert world_.holding_n > before_n
