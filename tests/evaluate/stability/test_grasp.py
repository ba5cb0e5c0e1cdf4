"""The extreme cases of the grasp loop: all are there, one is run for real, and faults would be seen."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.simulated import SimulatedGripper
from evetac_cli.evaluate.cost.grasp import CONTROLLERS, GraspResult
from evetac_cli.evaluate.stability import EvaluateStability, command
from evetac_cli.evaluate.stability import cases as stability_cases
from evetac_cli.evaluate.stability import grasp as stability
from evetac_cli.evaluate.stability.grasp import (
    DyingDetector,
    GraspCase,
    grasp_rows,
)
from evetac_cli.jobs import Job, Rows
from evetac_cli.kernels.grip.control import Control
from evetac_cli.sim.gripper import Drive
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.scene import VanishingDots

SHORT = (("lift_s", 0.3), ("balance_s", 0.1))
HELD: Mapping[str, Any] = {"lifted": True, "balanced": True, "moved_mm": 1.0}


def not_ok(rows: Rows) -> list[str]:
    return [row["quantity"] for row in rows if not row["ok"]]


def test_what_is_not_ok(short: GraspResult) -> None:
    """Assert that a lost object, numbers that are not finite, a goal out of range, too much current and swing are not.

    The short grasp does not lift by 50 mm, and its fingers still close, so that what is held is said by hand.
    """
    still = {**short.rows, "gripper/position_ticks": np.full_like(short.rows["gripper/position_ticks"], 500)}
    held = replace(short, figures={**short.figures, **HELD}, rows=still)
    assert not_ok(stability.check("as it is", "paper", held)) == []
    swings = still["gripper/position_ticks"].copy()
    swings[::2] += 9
    for path, value, quantity in (
        ("truth/normal_force_n", np.full(2600, np.nan), stability_cases.FINITE),
        ("control/goal_ticks", np.full(1300, 741), stability_cases.GOAL),
        ("control/goal_ticks", np.full(1300, -1), stability_cases.GOAL),
        ("gripper/current_ma", np.full(1300, 700.0), stability_cases.CURRENT),
        ("gripper/position_ticks", swings, stability_cases.SWING),
    ):
        wrong = replace(held, rows={**still, path: value})
        assert not_ok(stability.check("wrong", "paper", wrong)) == [quantity.quantity]
    for figures, wanted in (
        ({"balanced": False}, [stability_cases.HELD.quantity]),
        ({"moved_mm": 10.5}, [stability_cases.MOVED.quantity]),
        (
            {"lifted": False, "balanced": False, "moved_mm": 25.5},
            [stability_cases.HELD.quantity, stability_cases.MOVED.quantity],
        ),
    ):
        lost = replace(held, figures={**held.figures, **figures})
        assert not_ok(stability.check("lost", "paper", lost)) == wanted
    swinging = replace(held, figures={**held.figures, "balanced": False}, rows=wrong.rows)
    rows = stability.check("lost", "paper", swinging)
    assert stability_cases.SWING.quantity not in [
        row["quantity"] for row in rows
    ]  # fingers that lost their object may close
    assert rows[0]["outcome"].startswith("lost in balance, with ")


def test_the_limit_is_that_of_the_servo() -> None:
    """Assert that the bound of the current is the limit that is set in the servo."""
    assert Drive.current_limit_ma == stability_cases.CURRENT.most


@pytest.mark.slow
@pytest.mark.parametrize("controller", CONTROLLERS.pick(full=False))
def test_a_fault_in_the_controller_is_seen(controller: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that goals of a real short grasp are in range, and not once the controller gives goals beyond it."""
    assert stability_cases.GOAL.quantity not in not_ok(grasp_rows(GraspCase("as usual", timing=SHORT), controller, 0))
    real = Control.step
    monkeypatch.setattr(Control, "step", lambda *given: real(*given) + 2000)
    assert stability_cases.GOAL.quantity in not_ok(grasp_rows(GraspCase("as usual", timing=SHORT), controller, 0))


def test_a_grasp_that_breaks_off_lets_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a detector that dies ends the grasp without current, in words, and that one left pressing is seen."""
    case = GraspCase("dies", wrap_detector=lambda detector, rng: DyingDetector(detector, 50), timing=SHORT)
    (row,) = grasp_rows(case, "paper", 0)
    assert (row["quantity"], row["value"], row["ok"]) == (stability_cases.LET_GO.quantity, 0.0, True)
    assert row["outcome"] == "let go: the detector died"
    monkeypatch.setattr(SimulatedGripper, "close", lambda self: None)
    (row,) = grasp_rows(case, "paper", 0)
    assert (row["value"], row["ok"]) == (np.inf, False)


def test_refusals_are_ok() -> None:
    """Assert that a case whose plan cannot be simulated is ok, and says why."""

    def without_a_dot(usual: Plan) -> Plan:
        return replace(usual, scene=replace(usual.scene, vanishing_dots=VanishingDots(dots=((90, 0),), at_s=1.0)))

    (row,) = grasp_rows(GraspCase("a dot that the gel does not have", without_a_dot, timing=SHORT), "paper", 0)
    assert row["ok"]
    assert row["outcome"].startswith("refused: ")


@pytest.mark.slow
def test_the_report(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert rows of real grasps, what is not ok first, and counted by controller."""
    monkeypatch.setattr(stability, "extreme_cases", lambda full: [GraspCase("as usual", timing=SHORT)])
    chosen = EvaluateStability(part="grasp")
    outcome = command.run(Job((), tmp_path / "a.report.h5"), chosen)
    assert {(row["controller"], row["case"]) for row in outcome.rows} == {
        (controller, "as usual") for controller in CONTROLLERS.pick(full=False)
    }
    assert outcome.rows[0]["quantity"] == stability_cases.HELD.quantity  # the hand rises by far less than 50 mm
    assert outcome.summary["cases"] == 2
    assert outcome.summary["not_ok_by_controller"] == "paper 1 of 1, load-proportional 1 of 1"
