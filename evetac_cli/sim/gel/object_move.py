"""A Newton step of the object in the balance of forces: the stuck nodes move with it (see force_balance).

The exact line search prevents the object from alternating forever between the two directions of slip on a stiff gel.
Nodes that the step would bring to rest are caught, so that they also move with it. This keeps partial slip cheap: a
single node about to stick would stop the object again and again (400 sweeps without balance, where 20 are enough).

If the second finger's pad is not a mirror image of the first its equation is passed as `other`, and object and nodes of
both pads are balanced together. If `other` is None, numba omits the code for it when it compiles.
"""

import math

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.gel_layer import SPRING
from evetac_cli.sim.gel.force_balance import Equation, Stencil, Three
from evetac_cli.sim.gel.pad import Work
from evetac_cli.sim.gel.sheet import mirror, over_nodes, pull_sheet, relax_sheet, scalar_product, sheet_imbalance

# The upper triangle of a symmetric 3 x 3 matrix, row by row.
Matrix = tuple[float, float, float, float, float, float]
REACHES = (1.0, 0.3, 0.03, 1e-3, 1e-6, 0.0)  # a Newton step catches the nodes that this share of it brings to rest
WORTHWHILE = 0.1  # the first step is taken whose line search goes at least this far, else the last


@njit(cache=True, _nrt=False)
def _curvature(work: Work, stencil: Stencil) -> Matrix:
    """Estimate a pad's stiffness against motions of the object.

    Nodes that are not loose move with the object and contribute their springs. Next to a loose node the sheet is
    stretched over a length at which its stretch and its springs store the same energy. A loose node lags behind: its
    friction resists a change of the slip's direction, in series with the node's own diagonal. An estimate is enough,
    because the line search is exact; the sheet's answer to three motions would take longer than one more round.
    """
    loose, stretch = work.loose, stencil.stretch
    rows, columns = work.bound.shape
    diagonal = stencil.own + stencil.spring
    edge = 0.5 * stencil.spring / math.sqrt(SPRING)
    along_x, along_y = edge * math.sqrt(stretch.along_x), edge * math.sqrt(stretch.along_y)
    across_x, across_y = edge * math.sqrt(stretch.across_x), edge * math.sqrt(stretch.across_y)
    along_x2 = along_y2 = cross = turn_of_x = turn_of_y = turn = 0.0
    for row in range(rows):
        for column in range(columns):
            x = work.lever[row, column, 0]
            y = work.lever[row, column, 1]
            speed = work.speed[row, column]
            if loose[row + 1, column + 1] == 0.0:
                free_x = loose[row + 1, column] + loose[row + 1, column + 2]
                free_y = loose[row, column + 1] + loose[row + 2, column + 1]
                stiff_x = min(stencil.own + along_x * free_x + across_y * free_y, diagonal)
                stiff_y = min(stencil.own + across_x * free_x + along_y * free_y, diagonal)
                along_x2 += stiff_x
                along_y2 += stiff_y
                turn_of_x -= stiff_x * y
                turn_of_y += stiff_y * x
                turn += stiff_x * y * y + stiff_y * x * x
            elif speed > 0.0 and work.bound[row, column] > 0.0:
                slip_x = work.slip[row, column, 0] / speed
                slip_y = work.slip[row, column, 1] / speed
                arm = x * slip_x + y * slip_y
                bound = work.bound[row, column]
                stiff = bound * diagonal / (bound + diagonal * speed)
                along_x2 += stiff * slip_y * slip_y
                cross -= stiff * slip_y * slip_x
                along_y2 += stiff * slip_x * slip_x
                turn_of_x -= stiff * slip_y * arm
                turn_of_y += stiff * slip_x * arm
                turn += stiff * arm * arm
    return along_x2, cross, turn_of_x, along_y2, turn_of_y, turn


@njit(cache=True, _nrt=False)
def _follow(work: Work, stencil: Stencil, move: Three, reach: float) -> int:
    """Fill search_direction, each node's response to a motion of the object; return the number of nodes caught.

    Caught nodes are those that the motion would bring to rest. They are about to stick, and the motion must be computed
    again with them at rest.
    """
    rows, columns = work.bound.shape
    diagonal = stencil.own + stencil.spring
    caught = 0
    for row in range(rows):
        for column in range(columns):
            move_x = move[0] - move[2] * work.lever[row, column, 1]
            move_y = move[1] + move[2] * work.lever[row, column, 0]
            speed = work.speed[row, column]
            bound = work.bound[row, column]
            if work.loose[row + 1, column + 1] == 0.0:
                work.search_direction[row, column, 0] = move_x - work.slip[row, column, 0]
                work.search_direction[row, column, 1] = move_y - work.slip[row, column, 1]
            elif speed > 0.0 and bound > 0.0:
                along_x = work.slip[row, column, 0] / speed
                along_y = work.slip[row, column, 1] / speed
                if reach * (along_x * move_x + along_y * move_y) >= speed:
                    work.loose[row + 1, column + 1] = 0.0
                    caught += 1
                across = along_x * move_y - along_y * move_x
                across *= bound / (bound + diagonal * speed)
                work.search_direction[row, column, 0] = -across * along_y
                work.search_direction[row, column, 1] = across * along_x
            else:
                work.search_direction[row, column, 0] = 0.0
                work.search_direction[row, column, 1] = 0.0
    return caught


