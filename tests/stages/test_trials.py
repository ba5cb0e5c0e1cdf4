"""Trials: their files, their seeds, and that they can be sent to a worker process."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.devices import cameras, grippers
from evetac_cli.errors import InputError
from evetac_cli.params.grasp import Grasp
from evetac_cli.params.recording import Record
from evetac_cli.stages import grasp, record
from evetac_cli.stages.record.imported import ImportJob
from evetac_cli.stages.trials import DeviceTrial, ReplayTrial, SimulatedTrial, device_trials


@pytest.mark.parametrize(
    ("params", "kind"),
    [
        (Record(), SimulatedTrial),
        (Record(camera="virtual"), DeviceTrial),
        (Record(camera="dvxplorer", gripper="/dev/ttyUSB0", arm=True), DeviceTrial),
        (Record(source=Path("events.txt")), ImportJob),
        (Grasp(), SimulatedTrial),
        (Grasp(camera="virtual"), DeviceTrial),
        (Grasp(camera="replay:a.recording.h5"), ReplayTrial),
        (Grasp(camera="replay:a.recording.h5", gripper="virtual"), DeviceTrial),
    ],
)
def test_types(params: Record | Grasp, kind: type, tmp_path: Path) -> None:
    """Assert that what is asked for decides the type of the jobs, and that they survive being sent to a process."""
    jobs = record.jobs([], params, tmp_path) if isinstance(params, Record) else grasp.jobs([], params, tmp_path)
    assert [type(job) for job in jobs] == [kind]
    assert pickle.loads(pickle.dumps(jobs)) == jobs


def test_seeds_are_those_of_one_trial() -> None:
    """Assert that a trial's seeds depend on series, object, number and tone, and not on how many trials there are."""
    few, many = (record.jobs([], Record(objects="3,8", count=count, seed=7), None) for count in (1, 3))
    assert [trial.seeds().entropy for trial in many] == [
        [7, 3, 0],
        [7, 3, 1],
        [7, 3, 2],
        [7, 8, 0],
        [7, 8, 1],
        [7, 8, 2],
    ]
    assert [trial.seeds().entropy for trial in few] == [[7, 3, 0], [7, 8, 0]]
    (tone,) = record.jobs([], Record(scene="vibration", tones="200.5", seed=1), None)
    assert tone.seeds().entropy == [1, 0, 0, 200_500]
    (device,) = record.jobs([], Record(camera="dvxplorer", seed=4), None)
    np.testing.assert_array_equal(device.seeds().entropy, [4, 0])


def test_files_of_several_cameras(tmp_path: Path) -> None:
    """Assert that each camera has a file, those of a kind are numbered, and what was taken before is known."""
    (tmp_path / "dvxplorer-2-s0-001.recording.h5").touch()
    pair = (cameras.Dvxplorer(), cameras.Dvxplorer())
    trials = device_trials(("ramp",), pair, grippers.NoGripper(), Record(count=2), tmp_path)
    names = [[path.name for path in trial.outputs] for trial in trials]
    assert names == [[f"dvxplorer-{place}-s0-00{trial}.recording.h5" for place in (1, 2)] for trial in (0, 1)]
    assert all(trial.series == (trials[0].outputs, trials[1].outputs) for trial in trials)
    assert [path.name for path in trials[0].taken] == ["dvxplorer-2-s0-001.recording.h5"]


def test_one_file_holds_one_trial() -> None:
    """Assert that `-o NAME.h5` is refused where several trials or cameras would write it."""
    for params in (Record(camera="dvxplorer", count=2), Record(camera="dvxplorer:A,dvxplorer:B")):
        with pytest.raises(InputError, match="one output file cannot hold several"):
            record.jobs([], params, Path("a.recording.h5"))
