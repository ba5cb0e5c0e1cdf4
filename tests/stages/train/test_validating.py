"""What validates decides: calibrated probabilities, a threshold by false alarms per minute, what a model says of it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.commands.train import Train
from evetac_cli.errors import InputError
from evetac_cli.inspect import info
from evetac_cli.kernels.slip import alarms, reliability
from evetac_cli.kernels.slip.metrics import Prediction
from evetac_cli.kernels.slip.training import PRESETS
from evetac_cli.stages import model_files, slip_detectors, train
from evetac_cli.stages.train.validating import Validated
from evetac_cli.store.files import StageFile, header_of, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import run_stage

ADAM, PAPER = PRESETS["adam"], PRESETS["paper"]
ONSET = 450


def trial(folder: Path, number: int, *, slips: bool) -> Path:
    """Features of 600 slices in which dots move as they slip; without slip some move for a slice or two, or for ten."""
    rng = np.random.default_rng(number)
    moves = np.arange(600) >= ONSET if slips else np.isin(np.arange(600) % 200, [50, 51, 100, *range(150, 160)])
    motion = rng.normal(0, 0.3, (600, 56, 2)) + (3 if slips else 2) * np.array([1, 0]) * moves[:, None, None]
    events = rng.poisson(np.where(moves, 8, 1)[:, None], (600, 56)).astype(np.int32)
    total = events.sum(axis=1).astype(np.int32)
    arrays: dict[str, Any] = {
        "displacement_px": np.linalg.norm(motion, axis=2).astype(np.float32),
        "events_per_dot": events,
        "events_total": total,
        "events_outside": total,
        "label": (moves & slips).astype(np.int8),
        "onset_slice": np.int64(ONSET if slips else -1),
        "dot_shape": np.array([7, 8], np.int32),
    }
    recording = Recipe("recording", 1, {"object": 1 + number}, seed=number, simulated_source=True).header()
    labels = Recipe("labels", 1, {"method": "event-flow"}, parents=(recording,)).header()
    path = folder / f"trial-{number:02d}.features.h5"
    write_stage(path, Recipe("features", 2, {}, parents=(recording, labels)), arrays)
    return path


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Eight trials, of which every other one never slips."""
    folder = tmp_path_factory.mktemp("trials")
    return [trial(folder, number, slips=number % 2 == 0) for number in range(8)]


def params(trials: list[Path], **values: Any) -> Train:
    return Train(**({"model": "hist10", "preset": "adam", "epochs": 1000, "max_steps": 150} | values))


