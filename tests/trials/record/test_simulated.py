"""Recordings of simulated scenes: the progress that is reported while they are made, and what is written when."""

import itertools
import time
from dataclasses import replace
from pathlib import Path

import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.store.hdf5 import disk
from evetac_cli.trials import grasp, record
from evetac_cli.trials.record import simulated
from evetac_cli.trials.trial import SimulatedTrial
from tests.conftest import Made
from tests.quick import few

SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("scene", "most_off"),
    [
        ("rest", 0.0),
        pytest.param("press", 0.0, marks=SLOW),
        pytest.param("edge", 0.0, marks=SLOW),
        pytest.param("vibration", 0.0, marks=SLOW),
        pytest.param("handling", 0.0, marks=SLOW),
        pytest.param("slip", 0.1, marks=SLOW),
    ],
)
def test_progress_ends_at_its_total(scene: str, most_off: float, tmp_path: Path) -> None:
    """Assert that the total is known from the start, about so where an object slips out, and is reached at the end."""
    params = Record(scene=scene, tones="300" if scene == "vibration" else None)
    (job,) = record.jobs([], params, tmp_path)
    reports: list[tuple[float, float]] = []
    outcome = record.run(job, params, progress=lambda done, total, doing="": reports.append((done, total)))
    slices = outcome.rows[0]["slices"]
    assert reports[-1] == (slices, slices)
    assert [done for done, _ in reports[:-1]] == list(range(100, slices + 1, 100))
    assert all(done <= total for done, total in reports)
    assert reports[0][1] == pytest.approx(slices, rel=most_off, abs=0)


@pytest.mark.parametrize("what", few(["slip", "rest", "blocks", "grasp"], "slip", "blocks"))
def test_what_is_written_depends_on_no_clock(
    what: str, made: Made, short_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that as much is written of a trial, in as many pieces, whether hours pass in it or no time."""
    stage, params = {
        "slip": (record, Record(scene=str(short_scene))),
        "rest": (record, Record(scene="rest")),
        "blocks": (record, Record(scene=str(short_scene), seed=1)),
        "grasp": (grasp, Grasp(model=made.model, lift_s=1.0, balance_s=0.2)),
    }[what]
    writes: list[int] = []
    write = disk._Disk.write
    monkeypatch.setattr(disk._Disk, "write", lambda file, data: writes.append(write(file, data)) or writes[-1])
    if what == "blocks":
        monkeypatch.setattr("evetac_cli.store.recordings.trial_writer.BLOCK_SLICES", 100)
    seen = []
    for clock in (lambda: 1.0, itertools.count(0.0, 3600.0).__next__):
        with monkeypatch.context() as patch:
            for name in ("monotonic", "perf_counter", "time"):
                patch.setattr(time, name, clock)
            writes.clear()
            (job,) = stage.jobs([], params, tmp_path / f"{len(seen)}")
            stage.run(job, params)
        seen.append((len(writes), sum(writes)))
        assert [path.name for path in job.output.parent.iterdir()] == [job.output.name]
    assert len(set(seen)) == 1


def test_the_current_falls_as_fast_as_the_scene_says() -> None:
    """Assert that a range of factors is drawn from, and that the current falls so many times as fast as without."""
    ramps = []
    for factors in ((1.0, 1.0), (3.0, 3.0), (0.25, 4.0)):
        plan = first_plan("slip", "8")
        gripper = replace(plan.scene.gripper, fall_factor=factors)
        scene = replace(plan.scene, gripper=gripper, time=replace(plan.scene.time, longest_s=1.2))
        devices, slices = simulated.play(SimulatedTrial((), Path(), 0, 5, replace(plan, scene=scene)))
        rows = [row for _, row in slices]
        devices.close()
        targets = [row["gripper/current_target_ma"] for row in rows if "gripper/current_target_ma" in row]
        ramps.append((devices.fall_factor, targets[0] - targets[-1]))
    (once, as_printed), (thrice, faster), (drawn, varied) = ramps
    assert (once, thrice) == (1.0, 3.0) and 0.25 < drawn < 4.0
    assert faster == pytest.approx(3 * as_printed) and varied == pytest.approx(drawn * as_printed)
