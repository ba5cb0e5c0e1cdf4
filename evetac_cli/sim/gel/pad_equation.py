"""One pad in a time step (see time_step): sets up the equation of its nodes, refreshes bounds, applies the motion."""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.force_balance import Stencil, Three
from evetac_cli.sim.gel.friction import FrictionLaw, coefficient_after
from evetac_cli.sim.gel.pad import PadParts, Work
from evetac_cli.sim.gel.sheet import SheetStencil, largest, mirror, pull_sheet, relax_sheet, sheet_imbalance

SHEET_OFF_M = 1e-13  # tolerated distance of the sheet from its balance: 3e-9 px

Two = tuple[float, float]
# force with which a total normal force of 1 N squeezes each node aside (rows, columns, 2), and that normal force
Squeezing = tuple[Floats, float]


class Moved(NamedTuple):
    """Motion of a pad over a step, as in `time_step.StepInfo`; pressed: largest normal force of a slipping node."""

    slip_fraction: float
    gel_velocity: Two
    slip_velocity: Two
    gel_displacement: Two
    friction: Three
    heat: float
    pressed: float


class Falls(NamedTuple):
    """How the friction of a pad has fallen in a step, and the effects of that.

    change: largest change of a coefficient. moved_m: the resulting change of the gel's displacement at the highest
    pressure, in m.

    The others are slopes of friction over slip speed, times the memory length, in N s, to be compared with the limits
    of `time_step.Allowed`. hardest: of the node with the highest pressure. released: of that of the nodes that let go.
    Nodes at the rim, which bear little, let go first, and their timing determines which nodes follow.
    """

    change: float
    moved_m: float
    released: float
    hardest: float


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
def matrix(parts: PadParts, layer: np.void, h: float) -> Stencil:
    """Return the matrix of a pad's equation over h."""
    arms = parts.creep_arms
    gain = -layer["maxwell_share"] * layer["maxwell_time"] * math.expm1(-h / layer["maxwell_time"])
    for arm in range(len(arms)):
        gain -= arms[arm, 0] * arms[arm, 1] * math.expm1(-h / arms[arm, 1])
    lag = h + layer["viscous_time"] + gain
    stretch = SheetStencil(layer["along_x"], layer["along_y"], layer["across_x"], layer["across_y"], layer["corner"])
    own = layer["node_mass"] / h + lag * layer["shear"]
    return Stencil(own, lag * layer["spring"], stretch, layer["pads"])


@njit(cache=True, _nrt=False)
def let_go(parts: PadParts, layer: np.void, law: FrictionLaw, dt: float, h: float) -> Falls:
    """Return how the friction of a pad has fallen in a step."""
    normal, speed, coefficient = parts.work.normal, parts.work.speed, parts.friction_coefficient
    stuck, stuck_before = parts.stuck, parts.stuck_before
    rows, columns = normal.shape
    change = hardest = released = 0.0
    for row in range(rows):
        for column in range(columns):
            hardest = max(hardest, normal[row, column])
            if stuck_before[row, column] and not stuck[row, column]:
                released = max(released, normal[row, column])
            if normal[row, column] > 0.0 and not stuck[row, column]:  # at rest the law heals the coefficient exactly
                mu = min(max(coefficient[row, column], law.kinetic), law.static)
                change = max(change, abs(coefficient_after(mu, speed[row, column], dt, law) - mu))
    fall = (law.static - law.kinetic) * h
    return Falls(change, change * hardest / layer["shear"], fall * released, fall * hardest)


@njit(cache=True, _nrt=False, error_model="numpy")
def set_up(
    parts: PadParts, layer: np.void, squeeze: Squeezing, pose: Floats, law: FrictionLaw, h: float
) -> tuple[int, float, float]:
    """Fill the equation of the nodes over h: right-hand side, bounds, levers, and the start of the search.

    pose: of the object. Return the number of an error, or 0; the sum of all forces on the nodes; and the sum of the
    squares of their levers.
    """
    work, coefficient, slip_speed = parts.work, parts.friction_coefficient, parts.slip_m_s
    mean, nodes, arms = parts.mean_m_s, parts.node_xy_m, parts.creep_arms
    static, kinetic, pads = law.static, law.kinetic, layer["pads"]
    unit_squeeze, squeezed_n = squeeze
    momentum = layer["node_mass"] / h
    keep = math.exp(-h / layer["maxwell_time"])  # the share of its force that the fast arm keeps: exact
    rows, columns = work.normal.shape
    falls = kinetic < static
    scale = square = 0.0
    spring(parts.displacement_m, parts.sheet_m, layer["shear"], layer["spring"], work.pull)
    if layer["spring"] > 0.0:
        starts, lately = work.sheet.reshape(-1), parts.sheet_m_s.reshape(-1)
        for entry in range(starts.size):
            starts[entry] = lately[entry]
    right, moving, lagging = work.pull.reshape(-1), parts.velocity_m_s.reshape(-1), parts.maxwell_n.reshape(-1)
    for entry in range(right.size):
        right[entry] = momentum * moving[entry] - right[entry] - keep * lagging[entry]
    for arm in range(len(arms)):
        kept, creeping = math.exp(-h / arms[arm, 1]), parts.creep_n[arm].reshape(-1)
        for entry in range(right.size):
            right[entry] -= kept * creeping[entry]
    for row in range(rows):
        for column in range(columns):
            normal = work.normal[row, column]
            if not (normal >= 0.0 and normal < np.inf):
                return 1, 0.0, 0.0
            mu = static
            if falls:
                # a node that never bore a load is infinite; a law that changed under load takes effect at once
                mu = min(max(coefficient[row, column], kinetic), static)
                if normal > 0.0:
                    mu = coefficient_after(mu, slip_speed[row, column], h, law)
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
    return 0, pads * scale, square


