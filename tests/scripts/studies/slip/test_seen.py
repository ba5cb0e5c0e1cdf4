"""What detectors see of trials in memory: the numbers that the commands come to."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.track import Track
from evetac_cli.jobs import silent
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.slip.load_path import LoadPath
from evetac_cli.stages import featurize, track
from evetac_cli.stages.slip_detectors import read_series
from evetac_cli.store.files import StageFile
from evetac_cli.trials.record import simulated
from scripts.reproduce import perform
from scripts.reproduce.plan import EXPERIMENTS
from scripts.studies.slip import recordings, seen
from scripts.studies.slip.trials import planned_at


def test_what_is_seen_is_that_of_the_commands(tmp_path: Path) -> None:
    """Assert that detectors see the same, bit for bit, of a trial in memory, of its files, and of the kept trial."""
    _, planned = planned_at("slip-speeds", (7,), 11, 0, 11)
    scene = planned.plan.scene
    planned = planned._replace(
        plan=replace(planned.plan, scene=replace(scene, time=replace(scene.time, longest_s=1.1)))
    )
    row = {"object": 7, "seed": 11, "sensor": "evetac"}
    seen.write(tmp_path / "slip-speeds" / "00000.npz", seen.seen("slip-speeds", row, planned, 11, {}))
    (one,) = seen.trials_in(tmp_path, "slip-speeds")
    recording = tmp_path / "a.recording.h5"
    simulated.run(recordings.trial_of(planned, 11, recording), force=False, progress=silent)
    for stage, params in ((track, Track()), (featurize, Featurize(sticking_share=True))):
        (job,) = stage.jobs([recording], params, None)
        stage.run(job, params)
    with StageFile(tmp_path / "a.features.h5", "features") as features:
        wanted = read_series(features, ARCHITECTURES["load-path"])
    found = one.views["tracked"].path
    assert isinstance(wanted, LoadPath) and one.row == row and one.trial is not None
    assert np.isfinite(found.numbers).all() and found.touches.any() and not one.trial.slips[:1000].any()
    np.testing.assert_array_equal(found.numbers, wanted.numbers[: len(found.numbers)])
    np.testing.assert_array_equal(found.touches, wanted.touches[: len(found.touches)])
    assert not np.array_equal(found.numbers, one.views["true"].path.numbers)


@pytest.mark.parametrize("small", [False, True])
def test_ship_makes_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, small: bool) -> None:
    """Assert that the script takes its words, and that all trials are made unless few are asked."""
    made: list[Path] = []
    monkeypatch.setattr(recordings, "make", lambda asked: made.append(asked.folder) or "")
    monkeypatch.chdir(tmp_path)
    (ship,) = (one for one in EXPERIMENTS if one.name == "ship")
    steps = list(ship.steps(perform.sizes_for(ship, small=small, given={})))
    for words in (words for words in steps if words[1].endswith("recordings.py")):
        recordings.main(words[2:])
    if small:
        objects = sum(map(len, recordings.OBJECTS.values()))
        wanted = {(role, motion) for role in ("learn", "choose") for motion in ("slip", "pushes")}
        assert len(made) == 2 * objects and {folder.parts for folder in map(Path, made)} == wanted
    else:
        assert len(made) == sum(sum(counts.values()) for counts in recordings.COUNTS.values())
