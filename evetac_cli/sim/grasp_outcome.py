"""What became of a grasp: lifted, balanced, moved, opened (paper, "Evaluation Procedure & Control Strategy").

Lift succeeds if the object hangs more than 50 mm above the table at the end of the lifting phase, balance if it still
does so at the end, and only a grasp that lifted counts for balance. Distance moved is that of the object in the gripper
since the end of light contact; the change of opening is counted since then, negative where the gripper closed.

Force is compared with what just holds the object, from where it leaves the table: at the end, both in the mean over
END_MS; in the mean, both over all that time; at its peak with the largest that was needed. A reaction is false where
nothing began to slip about it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim import gripper

LIFTED_MM = 50.0
HANGS_MM = 0.1  # above the table: the gripper carries all of it
END_MS = 100
SLIPS_SHARE = 0.2  # of the visible contact: the onset of incipient slip
BEFORE_MS, AFTER_MS = 60, 20  # a reaction is to slip from so long before it, as it may be late, to so long after it
NEEDED = (
    *("truth/table_gap_mm", "truth/normal_force_n", "truth/object_xy_px", "truth/visible_slip_share"),
    *("truth/closing_ticks", "gripper/position_ticks", "gripper/current_ma"),
    *("control/t_us", "control/phase", "control/slip"),
)
HOLDING = "truth/holding_force_n"  # which recordings by earlier versions lack


def opening_mm(from_ticks: int, to_ticks: int) -> float:
    """How much further open the fingers are at one position than at another."""
    return 1e3 * (gripper.gap_m(to_ticks) - gripper.gap_m(from_ticks))


def outcome(
    rows: Mapping[str, NDArray[Any]],
    mm_per_px: float,
    planned_ms: int,
    newton_per_ma: float | None = None,
    second_slip_share: NDArray[Any] | None = None,
) -> dict[str, Any]:
    """Figures of one grasp, simulated, from the rows of its recording (`NEEDED`, `HOLDING` where it has that).

    second_slip_share: `truth/visible_slip_share` of a second finger that sees, whose slip is a reason to react, too.
    planned_ms: how long it should last; newton_per_ma: of a finger's drive, None for the usual one.
    moved_* in mm, opening_* in ticks and mm, force_* in N of one finger; reopened_share: by how much of the closing for
    the lift the gripper opened again in balance, None where it did not close; failure: how it was lost, "" if it held.
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
    balanced = held and hangs(last_ms) and len(gap_mm) >= planned_ms
    slip = rows["control/slip"].astype(int)
    began = np.flatnonzero(np.diff(slip, prepend=0)[touched + 1 :] > 0) + touched + 1
    slips = rows["truth/visible_slip_share"] >= SLIPS_SHARE
    if second_slip_share is not None:
        both = min(len(slips), len(second_slip_share))
        slips = np.append(slips[:both] | (second_slip_share[:both] >= SLIPS_SHARE), slips[both:])
    reactions_ms = [int(each) for each in step_ms[began]]
    false = [at for at in reactions_ms if not slips[max(at - BEFORE_MS, 0) : at + AFTER_MS + 1].any()]
    closed = int(ticks[lifted] - ticks[touched])
    closed_end = int(ticks[-1] - ticks[touched])
    return {
        "lifted": held,
        "balanced": balanced,
        "failure": "" if balanced else _lost(gap_mm, lifted_ms, held=held),
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
        **_over_holding(rows, balanced=balanced),
        "motor_work_j": _motor_work_j(rows, newton_per_ma),
        "slip_events": len(began),
        "false_slip_events": len(false),
    }


def _lost(gap_mm: NDArray[Any], lifted_ms: int, *, held: bool) -> str:
    """How an object was lost."""
    if held:
        return "fell in balance"
    return "fell in the lift" if gap_mm[: lifted_ms + 1].max() > HANGS_MM * 10 else "stayed on the table"


def _over_holding(rows: Mapping[str, NDArray[Any]], *, balanced: bool) -> dict[str, float | None]:
    """Grip force over what just holds: at the end, in the mean and at its peak; None where it fell or is not known."""
    names = ("holding_end_n", "over_holding_end", "over_holding_mean", "over_holding_peak")
    hangs = np.flatnonzero(rows["truth/table_gap_mm"] > HANGS_MM)
    if not balanced or HOLDING not in rows or not len(hangs):
        return dict.fromkeys(names)
    force_n, holding_n = (rows[name][hangs[0] :].astype(np.float64) for name in ("truth/normal_force_n", HOLDING))
    end_n = float(holding_n[-END_MS:].mean())
    ratios = (
        force_n[-END_MS:].mean() / end_n,
        force_n.mean() / holding_n.mean(),
        force_n.max() / holding_n.max(),
    )
    return dict(zip(names, (end_n, *map(float, ratios)), strict=True))


def _at_steps(rows: Mapping[str, NDArray[Any]], name: str) -> NDArray[np.float64]:
    """Rows of slices at the steps of the controller."""
    values = rows[name].astype(np.float64)
    at: NDArray[np.float64] = values[np.clip(rows["control/t_us"] // SLICE_US - 1, 0, len(values) - 1)]
    return at


def _motor_work_j(rows: Mapping[str, NDArray[Any]], newton_per_ma: float | None) -> float:
    """Mechanical work of the motors of both fingers, whichever way they move, in J."""
    usual = gripper.Drive.force_per_current_n_ma
    closing = _at_steps(rows, "truth/closing_ticks")
    ticks = float(np.median(rows["gripper/position_ticks"]))
    metres_per_tick = abs(gripper.gap_m(ticks + 0.5) - gripper.gap_m(ticks - 0.5))
    force_n = (usual if newton_per_ma is None else newton_per_ma) * np.abs(rows["gripper/current_ma"][1:])
    return float((force_n * np.abs(np.diff(closing))).sum() * metres_per_tick)
