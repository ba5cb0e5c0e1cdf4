"""One time step of the gel's arrays: the equation of the nodes is set up, solved (see force_balance), and applied.

The bound of a node's friction is its coefficient at the time of the balance, at the slip speed of the balance. It is
refreshed before each of the first rounds of the search, and then fixed. So the search ends with a convex problem, which
always has a solution. A sliding node continues to slide if possible, and a stuck node sticks until its static
coefficient is exceeded: when friction falls with speed, both may be solutions.
"""

import math
from typing import NamedTuple

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.force_balance import Three, imbalance, relax, work_in
from evetac_cli.sim.gel.object_move import move_object
from evetac_cli.sim.gel.pad_equation import (
    Fields,
    FrictionLaw,
    LayerConstants,
    Squeezing,
    advance,
    begin,
    let_go,
    named_constants,
    refresh,
)

# Number of sweeps between two Newton steps of the object. With 1, 2 and 3 each step took 120, 94 and 81 us, on 24 x 18
# nodes under a tilted cylinder that begins to slip, on a gel without a sheet.
SWEEPS_A_ROUND = 3
# Rounds whose bounds are refreshed. More rounds find no better balance, and without a limit they take up to 400 rounds.
REFRESHES = 4
TOO_LONG = 5  # returned by `step_nodes` if its step is longer than its `Allowed` permits
INFO_SIZE = 19  # numbers that `step_nodes` fills in


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


# The arguments of `step_nodes`, in groups. Plain tuples, because named tuples take 4 us longer, of 9 us for a step of
# 14 x 10 nodes.
# NodeArrays: displacement, velocity, maxwell, mean (velocity over the last step), slip_speed, friction coefficient,
# stuck, pose, twist, inertia and nodes. Then the force of each slow arm (arms, rows, columns, 2), and the arms' shares
# and times in s (arms, 2). Then scratch: memory of its `Work`, and which nodes stuck before. Then the sheet's arrays,
# as in `Fields`.
NodeArrays = tuple[
    Floats,
    Floats,
    Floats,
    Floats,
    Floats,
    Floats,
    Flags,
    Floats,
    Floats,
    Floats,
    Floats,
    Floats,
    Floats,
    Floats,
    Flags,
    Floats,
    Floats,
    Floats,
]
# Load: normal force of each node, its squeeze of the nodes, force and moment on the object, whether its twist is
# prescribed, and the prescribed twist.
Load = tuple[Floats, Squeezing, Three, bool, Three]
# dt, theta, tolerance, max_sweeps, and the fields of an `Allowed`
StepSettings = tuple[float, float, float, int, float, float, bool]
# the second finger's pad: its arrays, the normal force of each of its nodes, their squeeze, and its constants
Second = tuple[Fields, Floats, Squeezing, LayerConstants] | None


