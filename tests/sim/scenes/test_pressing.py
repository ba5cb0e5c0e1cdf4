"""Scenes in which a face is driven over the gel: shear forces, strokes, and the noise of sensors."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.arrays import Floats
from evetac_cli.resources import SCENES
from evetac_cli.sim.gel.contact import pad_nodes
from evetac_cli.sim.scenes.pressing import NO_HOLE, Pressing, covered
from evetac_cli.sim.setup.plan import first_plan, one_sensor
from evetac_cli.text_files import as_toml
from tests.make import play_trial
from tests.sim.camera.gel_cameras import gel_camera


def pressing(name: str, tmp_path: Path, **changes: dict[str, object]) -> Pressing:
    scene = tomllib.loads((SCENES / f"{name}.toml").read_text())
    for group, values in changes.items():
        scene[group] |= values
    path = tmp_path / f"{name}.toml"
    path.write_text(as_toml(scene))
    rngs = [np.random.default_rng(part) for part in range(2)]
    return Pressing(first_plan(str(path)), *rngs)


def column(rows: list[dict[str, object]], name: str) -> np.ndarray:
    return np.array([row[f"truth/{name}"] for row in rows])


def test_shear_sticks_and_stays_in_its_disc(tmp_path: Path) -> None:
    """Assert that a sheared face never slips, that the force stays within 11 N, and returns with the displacement."""
    trial = pressing("shear", tmp_path, motion={"count": 6, "move_s": [0.1, 0.2], "pause_s": 0.3, "offset_mm": 0.0})
    rows, _ = play_trial(trial)
    force = column(rows, "shear_force_n")
    assert not column(rows, "slip").any()
    assert 3 < np.linalg.norm(force, axis=1).max() < 11
    assert column(rows, "normal_force_n").max() == pytest.approx(20)
    still = np.linalg.norm(np.diff(column(rows, "object_xy_px"), axis=0), axis=1) < 1e-9
    settled = np.flatnonzero(np.convolve(still, np.ones(150), "valid") == 150)
    place = column(rows, "object_xy_px")[settled + 150] * trial.gel_camera.mm_per_px
    stiffness = -(force[settled + 150] * place).sum() / (place**2).sum()
    assert abs(stiffness) > 10  # N/mm: that of the layer alone is 10.9 for 20 x 15 mm
    assert force[settled + 150] == pytest.approx(-stiffness * place, abs=0.5)


@pytest.mark.slow
def test_strokes_move_every_dot(tmp_path: Path) -> None:
    """Assert that strokes over the gel move every dot by 3 px at least twice, and leave all of them at rest."""
    trial = pressing("press", tmp_path, motion={"speed_mm_s": 80.0, "lines": 5}, solver={"node_pitch_mm": 1.0})
    rows, _ = play_trial(trial)
    moved = np.linalg.norm(column(rows, "dot_xy_px") - trial.gel_camera.grid_xy_px.reshape(-1, 2), axis=2)
    times = ((moved[1:] >= 3) & (moved[:-1] < 3)).sum(axis=0)
    assert times.min() >= 2
    assert moved[-1].max() < 0.2
    assert moved.max() < 60


@pytest.mark.parametrize("name", ["evetac", "second", "bare-dvxplorer"])
def test_sensor_is_the_same_in_every_trial(name: str) -> None:
    """Assert that dots, thresholds and hot pixels belong to the sensor, and phases to the trial."""
    sensor = one_sensor(name)
    one, other = (gel_camera(sensor, cut=True, seed=seed) for seed in (1, 2))
    assert (one.grid_xy_px == other.grid_xy_px).all()
    assert (one._camera.threshold == other._camera.threshold).all()
    assert (one._camera.noise.hot_pixel == other._camera.noise.hot_pixel).all()
    assert (one._camera.reference != other._camera.reference).any()
    assert one.grid_xy_px.shape == (7, 8, 2)
    assert gel_camera(sensor, cut=False, seed=1).grid_xy_px.shape == (7, 9, 2)


NODES = pad_nodes(24, 18, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
FACES: dict[str, tuple[tuple[float, float], bool, Floats]] = {  # half sides, round, hole
    "rectangle": ((5.3e-3, 3.1e-3), False, NO_HOLE),
    "disc": ((4.7e-3, 4.7e-3), True, NO_HOLE),
    "ellipse": ((6.1e-3, 3.9e-3), True, NO_HOLE),
    "ring": ((6.1e-3, 4.5e-3), True, np.array([4.8e-3, 3.2e-3])),
}


@pytest.mark.parametrize("name", FACES)
def test_each_cell_is_that_of_its_points(name: str) -> None:
    """Assert that no cell is off by more than 4 % of it from the share of 32 x 32 points inside the face."""
    half_m, is_round, hole_m = FACES[name]
    fine = (np.arange(32) + 0.5) / 32 - 0.5
    pitch_m = NODES[1, 1] - NODES[0, 0]
    points = NODES[:, :, None, None, :] + np.stack(np.meshgrid(fine, fine), axis=-1) * pitch_m

    def inside(half: Floats, from_middle: Floats) -> Floats:
        scaled = np.abs(from_middle) / half
        result: Floats = (np.hypot(*np.moveaxis(scaled, -1, 0)) if is_round else scaled.max(axis=-1)) < 1.0
        return result

    for place_m in np.random.default_rng(1).uniform(-2e-3, 2e-3, (5, 2)):
        wanted = inside(np.array(half_m), points - place_m)
        if len(hole_m):
            wanted &= ~inside(hole_m, points - place_m)
        shares = covered(NODES, place_m, np.array(half_m), is_round=is_round, hole_m=hole_m)
        np.testing.assert_allclose(shares, wanted.mean(axis=(2, 3)), atol=0.04)


def test_a_face_that_moves_takes_up_cells_evenly() -> None:
    """Assert that a disc which moves by a tenth of a cell a step changes no cell by more than a fifth of it."""
    pitch_m = float(NODES[0, 1, 0] - NODES[0, 0, 0])
    places = [np.array([share * pitch_m, 0.3e-3]) for share in np.linspace(-2.0, 2.0, 41)]
    shares = np.array([covered(NODES, place, np.full(2, 4.7e-3), is_round=True) for place in places])
    assert 0.05 < np.abs(np.diff(shares, axis=0)).max() < 0.2
    assert not covered(NODES, np.array([1.0, 0.0]), np.full(2, 4.7e-3), is_round=True).any()
