"""What a time step (see time_step) does with one pad: sets up its nodes' equation, refreshes bounds, applies motion."""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.force_balance import Stencil, Work, links
from evetac_cli.sim.gel.friction import coefficient_after


class PadConstants(NamedTuple):
    """Constants of a pad, in SI units: a node's mass, its spring, its links to neighbours along x and y, its losses.

    pitch_x, pitch_y: distance of the nodes. viscous_time: of the dashpot. maxwell_share, maxwell_time: of the quick
    arm. pads: how many pads like this one hold the object.
    """

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


# Plain tuples, as named ones take longer to hand over. Of a pad: displacement, velocity, maxwell, mean (velocity over
# the last step), slip_speed, friction coefficient, stuck, nodes, force of each slow arm (arms, rows, columns, 2), and
# their shares and times in s (arms, 2); then scratch: memory of its `Work`, and which nodes stuck before
Fields = tuple[Floats, Floats, Floats, Floats, Floats, Floats, Flags, Floats, Floats, Floats, Floats, Flags]
# static and kinetic coefficient, the slip speed between them in m/s, and the memory length in m
FrictionLaw = tuple[float, float, float, float]
LayerConstants = tuple[float, ...]  # a PadConstants


@njit(cache=True, _nrt=False)
def named_constants(constants: LayerConstants) -> PadConstants:
    """Constants of a pad by their names."""
    node_mass, shear, coupling_x, coupling_y, pitch_x, pitch_y, viscous, maxwell_share, maxwell_time, pads = constants
    return PadConstants(
        node_mass, shear, coupling_x, coupling_y, pitch_x, pitch_y, viscous, maxwell_share, maxwell_time, pads
    )


@njit(cache=True, _nrt=False)
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


@njit(cache=True, _nrt=False)
def begin(
    state: Fields, nodal: Floats, pose: Floats, friction: FrictionLaw, h: float, layer: PadConstants, work: Work
) -> tuple[int, float, float, Stencil, float]:
    """The equation of a pad's nodes over h: what `_set_up` returns, and the factor of over-relaxation."""
    arms = state[9]
    # the Maxwell arm by its exact exponential update: what it keeps of its force, and gains per unit of K velocity
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
    # the factor of over-relaxation that is best for a smooth pattern on this grid
    ring = 2.0 * (stencil.link_x + stencil.link_y)
    smoothness = ring / (stencil.own + ring)
    factor = 2.0 / (1.0 + math.sqrt(1.0 - smoothness * smoothness))
    factors = (h, layer.node_mass / h, keep, factor)
    fault, scale, square = _set_up(state, nodal, pose, friction, factors, layer, stencil, work)
    return fault, scale, square, stencil, factor


@njit(cache=True, _nrt=False)
def let_go(
    work: Work,
    nodal: Floats,
    nodes: tuple[Floats, Flags, Flags],
    friction: FrictionLaw,
    dt: float,
    h: float,
    layer: PadConstants,
) -> tuple[float, float, float, float]:
    """How the friction of a pad has fallen in a step: the largest change of a coefficient, and what follows from it.

    nodes: coefficient of each, and whether it stuck before and sticks now. Returned are that change; by how much, in m,
    the gel is displaced otherwise for it where it is pressed hardest; and how steeply friction falls with slip speed,
    times the memory length, in N s, at the hardest pressed node that lets go and at the hardest pressed of all. The two
    are compared with what `time_step.Allowed` allows. Why so: nodes at the rim, which bear little, are the first to let
    go, and what is next follows from when they do.
    """
    coefficient, stuck_before, stuck = nodes
    static, kinetic, _, _ = friction
    rows, columns = nodal.shape
    change = hardest = released = 0.0
    for row in range(rows):
        for column in range(columns):
            hardest = max(hardest, nodal[row, column])
            if stuck_before[row, column] and not stuck[row, column]:
                released = max(released, nodal[row, column])
            if nodal[row, column] > 0.0 and not stuck[row, column]:  # at rest the law heals it exactly
                mu = min(max(coefficient[row, column], kinetic), static)
                change = max(change, abs(_after(mu, work.speed[row, column], dt, friction) - mu))
    fall = (static - kinetic) * h
    return change, change * hardest / layer.shear, fall * released, fall * hardest


@njit(cache=True, _nrt=False, error_model="numpy")
def _set_up(
    state: Fields,
    nodal: Floats,
    pose: Floats,
    friction: FrictionLaw,
    factors: tuple[float, float, float, float],
    layer: PadConstants,
    stencil: Stencil,
    work: Work,
) -> tuple[int, float, float]:
    """Fill the equation of the nodes: right-hand side, diagonal, bounds, levers, and where the search starts.

    factors: theta * dt, a node's mass over it, what the Maxwell arm keeps of its force, and that of over-relaxation.
    Returns the number of what is wrong, or 0; the sum of all forces on the nodes; and that of the squares of their
    levers.
    """
    displacement, velocity, maxwell, mean, slip_speed, coefficient, _, nodes, creep, arms = state[:10]
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


@njit(cache=True, _nrt=False)
def _after(mu: float, slip_speed: float, seconds: float, friction: FrictionLaw) -> float:
    """A node's coefficient after so many seconds at a slip speed; at rest it is often static, and then stays so."""
    static, kinetic, stribeck, memory = friction
    if slip_speed == 0.0 and mu == static:
        return mu
    return float(coefficient_after(mu, slip_speed, seconds, static, kinetic, stribeck, memory))


@njit(cache=True, _nrt=False)
def refresh(
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


@njit(cache=True, _nrt=False, error_model="numpy")
def advance(
    state: Fields,
    nodal: Floats,
    friction: FrictionLaw,
    dt: float,
    theta: float,
    layer: PadConstants,
    work: Work,
    info: Floats,
) -> None:
    """Move the gel on by dt with the velocities of the balance, and sum up what happened in info[2:]."""
    displacement, velocity, maxwell, mean, slip_speed, coefficient, stuck, nodes, creep, arms = state[:10]
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
