"""The outcome of a grasp: lifted, balanced, moved, opened (paper, "Evaluation Procedure & Control Strategy").

Lift succeeds if the object hangs more than 50 mm above the table at the end of the lifting phase. Balance succeeds if
the object still does so at the end of the grasp; only a grasp that lifted counts for balance. The distance moved is the
object's motion in the gripper since the end of light contact. The change of opening is counted from the same time and
is negative if the gripper closed.

The grip force is compared with the force that just holds the object, starting when it leaves the table. At the end,
both are means over END_MS; for the mean, both are averaged over all that time. The peak force is compared with the
largest holding force. A reaction is false if no slip began around it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim import gripper

LIFTED_MM = 50.0  # least height above the table after a successful lift (paper)
HANGS_MM = 0.1  # height above the table at which the gripper carries the whole object
END_MS = 100  # duration of the averages at the end
SLIPS_SHARE = 0.2  # share of the visible contact that slips at the onset of incipient slip
BEFORE_MS, AFTER_MS = 60, 20  # a reaction is true if slip occurs up to 60 ms before it (it may be late) or 20 ms after
NEEDED = (
    *("truth/table_gap_mm", "truth/normal_force_n", "truth/object_xy_px", "truth/visible_slip_share"),
    *("truth/closing_ticks", "gripper/position_ticks", "gripper/current_ma"),
    *("control/t_us", "control/phase", "control/slip"),
)
HOLDING = "truth/holding_force_n"  # missing in recordings by earlier versions


def opening_mm(from_ticks: int, to_ticks: int) -> float:
    """Return the difference in opening between two positions, in mm; positive if `to_ticks` is further open."""
    return 1e3 * (gripper.gap_m(to_ticks) - gripper.gap_m(from_ticks))


def outcome(
    rows: Mapping[str, NDArray[Any]],
    mm_per_px: float,
    planned_ms: int,
    newton_per_ma: float | None = None,
    second_slip_share: NDArray[Any] | None = None,
) -> dict[str, Any]:
    """Return the figures of one simulated grasp from the rows of its recording (`NEEDED`, and `HOLDING` if available).

    second_slip_share: `truth/visible_slip_share` of a second finger with a camera; its slip also justifies a reaction.

    planned_ms: planned duration. newton_per_ma: force per current of a finger's drive; None for the standard drive.

    The figures moved_* are in mm, opening_* in ticks and mm, and force_* in N of one finger.

    reopened_share: the share of the closing during the lift by which the gripper opened again in balance; None if it
    did not close.

    failure: how the object was lost, or that the lift was too short; "" if it was held.
    """
    gap_mm, force_n = rows["truth/table_gap_mm"], rows["truth/normal_force_n"]
    object_mm = rows["truth/object_xy_px"] * mm_per_px
    step_ms, phase, ticks = rows["control/t_us"] // SLICE_US, rows["control/phase"], rows["gripper/position_ticks"]
    contact, lifted = (int(np.flatnonzero(phase <= end)[-1]) for end in (GraspPhase.CONTACT, GraspPhase.LIFT))
    last_ms = len(gap_mm) - 1
    contact_ms, lifted_ms = (min(int(step_ms[index]), last_ms) for index in (contact, lifted))

    def hangs(at_ms: int) -> bool:
        return bool(gap_mm[at_ms] > LIFTED_MM and force_n[at_ms] > 0)

    def moved_mm(at_ms: int) -> float:
        return float(np.hypot(*(object_mm[at_ms] - object_mm[contact_ms])))

    is_held = hangs(lifted_ms)
    balanced = is_held and hangs(last_ms) and len(gap_mm) >= planned_ms
    reactions, false = _reactions(rows, contact, second_slip_share)
    closed, closed_end = (int(ticks[at] - ticks[contact]) for at in (lifted, -1))
    return {
        "lifted": is_held,
        "balanced": balanced,
        "failure": "" if balanced else _lost(gap_mm, force_n, lifted_ms, moved_mm(lifted_ms), is_held=is_held),
        "moved_lift_mm": moved_mm(lifted_ms),
        "moved_mm": moved_mm(last_ms),
        "opening_after_lift_ticks": -closed,
        "opening_after_balance_ticks": -closed_end,
        "opening_after_lift_mm": opening_mm(ticks[contact], ticks[lifted]),
        "opening_after_balance_mm": opening_mm(ticks[contact], ticks[-1]),
        "reopened_share": (closed - closed_end) / closed if closed > 0 else None,
        "force_touch_n": float(force_n[contact_ms]),
        "force_lift_n": float(force_n[lifted_ms]),
        "force_end_n": float(force_n[last_ms]),
        **_over_holding(rows, balanced=balanced),
        "motor_work_j": _motor_work_j(rows, newton_per_ma),
        "slip_events": reactions,
        "false_slip_events": false,
    }


def _reactions(
    rows: Mapping[str, NDArray[Any]], contact: int, second_slip_share: NDArray[Any] | None
) -> tuple[int, int]:
    """Return how often the controller reacted after a step, and how often without slip around it."""
    began = np.diff(rows["control/slip"].astype(int), prepend=0)[contact + 1 :] > 0
    reactions_ms = (rows["control/t_us"] // SLICE_US)[contact + 1 :][began].astype(int).tolist()
    slips = rows["truth/visible_slip_share"] >= SLIPS_SHARE
    if second_slip_share is not None:
        both = min(len(slips), len(second_slip_share))
        slips = np.append(slips[:both] | (second_slip_share[:both] >= SLIPS_SHARE), slips[both:])
    false = [at for at in reactions_ms if not slips[max(at - BEFORE_MS, 0) : at + AFTER_MS + 1].any()]
    return len(reactions_ms), len(false)


def _lost(gap_mm: NDArray[Any], force_n: NDArray[Any], lifted_ms: int, moved_lift_mm: float, *, is_held: bool) -> str:
    """Describe how an object was lost, or that the hand had no time to lift it."""
    if is_held:
        return "fell in balance"
    highest_mm = gap_mm[: lifted_ms + 1].max()
    if highest_mm <= HANGS_MM * 10:
        return "stayed on the table"
    hangs = gap_mm[lifted_ms] > HANGS_MM and force_n[lifted_ms] > 0
    if hangs and gap_mm[lifted_ms] + moved_lift_mm <= LIFTED_MM:  # the object is where the hand carried it
        return f"the hand rose less than {LIFTED_MM:g} mm in the lift"
    return "fell in the lift"


def _over_holding(rows: Mapping[str, NDArray[Any]], *, balanced: bool) -> dict[str, float | None]:
    """Return the ratios of grip force to holding force: at the end, mean and peak; None if it fell or is unknown."""
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


def _motor_work_j(rows: Mapping[str, NDArray[Any]], newton_per_ma: float | None) -> float:
    """Return the mechanical work of both fingers' motors in J, counted positive in both directions."""
    usual = gripper.Drive.force_per_current_n_ma
    closing = rows["truth/closing_ticks"].astype(np.float64)
    closing = closing[np.clip(rows["control/t_us"] // SLICE_US - 1, 0, len(closing) - 1)]  # at the controller's steps
    ticks = float(np.median(rows["gripper/position_ticks"]))
    metres_per_tick = abs(gripper.gap_m(ticks + 0.5) - gripper.gap_m(ticks - 0.5))
    force_n = (usual if newton_per_ma is None else newton_per_ma) * np.abs(rows["gripper/current_ma"][1:])
    return float((force_n * np.abs(np.diff(closing))).sum() * metres_per_tick)
