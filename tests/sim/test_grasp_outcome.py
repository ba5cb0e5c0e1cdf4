"""What became of a grasp, from rows made by hand."""

from typing import Any

import numpy as np
import pytest

from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim import gripper
from evetac_cli.sim.grasp_outcome import HOLDING, NEEDED, outcome

MM_PER_PX = 0.03
TOUCH_MS, LIFT_MS, END_MS = 100, 300, 500


def rows(**changes: Any) -> dict[str, Any]:
    """A grasp that holds: touched at tick 200, lifted at 210, balanced at 206, moved by 10 px, then by 5 more."""
    at_ms = np.arange(0, END_MS, 2)
    phase = np.select([at_ms < TOUCH_MS, at_ms < LIFT_MS], [GraspPhase.CONTACT, GraspPhase.LIFT], GraspPhase.BALANCE)
    object_px = np.zeros((END_MS, 2))
    object_px[TOUCH_MS:, 0] = 10.0
    object_px[LIFT_MS + 50 :, 1] = 5.0
    whole = {
        "truth/table_gap_mm": np.where(np.arange(END_MS) < TOUCH_MS + 10, 0.0, 60.0),
        "truth/normal_force_n": np.full(END_MS, 1.5),
        "truth/object_xy_px": object_px,
        "truth/visible_slip_share": np.where(np.abs(np.arange(END_MS) - 110) < 5, 0.5, 0.0),
        "truth/closing_ticks": np.where(np.arange(END_MS) < LIFT_MS, 3.0, 1.0),
        HOLDING: np.where(np.arange(END_MS) < LIFT_MS, 0.5, 1.0),
        "gripper/current_ma": np.full(len(at_ms), -20.0),
        "gripper/position_ticks": np.select([at_ms < TOUCH_MS, at_ms < LIFT_MS], [200, 210], 206),
        "control/t_us": (at_ms + 1) * 1000,
        "control/phase": phase,
        "control/slip": np.isin(at_ms, (50, 120, 122, 140, 400)).astype(np.uint8),
    }
    assert set(whole) == {*NEEDED, HOLDING}
    return {**whole, **changes}


def test_a_grasp_that_holds() -> None:
    """Assert success of both phases, and every figure by hand."""
    result = outcome(rows(), MM_PER_PX, END_MS)
    assert result["lifted"]
    assert result["balanced"]
    assert result["opening_after_lift_ticks"] == -10
    assert result["opening_after_balance_ticks"] == -6
    assert result["reopened_share"] == pytest.approx(0.4)
    assert result["moved_lift_mm"] == pytest.approx(0.3)
    assert result["moved_mm"] == pytest.approx(MM_PER_PX * np.hypot(10, 5))
    assert result["force_end_n"] == 1.5
    assert result["slip_events"] == 3  # that of the contact phase is none; two slices in a row are one
    assert result["false_slip_events"] == 1  # that at 400 ms: those at 120 and 140 have slip at 105 to 114 behind them
    assert result["failure"] == ""


def test_force_over_what_just_holds() -> None:
    """Assert the ratios from where the object leaves the table, by hand, and none where nothing is known or held."""
    result = outcome(rows(), MM_PER_PX, END_MS)
    assert result["holding_end_n"] == pytest.approx(1.0)
    assert result["over_holding_end"] == pytest.approx(1.5)
    hangs_ms = END_MS - TOUCH_MS - 10
    light_ms = LIFT_MS - TOUCH_MS - 10
    mean_n = (0.5 * light_ms + 1.0 * (hangs_ms - light_ms)) / hangs_ms
    assert result["over_holding_mean"] == pytest.approx(1.5 / mean_n)
    assert result["over_holding_peak"] == pytest.approx(1.5)
    unknown = rows()
    del unknown[HOLDING]
    assert outcome(unknown, MM_PER_PX, END_MS)["over_holding_end"] is None
    fallen = outcome(rows(**{"truth/table_gap_mm": np.zeros(END_MS)}), MM_PER_PX, END_MS)
    assert fallen["over_holding_mean"] is None
    assert fallen["failure"] == "stayed on the table"


def test_work_of_the_motors() -> None:
    """Assert the current's force times the way of both fingers, whichever way they move."""
    way_m = 2.0 * gripper.metres_per_tick(gripper.gap_m(206))
    result = outcome(rows(), MM_PER_PX, END_MS, newton_per_ma=0.3)
    assert result["motor_work_j"] == pytest.approx(0.3 * 20.0 * way_m, rel=1e-2)


def test_how_a_grasp_fails() -> None:
    """Assert that a lift fails below 50 mm or without force, and that only a lift that lasts to its end is balanced."""
    low = np.full(END_MS, 49.0)
    fell = np.where(np.arange(END_MS) < LIFT_MS + 100, 60.0, 10.0)
    let_go = np.where(np.arange(END_MS) < LIFT_MS + 100, 1.5, 0.0)
    late = np.where(np.arange(END_MS) < LIFT_MS + 100, 10.0, 60.0)
    for change, lifted in (
        ({"truth/table_gap_mm": low}, False),
        ({"truth/normal_force_n": np.zeros(END_MS)}, False),
        ({"truth/table_gap_mm": fell}, True),
        ({"truth/normal_force_n": let_go}, True),
        ({"truth/table_gap_mm": late}, False),
    ):
        result = outcome(rows(**change), MM_PER_PX, END_MS)
        assert result["lifted"] == lifted
        assert (result["failure"] == "fell in balance") == lifted
        assert not result["balanced"]
    assert not outcome(rows(), MM_PER_PX, END_MS + 1)["balanced"]  # it ended before its time


@pytest.mark.parametrize(
    ("low_mm", "slid_px", "force_n", "failure"),
    [
        (30.0, 10.0, 1.5, "the hand rose less than 50 mm in the lift"),
        (30.0, 20.0 / MM_PER_PX + 10.0, 1.5, "fell in the lift"),
        (30.0, 10.0, 0.0, "fell in the lift"),
        (0.0, 10.0, 1.5, "stayed on the table"),
    ],
)
def test_a_held_object_did_not_fall(low_mm: float, slid_px: float, force_n: float, failure: str) -> None:
    """Assert that an object that hangs low has fallen only if it slid or is not gripped, not if the lift was short."""
    slides_px = rows()["truth/object_xy_px"]
    slides_px[TOUCH_MS + 1 :, 0] += slid_px
    low = {"truth/table_gap_mm": np.full(END_MS, low_mm), "truth/object_xy_px": slides_px}
    low["truth/normal_force_n"] = np.full(END_MS, force_n)
    assert outcome(rows(**low), MM_PER_PX, END_MS)["failure"] == failure
