"""A Newton step of the object in the balance of forces: the nodes that stick move along (see force_balance).

Its exact line search keeps the object from flipping for ever between the two directions of slip on a stiff gel. Nodes
that the step would bring to rest are caught, so that they move along too, which keeps partial slip cheap: a single node
about to stick would stop the object again and again (400 sweeps without balance where 20 are enough).

Where the second finger's pad is not a mirror image of the first it is `Other`, and object and nodes of both pads are
balanced together. Where it is None numba leaves out what concerns it when it compiles. It is unpacked because numba
fails on other[0].
"""

import math

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.gel_layer import SPRING
from evetac_cli.sim.gel.force_balance import Stencil, Three, Work
from evetac_cli.sim.gel.sheet import mirror, over_nodes, pull_sheet, relax_sheet, scalar_product, sheet_imbalance

Other = tuple[Work, Stencil, Flags] | None  # of the second finger's pad, the last which of its nodes stick

# The upper triangle of a symmetric 3 x 3 matrix, row by row.
Matrix = tuple[float, float, float, float, float, float]
REACHES = (1.0, 0.3, 0.03, 1e-3, 1e-6, 0.0)  # a Newton step catches the nodes that this share of it brings to rest,
WORTHWHILE = 0.1  # and the first step is taken of which at least this part leads down, else the last


@njit(cache=True, _nrt=False)
def _curvature(work: Work, stencil: Stencil) -> Matrix:
    """A pad's stiffness against moves of the object, about.

    Nodes that are not loose move along, and bring their springs. Beside a loose node the sheet is stretched, over a
    length at which its stretch and its springs store as much. A loose node lags behind: its friction resists a turn of
    the slip, in series with the node's own diagonal. Why so: an estimate is enough, as the search along the move is
    exact, and how the sheet answers three moves takes longer than a round more.
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
    """Fill search_direction, how each node answers a move of the object; returns how many nodes it would bring to rest.

    Those are caught: they are about to stick, and the move has to be found again with them coming to rest.
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
    """Fill sheet_search: how the sheet answers search_direction, after one sweep from where that would have it.

    Why so: more sweeps find balances no sooner, as the search along the move is exact.
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
    """Slope and curvature, along search_direction and sheet_search, of one pad's potential without friction."""
    direction = work.search_direction.reshape(-1)
    slope = scalar_product(direction, work.pull.reshape(-1))
    own = scalar_product(direction, direction)
    bend = stencil.own * own
    if stencil.spring > 0.0:
        _answer_of_sheet(work, stencil)
        search = work.sheet_search
        sheet_imbalance(search, work.sheet_source, stencil.stretch, work.sheet_rule, work.search_left)
        slope -= stencil.spring / SPRING * over_nodes(search, work.sheet_left)
        # of nodes d and a sheet s: d * (d - s) - s * what the balance of s lacks
        of_sheet = over_nodes(search, work.sheet_source) + over_nodes(search, work.search_left)
        bend += stencil.spring * (own - of_sheet / SPRING)
    return slope, bend


