"""rgb, fit, force and evaluate force on made-up recordings whose gel is exactly linear."""

import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.track import Track
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.evaluate.force import EvaluateForce
from evetac_cli.evaluate.force import measure as evaluate_force
from evetac_cli.inspect import info
from evetac_cli.stages import track
from evetac_cli.stages.force import train_force
from evetac_cli.stages.touch import predict_touch
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Recipe
from tests.make import run_valid
from tests.stages.force.dots_and_forces import write_trial

N_PX = 0.4  # shear force for each px of mean displacement
SLICES = 2400
FIT = TrainForce(samples=40, epochs=5)


def tracks_of_shear(
    folder: Path, number: int, *, softer: float = 1.0, columns: int = 9, truth: bool = True, preset: str = "exact"
) -> Path:
    """A recording without events and the tracks of its dots, all of which move as one; the tracks' path.

    `softer`: how many times as far the dots move under the same force, on a sensor of the same name but other values.
    """
    rng = np.random.default_rng(number)
    knots = rng.uniform(-10, 10, (9, 2))
    time = np.arange(SLICES)
    pressed = (time > 200) & (time < SLICES - 200)
    at = np.linspace(200, SLICES - 200, len(knots))
    force_n = pressed[:, None] * np.stack([np.interp(time, at, knots[:, axis]) for axis in (0, 1)], axis=1)
    rest = np.stack(np.meshgrid(60.0 + 62.0 * np.arange(columns), 40.0 + 62.0 * np.arange(7)), axis=-1)
    dots = (rest.reshape(1, -1, 2) + force_n[:, None] * softer / N_PX).astype(np.float32)
    parameters = {"sensor_row": {"shear_modulus_pa": 145e3 / softer}, "columns": columns}
    recipe = Recipe("recording", 1, parameters, seed=number, simulated_source=truth)
    return write_trial(folder, recipe, rest, dots, 20.0 * pressed, force_n, "evetac", preset=preset)


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three trials to fit on and one apart, their tracks from events and from frames, and a model for each sensor."""
    folder = tmp_path_factory.mktemp("force")
    tracks = [tracks_of_shear(folder, number) for number in range(4)]
    frames = [run_valid(track, [folder / f"trial{number}.recording.h5"], Track(rgb=True))[0] for number in range(4)]
    run_valid(train_force, tracks[:3], FIT, folder / "events.force-model.h5")
    run_valid(train_force, frames[:3], FIT, folder / "frames.force-model.h5")
    return folder


def test_frames_show_where_the_dots_are(fits: Path) -> None:
    """Assert that dots tracked in frames are within 0.3 px of truth at each frame, and stay until the next."""
    with (
        StageFile(fits / "rgb" / "trial3.tracks.h5") as tracks,
        StageFile(fits / "trial3.recording.h5") as recording,
    ):
        result, true = tracks.read("dot_xy_px"), recording.read("truth/dot_xy_px")
    assert np.abs(result[::40] - true[::40]).max() < 0.3
    assert np.array_equal(result, np.repeat(result[::40], 40, axis=0))
    assert np.abs(true[::40] - true[0]).max() > 20


def test_a_linear_gel_is_told(fits: Path, tmp_path: Path) -> None:
    """Assert that the regression errs by no more than the force sensor's noise, and the report says what the paper got.

    The mean of the absolute value of a normal deviate is sqrt(2 / pi) of its deviation.
    """
    files = [fits / "trial3.tracks.h5", fits / "rgb" / "trial3.tracks.h5"]
    chosen = EvaluateForce(model=str(fits), samples=45)
    _, outcome = run_valid(evaluate_force, files, chosen, tmp_path)
    assert outcome.simulated
    assert [(row["sensor"], row["model"]) for row in outcome.rows] == [
        (sensor, model) for sensor in ("events", "frames") for model in ("regression", "network")
    ]
    for row in outcome.rows[::2]:
        for letter in "xy":
            assert row[f"mae_n_{letter}"] == pytest.approx(0.05 * np.sqrt(2 / np.pi), rel=0.4)
        assert row["gain"] == pytest.approx(1, abs=0.01)
        assert row["fitted"]
    assert [outcome.rows[2][f"paper_{name}"] for name in ("mae_n_x", "sd_n_x", "mae_n_y", "sd_n_y")] == [
        0.53, 0.49, 0.44, 0.29,
    ]  # fmt: skip
    assert outcome.summary["true_force_max_x_n"] <= 10.5


@pytest.mark.slow
def test_models_of_several_seeds(fits: Path, tmp_path: Path) -> None:
    """Assert that rows have the means over models that differ in the seed, and how much these differ."""
    learn, judged = (
        [fits / f"trial{number}.tracks.h5" for number in range(3)],
        [fits / "trial3.tracks.h5"],
    )
    rows = []
    for seed in (1, 2):
        model = tmp_path / f"{seed}.force-model.h5"
        run_valid(train_force, learn, TrainForce(samples=40, epochs=2, seed=seed), model)
        chosen = EvaluateForce(model=str(model), samples=45)
        rows.append(run_valid(evaluate_force, judged, chosen, tmp_path / f"{seed}.report.h5")[1].rows[1])
    chosen = EvaluateForce(model=str(tmp_path), samples=45)
    network = run_valid(evaluate_force, judged, chosen, tmp_path / "both.report.h5")[1].rows[1]
    assert [row["models"] for row in (*rows, network)] == [1, 1, 2]
    assert rows[0]["mae_n_x"] != rows[1]["mae_n_x"]
    for name in ("mae_n_x", "mae_n_y", "sd_n_x", "sd_n_y", "gain"):
        assert network[name] == pytest.approx((rows[0][name] + rows[1][name]) / 2)
    assert network["sd_over_models_n_x"] == pytest.approx(abs(rows[0]["mae_n_x"] - rows[1]["mae_n_x"]) / 2)


def test_another_gel_is_reported_as_it_is(fits: Path, tmp_path: Path) -> None:
    """Assert that a gel whose dots move 1.3 times as far gives 1.3 times the force, without the paper beside it."""
    soft = tracks_of_shear(tmp_path, 7, softer=1.3)
    chosen = EvaluateForce(model=str(fits / "events.force-model.h5"), samples=45)
    _, outcome = run_valid(evaluate_force, [soft], chosen, tmp_path / "out")
    regression = outcome.rows[0]
    assert regression["gain"] == pytest.approx(1.3, abs=0.01)
    assert regression["sensor_name"] == "evetac"
    assert not regression["fitted"]
    assert regression["paper_mae_n_x"] is None
    both, fitted = (
        run_valid(evaluate_force, files, chosen, tmp_path / f"{len(files)}.report.h5")[1]
        for files in ([fits / "trial3.tracks.h5", soft], [fits / "trial3.tracks.h5"])
    )
    assert (both.summary["trajectories_of_other_sensors"], both.summary["events_trajectories"]) == (1, 1)
    means = [outcome.summary["events_regression_mae_n_x"] for outcome in (both, fitted)]
    assert means[0] == pytest.approx(means[1], rel=0.2)
    _, (line, _) = evaluate_force.for_people(both.rows, chosen)
    assert line.endswith("; n = 2 of 2 trajectories; 1 of sensors that the model was not fitted on.")


def test_what_a_model_of_the_paper_is_for(fits: Path, tmp_path: Path) -> None:
    """Assert that info tells its sensor, and that neither touch maps nor their evaluation take it."""
    model = fits / "events.force-model.h5"
    assert info.run([model]).rows[0]["sensor"] == "events"
    tracks = [fits / "trial3.tracks.h5"]
    refused(predict_touch, tracks, PredictTouch(model=model), "of the paper's method", tmp_path)
    for flags in ({"adapt_on": str(fits / "trial1.tracks.h5")}, {"identified": str(fits)}):
        refused(evaluate_force, tracks, EvaluateForce(model=str(model), **flags), "is for touch maps alone", tmp_path)


def refused(stage: Any, files: list[Path], chosen: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        run_valid(stage, files, chosen, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_was_learned_is_not_judged(fits: Path, tmp_path: Path) -> None:
    """Assert that a recording that was fitted on is refused, whichever sensor tracked it, and so is one held out."""
    chosen = EvaluateForce(model=str(fits / "events.force-model.h5"), samples=45)
    for number in range(3):
        refused(
            evaluate_force,
            [fits / f"trial{number}.tracks.h5"],
            chosen,
            "trained on and evaluated on",
            tmp_path,
        )
    refused(
        train_force,
        [fits / "trial0.tracks.h5", fits / "trial0.tracks.h5"],
        FIT,
        "held out",
        tmp_path,
    )


def test_sensors_are_kept_apart(fits: Path, tmp_path: Path) -> None:
    """Assert that no model is fitted to two sensors, and that each file needs the one model of its own."""
    events, frames = fits / "trial3.tracks.h5", fits / "rgb" / "trial3.tracks.h5"
    refused(train_force, [fits / "trial0.tracks.h5", frames], FIT, "different sensors", tmp_path)
    only = EvaluateForce(model=str(fits / "frames.force-model.h5"))
    refused(evaluate_force, [events], only, "dots tracked in events", tmp_path)
    run_valid(
        train_force,
        [fits / "trial0.tracks.h5", fits / "trial1.tracks.h5"],
        FIT,
        tmp_path / "other.force-model.h5",
    )
    (tmp_path / "events.force-model.h5").write_bytes((fits / "events.force-model.h5").read_bytes())
    refused(evaluate_force, [events], EvaluateForce(model=str(tmp_path)), "two different models", tmp_path)


def test_trackers_are_kept_apart(fits: Path, tmp_path: Path) -> None:
    """Assert that dots tracked by another preset than the models' are refused, and that two presets have rows each."""
    other = [tracks_of_shear(tmp_path, number, preset="other") for number in range(4)]
    model = fits / "events.force-model.h5"
    refused(evaluate_force, other[3:], EvaluateForce(model=str(model)), "in events by other", tmp_path)
    run_valid(train_force, other[:3], FIT, tmp_path / "other.force-model.h5")
    (tmp_path / "events.force-model.h5").write_bytes(model.read_bytes())
    both = EvaluateForce(model=str(tmp_path), samples=45)
    files = [*other[3:], fits / "trial3.tracks.h5"]
    _, outcome = run_valid(evaluate_force, files, both, tmp_path / "a.report.h5")
    assert [row["tracker"] for row in outcome.rows] == ["other", "other", "exact", "exact"]
    assert "events_other_network_mae_n_x" in outcome.summary


