"""A grasp on a recording: its decisions are those that were, or would have been, made."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.kernels.grip.control import Control, SlipSignal
from evetac_cli.kernels.grip.paper import PAPER, GraspPhase
from evetac_cli.kernels.slip import networks, onnx_graphs
from evetac_cli.kernels.slip.alarms import alarming
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, LOAD_PATH, OF_GRIPPER, with_scaled_logit
from evetac_cli.kernels.slip.load_path import LoadPath
from evetac_cli.stages import featurize, track
from evetac_cli.stages.model_files import chosen_threshold
from evetac_cli.stages.slip_detectors import load_detector, read_series
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp.replay import _recipe

ROWS = ("goal_ticks", "u_ff_ticks", "x_ref_ticks", "slip", "phase", "mean_displacement_px", "t_us", "probability")


@pytest.fixture(scope="module")
def grasped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short simulated grasp."""
    params = Grasp(lift_s=1.5, balance_s=0.3)
    (job,) = grasp.jobs([], params, tmp_path_factory.mktemp("grasped") / "grasped.recording.h5")
    grasp.run(job, params)
    return job.output


def replay(path: Path, out: Path, **flags: float | str | Path) -> Path:
    params = Grasp(camera=f"replay:{path}", **flags)  # type: ignore[arg-type]
    (job,) = grasp.jobs([], params, out)
    made = grasp.run(job, params)
    assert made.simulated
    return job.output


def test_another_frame_is_part_of_the_recipe(grasped: Path, tmp_path: Path) -> None:
    """Assert that the recipe names a frame that is not an Evetac's, since what the detector tracks depends on it."""
    (job,) = grasp.jobs([], Grasp(camera=f"replay:{grasped}"), tmp_path / "again.recording.h5")
    with open_recording(grasped) as recording:
        other = SimpleNamespace(header=recording.header, frame_px=(320, 240))
        assert "frames_px" not in _recipe(job, [recording]).parameters
        assert _recipe(job, [other]).parameters["frames_px"] == [[320, 240]]


@pytest.mark.slow
def test_decisions_are_those_of_the_grasp(grasped: Path, tmp_path: Path) -> None:
    """Assert that a grasp that is replayed is evaluated and decided again just as it was, and moves nothing."""
    again = replay(grasped, tmp_path / "again.recording.h5")
    assert validate.run([again]).summary["invalid"] == 0
    with open_recording(grasped) as was, open_recording(again) as now:
        for name in ROWS:
            np.testing.assert_array_equal(was.read(f"control/{name}"), now.read(f"control/{name}"))
        for name in ("position_ticks", "current_ma", "t_us"):
            np.testing.assert_array_equal(was.read(f"gripper/{name}"), now.read(f"gripper/{name}"))
        assert was.read("control/slip").any()
        assert not now.has("truth")
        assert was.header["id"] in now.header["parents"]


def untrained(path: Path) -> Path:
    """A model that is told what the gripper does, with random weights of which the last tell much from little."""
    architecture = ARCHITECTURES["load-path"]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        network = networks.build(architecture)
    with torch.no_grad():
        of_nothing = float(network(torch.zeros(1, len(LOAD_PATH)))[0])
    weights = with_scaled_logit(networks.weights(network), "last", 50.0, -50.0 * of_nothing)
    arrays: dict[str, Any] = {f"weights/{name}": value for name, value in weights.items()}
    arrays |= {
        "onnx": np.frombuffer(onnx_graphs.build(architecture, weights), np.uint8),
        "architecture": architecture.name,
        "history": np.int64(architecture.history),
        "dot_shape": np.array([7, 8], np.int32),
        "threshold": np.float64(0.5),
        "curve/step": np.array([1]),
        "curve/loss": np.array([1.0]),
        "checkpoint/step": np.array([1]),
        "checkpoint/score": np.array([0.5]),
        "checkpoint/threshold": np.array([0.5]),
        "checkpoint/chosen": np.int64(0),
    }
    write_stage(path, Recipe("model", 1, {}, simulated_source=True), arrays)
    return path


def test_decisions_are_those_of_the_pipeline(grasped: Path, tmp_path: Path) -> None:
    """Assert that track, featurize and a network over the file, and the law over that, give the same decisions.

    The network is told where the fingers are, what they were commanded, and which share of the contact sticks.
    """
    told = untrained(tmp_path / "told.model.h5")
    again = replay(grasped, tmp_path / "again.recording.h5", controller="paper", model=told)
    tracking = Track()
    (job,) = track.jobs([again], tracking, tmp_path)
    track.run(job, tracking)
    features = Featurize(tracks=job.output, sticking_share=True)
    (job,) = featurize.jobs([again], features, tmp_path)
    featurize.run(job, features)
    with StageFile(told, "model") as model, StageFile(job.output, "features") as file:
        detector = load_detector(model)
        series = read_series(file, detector.architecture)
        probability = detector.over(series)
        assert isinstance(series, LoadPath) and series.touches.any()
        assert (series.numbers[:, LOAD_PATH.index("gripper_known")] == 1).all()
        series.numbers[:, OF_GRIPPER] = 0
        assert np.nanmax(np.abs(probability - detector.over(series))) > 0.01  # what it is told matters
        slips = np.cumsum(alarming(probability, chosen_threshold(model)))
    law = Control(PAPER)
    with open_recording(again) as now:
        np.testing.assert_array_equal(now.read("control/probability"), probability)
        position, phase = now.read("gripper/position_ticks"), now.read("control/phase")
        for step, goal in enumerate(now.read("control/goal_ticks")):
            assert law.step(GraspPhase(phase[step]), SlipSignal(int(slips[2 * step])), int(position[step])) == goal


@pytest.mark.slow
def test_another_law_and_another_recording(grasped: Path, short_scene: Path, tmp_path: Path) -> None:
    """Assert that a law can be tried on what was recorded, also without a grasp; phases are then those of the flags."""
    other = replay(grasped, tmp_path / "other.recording.h5", controller="fixed:3")
    with open_recording(other) as now, open_recording(grasped) as was:
        assert np.isnan(now.read("control/probability")).all()
        touched = was.read("control/phase") > 0
        assert (np.ptp(now.read("control/goal_ticks")[touched])) == 0
    params = Record(scene=str(short_scene), objects="8")
    (job,) = record.jobs([], params, tmp_path / "slip.recording.h5")
    record.run(job, params)
    plain = replay(job.output, tmp_path / "plain.recording.h5", lift_s=1.0, balance_s=0.0)
    with open_recording(plain) as now:
        times, phase = now.read("control/t_us"), now.read("control/phase")
        assert ((phase > 0) == (times > 1_500_000)).all()


def test_a_recording_without_dots(tmp_path: Path) -> None:
    """Assert that a recording of an unknown sensor is refused in words."""
    source = tmp_path / "events.txt"
    source.write_text("0 1 1 1\n1000 2 2 0\n")
    params = Record(source=source, frame_size="640x480")
    (job,) = record.jobs([source], params, tmp_path / "plain.recording.h5")
    record.run(job, params)
    with pytest.raises(InputError, match=r"no dot grid(.|\n)*evetac calibrate"):
        replay(job.output, tmp_path / "out.recording.h5")
    planned = Grasp(camera=f"replay:{job.output}", gripper="sim")
    with pytest.raises(InputError, match=r"no dot grid(.|\n)*evetac calibrate"):
        grasp.dry_run(grasp.jobs([], planned, tmp_path), planned)
