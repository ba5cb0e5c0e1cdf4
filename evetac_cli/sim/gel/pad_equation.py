"""One pad in a time step (see time_step): sets up the equation of its nodes, refreshes bounds, applies the motion."""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.force_balance import Stencil, Work
from evetac_cli.sim.gel.friction import coefficient_after
from evetac_cli.sim.gel.sheet import SheetStencil, largest, mirror, pull_sheet, relax_sheet, sheet_imbalance

SHEET_OFF_M = 1e-13  # tolerated distance of the sheet from its balance: 3e-9 px


class PadConstants(NamedTuple):
    """Constants of a pad, in SI units: a node's mass, its springs to the back and to the sheet, and its losses.

    pitch_x, pitch_y: distances between nodes. stretch: stencil of the sheet. viscous_time: of the dashpot.
    maxwell_share, maxwell_time: of the fast arm. pads: how many pads like this one hold the object.
    """

    node_mass: float
    shear: float
    spring: float
    pitch_x: float
    pitch_y: float
    viscous_time: float
    maxwell_share: float
    maxwell_time: float
    pads: float
    stretch: SheetStencil


# Plain tuples, because named tuples take longer to pass. Fields of a pad are first displacement, velocity, maxwell,
# mean (velocity over the last step), slip_speed, friction coefficient, stuck and nodes. Then the force of each slow arm
# (arms, rows, columns, 2), and the arms' shares and times in s (arms, 2). Then scratch: memory of its `Work`, and which
# nodes stuck before. Then the sheet's displacement and mean velocity (2, rows + 2, columns + 2), and its rule.
Fields = tuple[
    Floats, Floats, Floats, Floats, Floats, Floats, Flags, Floats, Floats, Floats, Floats, Flags, Floats, Floats, Floats
]
# force with which a total normal force of 1 N squeezes each node aside (rows, columns, 2), and that normal force
Squeezing = tuple[Floats, float]
# static and kinetic coefficient, the Stribeck velocity in m/s, and the memory length in m
FrictionLaw = tuple[float, float, float, float]
# the fields of a PadConstants
LayerConstants = tuple[float, float, float, float, float, float, float, float, float, tuple[float, ...]]


@njit(cache=True, _nrt=False)
def named_constants(constants: LayerConstants) -> PadConstants:
    """Return the constants of a pad with their names."""
    node_mass, shear, spring, pitch_x, pitch_y, viscous, maxwell_share, maxwell_time, pads, stretch = constants
    along_x, along_y, across_x, across_y, corner = stretch
    links = SheetStencil(along_x, along_y, across_x, across_y, corner)
    return PadConstants(node_mass, shear, spring, pitch_x, pitch_y, viscous, maxwell_share, maxwell_time, pads, links)


@njit(cache=True, _nrt=False)
def spring(field: Floats, sheet: Floats, shear: float, to_sheet: float, answer: Floats) -> None:
    """Set answer to K field, both (rows, columns, 2), for this displacement of the sheet (2, rows + 2, columns + 2)."""
    rows, columns, _ = field.shape
    both = shear + to_sheet
    for row in range(rows):
        for column in range(columns):
            for axis in range(2):
                answer[row, column, axis] = (
                    both * field[row, column, axis] - to_sheet * sheet[axis, row + 1, column + 1]
                )