def test_another_grid_is_refused(fits: Path, tmp_path: Path) -> None:
    """Assert that a cut gel's tracks do not fit a closed gel's model, in both commands."""
    cut = tracks_of_shear(tmp_path, 8, columns=8)
    model = fits / "events.force-model.h5"
    refused(evaluate_force, [cut], EvaluateForce(model=str(model)), "dot grid", tmp_path)
    refused(train_force, [fits / "trial0.tracks.h5", cut], FIT, "different dot grids", tmp_path)


def test_what_cannot_be_answered(fits: Path, tmp_path: Path) -> None:
    """Assert that too few files, no truth, too short a contact and no model to evaluate are refused in words."""
    model = str(fits / "events.force-model.h5")
    refused(train_force, [fits / "trial0.tracks.h5"], FIT, "at least two", tmp_path)
    refused(evaluate_force, [fits / "trial3.tracks.h5"], EvaluateForce(model=model), "too short", tmp_path)
    real = tracks_of_shear(tmp_path, 9, truth=False)
    refused(evaluate_force, [real], EvaluateForce(model=model), "has no truth", tmp_path)
    refused(track, [tmp_path / "trial9.recording.h5"], Track(rgb=True), "has no truth", tmp_path)


def test_damaged_network_is_refused(fits: Path, tmp_path: Path) -> None:
    """Assert that a model whose layers do not fit its grid is refused."""
    path = shutil.copy(fits / "events.force-model.h5", tmp_path / "wrong.force-model.h5")
    with h5py.File(path, "r+") as h5:
        h5["dot_shape"][...] = [7, 8]
    chosen = EvaluateForce(model=str(path))
    refused(evaluate_force, [fits / "trial3.tracks.h5"], chosen, "0/weight is impossible", tmp_path)