@njit(cache=True, _nrt=False, error_model="numpy")
def _rubbing(work: Work, move: Three, part: float) -> float:
    """Slope of one pad's friction potential, the sum of bound * |slip|, after a part of a move of object and nodes."""
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
    """Solution of a symmetric 3 x 3 system of which the upper triangle is given, and of which the pivots are >= least.

    That they are follows from the diagonal least being one positive summand of the matrix; rounding may forget it.
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
    """Begin with all nodes loose that do not stick."""
    rows, columns = stuck.shape
    for row in range(rows):
        for column in range(columns):
            work.loose[row + 1, column + 1] = 0.0 if stuck[row, column] else 1.0


@njit(cache=True, _nrt=False)
def _find_move(
    work: Work,
    stencil: Stencil,
    weight: Three,
    inertial: Three,
    pads_wrench: Three,
    stuck: Flags,
    reach: float,
    other: Other,
) -> Three:
    """Newton step of the object, found again with the nodes that a share `reach` of it brings to rest.

    Fills search_direction.
    """
    _loosen(work, stuck)
    if other is not None:
        work_2, stencil_2, stuck_2 = other
        _loosen(work_2, stuck_2)
    pads = stencil.pads
    left = (-inertial[0] - pads_wrench[0], -inertial[1] - pads_wrench[1], -inertial[2] - pads_wrench[2])
    move = (0.0, 0.0, 0.0)
    for _ in range(4):
        c00, c01, c02, c11, c12, c22 = _curvature(work, stencil)
        c00, c01, c02, c11, c12, c22 = pads * c00, pads * c01, pads * c02, pads * c11, pads * c12, pads * c22
        if other is not None:
            m00, m01, m02, m11, m12, m22 = _curvature(work_2, stencil_2)
            more = stencil_2.pads
            c00, c01, c02 = c00 + more * m00, c01 + more * m01, c02 + more * m02
            c11, c12, c22 = c11 + more * m11, c12 + more * m12, c22 + more * m22
        move = _solve3((c00 + weight[0], c01, c02, c11 + weight[1], c12, c22 + weight[2]), left, weight)
        caught = _follow(work, stencil, move, reach)
        if other is not None:
            caught += _follow(work_2, stencil_2, move, reach)
        if caught == 0:
            break
    return move


@njit(cache=True, _nrt=False)
def _rubbing_of_all(work: Work, stencil: Stencil, move: Three, part: float, other: Other) -> float:
    """Slope of the friction potential of all pads."""
    slope: float = stencil.pads * _rubbing(work, move, part)
    if other is not None:
        work_2, stencil_2, _ = other
        slope += stencil_2.pads * _rubbing(work_2, move, part)
    return slope


@njit(cache=True, _nrt=False)
def _search(work: Work, stencil: Stencil, move: Three, weight: Three, inertial: Three, other: Other) -> float:
    """Exact line search: the part, 0 to 1, of a move at which the potential is least; 0 if it only rises.

    The nodes move along search_direction.
    """
    slope, bend = _smooth(work, stencil)
    x, y, turn = move
    slope = stencil.pads * slope + (inertial[0] * x + inertial[1] * y + inertial[2] * turn)
    bend = stencil.pads * bend + (weight[0] * x * x + weight[1] * y * y + weight[2] * turn * turn)
    if other is not None:
        work_2, stencil_2, _ = other
        slope_2, bend_2 = _smooth(work_2, stencil_2)
        slope += stencil_2.pads * slope_2
        bend += stencil_2.pads * bend_2
    start = slope + _rubbing_of_all(work, stencil, move, 0.0, other)
    low = 0.0
    high = 1.0
    part = 1.0
    for _ in range(50):
        here = slope + part * bend + _rubbing_of_all(work, stencil, move, part, other)
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
    """Move the nodes by a part of search_direction, and the sheet by one of sheet_search."""
    velocity, direction = work.velocity.reshape(-1), work.search_direction.reshape(-1)
    for entry in range(velocity.size):
        velocity[entry] += part * direction[entry]
    sheet, search = work.sheet.reshape(-1), work.sheet_search.reshape(-1)
    for entry in range(sheet.size):
        sheet[entry] += part * search[entry]


@njit(cache=True, _nrt=False)
def move_object(
    work: Work,
    stencil: Stencil,
    twist: Floats,
    weight: Three,
    inertial: Three,
    pads_wrench: Three,
    stuck: Flags,
    other: Other,
) -> None:
    """Newton step of the object, and of the nodes that answer it.

    weight: inertia / (theta dt); inertial: the object's own unbalanced force; pads_wrench: what all pads add to it.
    To catch nodes is to guess which of them will stick. Where that leads nowhere fewer are caught, at last none: with
    the nodes in balance such a step always leads down, if only as far as the next node that comes to rest.
    """
    move = (0.0, 0.0, 0.0)
    part = 0.0
    for reach in REACHES:
        move = _find_move(work, stencil, weight, inertial, pads_wrench, stuck, reach, other)
        part = _search(work, stencil, move, weight, inertial, other)
        if part >= WORTHWHILE:
            break
    for axis in range(3):
        twist[axis] += part * move[axis]
    _answer(work, part)
    if other is not None:
        work_2, _, _ = other
        _answer(work_2, part)