@njit(cache=True, _nrt=False)
def _answer_of_sheet(work: Work, stencil: Stencil) -> None:
    """Fill sheet_search, the sheet's response to search_direction, by one sweep that starts from search_direction.

    More sweeps find balances no sooner, because the line search is exact.
    """
    rows, columns = work.bound.shape
    search = work.sheet_search
    for axis in range(2):
        for row in range(rows):
            for column in range(columns):
                search[axis, row + 1, column + 1] = work.search_direction[row, column, axis]
    for axis in range(2):
        mirror(search[axis], axis == 0)
    pull_sheet(work.search_direction, work.sheet_source)
    relax_sheet(search, work.sheet_source, stencil.stretch, work.sheet_rule, work.after)


@njit(cache=True, _nrt=False)
def _smooth(work: Work, stencil: Stencil) -> tuple[float, float]:
    """Return the slope and curvature of a pad's potential without friction, along search_direction and sheet_search."""
    direction = work.search_direction.reshape(-1)
    slope = scalar_product(direction, work.pull.reshape(-1))
    own = scalar_product(direction, direction)
    bend = stencil.own * own
    if stencil.spring > 0.0:
        _answer_of_sheet(work, stencil)
        search = work.sheet_search
        sheet_imbalance(search, work.sheet_source, stencil.stretch, work.sheet_rule, work.search_left)
        slope -= stencil.spring / SPRING * over_nodes(search, work.sheet_left)
        # of nodes d and a sheet s: d * (d - s) - s * residual of the balance of s
        of_sheet = over_nodes(search, work.sheet_source) + over_nodes(search, work.search_left)
        bend += stencil.spring * (own - of_sheet / SPRING)
    return slope, bend


@njit(cache=True, _nrt=False, error_model="numpy")
def _rubbing(work: Work, move: Three, part: float) -> float:
    """Return the slope of a pad's friction potential, the sum of bound * |slip|, after a part of a motion."""
    rows, columns = work.bound.shape
    slope = 0.0
    for row in range(rows):
        for column in range(columns):
            if work.speed[row, column] > 0.0 and work.bound[row, column] > 0.0:
                drift_x = work.search_direction[row, column, 0] - move[0] + move[2] * work.lever[row, column, 1]
                drift_y = work.search_direction[row, column, 1] - move[1] - move[2] * work.lever[row, column, 0]
                slip_x = work.slip[row, column, 0] + part * drift_x
                slip_y = work.slip[row, column, 1] + part * drift_y
                speed = math.sqrt(slip_x * slip_x + slip_y * slip_y)
                if speed > 0.0:
                    slope += work.bound[row, column] * (slip_x * drift_x + slip_y * drift_y) / speed
    return slope


@njit(cache=True, _nrt=False)
def _solve3(matrix: Matrix, right: Three, least: Three) -> Three:
    """Solve a symmetric 3 x 3 system, given by its upper triangle, with pivots >= least.

    The pivots are that large because the diagonal `least` is one positive summand of the matrix; rounding could violate
    it.
    """
    m00, m01, m02, m11, m12, m22 = matrix
    pivot_0 = max(m00, least[0])
    low_10 = m01 / pivot_0
    low_20 = m02 / pivot_0
    pivot_1 = max(m11 - low_10 * m01, least[1])
    cross = m12 - low_10 * m02
    low_21 = cross / pivot_1
    pivot_2 = max(m22 - low_20 * m02 - low_21 * cross, least[2])
    half_1 = right[1] - low_10 * right[0]
    half_2 = right[2] - low_20 * right[0] - low_21 * half_1
    third = half_2 / pivot_2
    second = half_1 / pivot_1 - low_21 * third
    first = right[0] / pivot_0 - low_10 * second - low_20 * third
    return first, second, third


@njit(cache=True, _nrt=False)
def _loosen(work: Work, stuck: Flags) -> None:
    """Mark all nodes as loose that do not stick."""
    rows, columns = stuck.shape
    for row in range(rows):
        for column in range(columns):
            work.loose[row + 1, column + 1] = 0.0 if stuck[row, column] else 1.0