@njit(cache=True, _nrt=False)
def _settle_sheet(displacement: Floats, sheet: Floats, stretch: SheetStencil, work: Work) -> None:
    """Bring the displaced sheet closer to its balance if steps have left it off balance.

    A step finds velocities within its tolerance, so the sheet would drift away with the sum of the residuals. Rounding
    errors are left, because a gel at rest would otherwise never come to rest.
    """
    for axis in range(2):  # code that displaced the sheet from outside may not have set its border
        mirror(sheet[axis], axis == 0)
    pull_sheet(displacement, work.sheet_source)
    sheet_imbalance(sheet, work.sheet_source, stretch, work.sheet_rule, work.sheet_left)
    if largest(work.sheet_left.reshape(-1)) > SHEET_OFF_M:
        relax_sheet(sheet, work.sheet_source, stretch, work.sheet_rule, work.after)


@njit(cache=True, _nrt=False)
def refresh(parts: PadParts, twist: Floats, law: FrictionLaw, h: float) -> None:
    """Set each loaded node's bound at the time of the balance, from its present slip speed."""
    work, stuck, coefficient = parts.work, parts.stuck, parts.friction_coefficient
    rows, columns = stuck.shape
    for row in range(rows):
        for column in range(columns):
            normal = work.normal[row, column]
            if normal > 0.0:
                speed = 0.0
                if not stuck[row, column]:
                    slip_x = work.velocity[row, column, 0] - twist[0] + twist[2] * work.lever[row, column, 1]
                    slip_y = work.velocity[row, column, 1] - twist[1] - twist[2] * work.lever[row, column, 0]
                    speed = math.sqrt(slip_x * slip_x + slip_y * slip_y)
                mu = min(max(coefficient[row, column], law.kinetic), law.static)
                work.bound[row, column] = normal * coefficient_after(mu, speed, h, law)


@njit(cache=True, _nrt=False, error_model="numpy")
def advance(
    parts: PadParts, layer: np.void, stretch: SheetStencil, law: FrictionLaw, dt: float, theta: float, twist: Floats
) -> Moved:
    """Advance the gel by dt with the velocities of the balance, and the object's; return its motion."""
    work, mean, stuck, coefficient = parts.work, parts.mean_m_s, parts.stuck, parts.friction_coefficient
    displacement, sheet, nodes, arms = parts.displacement_m, parts.sheet_m, parts.node_xy_m, parts.creep_arms
    static, kinetic, pads = law.static, law.kinetic, layer["pads"]
    rows, columns = stuck.shape
    for row in range(rows):
        for column in range(columns):
            for axis in range(2):
                mean[row, column, axis] = work.velocity[row, column, axis]
    if layer["spring"] > 0.0:
        moved_sheet, sheet_mean_m_s = sheet.reshape(-1), parts.sheet_m_s.reshape(-1)
        sheet_m_s = work.sheet.reshape(-1)
        for entry in range(moved_sheet.size):
            sheet_mean_m_s[entry] = sheet_m_s[entry]
            moved_sheet[entry] += dt * sheet_m_s[entry]
    spring(mean, work.sheet, layer["shear"], layer["spring"], work.search_direction)
    fade = math.exp(-dt / layer["maxwell_time"])
    build = -layer["maxwell_share"] * layer["maxwell_time"] * math.expm1(-dt / layer["maxwell_time"])
    moved, moving, lagging = displacement.reshape(-1), parts.velocity_m_s.reshape(-1), parts.maxwell_n.reshape(-1)
    here, pull = mean.reshape(-1), work.search_direction.reshape(-1)
    for entry in range(moved.size):
        moved[entry] += dt * here[entry]
        lagging[entry] = fade * lagging[entry] + build * pull[entry]
        moving[entry] += (here[entry] - moving[entry]) / theta
    if layer["spring"] > 0.0:
        _settle_sheet(displacement, sheet, stretch, work)
    for arm in range(len(arms)):
        fade, creeping = math.exp(-dt / arms[arm, 1]), parts.creep_n[arm].reshape(-1)
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
            load = work.normal[row, column]
            if work.bound[row, column] == 0.0:  # not needed for the balance, but for friction once the node is loaded
                slip_x_m_s = mean[row, column, 0] - twist[0] + twist[2] * work.lever[row, column, 1]
                slip_y_m_s = mean[row, column, 1] - twist[1] - twist[2] * work.lever[row, column, 0]
                work.slip[row, column, 0], work.slip[row, column, 1] = slip_x_m_s, slip_y_m_s
                work.speed[row, column] = math.sqrt(slip_x_m_s * slip_x_m_s + slip_y_m_s * slip_y_m_s)
            speed = work.speed[row, column]
            parts.slip_m_s[row, column] = speed
            if falls:
                mu = np.inf
                if load > 0.0:
                    mu = min(max(coefficient[row, column], kinetic), static)
                    mu = coefficient_after(mu, speed, dt, law)
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
                    heat += pads * work.bound[row, column] * speed * dt
                    pressed = max(pressed, load)
                gel_x += load * mean[row, column, 0]
                gel_y += load * mean[row, column, 1]
                slip_x -= load * work.slip[row, column, 0]
                slip_y -= load * work.slip[row, column, 1]
                shift_x += load * displacement[row, column, 0]
                shift_y += load * displacement[row, column, 1]
    share = 1.0 / total if total > 0.0 else 0.0
    return Moved(
        slipping / loaded if loaded > 0 else 1.0,
        (share * gel_x, share * gel_y),
        (share * slip_x, share * slip_y),
        (share * shift_x, share * shift_y),
        (push_sum_x, push_sum_y, moment),
        heat,
        pressed,
    )
