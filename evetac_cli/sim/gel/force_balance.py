"""The balance of forces in one time step of the gel: node velocities and the object's twist at which it holds.

The minimum of one convex function (see gel) is found in rounds: sweeps of projected over-relaxation over the nodes
(`relax`), then a Newton step of the object in which the nodes that stick move along (see object_move). Each pad that is
simulated has a `Stencil` and a `Work` of its own.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.compiled import njit

Three = tuple[float, float, float]  # along x, along y, and about the axis across both
ROUNDING = 1e-12  # a slip below this share of the object's speed sticks: its direction is lost, and with it the search


class Stencil(NamedTuple):
    """The matrix of the nodes in one time step: own + links on the diagonal, -link to each neighbour."""

    own: float
    link_x: float
    link_y: float
    pitch_x: float
    pitch_y: float
    pads: float


class Work(NamedTuple):
    """Memory for one step, (rows, columns[, 2]); `velocity` and `loose` have a border of zeros all around.

    It is the pad's from step to step (see `work_memory`), as making it anew took a tenth of a step.

    right, slip, ease and object_velocity have two columns more, so that in memory they run along with `velocity`.
    velocity: mean velocity of the nodes over the step, the unknown; right: right-hand side of their equation.
    lever: place of the nodes seen from the object's centre; bound: mu * normal force; diagonal: of the stencil.
    pull: the friction each node asks for; slip, speed: its velocity against the object's surface, and the size of that.
    loose: 1 where a node does not move along with the object.
    search_direction: how the nodes answer a move of the object.
    ease: factor of over-relaxation / diagonal, of both components; object_velocity: velocity of the object's surface.
    """

    velocity: Floats
    right: Floats
    lever: Floats
    bound: Floats
    diagonal: Floats
    pull: Floats
    slip: Floats
    speed: Floats
    loose: Floats
    search_direction: Floats
    ease: Floats
    object_velocity: Floats


def work_memory(rows: int, columns: int) -> Floats:
    """Zeros (numbers,) for the `Work` of a pad of so many nodes, their normal forces, and the object's twist."""
    bordered, longer, plain = (rows + 2) * (columns + 2), rows * (columns + 2), rows * columns
    return np.zeros(3 * bordered + 8 * longer + 10 * plain + 3)


