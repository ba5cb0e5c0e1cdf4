"""One time step of the gel's arrays: the equation of the nodes is set up, solved (see force_balance), and applied.

The bound of a node's friction is its coefficient at the time of the balance, at the slip speed of the balance. It is
refreshed before each of the first rounds of the search, and then fixed. So the search ends with a convex problem, which
always has a solution. A sliding node continues to slide if possible, and a stuck node sticks until its static
coefficient is exceeded: when friction falls with speed, both may be solutions.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.force_balance import Equation, Three, imbalance, relax
from evetac_cli.sim.gel.friction import FrictionLaw
from evetac_cli.sim.gel.object_move import move_object
from evetac_cli.sim.gel.pad import PadArrays, PadParts, parts_of
from evetac_cli.sim.gel.pad_equation import Squeezing, advance, let_go, matrix, refresh, set_up

# Number of sweeps between two Newton steps of the object. With 1, 2 and 3 each step took 120, 94 and 81 us, on 24 x 18
# nodes under a tilted cylinder that begins to slip, on a gel without a sheet.
SWEEPS_A_ROUND = 3
# Rounds whose bounds are refreshed. More rounds find no better balance, and without a limit they take up to 400 rounds.
REFRESHES = 4
TOO_LONG = 5  # returned by `step_nodes` if its step is longer than its `Allowed` permits

# Results of a step, explained in `gel.StepInfo`.
STEP = np.dtype(
    [
        ("sweeps", np.int64),
        ("residual", np.float64),
        ("slip_fraction", np.float64),
        ("gel_velocity_m_s", np.float64, 2),
        ("slip_velocity_m_s", np.float64, 2),
        ("gel_displacement_m", np.float64, 2),
        ("friction_n", np.float64, 3),
        ("friction_change", np.float64),
        ("friction_heat_j", np.float64),
        ("slipping_force_n", np.float64),
        ("error_m", np.float64),
        ("second_friction_n", np.float64, 3),  # force of the object on the second pad and its moment
    ]
)


class Allowed(NamedTuple):
    """Limits for a step; a step beyond them is TOO_LONG.

    error_m: largest estimated error.

    steepness: largest ratio of two slopes within the step: how fast a node's friction falls with its slip speed, and
    how fast the gel's own resistance rises. Above 1 several slip speeds are in balance. Well below 1 the order in which
    nodes pull each other loose is that of a fine step. The limit applies to nodes that let go. If `shortest`, a larger
    error is allowed once the limit holds for all nodes.
    """

    error_m: float = math.inf
    steepness: float = math.inf
    shortest: bool = True


class Load(NamedTuple):
    """Force and moment on the object, whether its twist is prescribed, and the prescribed twist."""

    force: Three
    prescribed: bool
    twist: Three


class StepRule(NamedTuple):
    """Length of a step in s, its theta, and the end of the search."""

    dt: float
    theta: float
    tolerance: float
    max_sweeps: int
    allowed: Allowed


class PadStep(NamedTuple):
    """A pad in a step: its arrays, constants and equation."""

    parts: PadParts
    layer: np.void
    equation: Equation


@njit(cache=True, _nrt=False)
def step_nodes(
    pad: PadArrays,
    squeeze: Squeezing,
    second: tuple[PadArrays, Squeezing] | None,
    load: Load,
    law: FrictionLaw,
    rule: StepRule,
    results: NDArray[np.void],
) -> int:
    """Make one time step in place; return 0, TOO_LONG, or the number of an error; the last two before any change.

    The normal force of each node is in the pad's memory, as `Work.normal`. second: the second finger's pad and its
    squeeze, if it is also simulated. results: (1,), of dtype STEP, is filled in.
    """
    parts, layer = parts_of(pad), pad.constants[0]
    inertia, pose, twist, body = parts.inertia, parts.pose, parts.twist, parts.work.twist
    for axis in range(3):
        if not (math.isfinite(load.force[axis]) and math.isfinite(load.twist[axis])):
            return 2
        if not (math.isfinite(inertia[axis]) and inertia[axis] > 0.0):
            return 3
        if not (math.isfinite(pose[axis]) and math.isfinite(twist[axis])):
            return 4
    dt, theta = rule.dt, rule.theta
    h = theta * dt
    fault, scale, square = set_up(parts, layer, squeeze, pose, law, h)
    if fault:
        return int(fault)
    one = PadStep(parts, layer, Equation(matrix(parts, layer, h), parts.work, parts.stuck))
    if second is None:
        other = None
    else:
        pad_2, squeeze_2 = second
        parts_2, layer_2 = parts_of(pad_2), pad_2.constants[0]
        fault, scale_2, _ = set_up(parts_2, layer_2, squeeze_2, pose, law, h)
        if fault:
            return int(fault)
        scale += scale_2
        other = PadStep(parts_2, layer_2, Equation(matrix(parts_2, layer_2, h), parts_2.work, parts_2.stuck))
        _set_flags(parts_2.stuck_before, parts_2.stuck)
    _set_flags(parts.stuck_before, parts.stuck)
    scale += abs(load.force[0]) + abs(load.force[1])
    # a moment counts as the force that causes it at the mean distance of the nodes from the object's centre
    reach = math.sqrt(square / parts.stuck.size + layer["pitch_x"] * layer["pitch_y"])
    scale = max(scale + abs(load.force[2]) / reach, 1e-300)
    sweeps, worst = _balance(one, other, load, law, rule, scale, reach)
    error = 0.0
    if not load.prescribed:
        # difference of the step from a step by the trapezoidal rule, of second order
        trapezoid_s = dt * abs(1.0 - 0.5 / theta)
        error = trapezoid_s * (math.hypot(body[0] - twist[0], body[1] - twist[1]) + reach * abs(body[2] - twist[2]))
    change, error, too_long = _judge(one, other, law, rule, error)
    if too_long:
        _set_flags(parts.stuck, parts.stuck_before)
        if other is not None:
            _set_flags(parts_2.stuck, parts_2.stuck_before)
        return TOO_LONG
    moved = advance(parts, layer, one.equation.stencil.stretch, law, dt, theta, body)
    heat, pressed, second_friction = moved.heat, moved.pressed, (0.0, 0.0, 0.0)
    if other is not None:
        moved_2 = advance(parts_2, layer_2, other.equation.stencil.stretch, law, dt, theta, body)
        heat, pressed, second_friction = heat + moved_2.heat, max(pressed, moved_2.pressed), moved_2.friction
    result = results[0]
    result["sweeps"], result["residual"], result["slip_fraction"] = sweeps, worst / scale, moved.slip_fraction
    result["friction_change"], result["friction_heat_j"] = change, heat
    result["slipping_force_n"], result["error_m"] = pressed, error
    for axis in range(2):
        result["gel_velocity_m_s"][axis] = moved.gel_velocity[axis]
        result["slip_velocity_m_s"][axis] = moved.slip_velocity[axis]
        result["gel_displacement_m"][axis] = moved.gel_displacement[axis]
    for axis in range(3):
        result["friction_n"][axis], result["second_friction_n"][axis] = moved.friction[axis], second_friction[axis]
        pose[axis] += dt * body[axis]
        twist[axis] = body[axis] if load.prescribed else twist[axis] + (body[axis] - twist[axis]) / theta
    return 0


@njit(cache=True, _nrt=False)
def _balance(
    one: PadStep, other: PadStep | None, load: Load, law: FrictionLaw, rule: StepRule, scale: float, reach: float
) -> tuple[int, float]:
    """Find the velocities of the nodes and the object's twist; return the sweeps and the largest unbalanced force.

    scale: sum of all forces. reach: the arm by which a moment counts as a force.
    """
    parts, equation = one.parts, one.equation
    inertia, twist, body = parts.inertia, parts.twist, parts.work.twist
    h, falls = rule.theta * rule.dt, law.kinetic < law.static
    equation_2 = None if other is None else other.equation
    for axis in range(3):
        body[axis] = load.twist[axis] if load.prescribed else twist[axis]
    weight = (inertia[0] / h, inertia[1] / h, inertia[2] / h)
    sweeps = 0
    rounds = 0
    while True:
        body_now = (body[0], body[1], body[2])
        # one sweep is enough if nothing changes speed; later a sweep costs less than the rest of a round
        for _ in range(min(SWEEPS_A_ROUND, rule.max_sweeps - sweeps) if sweeps > 0 else 1):
            relax(equation, body_now)
            if other is not None:
                relax(other.equation, body_now)
            sweeps += 1
        if falls and rounds < REFRESHES:
            refresh(parts, body, law, h)
            if other is not None:
                refresh(other.parts, body, law, h)
        rounds += 1
        worst, wrench = imbalance(equation, body)
        pads = equation.stencil.pads
        pads_wrench = (pads * wrench[0], pads * wrench[1], pads * wrench[2])
        if other is not None:
            worst_2, wrench_2 = imbalance(other.equation, body)
            worst = max(worst, worst_2)
            x, y, turn = pads_wrench
            pads = other.equation.stencil.pads
            pads_wrench = (x + pads * wrench_2[0], y + pads * wrench_2[1], turn + pads * wrench_2[2])
        inertial = (
            weight[0] * (body[0] - twist[0]) - load.force[0],
            weight[1] * (body[1] - twist[1]) - load.force[1],
            weight[2] * (body[2] - twist[2]) - load.force[2],
        )
        if not load.prescribed:
            worst = max(
                worst,
                abs(inertial[0] + pads_wrench[0]),
                abs(inertial[1] + pads_wrench[1]),
                abs(inertial[2] + pads_wrench[2]) / reach,
            )
        if worst <= rule.tolerance * scale or sweeps >= rule.max_sweeps:
            return sweeps, worst
        if not load.prescribed:
            move_object(equation, equation_2, body, weight, inertial, pads_wrench)


@njit(cache=True, _nrt=False)
def _judge(
    one: PadStep, other: PadStep | None, law: FrictionLaw, rule: StepRule, error: float
) -> tuple[float, float, bool]:
    """Return the largest change of a coefficient, the step's error, and whether it is longer than allowed.

    error: of the object's motion alone, in m.
    """
    h, allowed = rule.theta * rule.dt, rule.allowed
    change = 0.0
    too_long, accepted = False, allowed.shortest
    if law.kinetic < law.static:
        falls = let_go(one.parts, one.layer, law, rule.dt, h)
        change, error = falls.change, max(error, falls.moved_m)
        resisted = allowed.steepness * law.memory * one.equation.stencil.own  # see `Allowed.steepness`
        too_long = falls.released > resisted
        accepted = accepted and falls.hardest <= resisted
        if other is not None:
            falls_2 = let_go(other.parts, other.layer, law, rule.dt, h)
            change, error = max(change, falls_2.change), max(error, falls_2.moved_m)
            resisted = allowed.steepness * law.memory * other.equation.stencil.own
            too_long = too_long or falls_2.released > resisted
            accepted = accepted and falls_2.hardest <= resisted
    return change, error, too_long or (error > allowed.error_m and not accepted)


@njit(cache=True, _nrt=False)
def _set_flags(nodes: Flags, values: Flags) -> None:
    """Copy flags from `values` to `nodes`, both (rows, columns).

    Written as loops: assigning whole arrays makes numba include error texts about shapes, which take seconds to
    compile.
    """
    for row in range(nodes.shape[0]):
        for column in range(nodes.shape[1]):
            nodes[row, column] = values[row, column]
