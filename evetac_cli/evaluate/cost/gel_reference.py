"""Other ways to solve the trial of the mechanics, to compare with: an explicit integrator, and cosine modes."""

import math

import numpy as np
from scipy.fft import dctn, idctn

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.cost.gel_trial import GelMotion, GelTrial, follow
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.pad_equation import PadConstants, spring

CREEP_M_S = 1e-3  # below about this slip speed the explicit integrator's friction is viscous
TOO_FAST_M_S = 1e3  # no part of the trial ever moves at this speed: the integrator has blown up


def simulate_explicit(trial: GelTrial, dt_s: float) -> GelMotion:
    """The trial with semi-implicit Euler and friction mu N tanh(slip speed / 1 mm/s), as is common elsewhere."""
    if trial.begin_s or trial.hang_s:
        raise ValueError(
            "the explicit integrator takes trials whose grip falls, and whose weight hangs, from the start"
        )
    state = trial.start()
    shares = trial.shares(state)
    force = np.array(trial.weight_n(0.0))
    layer = state._layer
    rate_n_s = (trial.last_n - trial.first_n) / trial.seconds

    def advance(first: int, steps: int) -> tuple[int, bool]:
        made, blown_up = _explicit_steps(
            state.displacement_m,
            state.velocity_m_s,
            state.maxwell_n,
            state.pose,
            state.twist,
            state.inertia,
            state.node_xy_m,
            shares,
            trial.first_n + rate_n_s * first * dt_s,
            rate_n_s * dt_s,
            force,
            trial.friction.static,
            dt_s,
            steps,
            layer,
        )
        return int(made), bool(blown_up)

    def sample() -> tuple[Floats, Floats]:
        return state.pose.copy(), state.displacement_m.reshape(-1, 2).copy()

    return follow(trial, dt_s, advance, sample)


# Why so many arguments: called once for a whole solution, from one place, it gains nothing from groups of them.
@njit(cache=True)
def _explicit_steps(
    displacement: Floats,
    velocity: Floats,
    maxwell: Floats,
    pose: Floats,
    twist: Floats,
    inertia: Floats,
    nodes: Floats,
    shares: Floats,
    grip: float,
    grip_change: float,
    force: Floats,
    mu: float,
    dt: float,
    steps: int,
    layer: PadConstants,
) -> tuple[int, bool]:
    """Advance in place; returns the steps made, and whether it ended early, as something moved faster than it could."""
    rows, columns = shares.shape
    stretched = np.empty_like(displacement)
    pull = np.empty_like(displacement)
    rate = np.empty_like(displacement)
    keep = math.exp(-dt / layer.maxwell_time)
    gain = -layer.maxwell_share * layer.maxwell_time * math.expm1(-dt / layer.maxwell_time)
    total = np.empty(3)
    for done in range(steps):
        for row in range(rows):
            for column in range(columns):
                for axis in range(2):
                    lag = layer.viscous_time * velocity[row, column, axis]
                    stretched[row, column, axis] = displacement[row, column, axis] + lag
        spring(stretched, layer.shear, layer.coupling_x, layer.coupling_y, pull)
        spring(velocity, layer.shear, layer.coupling_x, layer.coupling_y, rate)
        total[:] = force
        fastest = max(abs(twist[0]), abs(twist[1]))
        for row in range(rows):
            for column in range(columns):
                x = nodes[row, column, 0] - pose[0]
                y = nodes[row, column, 1] - pose[1]
                slip_x = velocity[row, column, 0] - twist[0] + twist[2] * y
                slip_y = velocity[row, column, 1] - twist[1] - twist[2] * x
                speed = math.sqrt(slip_x * slip_x + slip_y * slip_y)
                hold = mu * grip * shares[row, column]
                hold *= math.tanh(speed / CREEP_M_S) / speed if speed > 0.0 else 0.0
                rub_x = -hold * slip_x
                rub_y = -hold * slip_y
                total[0] -= layer.pads * rub_x
                total[1] -= layer.pads * rub_y
                total[2] -= layer.pads * (x * rub_y - y * rub_x)
                push_x = rub_x - pull[row, column, 0] - maxwell[row, column, 0]
                push_y = rub_y - pull[row, column, 1] - maxwell[row, column, 1]
                velocity[row, column, 0] += dt / layer.node_mass * push_x
                velocity[row, column, 1] += dt / layer.node_mass * push_y
                for axis in range(2):
                    fastest = max(fastest, abs(velocity[row, column, axis]))
                    displacement[row, column, axis] += dt * velocity[row, column, axis]
                    maxwell[row, column, axis] = keep * maxwell[row, column, axis] + gain * rate[row, column, axis]
        for axis in range(3):
            twist[axis] += dt * total[axis] / inertia[axis]
            pose[axis] += dt * twist[axis]
        grip += grip_change
        if not fastest < TOO_FAST_M_S:
            return done + 1, True
    return steps, False


# -- any layer, by its cosine modes ------------------------------------------------------------------------------------


