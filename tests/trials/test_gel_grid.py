"""The gel's grid that a grasp chooses, and when it chooses none."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.jobs import Job
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.scene import LIFT_PITCH_MM, Solver
from evetac_cli.store.recordings.slip_grid import FEWEST_NODES
from evetac_cli.trials import grasp
from evetac_cli.trials.grasp.settings import SimulatedGrasp
from evetac_cli.trials.grasp.simulated import recipes
from evetac_cli.trials.part_costs import for_people
from evetac_cli.trials.trial import FINEST_MM, GRIP, Trial, nodes_of_slip

OTHER = {"time": {"before_rise_s": 0.4}}


def grasps(**flags: Any) -> list[SimulatedGrasp]:
    """The grasps of some flags."""
    return [job for job in grasp.jobs([], Grasp(**flags), None) if isinstance(job, SimulatedGrasp)]


@pytest.fixture
def sudden(tmp_path: Path) -> str:
    """A gel whose friction falls so far that the usual grid does not resolve the slip of most objects."""
    path = tmp_path / "sudden.sensor.toml"
    path.write_text('like = "evetac"\n[friction]\nkinetic_share = 0.6\n')
    return str(path)


def solver(job: Job) -> Solver:
    """The settings of a trial's simulation."""
    assert isinstance(job, Trial) and job.plan is not None
    return job.plan.scene.solver


def nodes_at(trial: SimulatedGrasp, pitch_mm: float) -> float:
    """The nodes of a trial's slip on another grid, with the margin."""
    scene = replace(trial.plan.scene, solver=Solver(node_pitch_mm=pitch_mm))
    return nodes_of_slip(replace(trial, plan=replace(trial.plan, scene=scene)), GRIP)


def test_the_coarsest_grid_that_resolves_slip_is_chosen(sudden: str) -> None:
    """Assert that the grid of each trial resolves slip with the margin, and that a coarser one would not."""
    for trial in grasps(objects="11", sensor=sudden, count=2):
        pitch_mm = solver(trial).node_pitch_mm
        assert FINEST_MM < pitch_mm < LIFT_PITCH_MM
        assert nodes_at(trial, pitch_mm) >= FEWEST_NODES > nodes_at(trial, 1.15 * pitch_mm)


@pytest.mark.parametrize("object_", ["16", "18"])
def test_a_grid_that_suffices_or_cannot_be_mended_is_kept(object_: str, sudden: str) -> None:
    """Assert the usual grid, and so the recipe, of an object whose slip it resolves, and of one that none resolves."""
    flags = {"objects": object_, "sensor": sudden}
    (trial,), (named,) = grasps(**flags), grasps(**flags, node_pitch_mm=LIFT_PITCH_MM)
    assert recipes(trial)[0].id == recipes(named)[0].id
    assert (nodes_of_slip(trial) < FEWEST_NODES) == (object_ == "18")
    assert not grasp.cautions([trial], Grasp())


def test_the_finest_grid_may_do_without_the_margin(sudden: str) -> None:
    """Assert the finest grid for an object whose slip it resolves, but not in a tighter grip."""
    (trial,) = grasps(objects="14", sensor=sudden, seed=500)
    assert solver(trial).node_pitch_mm == FINEST_MM
    assert nodes_of_slip(trial) >= FEWEST_NODES > nodes_of_slip(trial, GRIP)


def test_a_stated_grid_wins(sudden: str, tmp_path: Path) -> None:
    """Assert that a pitch by flag or in a scene's file is kept, and that a chosen one enters the recipe like a flag."""
    stated, free = tmp_path / "stated.toml", tmp_path / "free.toml"
    stated.write_text(scene_file.changed("lift", OTHER))
    free.write_text(scene_file.changed("lift", OTHER | {"solver": {"node_pitch_mm": None}}))
    assert solver(*grasps(objects="11", scene=str(stated))).node_pitch_mm == LIFT_PITCH_MM
    assert solver(*grasps(objects="11", node_pitch_mm=2.0)).node_pitch_mm == 2.0
    (chosen,) = grasps(objects="11", sensor=sudden, scene=str(free))
    pitch_mm = solver(chosen).node_pitch_mm
    assert pitch_mm < LIFT_PITCH_MM
    (named,) = grasps(objects="11", sensor=sudden, scene=str(free), node_pitch_mm=pitch_mm)
    assert recipes(chosen)[0].id == recipes(named)[0].id


def test_virtual_devices_keep_the_usual_grid() -> None:
    """Assert that a grasp in real time has no finer grid, which may be too slow for it."""
    (job,) = grasp.jobs([], Grasp(camera="virtual", objects="11"), None)
    assert solver(job).node_pitch_mm == LIFT_PITCH_MM


def test_the_choice_is_said(sudden: str) -> None:
    """Assert the note before a run and in a dry run, of one trial and of several."""
    one = grasps(objects="11", sensor=sudden)
    several = grasps(objects="11,14,16", sensor=sudden, count=2, seed=500)
    (said,) = grasp.cautions(one, Grasp())
    pitch_mm = solver(*one).node_pitch_mm
    assert said.startswith(f"gel grid {pitch_mm:.2f} mm for object 11 (default 1.45): slip resolved")
    (of_several,) = grasp.cautions(several, Grasp())
    assert "for objects 11, 14, 4 of 6 trials (default 1.45): slip resolved, unless the grip is tight" in of_several
    shown = grasp.dry_run(one, Grasp(), force=True)
    assert shown.summary["gel_grid"] == said
    assert f"G{said[1:]}." in for_people(shown)[1]
