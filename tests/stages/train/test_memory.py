"""A detector with memory from features to its file and to a slice: trained, adapted, refused, and live as offline."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.train import Train
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, LOAD_PATH
from evetac_cli.kernels.slip.load_path import EVERY, LoadPath
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.stages import featurize, slip_detectors, train
from evetac_cli.stages.train import plan
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials.grasp.online_detector import open_detector
from tests.conftest import Made
from tests.make import run_stage

MODEL = "load-path"


@pytest.fixture(scope="module")
def seen(made: Made, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Features of the session's recordings with the sticking share, and of one that is not used for training."""
    folder = tmp_path_factory.mktemp("seen")
    chosen = Featurize(sticking_share=True, true_slip_share=True)
    recordings = [*made.recordings[:3], made.folder / "apart.recording.h5"]
    jobs = featurize.jobs(recordings, chosen, folder)
    for job in jobs:
        featurize.run(job, chosen)
    return [job.output for job in jobs]


@pytest.fixture(scope="module")
def trained(seen: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    params = Train(model=MODEL, horizon_ms=10, max_steps=20, learn_true_slip_share=True)
    output, outcome = run_stage(train, seen[:3], params, tmp_path_factory.mktemp("model"))
    (row,) = outcome.rows
    assert (row["model"], row["preset"], row["steps"]) == (MODEL, "memory", 20)
    return output


def test_its_file(trained: Path, seen: list[Path]) -> None:
    """Assert that the file is valid, names no state, and its detector is that of its weights."""
    assert [row["valid"] for row in validate.run([trained]).rows] == [True]
    assert [path.name for path in trained.parent.iterdir()] == ["load-path-10ms.model.h5"]
    with StageFile(trained, "model") as model, StageFile(seen[0], "features") as file:
        assert (int(model.read("history")), model.read("architecture")) == (1, MODEL)
        detector = slip_detectors.load_detector(model)
        assert detector.architecture == ARCHITECTURES[MODEL]
        series = slip_detectors.read_series(file, detector.architecture)
        assert isinstance(series, LoadPath)
        assert plan.series_bytes(file, detector.architecture) == series.numbers.nbytes + series.touches.nbytes
        assert series.numbers.shape == (series.slices // EVERY, len(LOAD_PATH))
        part = slip_detectors.read_series(file, detector.architecture, 0, 103)
    probability = detector.over(series)
    assert np.isfinite(probability).any()
    (late,) = slip_detectors.probabilities([detector], series, 50)
    np.testing.assert_array_equal(late, probability[50:])
    np.testing.assert_array_equal(detector.over(part), probability[:103])


@pytest.mark.parametrize("told", [False, True])
def test_live_is_offline(trained: Path, seen: list[Path], made: Made, told: bool) -> None:
    """Assert that the detector of a grasp computes the bits of track, featurize and model, with and without gripper."""
    with StageFile(trained, "model") as model, StageFile(seen[0], "features") as file:
        detector = slip_detectors.load_detector(model)
        gripper = [file.read(name) for name in ("gripper_position_ticks", "gripper_goal_ma")]
        sensor: dict[str, Any] = {}
        with open_recording(made.recordings[0]) as recording:
            names = ("frame_px", "window_px", "dot_radius_px", "dot_xy_px", *recording.sensitivity.known())
            sensor = {f"sensor/{name}": recording.read(f"sensor/{name}") for name in names}
            online = open_detector(model, sensor, PRESETS["stable"], 0.5)
            assert online.sticking is not None
            series = slip_detectors.read_series(file, detector.architecture)
            assert isinstance(series, LoadPath)
            found = np.empty(series.slices, np.float32)
            for k, events in enumerate(recording):
                if told:
                    online.tell_gripper(float(gripper[0][k]), float("nan"))
                found[k] = online.step(events)
    # no device is told of a goal current, so the last number is unknown
    series.numbers[:, LOAD_PATH.index("current_rises_20_ms") if told else LOAD_PATH.index("gripper_known") :] = 0
    np.testing.assert_array_equal(found, detector.over(series))
    assert np.isfinite(found).any()


def test_it_is_adapted(trained: Path, seen: list[Path], tmp_path: Path) -> None:
    """Assert that --adapt goes on from its weights by small steps."""
    params = Train(adapt=str(trained), max_steps=3, validate=str(seen[3]))
    output, outcome = run_stage(train, seen[:3], params, tmp_path / "own.model.h5")
    (row,) = outcome.rows
    assert (row["model"], row["preset"], row["steps"]) == (MODEL, "adapt", 3)
    with StageFile(trained, "model") as before, StageFile(output, "model") as after:
        for name in ("first.weight", "recurring.bias"):
            moved = np.abs(after.read(f"weights/{name}") - before.read(f"weights/{name}")).max()
            assert 0 < moved < 0.002


def test_refusals(made: Made, seen: list[Path]) -> None:
    """Assert that a preset is refused, and features without the sticking share, with how to get it."""
    with pytest.raises(InputError, match="--preset"):
        train.jobs(seen, Train(model=MODEL, preset="adamw"), None)
    plain = [made.beside(path, "features") for path in made.recordings[:3]]
    params = Train(model=MODEL)
    (job,) = train.jobs(plain, params, made.folder / "never.model.h5")
    with pytest.raises(InputError, match="--sticking-share"):
        train.run(job, params)