@njit(cache=True, _nrt=False)
def _find_move(
    one: Equation, other: Equation | None, weight: Three, inertial: Three, pads_wrench: Three, reach: float
) -> Three:
    """Return the object's Newton step, recomputed until no more nodes are caught (see `_follow`).

    Fills search_direction.
    """
    _loosen(one.work, one.stuck)
    if other is not None:
        _loosen(other.work, other.stuck)
    pads = one.stencil.pads
    left = (-inertial[0] - pads_wrench[0], -inertial[1] - pads_wrench[1], -inertial[2] - pads_wrench[2])
    move = (0.0, 0.0, 0.0)
    for _ in range(4):
        c00, c01, c02, c11, c12, c22 = _curvature(one.work, one.stencil)
        c00, c01, c02, c11, c12, c22 = pads * c00, pads * c01, pads * c02, pads * c11, pads * c12, pads * c22
        if other is not None:
            m00, m01, m02, m11, m12, m22 = _curvature(other.work, other.stencil)
            more = other.stencil.pads
            c00, c01, c02 = c00 + more * m00, c01 + more * m01, c02 + more * m02
            c11, c12, c22 = c11 + more * m11, c12 + more * m12, c22 + more * m22
        move = _solve3((c00 + weight[0], c01, c02, c11 + weight[1], c12, c22 + weight[2]), left, weight)
        caught = _follow(one.work, one.stencil, move, reach)
        if other is not None:
            caught += _follow(other.work, other.stencil, move, reach)
        if caught == 0:
            break
    return move


@njit(cache=True, _nrt=False)
def _rubbing_of_all(one: Equation, other: Equation | None, move: Three, part: float) -> float:
    """Return the slope of the friction potential of all pads."""
    slope: float = one.stencil.pads * _rubbing(one.work, move, part)
    if other is not None:
        slope += other.stencil.pads * _rubbing(other.work, move, part)
    return slope


@njit(cache=True, _nrt=False)
def _search(one: Equation, other: Equation | None, move: Three, weight: Three, inertial: Three) -> float:
    """Return the part of a motion, 0 to 1, at which the potential is least (exact line search); 0 if it only rises.

    The nodes move along search_direction.
    """
    slope, bend = _smooth(one.work, one.stencil)
    x, y, turn = move
    slope = one.stencil.pads * slope + (inertial[0] * x + inertial[1] * y + inertial[2] * turn)
    bend = one.stencil.pads * bend + (weight[0] * x * x + weight[1] * y * y + weight[2] * turn * turn)
    if other is not None:
        slope_2, bend_2 = _smooth(other.work, other.stencil)
        slope += other.stencil.pads * slope_2
        bend += other.stencil.pads * bend_2
    start = slope + _rubbing_of_all(one, other, move, 0.0)
    low = 0.0
    high = 1.0
    part = 1.0
    for _ in range(50):
        here = slope + part * bend + _rubbing_of_all(one, other, move, part)
        if here <= -1e-9 * start:
            low = part
            if part == 1.0 or here >= 1e-3 * start:
                break
        else:
            high = part
        part = 0.5 * (low + high)
    return low if start < 0.0 else 0.0


@njit(cache=True, _nrt=False)
def _answer(work: Work, part: float) -> None:
    """Move the nodes by a part of search_direction, and the sheet by the same part of sheet_search."""
    velocity, direction = work.velocity.reshape(-1), work.search_direction.reshape(-1)
    for entry in range(velocity.size):
        velocity[entry] += part * direction[entry]
    sheet, search = work.sheet.reshape(-1), work.sheet_search.reshape(-1)
    for entry in range(sheet.size):
        sheet[entry] += part * search[entry]


@njit(cache=True, _nrt=False)
def move_object(
    one: Equation, other: Equation | None, twist: Floats, weight: Three, inertial: Three, pads_wrench: Three
) -> None:
    """Make a Newton step of the object, and move the nodes that respond to it.

    weight: inertia / (theta dt); inertial: the object's own unbalanced force; pads_wrench: the force of all pads on it.
    Catching nodes is a guess which of them will stick. If it leads nowhere fewer are caught, and at last none. With the
    nodes in balance such a step always descends, even if only to the next node that comes to rest.
    """
    move = (0.0, 0.0, 0.0)
    part = 0.0
    for reach in REACHES:
        move = _find_move(one, other, weight, inertial, pads_wrench, reach)
        part = _search(one, other, move, weight, inertial)
        if part >= WORTHWHILE:
            break
    for axis in range(3):
        twist[axis] += part * move[axis]
    _answer(one.work, part)
    if other is not None:
        _answer(other.work, part)
