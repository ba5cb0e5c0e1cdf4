"""Rows of the cases of `evaluate stability`, with bounds and the reasons for them; scenes with one extreme part each.

A case has a row per measured quantity, which is ok if the value is within its bound. Values that are not finite are
within no bound. A case may also be refused with an error message before it produces a wrong result. The bounds were
chosen before the cases were first run. A case that misses a bound is shown and counted, and
the bound is not moved for it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Rows
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.scene_file import merged
from evetac_cli.sim.setup.tables import as_table, read_table
from evetac_cli.store.recordings import slip_grid


class Bound(NamedTuple):
    """A measured quantity of a case, its largest allowed value, its unit, and the reason for the bound."""

    quantity: str
    most: float
    unit: str
    reason: str


REFUSED = Bound("calls that are not refused in words", 0.0, "calls", "what cannot be computed must be refused in words")
FINITE = Bound("numbers that are not finite", 0.0, "numbers", "no number that follows could be trusted")

# Bounds of the simulator.
ENERGY = Bound(
    "energy gained", 1e-6, "of the largest energy or work", "a larger gain is due to the scheme, not rounding"
)
BALANCE = Bound("force left unbalanced", 1e-6, "of all forces", "the search for the balance stops at this value")
ONSET = Bound(
    "error of the onset of gross slip", 0.5, "ms", "half a slice: the onset is in its slice or an adjacent one"
)
RESOLVED = Bound(
    "nodes that half a wavelength of unstable slip lacks",
    0.0,
    f"of {slip_grid.FEWEST_NODES} nodes",
    "with fewer nodes the onset depends on the grid; a finer --node-pitch-mm cures this, a shorter step does not",
)
TURNS = Bound(
    "times that the finger turns back", 0.0, "times", "under a constant current it moves one way until it rests"
)
SURPLUS = Bound(
    "force beyond the band of dry friction, at rest", 1e-9, "of the band", "dry friction alone holds a finger at rest"
)
EVENTS = Bound(
    "events more or fewer than a slice should hold", 0.0, "events", "0 without motion or flicker, at most 1,000,000"
)
ORDER = Bound(
    "events out of order, of their slice or of the frame", 0.0, "events", "readers rely on time stamps and on pixels"
)

# Of the dot tracker: distances of all dots from their true positions in all slices, except dots flagged as lost.
WORST_DOT = Bound("distance of the worst dot", 5.0, "px", "beyond this, the dot's rims leave the ring that is searched")
P99_DOT = Bound("99th percentile of the distance", 1.0, "px", "1 px of shear on 1 cm2 of this gel is 0.12 N")
SAME_DOTS = Bound("dots that move with the order of the events", 0.0, "dots", "the order in a slice is not reliable")

# Of grasps.
HELD = Bound(
    "phases in which the object is not held", 0.0, "of 2", "the paper's: 50 mm up after the lift and at the end"
)
MOVED = Bound("distance that the object moves in the gripper", 10.0, "mm", "half the pad: its centre is at the edge")
CURRENT = Bound("current of the motor", 661.0, "mA", "the limit that the paper's authors set in the servo")
GOAL = Bound("goal beyond the gripper's range", 0.0, "ticks", "the servo would refuse it and keep the previous goal")
SWING = Bound("swing of the fingers in the last 0.5 s", 4.0, "ticks", "a whole step of the goal moves them by less")
LET_GO = Bound(
    "current still commanded after the grasp broke off", 0.0, "mA", "a grasp that cannot continue turns torque off"
)


def in_nodes(nodes: float | None) -> str:
    """Return a remark for a row if its slip is not resolved by the nodes of the gel, else nothing."""
    if not slip_grid.is_unresolved(nodes):
        return ""
    fewest = slip_grid.FEWEST_NODES
    return f"; half a wavelength of unstable slip is {nodes:.1f} nodes, fewer than {fewest}: it depends on the grid"


def case_rows(case: str, outcome: str, measured: Sequence[tuple[Bound, float]], **columns: str) -> Rows:
    """Return the rows of a case, one per bound and value; `columns` come first, to group the cases by."""
    return [
        {
            **columns,
            "case": case,
            "ok": bool(value <= bound.most),
            "quantity": bound.quantity,
            "value": value,
            "bound": bound.most,
            "unit": bound.unit,
            "outcome": outcome,
            "reason": bound.reason,
        }
        for bound, value in measured
    ]


def run_case(case: str, run: Callable[[], Rows], **columns: str) -> Rows:
    """Return the rows of `run`; if it raises, a refusal with a reason is ok, and any other failure is not."""
    try:
        return run()
    except (ValueError, EvetacError) as error:
        return case_rows(case, f"refused: {error}", [(REFUSED, float(not str(error)))], **columns)
    except Exception as error:  # the suite must continue after the failures that it looks for
        return case_rows(case, f"failed: {type(error).__name__}: {error}", [(REFUSED, 1.0)], **columns)


Tables = Mapping[str, Mapping[str, Any]]

# Merged into the scene `slip` for the dot tracker: the weight is handed over from 0.2 to 0.5 s, and the current falls
# from 0.9 s until the object slips. The grip is near its limit from the start, so that slip comes soon.
SLIP_SOON: Tables = {"time": {"longest_s": 2.0}, "gripper": {"start_factor": [1.3, 1.5]}}
SLIPS: dict[str, Tables] = {
    "as usual": {},
    "light flickers at 100 Hz by 10 %": {"light": {"flicker": {"frequency_hz": 100.0, "depth": 0.1}}},
    "light flickers at 120 Hz by 10 %": {"light": {"flicker": {"frequency_hz": 120.0, "depth": 0.1}}},
    "light falls to half at 0.7 s": {"light": {"step": {"at_s": 0.7, "factor": 0.5}}},
    "light rises to twice at 0.7 s": {"light": {"step": {"at_s": 0.7, "factor": 2.0}}},
    "dot grid off by 1 px": {"calibration": {"offset_px": [0.8, 0.6]}},
    "dot grid off by 2 px": {"calibration": {"offset_px": [1.6, 1.2]}},
    "dot grid off by 3 px": {"calibration": {"offset_px": [2.4, 1.8]}},
    "dot grid turned by 1 degree": {"calibration": {"turned_deg": 1.0}},
    "two dots vanish at 0.3 s": {"vanishing_dots": {"dots": [[3, 4], [0, 0]], "at_s": 0.3}},
    "friction falls to a tenth at 0.7 s": {"friction_change": {"at_s": 0.7, "factor": 0.1}},
    "gel 10 times as stiff": {"gel": {"stiffness_factor": 10.0}},
    "gel a tenth as stiff": {"gel": {"stiffness_factor": 0.1}},
    "object of 5 g": {"object": {"mass_g": 5.0}},
    "object of 2 kg": {"object": {"mass_g": 2000.0}},
}

# Merged into the scene `lift`: the fingers touch until 1.5 s, the hand rises from 2 s, balance begins at 5 s.
LIFTS: dict[str, Tables] = {
    "gear friction x0.7": {"gripper": {"friction_factor": 0.7}},
    "gear friction x1.3": {"gripper": {"friction_factor": 1.3}},
    "backlash of 5 ticks": {"gripper": {"backlash_ticks": 5.0}},
    "light flickers at 120 Hz by 10 %": {"light": {"flicker": {"frequency_hz": 120.0, "depth": 0.1}}},
    "light falls to half at 3 s": {"light": {"step": {"at_s": 3.0, "factor": 0.5}}},
    "dot grid off by 3 px": {"calibration": {"offset_px": [2.4, 1.8]}},
    "dot grid turned by 1 degree": {"calibration": {"turned_deg": 1.0}},
    "two dots vanish at 3 s": {"vanishing_dots": {"dots": [[3, 4], [0, 0]], "at_s": 3.0}},
    "friction falls to a tenth at 6 s": {"friction_change": {"at_s": 6.0, "factor": 0.1}},
    "gel 10 times as stiff": {"gel": {"stiffness_factor": 10.0}},
    "gel a tenth as stiff": {"gel": {"stiffness_factor": 0.1}},
    "object of 5 g": {"object": {"mass_g": 5.0}},
    "object of 2 kg": {"object": {"mass_g": 2000.0}},
    "hand jerks by 100 mm/s at 4 s": {"hand": {"jerk": {"at_s": 4.0, "speed_mm_s": 100.0, "lasts_s": 0.05}}},
}
MORE_LIFTS: dict[str, Tables] = {  # with --full
    "gear friction x0.85": {"gripper": {"friction_factor": 0.85}},
    "gear friction x1.15": {"gripper": {"friction_factor": 1.15}},
    "backlash of 2 ticks": {"gripper": {"backlash_ticks": 2.0}},
    "light flickers at 100 Hz by 10 %": {"light": {"flicker": {"frequency_hz": 100.0, "depth": 0.1}}},
    "dot grid off by 1 px": {"calibration": {"offset_px": [0.8, 0.6]}},
}


def merge(plan: Plan, *changes: Tables) -> Plan:
    """Return a plan whose scene has these tables added or replaced; their values may be out of all ranges."""
    scene = as_table(plan.scene)
    for tables in changes:
        scene = merged(scene, tables)
    return replace(plan, scene=read_table(Scene, scene, "evaluate stability"))
