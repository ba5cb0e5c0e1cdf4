"""What became of a grasp: lifted, balanced, moved, opened (paper, "Evaluation Procedure & Control Strategy").

Lift succeeds if the object hangs more than 50 mm above the table at the end of the lifting phase, balance if it still
does so at the end, and only a grasp that lifted counts for balance. Distance moved is that of the object in the gripper
since the end of light contact; the change of opening is counted since then, negative where the gripper closed.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim import gripper

LIFTED_MM = 50.0
NEEDED = (
    *("truth/table_gap_mm", "truth/normal_force_n", "truth/object_xy_px", "gripper/position_ticks"),
    *("control/t_us", "control/phase", "control/slip"),
)


def opening_mm(from_ticks: int, to_ticks: int) -> float:
    """How much further open the fingers are at one position than at another."""
    return 1e3 * (gripper.gap_m(to_ticks) - gripper.gap_m(from_ticks))


def outcome(rows: Mapping[str, NDArray[Any]], mm_per_px: float, planned_ms: int) -> dict[str, Any]:
    """Figures of one grasp, simulated, from the rows of its recording (`NEEDED`); planned_ms: how long it should last.

    moved_* in mm, opening_* in ticks and mm, force_* in N of one finger; reopened_share: by how much of the closing for
    the lift the gripper opened again in balance, None where it did not close.
    """
    gap_mm, force_n = rows["truth/table_gap_mm"], rows["truth/normal_force_n"]
    object_mm = rows["truth/object_xy_px"] * mm_per_px
    step_ms, phase, ticks = rows["control/t_us"] // SLICE_US, rows["control/phase"], rows["gripper/position_ticks"]
    touched, lifted = (int(np.flatnonzero(phase <= end)[-1]) for end in (GraspPhase.CONTACT, GraspPhase.LIFT))
    last_ms = len(gap_mm) - 1
    touched_ms, lifted_ms = (min(int(step_ms[index]), last_ms) for index in (touched, lifted))

    def hangs(at_ms: int) -> bool:
        return bool(gap_mm[at_ms] > LIFTED_MM and force_n[at_ms] > 0)

    def moved_mm(at_ms: int) -> float:
        return float(np.hypot(*(object_mm[at_ms] - object_mm[touched_ms])))

    held = hangs(lifted_ms)
    slip = rows["control/slip"].astype(int)
    closed = int(ticks[lifted] - ticks[touched])
    closed_end = int(ticks[-1] - ticks[touched])
    return {
        "lifted": held,
        "balanced": held and hangs(last_ms) and len(gap_mm) >= planned_ms,
        "moved_lift_mm": moved_mm(lifted_ms),
        "moved_mm": moved_mm(last_ms),
        "opening_after_lift_ticks": -closed,
        "opening_after_balance_ticks": -closed_end,
        "opening_after_lift_mm": opening_mm(ticks[touched], ticks[lifted]),
        "opening_after_balance_mm": opening_mm(ticks[touched], ticks[-1]),
        "reopened_share": (closed - closed_end) / closed if closed > 0 else None,
        "force_touch_n": float(force_n[touched_ms]),
        "force_lift_n": float(force_n[lifted_ms]),
        "force_end_n": float(force_n[last_ms]),
        "slip_events": int(np.sum(np.diff(slip, prepend=0)[touched + 1 :] > 0)),
    }