@njit(cache=True, _nrt=False)
def begin(
    state: Fields,
    nodal: Floats,
    squeeze: Squeezing,
    pose: Floats,
    friction: FrictionLaw,
    h: float,
    layer: PadConstants,
    work: Work,
) -> tuple[int, float, float, Stencil]:
    """Set up the equation of a pad's nodes over h; return the results of `_set_up` and the equation's matrix."""
    arms = state[9]
    # exact exponential update of the Maxwell arm: the share of its force that remains, and the gain per K velocity
    keep = math.exp(-h / layer.maxwell_time)
    gain = -layer.maxwell_share * layer.maxwell_time * math.expm1(-h / layer.maxwell_time)
    for arm in range(len(arms)):
        gain -= arms[arm, 0] * arms[arm, 1] * math.expm1(-h / arms[arm, 1])
    lag = h + layer.viscous_time + gain
    stencil = Stencil(layer.node_mass / h + lag * layer.shear, lag * layer.spring, layer.stretch, layer.pads)
    factors = (h, layer.node_mass / h, keep)
    fault, scale, square = _set_up(state, nodal, squeeze, pose, friction, factors, layer, work)
    return fault, scale, square, stencil


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
    """Return how the friction of a pad has fallen in a step, and the effects of that.

    nodes: coefficient of each node, whether it stuck before, and whether it sticks now. The first result is the largest
    change of a coefficient. The second is the resulting change of the gel's displacement at the highest pressure, in m.
    The others are slopes of friction over slip speed, times the memory length, in N s. The third is that of the node
    with the highest pressure of those that let go, the fourth that of the node with the highest pressure of all. They
    are compared with the limits of `time_step.Allowed`. Nodes at the rim, which bear little, let go first, and their
    timing determines which nodes follow.
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
            if nodal[row, column] > 0.0 and not stuck[row, column]:  # at rest the law heals the coefficient exactly
                mu = min(max(coefficient[row, column], kinetic), static)
                change = max(change, abs(_after(mu, work.speed[row, column], dt, friction) - mu))
    fall = (static - kinetic) * h
    return change, change * hardest / layer.shear, fall * released, fall * hardest


@njit(cache=True, _nrt=False, error_model="numpy")
def _set_up(
    state: Fields,
    nodal: Floats,
    squeeze: Squeezing,
    pose: Floats,
    friction: FrictionLaw,
    factors: tuple[float, float, float],
    layer: PadConstants,
    work: Work,
) -> tuple[int, float, float]:
    """Fill the equation of the nodes: right-hand side, bounds, levers, and the start of the search.

    factors: theta * dt, a node's mass divided by it, and the share of its force that the Maxwell arm keeps. Return the
    number of an error, or 0; the sum of all forces on the nodes; and the sum of the squares of their levers.
    """
    displacement, velocity, maxwell, mean, slip_speed, coefficient, _, nodes, creep, arms = state[:10]
    sheet, sheet_mean = state[12], state[13]
    static, kinetic, _, _ = friction
    h, momentum, keep = factors
    unit_squeeze, squeezed_n = squeeze
    rows, columns = nodal.shape
    falls = kinetic < static
    scale = square = 0.0
    spring(displacement, sheet, layer.shear, layer.spring, work.pull)
    if layer.spring > 0.0:
        starts, lately = work.sheet.reshape(-1), sheet_mean.reshape(-1)
        for entry in range(starts.size):
            starts[entry] = lately[entry]
    right, moving, lagging = work.pull.reshape(-1), velocity.reshape(-1), maxwell.reshape(-1)
    for entry in range(right.size):
        right[entry] = momentum * moving[entry] - right[entry] - keep * lagging[entry]
    for arm in range(len(arms)):
        kept, creeping = math.exp(-h / arms[arm, 1]), creep[arm].reshape(-1)
        for entry in range(right.size):
            right[entry] -= kept * creeping[entry]
    for row in range(rows):
        for column in range(columns):
            normal = nodal[row, column]
            if not (normal >= 0.0 and normal < np.inf):
                return 1, 0.0, 0.0
            mu = static
            if falls:
                # a node that never bore a load is infinite; a law that changed under load takes effect at once
                mu = min(max(coefficient[row, column], kinetic), static)
                if normal > 0.0:
                    mu = _after(mu, slip_speed[row, column], h, friction)
            for axis in range(2):
                work.velocity[row, column, axis] = mean[row, column, axis]
                squeezed = squeezed_n * unit_squeeze[row, column, axis]
                work.right[row, column, axis] = work.pull[row, column, axis] + squeezed
            work.bound[row, column] = mu * normal
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
def _settle_sheet(displacement: Floats, sheet: Floats, layer: PadConstants, work: Work) -> None:
    """Bring the displaced sheet closer to its balance if steps have left it off balance.

    A step finds velocities within its tolerance, so the sheet would drift away with the sum of the residuals. Rounding
    errors are left, because a gel at rest would otherwise never come to rest.
    """
    for axis in range(2):  # code that displaced the sheet from outside may not have set its border
        mirror(sheet[axis], axis == 0)
    pull_sheet(displacement, work.sheet_source)
    sheet_imbalance(sheet, work.sheet_source, layer.stretch, work.sheet_rule, work.sheet_left)
    if largest(work.sheet_left.reshape(-1)) > SHEET_OFF_M:
        relax_sheet(sheet, work.sheet_source, layer.stretch, work.sheet_rule, work.after)


@njit(cache=True, _nrt=False)
def _after(mu: float, slip_speed: float, seconds: float, friction: FrictionLaw) -> float:
    """Return a node's coefficient after some time at a slip speed; at rest it is often static, and stays static."""
    static, kinetic, stribeck, memory = friction
    if slip_speed == 0.0 and mu == static:
        return mu
    return float(coefficient_after(mu, slip_speed, seconds, static, kinetic, stribeck, memory))