@njit(cache=True, _nrt=False)
def step_nodes(
    arrays: NodeArrays,
    load: Load,
    friction: FrictionLaw,
    settings: StepSettings,
    constants: LayerConstants,
    info: Floats,
    second: Second,
) -> int:
    """Make one time step in place; return 0, TOO_LONG, or the number of an error; the last two before any change.

    second: the second finger's pad, if it is also simulated. Fills `info`: sweeps, residual, the rest of `gel.StepInfo`
    in its order, and then the force of the object on the second pad and its moment.
    """
    stuck, pose, twist, inertia = arrays[6:10]
    memory, stuck_before = arrays[13:15]
    coefficient = arrays[5]
    nodal, squeeze, force, prescribed, wanted = load
    dt, theta, tolerance, max_sweeps, allowed_m, steepest, shortest = settings
    for axis in range(3):
        if not (math.isfinite(force[axis]) and math.isfinite(wanted[axis])):
            return 2
        if not (math.isfinite(inertia[axis]) and inertia[axis] > 0.0):
            return 3
        if not (math.isfinite(pose[axis]) and math.isfinite(twist[axis])):
            return 4
    h = theta * dt
    state = (*arrays[:7], *arrays[10:])
    rows, columns = nodal.shape
    work = work_in(memory, arrays[17], rows, columns)
    layer = named_constants(constants)
    fault, scale, square, stencil = begin(state, nodal, squeeze, pose, friction, h, layer, work)
    if fault:
        return int(fault)
    if second is None:
        other = None
    else:
        state_2, nodal_2, squeeze_2, constants_2 = second
        coefficient_2, stuck_2, memory_2, stuck_before_2 = state_2[5], state_2[6], state_2[10], state_2[11]
        rows_2, columns_2 = nodal_2.shape
        work_2 = work_in(memory_2, state_2[14], rows_2, columns_2)
        layer_2 = named_constants(constants_2)
        fault, scale_2, _, stencil_2 = begin(state_2, nodal_2, squeeze_2, pose, friction, h, layer_2, work_2)
        if fault:
            return int(fault)
        scale += scale_2
        other = (work_2, stencil_2, stuck_2)
        _set_flags(stuck_before_2, stuck_2)
    falls = friction[1] < friction[0]
    scale += abs(force[0]) + abs(force[1])
    # a moment counts as the force that causes it at the mean distance of the nodes from the object's centre
    reach = math.sqrt(square / nodal.size + layer.pitch_x * layer.pitch_y)
    scale = max(scale + abs(force[2]) / reach, 1e-300)
    body = memory[-3:]
    for axis in range(3):
        body[axis] = wanted[axis] if prescribed else twist[axis]
    weight = (inertia[0] / h, inertia[1] / h, inertia[2] / h)
    _set_flags(stuck_before, stuck)
    sweeps = 0
    rounds = 0
    while True:
        body_now = (body[0], body[1], body[2])
        # one sweep is enough if nothing changes speed; later a sweep costs less than the rest of a round
        for _ in range(min(SWEEPS_A_ROUND, max_sweeps - sweeps) if sweeps > 0 else 1):
            relax(work, stencil, stuck, body_now)
            if second is not None:
                relax(work_2, stencil_2, stuck_2, body_now)
            sweeps += 1
        if falls and rounds < REFRESHES:
            refresh(work, nodal, coefficient, body, stuck, h, friction)
            if second is not None:
                refresh(work_2, nodal_2, coefficient_2, body, stuck_2, h, friction)
        rounds += 1
        worst, wrench = imbalance(work, stencil, body, stuck)
        pads_x, pads_y, pads_turn = layer.pads * wrench[0], layer.pads * wrench[1], layer.pads * wrench[2]
        if second is not None:
            worst_2, wrench_2 = imbalance(work_2, stencil_2, body, stuck_2)
            worst = max(worst, worst_2)
            pads_x += layer_2.pads * wrench_2[0]
            pads_y += layer_2.pads * wrench_2[1]
            pads_turn += layer_2.pads * wrench_2[2]
        inertial_x = weight[0] * (body[0] - twist[0]) - force[0]
        inertial_y = weight[1] * (body[1] - twist[1]) - force[1]
        inertial_turn = weight[2] * (body[2] - twist[2]) - force[2]
        if not prescribed:
            worst = max(
                worst,
                abs(inertial_x + pads_x),
                abs(inertial_y + pads_y),
                abs(inertial_turn + pads_turn) / reach,
            )
        if worst <= tolerance * scale or sweeps >= max_sweeps:
            break
        if not prescribed:
            inertial, pads_wrench = (inertial_x, inertial_y, inertial_turn), (pads_x, pads_y, pads_turn)
            move_object(work, stencil, body, weight, inertial, pads_wrench, stuck, other)
    error = 0.0
    if not prescribed:
        # difference of the step from a step by the trapezoidal rule, of second order
        trapezoid_s = dt * abs(1.0 - 0.5 / theta)
        error = trapezoid_s * (math.hypot(body[0] - twist[0], body[1] - twist[1]) + reach * abs(body[2] - twist[2]))
    change = 0.0
    too_long, accepted = False, shortest
    if falls:
        change, moved_m, released, hardest = let_go(
            work, nodal, (coefficient, stuck_before, stuck), friction, dt, h, layer
        )
        error = max(error, moved_m)
        resisted = steepest * friction[3] * stencil.own  # the gel's resistance, see `Allowed.steepness`
        too_long = released > resisted
        accepted = shortest and hardest <= resisted
        if second is not None:
            nodes_2 = (coefficient_2, stuck_before_2, stuck_2)
            change_2, moved_m, released, hardest = let_go(work_2, nodal_2, nodes_2, friction, dt, h, layer_2)
            change, error = max(change, change_2), max(error, moved_m)
            resisted = steepest * friction[3] * stencil_2.own
            too_long = too_long or released > resisted
            accepted = accepted and hardest <= resisted
    if too_long or (error > allowed_m and not accepted):
        _set_flags(stuck, stuck_before)
        if second is not None:
            _set_flags(stuck_2, stuck_before_2)
        return TOO_LONG
    info[:] = 0.0
    if second is not None:
        advance(state_2, nodal_2, friction, dt, theta, layer_2, work_2, body, info)
        for axis in range(3):
            info[16 + axis] = info[9 + axis]
        heat, pressed = info[13], info[14]
    info[0] = sweeps
    info[1] = worst / scale
    info[12] = change
    info[15] = error
    advance(state, nodal, friction, dt, theta, layer, work, body, info)
    if second is not None:
        info[13] += heat
        info[14] = max(info[14], pressed)
    for axis in range(3):
        pose[axis] += dt * body[axis]
        twist[axis] = body[axis] if prescribed else twist[axis] + (body[axis] - twist[axis]) / theta
    return 0


@njit(cache=True, _nrt=False)
def _set_flags(nodes: Flags, values: Flags) -> None:
    """Copy flags from `values` to `nodes`, both (rows, columns).

    Written as loops: assigning whole arrays makes numba include error texts about shapes, which take seconds to
    compile.
    """
    for row in range(nodes.shape[0]):
        for column in range(nodes.shape[1]):
            nodes[row, column] = values[row, column]