@njit(cache=True, _nrt=False, inline="always")
def work_in(memory: Floats, rows: int, columns: int) -> Work:
    """The memory of a pad (see `work_memory`) by its parts."""
    border = 2 * (rows + 2) * (columns + 2)
    long = 2 * rows * (columns + 2)
    pair = 2 * rows * columns
    longs = border + border // 2
    pairs = longs + 4 * long
    singles = pairs + 3 * pair
    return Work(
        velocity=memory[:border].reshape(rows + 2, columns + 2, 2),
        right=memory[longs : longs + long].reshape(rows, columns + 2, 2),
        lever=memory[pairs : pairs + pair].reshape(rows, columns, 2),
        bound=memory[singles : singles + pair // 2].reshape(rows, columns),
        diagonal=memory[singles + pair // 2 : singles + pair].reshape(rows, columns),
        pull=memory[pairs + pair : pairs + 2 * pair].reshape(rows, columns, 2),
        slip=memory[longs + long : longs + 2 * long].reshape(rows, columns + 2, 2),
        speed=memory[singles + pair : singles + pair + pair // 2].reshape(rows, columns),
        loose=memory[border:longs].reshape(rows + 2, columns + 2),
        search_direction=memory[pairs + 2 * pair : singles].reshape(rows, columns, 2),
        ease=memory[longs + 2 * long : longs + 3 * long].reshape(rows, columns + 2, 2),
        object_velocity=memory[longs + 3 * long : pairs].reshape(rows, columns + 2, 2),
    )


# numba takes an index that may be negative from the end of an array, and tests each for that; these are none.
_ONE = np.uint64(1)
_TWO = np.uint64(2)
_FOUR = np.uint64(4)


@njit(cache=True, _nrt=False)
def links(index: int, count: int) -> int:
    """How many neighbours a node has along a line of count nodes."""
    return min(index, 1) + min(count - 1 - index, 1)


@njit(cache=True, _nrt=False, error_model="numpy")
def friction_projection(x: float, y: float, bound: float) -> float:
    """The share of a vector (x, y) that is left when its length is made less by `bound`; 0 where it is not longer.

    This is Coulomb's law in the search (the proximal map of friction): what a node would slip, less what its friction
    holds.
    """
    square = x * x + y * y
    return 1.0 - bound / math.sqrt(square) if square > bound * bound else 0.0


@njit(cache=True, _nrt=False)
def set_object_velocity(work: Work, twist: Floats) -> None:
    """Fill `object_velocity` for the object's twist."""
    rows, columns = work.bound.shape
    for row in range(rows):
        for column in range(columns):
            work.object_velocity[row, column, 0] = twist[0] - twist[2] * work.lever[row, column, 1]
            work.object_velocity[row, column, 1] = twist[1] + twist[2] * work.lever[row, column, 0]


@njit(cache=True, _nrt=False, error_model="numpy")
def _slip_alone(
    above: Floats,
    here: Floats,
    below: Floats,
    right: Floats,
    ease: Floats,
    object_velocity: Floats,
    stencil: Stencil,
    keep: float,
    slip: Floats,
) -> None:
    """What each node would slip after a sweep if there were no friction, `keep` of its velocity being left."""
    link_x = stencil.link_x
    link_y = stencil.link_y
    for k in range(len(slip)):
        total = right[k] + link_x * (here[k] + here[k + 4])
        total += link_y * (above[k] + below[k])
        slip[k] = keep * here[k + 2] + ease[k] * total - object_velocity[k]


@njit(cache=True, _nrt=False, error_model="numpy")
def relax(work: Work, stencil: Stencil, stuck: Flags, factor: float) -> None:
    """One sweep of projected over-relaxation over the nodes, with the object's velocity as in `object_velocity`.

    Nodes go in the order of a chess board, first one colour, then the other: those of one colour do not wait for each
    other, neither in the processor nor in the result, which so keeps the symmetries of the problem.

    Why so: what has no branch is computed for both colours at once, in flat loops that numba makes vector code of.
    """
    rows, columns = work.bound.shape
    stride = 2 * columns + 4
    count = rows * stride - 4
    velocity = work.velocity.reshape(-1)
    right = work.right.reshape(-1)
    slip = work.slip.reshape(-1)
    ease = work.ease.reshape(-1)
    object_velocity = work.object_velocity.reshape(-1)
    bound = work.bound.reshape(-1)
    sticks = stuck.reshape(-1)
    above = velocity[2:]
    here = velocity[stride:]
    below = velocity[2 * stride + 2 :]
    for colour in range(2):
        _slip_alone(above, here, below, right, ease, object_velocity, stencil, 1.0 - factor, slip[:count])
        for row in range(rows):
            first = (row + colour) % 2
            entry = np.uint64(row * stride + 2 * first)
            node = np.uint64(row * columns + first)
            end = np.uint64(row * columns + columns)
            while node < end:
                slip_x = slip[entry]
                slip_y = slip[entry + _ONE]
                body_x = object_velocity[entry]
                body_y = object_velocity[entry + _ONE]
                hold = ease[entry] * bound[node]
                left = 1.0  # as most nodes bear nothing, of them no root is taken
                if hold > 0.0:
                    left = friction_projection(slip_x, slip_y, hold)
                if left * (abs(slip_x) + abs(slip_y)) <= ROUNDING * (abs(body_x) + abs(body_y)):
                    left = 0.0
                sticks[node] = hold > 0.0 and left == 0.0
                here[entry + _TWO] = body_x + left * slip_x
                here[entry + _TWO + _ONE] = body_y + left * slip_y
                entry += _FOUR
                node += _TWO


@njit(cache=True, _nrt=False, error_model="numpy")
def imbalance(work: Work, stencil: Stencil, twist: Floats, stuck: Flags) -> tuple[float, Three]:
    """Largest force left unbalanced at a node; force and moment of a pad on the object. Fills pull, slip, speed."""
    velocity = work.velocity
    rows, columns = work.bound.shape
    worst = wrench_x = wrench_y = moment = 0.0  # sums in memory, not in registers, would wait for each other
    for row in range(rows):
        for column in range(columns):
            here_x = velocity[row + 1, column + 1, 0]
            here_y = velocity[row + 1, column + 1, 1]
            x = work.lever[row, column, 0]
            y = work.lever[row, column, 1]
            bound = work.bound[row, column]
            pull_x = work.diagonal[row, column] * here_x - work.right[row, column, 0]
            pull_y = work.diagonal[row, column] * here_y - work.right[row, column, 1]
            pull_x -= stencil.link_x * (velocity[row + 1, column, 0] + velocity[row + 1, column + 2, 0])
            pull_y -= stencil.link_x * (velocity[row + 1, column, 1] + velocity[row + 1, column + 2, 1])
            pull_x -= stencil.link_y * (velocity[row, column + 1, 0] + velocity[row + 2, column + 1, 0])
            pull_y -= stencil.link_y * (velocity[row, column + 1, 1] + velocity[row + 2, column + 1, 1])
            slip_x = 0.0
            slip_y = 0.0
            speed = 0.0
            force_x = pull_x
            force_y = pull_y
            if stuck[row, column]:
                left = math.sqrt(pull_x * pull_x + pull_y * pull_y) - bound
            else:
                slip_x = here_x - twist[0] + twist[2] * y
                slip_y = here_y - twist[1] - twist[2] * x
                speed = math.sqrt(slip_x * slip_x + slip_y * slip_y)
                force_x = force_y = 0.0
                if speed > 0.0 and bound > 0.0:
                    force_x = -bound * (slip_x / speed)
                    force_y = -bound * (slip_y / speed)
                left = math.sqrt((pull_x - force_x) ** 2 + (pull_y - force_y) ** 2)
            worst = max(worst, left)
            work.pull[row, column, 0] = pull_x
            work.pull[row, column, 1] = pull_y
            work.slip[row, column, 0] = slip_x
            work.slip[row, column, 1] = slip_y
            work.speed[row, column] = speed
            wrench_x += force_x
            wrench_y += force_y
            moment += x * force_y - y * force_x
    return worst, (wrench_x, wrench_y, moment)