@njit(cache=True, _nrt=False)
def refresh(
    work: Work, nodal: Floats, coefficient: Floats, twist: Floats, stuck: Flags, h: float, friction: FrictionLaw
) -> None:
    """Set each loaded node's bound at the time of the balance, from its present slip speed."""
    static, kinetic, _, _ = friction
    rows, columns = nodal.shape
    for row in range(rows):
        for column in range(columns):
            normal = nodal[row, column]
            if normal > 0.0:
                speed = 0.0
                if not stuck[row, column]:
                    slip_x = work.velocity[row, column, 0] - twist[0] + twist[2] * work.lever[row, column, 1]
                    slip_y = work.velocity[row, column, 1] - twist[1] - twist[2] * work.lever[row, column, 0]
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
    twist: Floats,
    info: Floats,
) -> None:
    """Advance the gel by dt with the velocities of the balance, and collect the results in info[2:]."""
    displacement, velocity, maxwell, mean, slip_speed, coefficient, stuck, nodes, creep, arms = state[:10]
    sheet, sheet_mean = state[12], state[13]
    static, kinetic, _, _ = friction
    rows, columns = nodal.shape
    for row in range(rows):
        for column in range(columns):
            for axis in range(2):
                mean[row, column, axis] = work.velocity[row, column, axis]
    if layer.spring > 0.0:
        moved_sheet, sheet_mean_m_s, sheet_m_s = sheet.reshape(-1), sheet_mean.reshape(-1), work.sheet.reshape(-1)
        for entry in range(moved_sheet.size):
            sheet_mean_m_s[entry] = sheet_m_s[entry]
            moved_sheet[entry] += dt * sheet_m_s[entry]
    spring(mean, work.sheet, layer.shear, layer.spring, work.search_direction)
    fade = math.exp(-dt / layer.maxwell_time)
    build = -layer.maxwell_share * layer.maxwell_time * math.expm1(-dt / layer.maxwell_time)
    moved, moving, lagging = displacement.reshape(-1), velocity.reshape(-1), maxwell.reshape(-1)
    here, pull = mean.reshape(-1), work.search_direction.reshape(-1)
    for entry in range(moved.size):
        moved[entry] += dt * here[entry]
        lagging[entry] = fade * lagging[entry] + build * pull[entry]
        moving[entry] += (here[entry] - moving[entry]) / theta
    if layer.spring > 0.0:
        _settle_sheet(displacement, sheet, layer, work)
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
            if work.bound[row, column] == 0.0:  # not needed for the balance, but for friction once the node is loaded
                slip_x_m_s = mean[row, column, 0] - twist[0] + twist[2] * work.lever[row, column, 1]
                slip_y_m_s = mean[row, column, 1] - twist[1] - twist[2] * work.lever[row, column, 0]
                work.slip[row, column, 0], work.slip[row, column, 1] = slip_x_m_s, slip_y_m_s
                work.speed[row, column] = math.sqrt(slip_x_m_s * slip_x_m_s + slip_y_m_s * slip_y_m_s)
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