@pytest.fixture(scope="module")
def model(trials: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of four of them, which two that slip and two that do not validate."""
    folder = tmp_path_factory.mktemp("model")
    held = folder / "held"
    held.mkdir()
    for path in trials[4:]:
        (held / path.name).symlink_to(path)
    output, _ = run_stage(train, trials[:4], params(trials, validate=str(held), false_alarms_per_min=1.0), folder)
    return output


def predictions(model: Path, trials: list[Path]) -> list[Prediction]:
    with StageFile(model, "model") as file:
        detector, horizon_ms = slip_detectors.load_detector(file), model_files.read_horizon_ms(file)
    return [
        slip_detectors.predict(
            [detector],
            slip_detectors.read_trajectory(path, detector.architecture),
            header_of(path, "features"),
            horizon_ms,
        )[0]
        for path in trials
    ]


def test_the_model_keeps_what_its_warnings_cost(model: Path, trials: list[Path]) -> None:
    """Assert that the stored curve is that of the stored network on what validated, and the threshold keeps to 1."""
    with StageFile(model, "model") as file:
        curve, threshold = model_files.read_curve(file), float(file.read("threshold"))
    assert curve is not None
    ours = alarms.warning_curve(predictions(model, trials[4:]))
    assert (curve.minutes, curve.slips) == (pytest.approx(ours.minutes), 2)
    assert np.count_nonzero(np.abs(curve.false_alarms_per_min - ours.false_alarms_per_min) > 1e-9) <= 2  # float32
    assert curve.at(threshold)[0] <= 1.0
    below = curve.threshold[curve.threshold < threshold]
    assert not len(below) or curve.at(float(below[-1]))[0] > 1.0
    (row,) = info.run([model]).rows
    assert row["false_alarms_per_min"] == curve.at(threshold)[0]
    assert (row["warned_10_ms_ahead"], row["slips_validated_on"]) == (curve.at(threshold)[1], 2)
    assert "trajectories to validate on" in row["calibrated_on"]


def test_probabilities_are_calibrated_on_what_validates(model: Path, trials: list[Path]) -> None:
    """Assert that the stored network needs no other scale and offset there, and that the file says what was applied."""
    scale, offset = reliability.fit(predictions(model, trials[4:]))
    assert (scale, offset) == pytest.approx((1.0, 0.0), abs=0.05)
    with StageFile(model, "model") as file:
        applied = model_files.read_calibration(file)
        assert applied is not None and applied.scale > 0
        assert file.read("calibration/on").startswith("4 trajectories to validate on")
        assert 0 < int(file.read("calibration/slips")) < int(file.read("calibration/slices"))


def test_few_minutes_without_slip_are_said(model: Path) -> None:
    """Assert that a person is told where false alarms were counted in few minutes, and not where they were in many."""
    row = {"calibrated": True, "minutes_without_slip": 0.25}
    assert "counted in 0.2 minutes" in " ".join(train.for_people([row], Train())[1])
    assert train.for_people([row | {"minutes_without_slip": 30.0}], Train())[1] == []


def test_a_threshold_by_false_alarms(model: Path) -> None:
    """Assert that fewer false alarms give a higher threshold, a given one is taken, and both are refused."""
    with StageFile(model, "model") as file:
        own, curve = model_files.chosen_threshold(file), model_files.read_curve(file)
        assert curve is not None
        assert own == float(file.read("threshold")) == model_files.chosen_threshold(file, false_alarms_per_min=1.0)
        most = float(curve.most_per_min[0])
        assert model_files.chosen_threshold(file, false_alarms_per_min=most) == curve.threshold[0] < own
        assert model_files.chosen_threshold(file, threshold=0.25) == 0.25
        with pytest.raises(InputError, match="cannot be combined"):
            model_files.chosen_threshold(file, 0.25, 1.0)


def steady(probability: NDArray[np.floating], onset: int = -1) -> Prediction:
    label = np.zeros(len(probability), np.int8)
    if onset >= 0:
        label[onset:] = 1
    return Prediction(probability.astype(np.float32), label, onset)


def some() -> list[Prediction]:
    """A slip of which 0.6 is said at its onset and 0.9 later; six minutes without slip, of which 0.7 is said twice."""
    slip, quiet = np.full(500, 0.02), np.full(360_000, 0.02)
    slip[400:], slip[405:] = 0.6, 0.9
    quiet[1000:1003], quiet[9000:9003] = 0.7, 0.7
    return [steady(slip, 400), steady(quiet)]


def test_the_papers_preset_keeps_the_papers_rule() -> None:
    """Assert that preset paper is not calibrated and has the best mean of timing and F1, unless a number is named."""
    paper, named = Validated.of([some()], PAPER, None), Validated.of([some()], PAPER, 0.1)
    assert paper.calibrations == named.calibrations == [None]
    assert paper.choice.threshold < 0.6 < 0.7 < named.choice.threshold < 0.9
    assert paper.curve.at(paper.choice.threshold)[0] == pytest.approx(2 / 6, rel=0.01)
    ours = Validated.of([some()], ADAM, 0.1)
    assert ours.curve.at(ours.choice.threshold)[0] == 0.0
    assert ours.figures()["calibrated"] is True


def test_the_papers_rule_means_the_same_once_calibrated() -> None:
    """Assert that the threshold of the paper's rule detects the same slices of calibrated probabilities."""
    near = [steady(np.concatenate([np.linspace(0, 0.6, 140), np.linspace(0.5, 1, 60)]), 150)]
    plain, ours = Validated.of([near], PAPER, None), Validated.of([near], ADAM, None)
    assert plain.choice.threshold != ours.choice.threshold
    np.testing.assert_array_equal(
        ours.predictions[0].detected(ours.choice.threshold), near[0].detected(plain.choice.threshold)
    )
    assert ours.choice.detected_share == plain.choice.detected_share
    assert ours.choice.score == plain.choice.score


def test_without_quiet_slices_the_papers_rule_is_taken_and_a_number_refused() -> None:
    """Assert so for trials that are near slip throughout, and the rule alone where there are a few minutes."""
    few = [some()[0], replace(some()[1], probability=some()[1].probability[:9100], label=some()[1].label[:9100])]
    plain, ours = Validated.of([few], PAPER, None), Validated.of([few], ADAM, None)
    assert 0.1 < ours.curve.minutes < 5
    assert ours.choice.score == plain.choice.score
    assert ours.choice.detected_share == plain.choice.detected_share > 0
    assert Validated.of([few], ADAM, 1.0).choice.threshold > ours.choice.threshold
    near = [steady(np.linspace(0, 1, 300), 150)]
    assert Validated.of([near], ADAM, None).figures()["false_alarms_per_min"] is None
    with pytest.raises(InputError, match="cannot be counted"):
        Validated.of([near], ADAM, 1.0)


def test_what_says_nothing_is_not_calibrated() -> None:
    """Assert that a checkpoint of which slip is the likelier the less it says stays as it is."""
    contrary = [steady(np.linspace(1, 0, 600), 450)]
    assert Validated.of([contrary], replace(ADAM, name="any"), None).calibrations == [None]
