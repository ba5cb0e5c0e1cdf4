"""One time step of the gel's arrays: the equation of the nodes is set up, balanced (see force_balance), and applied.

The bound of a node's friction is its coefficient at the time of the balance, at the slip speed that the balance has:
it is refreshed before each of the first rounds of the search, then held. So the search ends with a convex problem,
which always has a solution. A node that slides goes on sliding if it can, one that sticks sticks until its static
coefficient is exceeded: where friction falls with speed both may be solutions.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.sim.gel.force_balance import Stencil, Work, imbalance, links, move_object, relax, set_object_velocity
from evetac_cli.sim.gel.friction import coefficient_after

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Sweeps between two Newton steps of the object: 1, 2 and 3 took 120, 94 and 81 us a step, on 24 x 18 nodes under a
# tilted cylinder that begins to slip.
SWEEPS_A_ROUND = 3
# Rounds whose bounds are refreshed. More of them find no better balance, and without end they take up to 400 rounds.
REFRESHES = 4
TOO_LONG = 5  # what `step_nodes` returns where its step is longer than its `Allowed` allows
INFO_SIZE = 16


class Layer(NamedTuple):
    """Constants of a pad: a node's mass and spring, its links to neighbours along x and y, its cell, its losses."""

    node_mass: float
    shear: float
    coupling_x: float
    coupling_y: float
    pitch_x: float
    pitch_y: float
    viscous_time: float
    maxwell_share: float
    maxwell_time: float
    pads: float


class Allowed(NamedTuple):
    """What a step may be at most; anything beyond is TOO_LONG.

    error_m: the estimated error. steepness: how much faster a node's friction falls with its slip speed within the step
    than the gel's own resistance rises. Above 1 several slip speeds are in balance; well below 1 the order in which
    nodes pull each other loose is that of a fine step. It holds for nodes that let go, and where `shortest`, a larger
    error is allowed as soon as it holds for all.
    """

    error_m: float = math.inf
    steepness: float = math.inf
    shortest: bool = True


# The groups in which `step_nodes` takes its arguments. Why so: plain tuples, as named ones take 4 us more, of 9 for a
# step of 14 x 10 nodes.
# displacement, velocity, maxwell, mean (velocity over the last step), slip_speed, friction coefficient, stuck, pose,
# twist, inertia, nodes, force of each slow arm (arms, rows, columns, 2), and their shares and times in s (arms, 2)
NodeArrays = tuple[
    Floats, Floats, Floats, Floats, Floats, Floats, Flags, Floats, Floats, Floats, Floats, Floats, Floats
]
# the first seven of these, and the nodes and slow arms
Fields = tuple[Floats, Floats, Floats, Floats, Floats, Floats, Flags, Floats, Floats, Floats]
# normal force of each node, force and moment on the object, whether its twist is prescribed, and the twist it has then
Load = tuple[Floats, Floats, bool, Floats]
# static and kinetic coefficient, the slip speed between them in m/s, and the memory length in m
FrictionLaw = tuple[float, float, float, float]
# dt, theta, tolerance, max_sweeps, and an Allowed
StepSettings = tuple[float, float, float, int, float, float, bool]
LayerConstants = tuple[float, ...]  # a Layer


@njit(cache=True)
def spring(field: Floats, shear: float, coupling_x: float, coupling_y: float, answer: Floats) -> None:
    """Set answer to K field, both (rows, columns, 2); the edges of the pad are free."""
    rows, columns, _ = field.shape
    for row in range(rows):
        for column in range(columns):
            for axis in range(2):
                here = field[row, column, axis]
                pull = shear * here
                if column > 0:
                    pull += coupling_x * (here - field[row, column - 1, axis])
                if column < columns - 1:
                    pull += coupling_x * (here - field[row, column + 1, axis])
                if row > 0:
                    pull += coupling_y * (here - field[row - 1, column, axis])
                if row < rows - 1:
                    pull += coupling_y * (here - field[row + 1, column, axis])
                answer[row, column, axis] = pull


