"""What detectors say of trials in memory: the numbers that the commands come to."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import motion_recordings
import seen_trials
import train_detectors
from slip_trials import planned_at

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.track import Track
from evetac_cli.evaluate.slip_models import Model
from evetac_cli.jobs import silent
from evetac_cli.resources import MODEL
from evetac_cli.stages import featurize, track
from evetac_cli.stages.slip_detectors import read_series
from evetac_cli.store.files import StageFile
from evetac_cli.trials.record import simulated


def test_probabilities_are_those_of_the_commands(tmp_path: Path) -> None:
    """Assert that a detector says the same, bit for bit, of a trial in memory and of its files."""
    _, planned = planned_at("slip-speeds", (7,), 11, 0, 11)
    scene = planned.plan.scene
    planned = planned._replace(
        plan=replace(planned.plan, scene=replace(scene, time=replace(scene.time, longest_s=1.1)))
    )
    _, scores = seen_trials.seen(planned, 11, {"shipped": Model.read(MODEL)})
    said, horizon_ms = scores["shipped"]
    recording = tmp_path / "a.recording.h5"
    simulated.run(motion_recordings.trial_of(planned, 11, recording), force=False, progress=silent)
    for stage, params in ((track, Track()), (featurize, Featurize())):
        (job,) = stage.jobs([recording], params, None)
        stage.run(job, params)
    with StageFile(tmp_path / "a.features.h5", "features") as features:
        model = Model.read(MODEL)
        wanted = model.detector().over(read_series(features, model.architecture))
    assert horizon_ms == model.horizon_ms
    np.testing.assert_array_equal(said, wanted[: len(said)])
    assert np.isfinite(said[100:]).all()


def test_variants_are_trained_on_what_they_say(tmp_path: Path) -> None:
    """Assert which folders each variant learns from: slips alone, other speeds, motion without slip."""
    every = ("slip", "slip-varied", "slip-speeds", "pushes", "opening", *(train_detectors.FROM_EVENTS, "sticking"))
    for name in every:
        (tmp_path / name).mkdir()
    folders = {name: train_detectors.folders_of(one, tmp_path) for name, one in train_detectors.VARIANTS.items()}
    names = {name: {folder.name for folder in of} for name, of in folders.items()}
    assert names["slips"] == {"slip", "slip-varied"} and names["speeds"] == names["slips"] | {"slip-speeds"}
    assert names["negatives"] == names["grip"] == names["speeds"] | {"pushes", "opening"}
    assert {folder.parent.name for folder in folders["slips-events"]} == {train_detectors.FROM_EVENTS}
    assert {folder.parent.name for folder in folders["sticking"]} == {train_detectors.STICKING}
