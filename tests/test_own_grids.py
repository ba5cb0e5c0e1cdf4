"""Gels of one's own: grids of other sizes and dots in no grid, from a sensor's file to features, models and forces."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.commands.calibrate import Calibrate
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.label import Label
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.commands.train import Train
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.evaluate.force import EvaluateForce
from evetac_cli.evaluate.force import measure as evaluate_force
from evetac_cli.inspect import info
from evetac_cli.resources import SCENES
from evetac_cli.stages import calibrate, featurize, label, track, train
from evetac_cli.stages.force import train_force
from evetac_cli.stages.touch import predict_touch
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import StageFile
from evetac_cli.text_files import as_toml
from evetac_cli.trials import grasp, record
from tests.make import output_of

Dots = NDArray[np.float64]

FARTHEST_PX = 1.0  # of a tracked dot from its true place


def grid(rows: int, columns: int) -> Dots:
    """(rows, columns, 2) over the gel beside the window."""
    return np.stack(np.meshgrid(np.linspace(40, 510, columns), np.linspace(40, 440, rows)), axis=-1)


def staggered() -> Dots:
    """Staggered rows (n, 2), each dot with six neighbours, of which one dot is missing."""
    y, x = np.mgrid[:8, :8]
    dots = np.stack([40 + 60 * (x + 0.5 * (y % 2)), 40 + 52 * y], axis=-1).reshape(-1, 2)
    return np.delete(dots, 20, axis=0)


def scattered() -> Dots:
    """Dots (40, 2) at random, at least 48 px apart."""
    rng, dots = np.random.default_rng(5), [np.array([300.0, 200.0])]
    while len(dots) < 40:
        one = rng.uniform((30, 30), (510, 450))
        if np.linalg.norm(np.array(dots) - one, axis=1).min() > 48.0:
            dots.append(one)
    return np.array(dots)


GELS = {
    "3 x 4": (grid(3, 4), 20.0, (3, 4)),
    "10 x 13": (grid(10, 13), 10.0, (10, 13)),
    "13 x 10": (grid(13, 10), 10.0, (13, 10)),
    "staggered": (staggered(), 13.0, (1, 63)),
    "scattered": (scattered(), 13.0, (1, 40)),
}


def sensor(folder: Path, name: str) -> str:
    dots, radius_px, _ = GELS[name]
    path = folder / "own.sensor.toml"
    path.write_text(as_toml({"like": "evetac", "dot_radius_px": radius_px, "dot_xy_px": dots.tolist()}))
    return str(path)


def slipped(name: str, scene: Path, folder: Path, seed: int = 0) -> Path:
    """The features of a trial with this gel, with its recording, tracks and labels beside them."""
    slips = Record(scene=str(scene), objects="8", sensor=sensor(folder, name), seed=seed)
    recording = output_of(record, slips, out=folder / f"{seed}.recording.h5")
    output_of(track, Track(), recording)
    output_of(label, Label(after_ms=25), recording)
    return output_of(featurize, Featurize(images=True), recording)


@pytest.mark.slow
@pytest.mark.parametrize("name", GELS)
def test_slip(name: str, short_scene: Path, tmp_path: Path) -> None:
    """Assert that dots are tracked to 1 px, slip is labelled, and features are of this grid, also in `info`."""
    features = slipped(name, short_scene, tmp_path)
    recording, tracks, labels = (features.with_name(f"0.{kind}.h5") for kind in ("recording", "tracks", "labels"))
    shape = GELS[name][2]
    with StageFile(recording, "recording") as truth, StageFile(tracks, "tracks") as tracked:
        true_px = truth.read("truth/dot_xy_px")
        error_px = np.linalg.norm(tracked.read("dot_xy_px") - true_px, axis=2)
        assert error_px.shape[1] == np.prod(shape) and error_px.max() < FARTHEST_PX
        assert not tracked.read("lost").any()
        assert np.ptp(true_px, axis=0).max() > 1.0  # and they moved
    with StageFile(labels, "labels") as labelled:
        assert labelled.read("onset_slice") > 0
    with StageFile(features, "features") as made:
        assert made.read("dot_shape").tolist() == list(shape)
    (row,) = info.run([recording]).rows
    assert row["dots"] == (f"{shape[0]} rows x {shape[1]} columns" if shape[0] > 1 else f"{shape[1]} dots in no grid")


@pytest.mark.parametrize(
    "name", ["3 x 4", *(pytest.param(name, marks=pytest.mark.slow) for name in ("13 x 10", "scattered"))]
)
@pytest.mark.slow
def test_slip_detectors(name: str, short_scene: Path, tmp_path: Path) -> None:
    """Assert that networks over a grid are trained on any grid and refuse dots in no grid, which those of images take.

    A grasp takes the model of its own gel alone.
    """
    features = [slipped(name, short_scene, tmp_path, seed) for seed in (0, 1)]
    in_a_grid = GELS[name][2][0] > 1
    if not in_a_grid:
        with pytest.raises(InputError, match="needs a grid of dots") as refused:
            output_of(train, Train(max_steps=2, preset="adam"), *features)
        assert "40 dots in no grid" in str(refused.value) and "no-hist-img" in str(refused.value)
    architecture = "hist10" if in_a_grid else "no-hist-img-6x6"
    model = output_of(train, Train(model=architecture, max_steps=2, preset="adam"), *features)
    with StageFile(model, "model") as made:
        assert made.read("dot_shape").tolist() == list(GELS[name][2])
    grasped = tmp_path / "grasp.recording.h5"
    with pytest.raises(InputError, match="the model is for another dot grid"):
        output_of(grasp, Grasp(sensor=sensor(tmp_path, name)), out=grasped)
    output_of(grasp, Grasp(sensor=sensor(tmp_path, name), model=model, lift_s=1.0, balance_s=0.2), out=grasped)
    with StageFile(grasped, "recording") as grip:
        assert np.isfinite(grip.read("control/probability")).any()


@pytest.mark.slow
def test_calibration_of_dots_in_no_grid(short_scene: Path, tmp_path: Path) -> None:
    """Assert that a press shows staggered dots to 0.5 px, and that they are tracked from there, with --irregular."""
    scene = tomllib.loads((SCENES / "press.toml").read_text())
    scene["motion"] |= {"speed_mm_s": 120.0, "lines": 5, "approach_s": 0.1, "press_s": 0.05}
    scene["solver"] = {"node_pitch_mm": 1.45}
    scene["time"]["rest_s"] = 0.1
    (tmp_path / "press.toml").write_text(as_toml(scene))
    pressing = Record(scene=str(tmp_path / "press.toml"), sensor=sensor(tmp_path, "staggered"))
    pressed = output_of(record, pressing, out=tmp_path / "press.recording.h5")
    with pytest.raises(InputError, match="staggered rows") as refused:
        output_of(calibrate, Calibrate(), pressed)
    assert "--irregular" in str(refused.value)
    made = output_of(calibrate, Calibrate(irregular=True), pressed)
    dots = read_calibration(made).dot_xy_px
    assert dots.shape == (1, 63, 2)
    assert np.linalg.norm(dots[0][:, None] - staggered()[None], axis=2).min(axis=1).max() < 0.5
    recording = slipped("staggered", short_scene, tmp_path).with_name("0.recording.h5")
    tracks = output_of(track, Track(calibration=made), recording, out=tmp_path / "calibrated.tracks.h5")
    with StageFile(tracks, "tracks") as tracked, StageFile(recording, "recording") as truth:
        true_px = truth.read("truth/dot_xy_px")
        same = np.linalg.norm(dots[0][:, None] - true_px[0][None], axis=2).argmin(axis=1)
        error_px = np.linalg.norm(tracked.read("dot_xy_px") - true_px[:, same], axis=2)
        assert error_px.max() < FARTHEST_PX


def test_forces_of_dots_in_no_grid(short_scene: Path, tmp_path: Path) -> None:
    """Assert that a force model is trained on them and judged, refuses another gel, and that they tell touch."""
    for seed in (0, 1):
        slipped("scattered", short_scene, tmp_path, seed)
    tracks = [tmp_path / f"{seed}.tracks.h5" for seed in (0, 1)]
    model = output_of(train_force, TrainForce(samples=10, epochs=2), *tracks, out=tmp_path / "a.force-model.h5")
    touch = output_of(predict_touch, PredictTouch(map_every=0), tracks[0])
    with StageFile(touch, "touch") as made, StageFile(tmp_path / "0.recording.h5", "recording") as truth:
        assert made.read("shear_n").shape == truth.read("truth/shear_force_n").shape
        assert made.read("touches").any()
    other = slipped("3 x 4", short_scene, tmp_path, 2).with_name("2.tracks.h5")
    with pytest.raises(InputError, match="dot grid") as refused:
        output_of(evaluate_force, EvaluateForce(model=str(model)), other)
    assert "40 dots in no grid" in str(refused.value)
