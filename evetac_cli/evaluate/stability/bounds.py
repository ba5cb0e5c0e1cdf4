"""The bounds of `evaluate stability`: what is measured of a case, how much it may be at most, and why so much.

A case has a row for every quantity that is measured of it, ok where the value is within its bound. What is not finite
is within none. A case may also be refused in words, before anything wrong comes out of it; nonsense has to be. Bounds
were written down before the cases were first held to them; a case that misses one is shown and counted, and no bound
is moved for it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Rows
from evetac_cli.store.recordings import slip_grid


class Bound(NamedTuple):
    """What is measured of a case, and the most that it may be, in a unit, for a reason."""

    quantity: str
    most: float
    unit: str
    reason: str


REFUSED = Bound(
    "calls that are not refused in words",
    0.0,
    "calls",
    "what makes no sense or cannot be computed is refused, with the reason, before anything wrong comes out of it",
)
FINITE = Bound("numbers that are not finite", 0.0, "numbers", "no number further down could be trusted")

# Of the simulator.
ENERGY = Bound(
    "energy gained",
    1e-6,
    "of the largest energy or work",
    "forces are balanced to 1e-6 of all forces: a larger gain comes from the scheme and not from rounding",
)
BALANCE = Bound(
    "force left unbalanced",
    1e-6,
    "of all forces",
    "that is where the search for the balance ends: with more left it has given up",
)
ONSET = Bound(
    "error of the onset of gross slip",
    0.5,
    "ms",
    "half a slice of events: the onset falls into the right slice of 1 ms, or into the one beside it",
)
RESOLVED = Bound(
    "nodes that half a wavelength of unstable slip lacks",
    0.0,
    f"of {slip_grid.FEWEST_NODES} nodes",
    "with fewer the onset depends on the grid, which no shorter step mends: a finer --node-pitch-mm does",
)
TURNS = Bound(
    "times that the finger turns back",
    0.0,
    "times",
    "a finger under a constant current, which dry friction damps, moves one way until it rests",
)
SURPLUS = Bound(
    "force beyond the band of dry friction, at rest",
    1e-9,
    "of the band",
    "a finger rests only where dry friction holds it",
)
EVENTS = Bound(
    "events more or fewer than a slice should hold",
    0.0,
    "events",
    "nothing that moves or flickers makes no event, and a slice holds 1,000,000 at the most",
)
ORDER = Bound(
    "events out of order, of their slice or of the frame",
    0.0,
    "events",
    "whatever reads events relies on rising time stamps within the slice, and on pixels within the frame",
)

# Of the dot tracker: distances of all dots in all slices from where they truly are, without dots that are flagged lost.
WORST_DOT = Bound(
    "distance of the worst dot",
    5.0,
    "px",
    "further off, the rims ahead and behind are outside the 10 to 20 px in which a dot's rim is looked for",
)
P99_DOT = Bound(
    "99th percentile of the distance",
    1.0,
    "px",
    "a pixel of shear on 1 cm2 of this gel is 0.12 N, a quarter of the error of the paper's force model",
)
SAME_DOTS = Bound(
    "dots that move with the order of the events",
    0.0,
    "dots",
    "events of a slice come in no order that could be relied on",
)

# Of grasps.
HELD = Bound(
    "phases in which the object is not held",
    0.0,
    "of 2",
    "as the paper counts: the object hangs more than 50 mm above the table after the lift, and still does at the end",
)
MOVED = Bound(
    "distance that the object moves in the gripper",
    10.0,
    "mm",
    "half the length of the pad: what was gripped in its middle has come to its edge",
)
CURRENT = Bound("current of the motor", 661.0, "mA", "the limit that the paper's authors set in the servo")
GOAL = Bound("goal beyond the gripper's range", 0.0, "ticks", "the servo would refuse it, and hold the goal before it")
SWING = Bound(
    "swing of the fingers in the last 0.5 s",
    4.0,
    "ticks",
    "a whole step of the goal moves the fingers by less: what is more is an oscillation of the loop",
)
LET_GO = Bound(
    "current still commanded after the grasp broke off",
    0.0,
    "mA",
    "a grasp that cannot go on lets go: torque off, and an error that says why",
)


def in_nodes(nodes: float | None) -> str:
    """What a row adds where its slip is not resolved by the nodes of the gel; nothing where it is."""
    if not slip_grid.is_unresolved(nodes):
        return ""
    fewest = slip_grid.FEWEST_NODES
    return f"; half a wavelength of unstable slip is {nodes:.1f} nodes, of {fewest} at least: it depends on the grid"


def case_rows(case: str, outcome: str, measured: Sequence[tuple[Bound, float]], **columns: str) -> Rows:
    """The rows of a case, one for each bound and what was measured; `columns` come first, to group the cases by."""
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
    """The rows that `run` gives; where it raises, a refusal that says why is ok, and any other failure is not."""
    try:
        return run()
    except (ValueError, EvetacError) as error:
        return case_rows(case, f"refused: {error}", [(REFUSED, float(not str(error)))], **columns)
    except Exception as error:  # a suite has to go on after the failures that it looks for
        return case_rows(case, f"failed: {type(error).__name__}: {error}", [(REFUSED, 1.0)], **columns)


def refusal(case: str, call: Callable[[], object], **columns: str) -> Rows:
    """The row of a call that has to be refused: ok only where it raises an error that says why."""

    def accepted() -> Rows:
        call()
        return case_rows(case, "accepted", [(REFUSED, 1.0)], **columns)

    return run_case(case, accepted, **columns)
