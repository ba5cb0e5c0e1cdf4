"""The extreme cases of the grasp loop: all are there, one is run for real, and faults would be seen."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evetac_cli import params
from evetac_cli.jobs import Job
from evetac_cli.kernels.grip.control import Control
from evetac_cli.numerics import stability as command
from evetac_cli.numerics.grasp import stability
from evetac_cli.numerics.grasp.stability import Case, UnevenSlices, extreme_cases, grasp_row
from evetac_cli.numerics.grasp.trials import GraspResult
from tests.numerics.grasp.conftest import CountingDetector

SHORT = (("lift_s", 0.3), ("balance_s", 0.1))


def test_what_is_not_ok(short: GraspResult) -> None:
    """Assert that numbers that are not finite, a goal out of range, too much current and swinging fingers are not."""
    assert stability.check("as it is", short)["ok"]
    swings = short.rows["gripper/position_ticks"].copy()
    swings[::2] += 9
    for path, value in (
        ("truth/normal_force_n", np.full(2600, np.nan)),
        ("control/goal_ticks", np.full(1300, 741)),
        ("gripper/current_ma", np.full(1300, 700.0)),
        ("gripper/position_ticks", swings),
    ):
        figures = {**short.figures, "balanced": True}  # fingers that lost their object may close
        wrong = replace(short, figures=figures, rows={**short.rows, path: value})
        assert not stability.check("wrong", wrong)["ok"]


@pytest.mark.parametrize("controller", stability.QUICK_CONTROLLERS)
def test_a_fault_in_the_controller_is_seen(controller: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a real short grasp is ok, and not ok once the controller gives goals beyond the gripper's range."""
    assert grasp_row(Case("as usual", timing=SHORT), controller, 0)["ok"]
    real = Control.step
    monkeypatch.setattr(Control, "step", lambda *given: real(*given) + 2000)
    row = grasp_row(Case("as usual", timing=SHORT), controller, 0)
    assert not row["ok"]


@pytest.mark.parametrize(("lost", "twice", "times"), [(0.2, 0.0, 0.8), (0.0, 0.2, 1.2)])
def test_slices_that_are_lost_or_come_twice(lost: float, twice: float, times: float) -> None:
    """Assert that slices are lost and doubled in their shares."""
    counting = CountingDetector()
    uneven = UnevenSlices(counting, np.random.default_rng(0), lost, twice)
    probabilities = [uneven.step(None) for _ in range(5000)]
    assert counting.slices == pytest.approx(5000 * times, rel=0.03)
    assert np.isnan(probabilities).mean() == pytest.approx(lost, abs=0.02)


def test_every_case_is_another() -> None:
    """Assert that the suite has all extremes, each once, and more when it is full."""
    quick, full = extreme_cases(full=False), extreme_cases(full=True)
    names = [case.name for case in quick]
    assert len(set(names)) == len(names)
    assert {"detector never fires", "detector always fires", "mass 5 g", "mass 2000 g", "friction 0.1", "friction 2",
            "gel stiffness x0.1", "gel stiffness x10", "one slice in five lost", "one slice in five twice",
            "law's gain x0.1", "law's gain x10"} <= set(names)  # fmt: skip
    assert len(full) > len(quick)
    assert len(stability.cases(0, False)) == 2 * len(quick) - sum(case.paper_only for case in quick)


def test_refusals_are_ok() -> None:
    """Assert that a case whose plan cannot be simulated is ok, and says why."""

    def without_mass(plan: dict[str, Any]) -> None:
        plan["object_row"] = {**plan["object_row"], "mass_g": -1.0}

    row = grasp_row(Case("object of -1 g", without_mass, timing=SHORT), "paper", 0)
    assert row["ok"]
    assert row["outcome"].startswith("refused: ")


def test_the_report(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert rows of real grasps, with the largest current over all in the summary."""
    monkeypatch.setattr(stability, "extreme_cases", lambda full: [Case("as usual", timing=SHORT)])
    chosen = params.EvaluateStability(part="grasp")
    outcome = command.run(Job((), tmp_path / "a.report.h5"), chosen)
    assert [row["case"] for row in outcome.rows] == ["paper: as usual", "load-proportional: as usual"]
    assert [list(row)[3:] for row in outcome.rows] == [list(command.PARTS["grasp"].columns)] * 2
    assert outcome.summary["current_max_ma"] == max(row["current_max_ma"] for row in outcome.rows) > 0
    assert outcome.summary["ok"] == 2
