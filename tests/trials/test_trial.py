"""Trials: their files, their seeds, and that they can be sent to a worker process."""

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.devices import cameras, grippers
from evetac_cli.sim.setup.scene import Solver
from evetac_cli.trials import grasp, record
from evetac_cli.trials import trial as trials
from evetac_cli.trials.grasp.settings import DeviceGrasp, ReplayGrasp, SimulatedGrasp
from evetac_cli.trials.record import Preview
from evetac_cli.trials.record.capture_plan import DeviceRecording
from evetac_cli.trials.record.imported import ImportJob
from evetac_cli.trials.trial import SimulatedTrial, device_trials
from tests.conftest import Made


@pytest.mark.parametrize(
    ("params", "kind"),
    [
        (Record(), SimulatedTrial),
        (Record(preview=True), Preview),
        (Record(camera="virtual"), DeviceRecording),
        (Record(camera="virtual", preview=True), Preview),
        (Record(camera="dvxplorer", gripper="/dev/ttyUSB0", arm=True), DeviceRecording),
        (Record(source=Path("events.txt")), ImportJob),
        (Grasp(), SimulatedGrasp),
        (Grasp(camera="virtual"), DeviceGrasp),
        (Grasp(camera="replay:a.recording.h5"), ReplayGrasp),
        (Grasp(camera="replay:a.recording.h5", gripper="virtual"), DeviceGrasp),
    ],
)
def test_types(params: Record | Grasp, kind: type, tmp_path: Path, made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that what is asked for decides the type of the jobs, and that they survive being sent to a process."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(made.recordings[0], "a.recording.h5")
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


@pytest.mark.parametrize(("nodes", "warned"), [(6.0, False), (2.5, True)])
def test_a_grid_that_is_too_coarse_is_warned_of(nodes: float, warned: bool) -> None:
    """Assert that the row of a recording has its fewest nodes and what to do, and that people read that once."""
    solver = trials.SolverFigures()
    for half in (np.nan, nodes + 1.0, nodes):
        solver.add(
            {"truth/mechanical_steps": 2, "truth/estimated_error_um": 0.1, "truth/slip_half_wavelength_nodes": half}
        )
    row = solver.figures(Solver())
    assert row["slip_half_wavelength_nodes"] == nodes
    assert (row["warning"] is not None) == warned
    shown, said = record.STAGE.for_people([row], Record())
    assert said == []
    assert shown == [{name: value for name, value in row.items() if name != "warning"}]
    assert record.STAGE.warnings([row, row]) == grasp.STAGE.warnings([row, row])
    assert len(record.STAGE.warnings([row, row])) == warned
