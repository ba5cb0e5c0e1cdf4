"""The bounds of `evaluate stability`: the measured quantities of a case, their limits, and the reasons for the limits.

A case has a row per measured quantity, which is ok if the value is within its bound. Values that are not finite are
within no bound. A case may also be refused with an error message before it produces a wrong result; invalid input must
be refused. The bounds were chosen before the cases were first run. A case that misses a bound is shown and counted, and
the bound is not moved for it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Rows
from evetac_cli.store.recordings import slip_grid


class Bound(NamedTuple):
    """A measured quantity of a case, its largest allowed value, its unit, and the reason for the bound."""

    quantity: str
    most: float
    unit: str
    reason: str


REFUSED = Bound(
    "calls that are not refused in words",
    0.0,
    "calls",
    "invalid input, or input that cannot be computed, must be refused with a reason before it gives wrong results",
)
FINITE = Bound("numbers that are not finite", 0.0, "numbers", "no number that follows could be trusted")

# Bounds of the simulator.
ENERGY = Bound(
    "energy gained",
    1e-6,
    "of the largest energy or work",
    "forces are balanced to 1e-6 of all forces: a larger gain is due to the scheme, not to rounding",
)
BALANCE = Bound(
    "force left unbalanced",
    1e-6,
    "of all forces",
    "the search for the balance stops at this value: with more left it has given up",
)
ONSET = Bound(
    "error of the onset of gross slip",
    0.5,
    "ms",
    "half a slice of events: the onset is in the correct slice of 1 ms or in an adjacent one",
)
RESOLVED = Bound(
    "nodes that half a wavelength of unstable slip lacks",
    0.0,
    f"of {slip_grid.FEWEST_NODES} nodes",
    "with fewer nodes the onset depends on the grid; a finer --node-pitch-mm cures this, a shorter step does not",
)
TURNS = Bound(
    "times that the finger turns back",
    0.0,
    "times",
    "with a constant current and dry friction, a finger moves in one direction until it rests",
)
SURPLUS = Bound(
    "force beyond the band of dry friction, at rest",
    1e-9,
    "of the band",
    "a finger rests only if dry friction can hold it",
)
EVENTS = Bound(
    "events more or fewer than a slice should hold",
    0.0,
    "events",
    "without motion or flicker there are no events, and a slice holds at most 1,000,000",
)
ORDER = Bound(
    "events out of order, of their slice or of the frame",
    0.0,
    "events",
    "readers of events rely on rising time stamps within the slice and on pixels within the frame",
)

# Of the dot tracker: distances of all dots from their true positions in all slices, except dots flagged as lost.
WORST_DOT = Bound(
    "distance of the worst dot",
    5.0,
    "px",
    "beyond this, the dot's rims ahead and behind are outside the ring of 10 to 20 px in which the tracker searches",
)
P99_DOT = Bound(
    "99th percentile of the distance",
    1.0,
    "px",
    "1 px of shear on 1 cm2 of this gel is 0.12 N, a quarter of the error of the paper's force model",
)
SAME_DOTS = Bound(
    "dots that move with the order of the events",
    0.0,
    "dots",
    "the order of events within a slice is not reliable",
)

# Of grasps.
HELD = Bound(
    "phases in which the object is not held",
    0.0,
    "of 2",
    "as in the paper: the object is more than 50 mm above the table after the lift, and still is at the end",
)
MOVED = Bound(
    "distance that the object moves in the gripper",
    10.0,
    "mm",
    "half the length of the pad: an object gripped at its centre has reached its edge",
)
CURRENT = Bound("current of the motor", 661.0, "mA", "the limit that the paper's authors set in the servo")
GOAL = Bound("goal beyond the gripper's range", 0.0, "ticks", "the servo would refuse it and keep the previous goal")
SWING = Bound(
    "swing of the fingers in the last 0.5 s",
    4.0,
    "ticks",
    "a whole step of the goal moves the fingers by less: more than this is an oscillation of the loop",
)
LET_GO = Bound(
    "current still commanded after the grasp broke off",
    0.0,
    "mA",
    "a grasp that cannot continue lets go: torque off, and an error with the reason",
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


def refusal(case: str, call: Callable[[], object], **columns: str) -> Rows:
    """Return the row of a call that must be refused: ok only if it raises an error with a reason."""

    def accepted() -> Rows:
        call()
        return case_rows(case, "accepted", [(REFUSED, 1.0)], **columns)

    return run_case(case, accepted, **columns)