@njit(cache=True)
def step_nodes(
    arrays: NodeArrays,
    load: Load,
    friction: FrictionLaw,
    settings: StepSettings,
    constants: LayerConstants,
    info: Floats,
) -> int:
    """One time step in place; returns 0, TOO_LONG, or the number of what is wrong, both before anything is changed.

    Fills `info`: sweeps, residual, and the rest of `gel.StepInfo` in its order.
    """
    displacement, velocity, maxwell, mean, slip_speed, coefficient, stuck, pose, twist, inertia, nodes, creep, arms = (
        arrays
    )
    nodal, force, prescribed, wanted = load
    mu_static, mu_kinetic, stribeck_speed, memory = friction
    node_mass, shear, coupling_x, coupling_y, pitch_x, pitch_y, viscous, maxwell_share, maxwell_time, pads = constants
    layer = Layer(
        node_mass, shear, coupling_x, coupling_y, pitch_x, pitch_y, viscous, maxwell_share, maxwell_time, pads
    )
    dt, theta, tolerance, max_sweeps, allowed_m, steepest, shortest = settings
    rows, columns = nodal.shape
    for axis in range(3):
        if not (math.isfinite(force[axis]) and math.isfinite(wanted[axis])):
            return 2
        if not (math.isfinite(inertia[axis]) and inertia[axis] > 0.0):
            return 3
        if not (math.isfinite(pose[axis]) and math.isfinite(twist[axis])):
            return 4
    # the Maxwell arm by its exact exponential update: what it keeps of its force, and gains per unit of K velocity
    h = theta * dt
    keep = math.exp(-h / layer.maxwell_time)
    gain = -layer.maxwell_share * layer.maxwell_time * math.expm1(-h / layer.maxwell_time)
    for arm in range(len(arms)):
        gain -= arms[arm, 0] * arms[arm, 1] * math.expm1(-h / arms[arm, 1])
    lag = h + layer.viscous_time + gain
    stencil = Stencil(
        layer.node_mass / h + lag * layer.shear,
        lag * layer.coupling_x,
        lag * layer.coupling_y,
        layer.pitch_x,
        layer.pitch_y,
        layer.pads,
    )
    grid = (rows, columns)
    longer = (rows, columns + 2, 2)
    work = Work(  # made anew: ten arrays handed over from Python took 5 us more, of 12 for a step of one node
        np.zeros((rows + 2, columns + 2, 2)),
        np.zeros(longer),
        np.empty((rows, columns, 2)),
        np.empty(grid),
        np.empty(grid),
        np.empty((rows, columns, 2)),
        np.empty(longer),
        np.empty(grid),
        np.zeros((rows + 2, columns + 2)),
        np.empty((rows, columns, 2)),
        np.zeros(longer),
        np.zeros(longer),
    )
    # the factor of over-relaxation that is best for a smooth pattern on this grid
    ring = 2.0 * (stencil.link_x + stencil.link_y)
    smoothness = ring / (stencil.own + ring)
    factor = 2.0 / (1.0 + math.sqrt(1.0 - smoothness * smoothness))
    falls = mu_kinetic < mu_static
    state = (displacement, velocity, maxwell, mean, slip_speed, coefficient, stuck, nodes, creep, arms)
    fault, scale, square = _set_up(
        state,
        nodal,
        pose,
        friction,
        (h, layer.node_mass / h, keep, factor),
        layer,
        stencil,
        work,
    )
    if fault:
        return int(fault)
    scale += abs(force[0]) + abs(force[1])
    # a moment counts as the force that makes it at the mean distance of the nodes from the object's centre
    reach = math.sqrt(square / nodal.size + layer.pitch_x * layer.pitch_y)
    scale = max(scale + abs(force[2]) / reach, 1e-300)
    body = wanted.copy()
    weight = inertia / h
    friction_wrench = np.zeros(3)
    stuck_before = stuck.copy()
    sweeps = 0
    rounds = 0
    while True:
        set_object_velocity(work, body)
        # one sweep is enough where everything sticks; after that a sweep costs less than the rest of a round
        for _ in range(min(SWEEPS_A_ROUND, max_sweeps - sweeps) if sweeps > 0 else 1):
            relax(work, stencil, stuck, factor)
            sweeps += 1
        if falls and rounds < REFRESHES:
            _refresh(work, nodal, coefficient, body, stuck, h, friction)
        rounds += 1
        worst = imbalance(work, stencil, body, stuck, friction_wrench)
        inertial = weight * (body - twist) - force
        if not prescribed:
            left = np.abs(inertial + layer.pads * friction_wrench)
            worst = max(worst, left[0], left[1], left[2] / reach)
        if worst <= tolerance * scale or sweeps >= max_sweeps:
            break
        if not prescribed:
            move_object(work, stencil, body, weight, inertial, friction_wrench, stuck)
    error = 0.0
    if not prescribed:
        # what the step differs by from one by the trapezoidal rule, of second order
        trapezoid_s = dt * abs(1.0 - 0.5 / theta)
        error = trapezoid_s * (math.hypot(body[0] - twist[0], body[1] - twist[1]) + reach * abs(body[2] - twist[2]))
    change = 0.0
    too_long, accepted = False, shortest
    if falls:
        hardest = released = 0.0
        for row in range(rows):
            for column in range(columns):
                hardest = max(hardest, nodal[row, column])
                if stuck_before[row, column] and not stuck[row, column]:
                    released = max(released, nodal[row, column])
                if nodal[row, column] > 0.0 and not stuck[row, column]:  # at rest the law heals it exactly
                    mu = min(max(coefficient[row, column], mu_kinetic), mu_static)
                    change = max(change, abs(_after(mu, work.speed[row, column], dt, friction) - mu))
        # what the gel where it is pressed hardest would be displaced by, were friction that of the start of the step;
        # those at the rim, which bear little, are the first to let go, and what is next follows from when they do
        error = max(error, change * hardest / layer.shear)
        fall = (mu_static - mu_kinetic) * h  # over what the gel resists with, `Allowed.steepness`
        resisted = steepest * memory * stencil.own
        too_long = released * fall > resisted
        accepted = shortest and hardest * fall <= resisted
    if too_long or (error > allowed_m and not accepted):
        stuck[:] = stuck_before
        return TOO_LONG
    info[:] = 0.0
    info[0] = sweeps
    info[1] = worst / scale
    info[12] = change
    info[15] = error
    _advance(state, nodal, friction, dt, theta, layer, work, info)
    for axis in range(3):
        pose[axis] += dt * body[axis]
        twist[axis] = body[axis] if prescribed else twist[axis] + (body[axis] - twist[axis]) / theta
    return 0


