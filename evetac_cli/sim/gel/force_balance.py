"""The balance of forces in one time step of the gel: the node velocities and the object's twist that satisfy it.

The minimum of a convex function (see gel) is found in rounds. Each round makes sweeps of projected over-relaxation over
the nodes and the sheet that couples them (`relax`), then a Newton step of the object, with which the stuck nodes move
(see object_move). Each simulated pad has its own `Equation`.
"""

import math
from typing import NamedTuple

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.gel_layer import SPRING
from evetac_cli.sim.gel.pad import Work
from evetac_cli.sim.gel.sheet import SheetStencil, largest, pull_sheet, relax_sheet, sheet_imbalance

Three = tuple[float, float, float]  # along x, along y, and about the axis normal to both
ROUNDING = 1e-12  # slip below this share of the object's speed counts as sticking: its direction is lost in rounding
FACTOR = 1.3  # over-relaxation factor of the nodes
# Number of sweeps over the sheet after each sweep over the nodes. With 1, 2 and 3 the gel of a slip slice took 85, 79
# and 82 us (object 8), and 102, 88 and 95 us (object 11).
SHEET_SWEEPS = 2
# The sheet must be in balance within this share of the force that pulls it, or STRICTER than everything else. Measured
# by all forces alone, of which most are friction, the sheet would lag behind a gel that creeps. Slips of objects 3, 8
# and 11 begin in the same slice with shares of 0.001, 0.01, 0.05 and 0.15; the events of the 60 slices before it differ
# by 2 at most.
SHEET_SHARE, STRICTER = 0.05, 1e3


class Stencil(NamedTuple):
    """The matrix of the nodes in one time step: own + spring on the diagonal, -spring to the sheet below a node.

    Both in N s/m. pads: how many pads like this one hold the object.
    """

    own: float
    spring: float
    stretch: SheetStencil
    pads: float


class Equation(NamedTuple):
    """The equation of a pad's nodes in one time step, as far as it is solved: and which nodes stick."""

    stencil: Stencil
    work: Work
    stuck: Flags


@njit(cache=True, _nrt=False, error_model="numpy")
def friction_projection(x: float, y: float, bound: float) -> float:
    """Return the share of a vector (x, y) that remains if its length is reduced by `bound`; 0 if it is not longer.

    This is Coulomb's law in the search (the proximal map of friction): the slip of a node, reduced by its friction.
    """
    square = x * x + y * y
    return 1.0 - bound / math.sqrt(square) if square > bound * bound else 0.0


@njit(cache=True, _nrt=False, error_model="numpy")
def relax(equation: Equation, twist: Three) -> None:
    """Make one sweep of projected over-relaxation at the object's velocity: over the nodes, then over the sheet."""
    stencil, work, stuck = equation
    rows, columns = work.bound.shape
    ease = FACTOR / (stencil.own + stencil.spring)
    keep = 1.0 - FACTOR
    spring = stencil.spring
    body_x, body_y, turn = twist
    velocity, right, sheet = work.velocity, work.right, work.sheet
    for row in range(rows):  # vectorised, as if no node was loaded, because most are not
        for column in range(columns):
            pull_x = right[row, column, 0] + spring * sheet[0, row + 1, column + 1]
            pull_y = right[row, column, 1] + spring * sheet[1, row + 1, column + 1]
            velocity[row, column, 0] = keep * velocity[row, column, 0] + ease * pull_x
            velocity[row, column, 1] = keep * velocity[row, column, 1] + ease * pull_y
    for row in range(rows):
        for column in range(columns):
            stuck[row, column] = False
            hold = ease * work.bound[row, column]
            if hold > 0.0:
                object_x = body_x - turn * work.lever[row, column, 1]
                object_y = body_y + turn * work.lever[row, column, 0]
                slip_x = velocity[row, column, 0] - object_x
                slip_y = velocity[row, column, 1] - object_y
                left = friction_projection(slip_x, slip_y, hold)
                if left * (abs(slip_x) + abs(slip_y)) <= ROUNDING * (abs(object_x) + abs(object_y)):
                    left = 0.0
                    stuck[row, column] = True
                velocity[row, column, 0] = object_x + left * slip_x
                velocity[row, column, 1] = object_y + left * slip_y
    if spring > 0.0:
        pull_sheet(work.velocity, work.sheet_source)
        for _ in range(SHEET_SWEEPS):
            relax_sheet(work.sheet, work.sheet_source, stencil.stretch, work.sheet_rule, work.after)


@njit(cache=True, _nrt=False, error_model="numpy")
def imbalance(equation: Equation, twist: Floats) -> tuple[float, Three]:
    """Return the largest unbalanced force at a node or at the sheet; and a pad's force and moment on the object.

    Fills pull and sheet_left, and slip and speed of the loaded nodes.
    """
    stencil, work, stuck = equation
    velocity, sheet, pull = work.velocity, work.sheet, work.pull
    rows, columns = work.bound.shape
    spring, diagonal = stencil.spring, stencil.own + stencil.spring
    worst = unloaded = wrench_x = wrench_y = moment = 0.0  # local sums: sums in memory would wait for each other
    if spring > 0.0:
        pull_sheet(velocity, work.sheet_source)
        sheet_imbalance(sheet, work.sheet_source, stencil.stretch, work.sheet_rule, work.sheet_left)
        most, left = largest(work.sheet_source.reshape(-1)), largest(work.sheet_left.reshape(-1))
        worst = spring / SPRING * max(left, STRICTER * (left - SHEET_SHARE * most))
    for row in range(rows):
        for column in range(columns):
            pull_x = diagonal * velocity[row, column, 0] - work.right[row, column, 0]
            pull_y = diagonal * velocity[row, column, 1] - work.right[row, column, 1]
            pull[row, column, 0] = pull_x - spring * sheet[0, row + 1, column + 1]
            pull[row, column, 1] = pull_y - spring * sheet[1, row + 1, column + 1]
    for row in range(rows):
        for column in range(columns):
            pull_x, pull_y = pull[row, column, 0], pull[row, column, 1]
            bound = work.bound[row, column]
            if bound == 0.0:
                unloaded = max(unloaded, pull_x * pull_x + pull_y * pull_y)
                continue
            x = work.lever[row, column, 0]
            y = work.lever[row, column, 1]
            slip_x = 0.0
            slip_y = 0.0
            speed = 0.0
            force_x = pull_x
            force_y = pull_y
            if stuck[row, column]:
                left = math.sqrt(pull_x * pull_x + pull_y * pull_y) - bound
            else:
                slip_x = velocity[row, column, 0] - twist[0] + twist[2] * y
                slip_y = velocity[row, column, 1] - twist[1] - twist[2] * x
                speed = math.sqrt(slip_x * slip_x + slip_y * slip_y)
                force_x = force_y = 0.0
                if speed > 0.0:
                    force_x = -bound * (slip_x / speed)
                    force_y = -bound * (slip_y / speed)
                left = math.sqrt((pull_x - force_x) ** 2 + (pull_y - force_y) ** 2)
            worst = max(worst, left)
            work.slip[row, column, 0] = slip_x
            work.slip[row, column, 1] = slip_y
            work.speed[row, column] = speed
            wrench_x += force_x
            wrench_y += force_y
            moment += x * force_y - y * force_x
    return max(worst, math.sqrt(unloaded)), (wrench_x, wrench_y, moment)