def layer_stiffness(state: gel.GelState, order: int) -> Floats:
    """Stiffness in N/m of a node against each cosine pattern of the grid, (rows, columns), free edges.

    order 0: a G/H; 1: that of the stencil of `gel`; 2: a G k / tanh(kH), exact for a layer bonded to a stiff back.
    """
    if order not in (0, 1, 2):
        raise ValueError(f"order must be 0, 1 or 2, found {order}")
    rows, columns = state.stuck.shape
    layer = state._layer
    angle_y, angle_x = np.meshgrid(np.pi * np.arange(rows) / rows, np.pi * np.arange(columns) / columns, indexing="ij")
    if order < 2:
        bent = layer.coupling_x * (2 - 2 * np.cos(angle_x)) + layer.coupling_y * (2 - 2 * np.cos(angle_y))
        return np.asarray(layer.shear + order * bent)
    wave_height = np.hypot(angle_x / layer.pitch_x, angle_y / layer.pitch_y) * state.material.height_m
    wave_height[0, 0] = 1.0
    stiffness: Floats = layer.shear * wave_height / np.tanh(wave_height)
    stiffness[0, 0] = layer.shear
    return stiffness


def simulate_modes(
    trial: GelTrial, order: int, dt_s: float, theta: float, *, tolerance: float = 1e-6, max_rounds: int = 5000
) -> GelMotion:
    """The trial, time step by time step as `gel.step` poses it, for a layer of any order, solved in another way.

    The balance is searched by alternating directions: a linear system in cosine modes, then the friction of each node,
    then the force that makes both agree. It needs no sparse layer, and shares no code with the search of `gel`. The
    trial's material has to be coupled (order 0 leaves the coupling out here). RuntimeError after max_rounds.
    """
    state = trial.start()
    shares = trial.shares(state)
    stiffness = layer_stiffness(state, order)[..., None]
    layer = state._layer
    h = theta * dt_s
    mu = trial.friction.static
    gain = -layer.maxwell_share * layer.maxwell_time * math.expm1(-h / layer.maxwell_time)
    diagonal = layer.node_mass / h + (h + layer.viscous_time + gain) * stiffness
    penalty = math.sqrt(float(diagonal.min() * diagonal.max()))  # between the softest pattern and the stiffest
    weight = state.inertia / h / layer.pads
    slip = np.zeros_like(state.displacement_m)
    price = np.zeros_like(slip)

    def soften(field: Floats) -> Floats:
        """Solve (diagonal + penalty) x = field."""
        solution: Floats = idctn(_modes(field) / (diagonal + penalty), axes=(0, 1), norm="ortho")
        return solution

    def stiffen(field: Floats) -> Floats:
        force: Floats = idctn(_modes(field) * stiffness, axes=(0, 1), norm="ortho")
        return force

    def advance(first: int, steps: int) -> tuple[int, bool]:
        nonlocal slip, price
        for k in range(first, first + steps):
            bound = mu * trial.grip_n((k + theta) * dt_s) * shares
            right = layer.node_mass / h * state.velocity_m_s - stiffen(state.displacement_m)
            right -= math.exp(-h / layer.maxwell_time) * state.maxwell_n
            body_right = weight * state.twist + np.array(trial.weight_n((k + theta) * dt_s)) / layer.pads
            arm = state.node_xy_m - state.pose[:2]
            rigid = np.zeros((3, *arm.shape))  # how the nodes move along with the object
            rigid[0, ..., 0] = rigid[1, ..., 1] = 1.0
            rigid[2] = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)
            soft = np.stack([soften(penalty * mode) for mode in rigid])
            system = np.diag(weight) + penalty * np.tensordot(rigid, rigid - soft, ((1, 2, 3), (1, 2, 3)))
            scale = float(np.abs(right).sum() + bound.sum() + np.abs(body_right).sum())
            for _ in range(max_rounds):
                alone = soften(right + penalty * (slip - price))
                lag = penalty * (alone - slip + price)
                body = np.linalg.solve(system, body_right + np.tensordot(rigid, lag, 3))
                velocity = alone + np.tensordot(body, soft, 1)
                apart = velocity - np.tensordot(body, rigid, 1)
                wanted = apart + price
                speed = np.maximum(np.linalg.norm(wanted, axis=-1), 1e-300)
                before, slip = slip, np.maximum(0.0, 1.0 - bound / penalty / speed)[..., None] * wanted
                price = wanted - slip
                off = max(float(np.abs(apart - slip).max()), float(np.abs(slip - before).max()))
                if penalty * off <= tolerance * scale:
                    break
            else:
                raise RuntimeError(f"no balance within {max_rounds} rounds, step {k}")
            state.maxwell_n *= math.exp(-dt_s / layer.maxwell_time)
            build = -layer.maxwell_share * layer.maxwell_time * math.expm1(-dt_s / layer.maxwell_time)
            state.maxwell_n += build * stiffen(velocity)
            state.displacement_m += dt_s * velocity
            state.velocity_m_s += (velocity - state.velocity_m_s) / theta
            state.pose += dt_s * body
            state.twist += (body - state.twist) / theta
        return steps, False

    def sample() -> tuple[Floats, Floats]:
        return state.pose.copy(), state.displacement_m.reshape(-1, 2).copy()

    return follow(trial, dt_s, advance, sample)


def _modes(field: Floats) -> Floats:
    modes: Floats = dctn(field, axes=(0, 1), norm="ortho")
    return modes
