"""A simulated trial, from gripper current to events: that the scene does what scenes.md says of it."""

import json

import numpy as np
import pytest
from conftest import Made

from evetac_cli.errors import SceneError
from evetac_cli.sim import scene
from evetac_cli.sim.eye import dot_grid
from evetac_cli.sim.scene import plan
from evetac_cli.sim.world import GRAVITY_M_S2, World
from evetac_cli.store.read import open_recording


def world(object_number: int, seed: int = 0, name: str = "slip") -> World:
    kind = "lift" if name == "lift" else "ramp"
    rngs = [np.random.default_rng([seed, part]) for part in range(2)]
    return World(plan(name, str(object_number), "evetac", (kind,))[0], *rngs, lift_s=1.5, balance_s=0.0)


def run(one: World, slices: int) -> list[dict[str, object]]:
    rows = []
    for _ in range(slices):
        if one.finished:
            break
        one.step()
        rows.append(one.truth())
    return rows


@pytest.mark.parametrize("number", [1, 6, 12, 14, 18, 19, 20])
def test_object_hangs_still(number: int) -> None:
    """Assert that a held object comes to rest: no slip, friction carries the weight, no dot moves any more."""
    held = world(number)
    rows = run(held, 1100)
    assert not any(row["truth/slip"] for row in rows)
    assert held.finger.force_n > held.drawn.mass_kg * GRAVITY_M_S2 / (2 * held.drawn.static_friction)
    dots = np.array([rows[at]["truth/dot_xy_px"] for at in (1000, 1099)])
    assert np.abs(dots[1] - dots[0]).max() < 0.01
    assert dots[1][:, 0].max() - held.eye.grid_xy_px[..., 0].max() >= 0  # hangs along +x
    assert (dots[1] - held.eye.grid_xy_px.reshape(-1, 2))[:, 0].max() > 0.5


def test_quasi_static_onset(made: Made) -> None:
    """Assert that slip begins within 40 ms of the moment when twice the friction limit no longer carries the weight."""
    for path in made.recordings:
        with open_recording(path) as recording:
            drawn = json.loads(recording.read("truth/drawn"))
            force = recording.read("truth/normal_force_n")
            slip = np.flatnonzero(recording.read("truth/slip"))
        limit_n = drawn["mass_kg"] * GRAVITY_M_S2 / (2 * drawn["static_friction"])
        lost = np.flatnonzero(force < limit_n)[0]
        assert len(slip)
        assert abs(int(slip[0]) - int(lost)) <= 40


def test_object_falls_when_released() -> None:
    """Assert that after the grip is opened the object falls freely: half g t^2, within 2 %."""
    fallen = world(8)
    run(fallen, 600)
    fallen.command = ("current", -60)
    rows = run(fallen, 400)
    free = [index for index, row in enumerate(rows) if row["truth/normal_force_n"] == 0.0]
    assert len(free) > 60
    x_mm = np.array([row["truth/object_xy_px"][0] for row in rows])[free[5] : free[5] + 50] * 0.0329  # type: ignore[index]
    t = np.arange(50) * 1e-3
    acceleration = 2 * np.polyfit(t, x_mm * 1e-3, 2)[0]
    assert acceleration == pytest.approx(GRAVITY_M_S2, rel=0.02)


def test_table_carries_the_object() -> None:
    """Assert that before the hand rises an object on the table stays on it, and that it is never below it."""
    grasp = world(11, name="lift")
    rows = run(grasp, 3000)
    gaps = np.array([row["truth/table_gap_mm"] for row in rows])
    assert gaps.min() >= -1e-9
    assert np.abs(gaps[:1999]).max() < 1e-9
    assert max(abs(row["truth/object_xy_px"][0]) for row in rows[:1999]) == 0  # type: ignore[index]


def test_hand_rises_by_the_height_of_the_scene() -> None:
    """Assert that the table sinks by 100 mm in the gripper's frame, at 20 mm/s at most."""
    grasp = world(11, name="lift")
    speeds = [grasp._hand_speed(ms * 1e-3) for ms in range(12000)]
    assert max(speeds) == pytest.approx(0.02)
    assert sum(speeds) * 1e-3 == pytest.approx(0.1, rel=1e-3)


def test_seeds_are_enough() -> None:
    """Assert that the same seed gives the same events and truth, and another seed others."""
    same = [world(8, seed=3).step() for _ in range(2)]
    assert same[0].t.tolist() == same[1].t.tolist()
    assert same[0].x.tolist() == same[1].x.tolist()
    assert world(8, seed=3).drawn != world(8, seed=4).drawn


def test_window_dots_do_not_exist() -> None:
    """Assert that the cut gel keeps 7 rows of 8 dots, all outside the window."""
    row = scene.individual_row("evetac")
    grid = dot_grid(row, cut=True)
    assert grid.shape == (7, 8, 2)
    assert grid[..., 0].max() < row["window_px"][0]


def test_scene_of_the_wrong_kind_is_refused() -> None:
    """Assert that a lift scene cannot be recorded as a ramp."""
    with pytest.raises(SceneError, match="another command"):
        plan("lift", "8", "evetac", ("ramp",))
