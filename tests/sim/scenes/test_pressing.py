"""Scenes in which a face is driven over the gel: shear forces, strokes, and the noise of sensors."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.resources import SCENES
from evetac_cli.sim.scenes.pressing import Pressing
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
    assert (one._camera.hot_pixel == other._camera.hot_pixel).all()
    assert (one._camera.reference != other._camera.reference).any()
    assert one.grid_xy_px.shape == (7, 8, 2)
    assert gel_camera(sensor, cut=False, seed=1).grid_xy_px.shape == (7, 9, 2)