@njit(cache=True, error_model="numpy")
def _set_up(
    state: Fields,
    nodal: Floats,
    pose: Floats,
    friction: FrictionLaw,
    factors: tuple[float, float, float, float],
    layer: Layer,
    stencil: Stencil,
    work: Work,
) -> tuple[int, float, float]:
    """Fill the equation of the nodes: right-hand side, diagonal, bounds, levers, and where the search starts.

    factors: theta * dt, a node's mass over it, what the Maxwell arm keeps of its force, and that of over-relaxation.
    Returns the number of what is wrong, or 0; the sum of all forces on the nodes; and that of the squares of their
    levers.
    """
    displacement, velocity, maxwell, mean, slip_speed, coefficient, _, nodes, creep, arms = state
    static, kinetic, _, _ = friction
    h, momentum, keep, factor = factors
    rows, columns = nodal.shape
    falls = kinetic < static
    scale = square = 0.0
    spring(displacement, layer.shear, layer.coupling_x, layer.coupling_y, work.pull)
    right, moving, lagging = work.pull.reshape(-1), velocity.reshape(-1), maxwell.reshape(-1)
    for entry in range(right.size):
        right[entry] = momentum * moving[entry] - right[entry] - keep * lagging[entry]
    for arm in range(len(arms)):
        kept, creeping = math.exp(-h / arms[arm, 1]), creep[arm].reshape(-1)
        for entry in range(right.size):
            right[entry] -= kept * creeping[entry]
    for row in range(rows):
        links_y = links(row, rows) * stencil.link_y
        for column in range(columns):
            normal = nodal[row, column]
            if not (normal >= 0.0 and normal < np.inf):
                return 1, 0.0, 0.0
            mu = static
            if falls:
                # one that never bore a load is infinite, and a law that changed under a load takes hold at once
                mu = min(max(coefficient[row, column], kinetic), static)
                if normal > 0.0:
                    mu = _after(mu, slip_speed[row, column], h, friction)
            for axis in range(2):
                work.velocity[row + 1, column + 1, axis] = mean[row, column, axis]
                work.right[row, column, axis] = work.pull[row, column, axis]
            work.bound[row, column] = mu * normal
            work.diagonal[row, column] = stencil.own + links(column, columns) * stencil.link_x + links_y
            work.ease[row, column, 0] = work.ease[row, column, 1] = factor / work.diagonal[row, column]
            scale += mu * normal + abs(work.right[row, column, 0]) + abs(work.right[row, column, 1])
            x = nodes[row, column, 0] - pose[0]
            y = nodes[row, column, 1] - pose[1]
            square += x * x + y * y
            work.lever[row, column, 0] = x
            work.lever[row, column, 1] = y
    if not math.isfinite(scale):
        return 4, 0.0, 0.0
    return 0, layer.pads * scale, square


@njit(cache=True)
def _after(mu: float, slip_speed: float, seconds: float, friction: FrictionLaw) -> float:
    """A node's coefficient after so many seconds at a slip speed; at rest it is often static, and then stays so."""
    static, kinetic, stribeck, memory = friction
    if slip_speed == 0.0 and mu == static:
        return mu
    return float(coefficient_after(mu, slip_speed, seconds, static, kinetic, stribeck, memory))


@njit(cache=True)
def _refresh(
    work: Work, nodal: Floats, coefficient: Floats, twist: Floats, stuck: Flags, h: float, friction: FrictionLaw
) -> None:
    """Set each loaded node's bound to what its slip speed of now makes of it at the time of the balance."""
    static, kinetic, _, _ = friction
    rows, columns = nodal.shape
    for row in range(rows):
        for column in range(columns):
            normal = nodal[row, column]
            if normal > 0.0:
                speed = 0.0
                if not stuck[row, column]:
                    slip_x = work.velocity[row + 1, column + 1, 0] - twist[0] + twist[2] * work.lever[row, column, 1]
                    slip_y = work.velocity[row + 1, column + 1, 1] - twist[1] - twist[2] * work.lever[row, column, 0]
                    speed = math.sqrt(slip_x * slip_x + slip_y * slip_y)
                mu = min(max(coefficient[row, column], kinetic), static)
                work.bound[row, column] = normal * _after(mu, speed, h, friction)


@njit(cache=True, error_model="numpy")
def _advance(
    state: Fields,
    nodal: Floats,
    friction: FrictionLaw,
    dt: float,
    theta: float,
    layer: Layer,
    work: Work,
    info: Floats,
) -> None:
    """Move the gel on by dt with the velocities of the balance, and sum up what happened in info[2:]."""
    displacement, velocity, maxwell, mean, slip_speed, coefficient, stuck, nodes, creep, arms = state
    static, kinetic, _, _ = friction
    rows, columns = nodal.shape
    for row in range(rows):
        for column in range(columns):
            for axis in range(2):
                mean[row, column, axis] = work.velocity[row + 1, column + 1, axis]
    spring(mean, layer.shear, layer.coupling_x, layer.coupling_y, work.search_direction)
    fade = math.exp(-dt / layer.maxwell_time)
    build = -layer.maxwell_share * layer.maxwell_time * math.expm1(-dt / layer.maxwell_time)
    moved, moving, lagging = displacement.reshape(-1), velocity.reshape(-1), maxwell.reshape(-1)
    here, pull = mean.reshape(-1), work.search_direction.reshape(-1)
    for entry in range(moved.size):
        moved[entry] += dt * here[entry]
        lagging[entry] = fade * lagging[entry] + build * pull[entry]
        moving[entry] += (here[entry] - moving[entry]) / theta
    for arm in range(len(arms)):
        fade, creeping = math.exp(-dt / arms[arm, 1]), creep[arm].reshape(-1)
        build = -arms[arm, 0] * arms[arm, 1] * math.expm1(-dt / arms[arm, 1])
        for entry in range(moved.size):
            creeping[entry] = fade * creeping[entry] + build * pull[entry]
    falls = kinetic < static
    total = heat = pressed = 0.0
    gel_x = gel_y = slip_x = slip_y = shift_x = shift_y = push_sum_x = push_sum_y = moment = 0.0
    loaded = 0
    slipping = 0
    for row in range(rows):
        for column in range(columns):
            load = nodal[row, column]
            speed = work.speed[row, column]
            slip_speed[row, column] = speed
            if falls:
                mu = np.inf
                if load > 0.0:
                    mu = min(max(coefficient[row, column], kinetic), static)
                    mu = _after(mu, speed, dt, friction)
                coefficient[row, column] = mu
            push_x = push_y = 0.0
            if stuck[row, column]:
                push_x = work.pull[row, column, 0]
                push_y = work.pull[row, column, 1]
            elif speed > 0.0 and load > 0.0:
                push_x = -work.bound[row, column] * (work.slip[row, column, 0] / speed)
                push_y = -work.bound[row, column] * (work.slip[row, column, 1] / speed)
            push_sum_x += push_x
            push_sum_y += push_y
            moment += nodes[row, column, 0] * push_y - nodes[row, column, 1] * push_x
            if load > 0.0:
                total += load
                loaded += 1
                if not stuck[row, column]:
                    slipping += 1
                    heat += layer.pads * work.bound[row, column] * speed * dt
                    pressed = max(pressed, load)
                gel_x += load * mean[row, column, 0]
                gel_y += load * mean[row, column, 1]
                slip_x -= load * work.slip[row, column, 0]
                slip_y -= load * work.slip[row, column, 1]
                shift_x += load * displacement[row, column, 0]
                shift_y += load * displacement[row, column, 1]
    info[2] = slipping / loaded if loaded > 0 else 1.0
    share = 1.0 / total if total > 0.0 else 0.0
    info[3], info[4] = share * gel_x, share * gel_y
    info[5], info[6] = share * slip_x, share * slip_y
    info[7], info[8] = share * shift_x, share * shift_y
    info[9], info[10], info[11] = push_sum_x, push_sum_y, moment
    info[13], info[14] = heat, pressed
