"""What the numerical choices of the mechanics cost and what they are worth: error against a reference, and run time.

One trial is simulated again and again: a cylinder of 100 g, held slightly tilted and beside its centre of mass, while
the grip falls from 2 to 0.2 N within 0.2 s. It bounces on the gel, slips in part, turns, and falls. Compared are the
integrator and its time step, the number of nodes, and the layer's answer to a pattern of wave number k (order 0: G/H,
springs of their own; order 1: G/H (1 + (kH)^2/3), the one in use; order 2: G k / tanh(kH), exact for a bonded layer).

Why so: each comparison changes one choice and has a reference of its own that differs in that choice only, so that the
errors of the others do not hide it. How far the reference in time is itself off is bounded by step doubling: with a
method of first order, the solution at twice the step differs from it by what it differs from the truth.

An error is the root mean square over samples every 10 ms: of the distance between the object's positions, and of the
distance between displacements of the gel over nodes (or points). Times are those of one simulated millisecond, on one
core, without the waiting that other programs cause.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from evetac_cli.sim import gel
from evetac_cli.sim.contact import gap_profile, pad_nodes, pressure

Floats = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
PAD_M = (20e-3, 15e-3)
SAMPLE_S = 0.01
BLOCK_S = 1e-3  # run time is taken block by block, or step by step where a step is longer

THETAS = (1.0, 0.55, 0.5)
REFERENCE_THETA = 0.51
CREEP_M_S = 1e-3  # below about this slip speed the explicit integrator's friction is viscous
TOO_FAST_M_S = 1e3  # no part of the trial ever moves at this speed: the integrator has blown up


@dataclass(frozen=True)
class Extent:
    """What is compared: time steps, of which each divides 10 ms, and grids (columns, rows)."""

    steps_us: tuple[float, ...] = (10_000, 5_000, 2_000, 1_000, 500, 200, 100)
    explicit_us: tuple[float, ...] = (1_000, 100, 20, 10, 8, 5, 4, 2, 1)
    reference_us: float = 5.0
    nodes: tuple[tuple[int, int], ...] = ((8, 10), (14, 10), (24, 18), (32, 24))
    finest: tuple[int, int] = (64, 48)

    @property
    def rows(self) -> int:
        """How many rows these comparisons give: with the three references, and the layers of order 0 and 1."""
        return len(THETAS) * len(self.steps_us) + len(self.explicit_us) + len(self.nodes) + 5


USUAL = Extent()
FULL = Extent(
    steps_us=(*USUAL.steps_us, 50, 20),
    explicit_us=(*USUAL.explicit_us, 0.5, 0.25),
    reference_us=2.0,
    nodes=(*USUAL.nodes, (48, 36)),
    finest=(96, 72),
)


@dataclass(frozen=True)
class Trial:
    """What is simulated: grid, material, object, contact, and a grip that falls evenly from first to last."""

    columns: int = 24
    rows: int = 18
    material: gel.GelMaterial = gel.GelMaterial()
    friction: gel.Friction = gel.Friction(0.8, 0.8)
    mass_kg: float = 0.1
    inertia_kg_m2: float = 4e-5
    centre_m: tuple[float, float] = (0.0, 0.0)
    radius_m: float = 0.06
    tilt_rad: float = 0.0
    indentation_m: float = 0.4e-3
    first_n: float = 2.0
    last_n: float = 0.2
    seconds: float = 0.2

    def start(self) -> gel.GelState:
        """The pad and the object, at rest."""
        x, y = PAD_M
        nodes = pad_nodes(self.columns, self.rows, (-x / 2, x / 2), (-y / 2, y / 2))
        return gel.start(nodes, self.material, self.mass_kg, self.inertia_kg_m2, body_xy_m=self.centre_m)

    def shares(self, state: gel.GelState) -> Floats:
        """The part of the grip that each node bears, (rows, columns), together 1."""
        gap = gap_profile(state.node_xy_m, "cylinder", self.radius_m, self.tilt_rad)
        return np.asarray(pressure(self.indentation_m, gap, 1.0))

    def grip_n(self, time_s: float) -> float:
        """Normal force on one pad."""
        return self.first_n + (self.last_n - self.first_n) * min(time_s / self.seconds, 1.0)

    @property
    def weight_n(self) -> tuple[float, float, float]:
        """Gravity, along x, through the centre of mass."""
        return (self.mass_kg * GRAVITY_M_S2, 0.0, 0.0)


def draw_trial(seed: int) -> Trial:
    """The trial of a seed: it says how far the fingers are tilted and how far beside its centre the object is held."""
    rng = np.random.default_rng(seed)
    tilt_rad = rng.choice([-1, 1]) * rng.uniform(0.005, 0.015)
    centre_m = (rng.uniform(-2e-3, 2e-3), rng.choice([-1, 1]) * rng.uniform(1e-3, 2e-3))
    return Trial(tilt_rad=float(tilt_rad), centre_m=(float(centre_m[0]), float(centre_m[1])))


class Motion(NamedTuple):
    """What a simulation gave, sampled every 10 ms, and its run time.

    pose: (samples, 3); gel_m: displacement, (samples, points, 2), of all nodes or of the points asked for.
    block_us: run time of each block, as microseconds for a simulated millisecond.
    blown_up_s: the time at which the integrator blew up, and with it all samples; NaN where it did not.
    """

    pose: Floats
    gel_m: Floats
    block_us: Floats
    blown_up_s: float = math.nan


Advance = Callable[[int, int], tuple[int, bool]]  # (first step, number of steps) -> (steps made, blown up)


def _follow(trial: Trial, dt_s: float, advance: Advance, sample: Callable[[], tuple[Floats, Floats]]) -> Motion:
    """Advance a trial to its end, with the clock running, and sample it."""
    steps_a_sample = round(SAMPLE_S / dt_s)
    if abs(steps_a_sample * dt_s / SAMPLE_S - 1) > 1e-9:
        raise ValueError(f"dt_s must divide {SAMPLE_S} s, found {dt_s}")
    steps_a_block = max(1, round(BLOCK_S / dt_s))
    poses, fields, blocks, done = [], [], [], 0
    for _ in range(round(trial.seconds / SAMPLE_S)):
        for first in range(0, steps_a_sample, steps_a_block):
            steps = min(steps_a_block, steps_a_sample - first)
            started = time.thread_time()
            made, blown_up = advance(done, steps)
            blocks.append((time.thread_time() - started) / (made * dt_s) * 1e3)
            done += made
            if blown_up:
                return Motion(np.empty((0, 3)), np.empty((0, 0, 2)), np.array(blocks), done * dt_s)
        pose, field = sample()
        poses.append(pose)
        fields.append(field)
    return Motion(np.array(poses), np.array(fields), np.array(blocks))


def simulate(
    trial: Trial, dt_s: float, theta: float, *, tolerance: float = 1e-6, points_xy_m: Floats | None = None
) -> Motion:
    """The trial with `gel.step`; ValueError where dt_s does not divide 10 ms."""
    state = trial.start()
    shares = trial.shares(state)
    where = None if points_xy_m is None else gel.interpolation(state.node_xy_m, points_xy_m)

    def advance(first: int, steps: int) -> tuple[int, bool]:
        for k in range(first, first + steps):
            nodal_n = trial.grip_n((k + theta) * dt_s) * shares
            gel.step(state, nodal_n, trial.weight_n, trial.friction, dt_s, theta=theta, tolerance=tolerance)
        return steps, False

    def sample() -> tuple[Floats, Floats]:
        field = state.displacement_m.reshape(-1, 2) if where is None else gel.displacement_at(state, *where)
        return state.pose.copy(), field.copy()

    return _follow(trial, dt_s, advance, sample)


# -- an explicit integrator, for comparison ----------------------------------------------------------------------------


def simulate_explicit(trial: Trial, dt_s: float) -> Motion:
    """The trial with semi-implicit Euler and friction mu N tanh(slip speed / 1 mm/s), as is common elsewhere."""
    state = trial.start()
    shares = trial.shares(state)
    force = np.array(trial.weight_n)
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

    return _follow(trial, dt_s, advance, sample)


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
    layer: gel._Layer,
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
        gel._spring(stretched, layer.shear, layer.coupling_x, layer.coupling_y, pull)
        gel._spring(velocity, layer.shear, layer.coupling_x, layer.coupling_y, rate)
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
    trial: Trial, order: int, dt_s: float, theta: float, *, tolerance: float = 1e-6, max_rounds: int = 5000
) -> Motion:
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
        found: Floats = idctn(_modes(field) / (diagonal + penalty), axes=(0, 1), norm="ortho")
        return found

    def stiffen(field: Floats) -> Floats:
        found: Floats = idctn(_modes(field) * stiffness, axes=(0, 1), norm="ortho")
        return found

    def advance(first: int, steps: int) -> tuple[int, bool]:
        nonlocal slip, price
        for k in range(first, first + steps):
            bound = mu * trial.grip_n((k + theta) * dt_s) * shares
            right = layer.node_mass / h * state.velocity_m_s - stiffen(state.displacement_m)
            right -= math.exp(-h / layer.maxwell_time) * state.maxwell_n
            body_right = weight * state.twist + np.array(trial.weight_n) / layer.pads
            arm = state.node_xy_m - state.pose[:2]
            rigid = np.zeros((3, *arm.shape))  # how the nodes move along with the object
            rigid[0, ..., 0] = rigid[1, ..., 1] = 1.0
            rigid[2] = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)
            soft = np.stack([soften(penalty * way) for way in rigid])
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

    return _follow(trial, dt_s, advance, sample)


def _modes(field: Floats) -> Floats:
    found: Floats = dctn(field, axes=(0, 1), norm="ortho")
    return found


# -- rows --------------------------------------------------------------------------------------------------------------


def errors_um(motion: Motion, reference: Motion) -> tuple[float, float]:
    """Root mean square distance from a reference of the object's position, and of the gel; NaN after a blow-up."""
    if len(motion.pose) == 0:
        return math.nan, math.nan
    square = ((motion.pose - reference.pose)[:, :2] ** 2).sum(-1).mean()
    gel_square = ((motion.gel_m - reference.gel_m) ** 2).sum(-1).mean()
    return 1e6 * math.sqrt(square), 1e6 * math.sqrt(gel_square)


def row(setting: str, motion: Motion, reference: Motion | None, outcome: str = "finished") -> dict[str, Any]:
    """The row of a setting; without a reference it is one itself and has no error."""
    blown_up = not math.isnan(motion.blown_up_s)
    object_um, gel_um = errors_um(motion, reference) if reference else (math.nan, math.nan)
    return {
        "part": "mechanics",
        "setting": setting,
        "error_um_object_rms": None if math.isnan(object_um) else object_um,
        "error_um_gel_rms": None if math.isnan(gel_um) else gel_um,
        "time_us_median": float(np.median(motion.block_us)),
        "time_us_p99": float(np.percentile(motion.block_us, 99)),
        "times_real_time": 1e3 / float(np.mean(motion.block_us)),
        "outcome": f"blew up after {motion.blown_up_s * 1e3:.3g} ms" if blown_up else outcome,
    }


def in_words(dt_us: float) -> str:
    """A time step: 1 ms, 0.1 ms, 20 us."""
    return f"{dt_us / 1e3:g} ms" if dt_us >= 100 else f"{dt_us:g} us"


def time_reference(trial: Trial, dt_us: float = USUAL.reference_us) -> tuple[Motion, dict[str, Any]]:
    """The reference in time at a step far below all others, and its row: errors bounded by step doubling.

    Its theta of 0.51 leaves next to nothing of the first order, and still damps the ringing. An error falls at least in
    proportion to the step, e(2 dt) >= 2 e(dt), so the difference of the two solutions, the row's error, is >= e(dt).
    """
    twice = simulate(trial, 2e-6 * dt_us, REFERENCE_THETA, tolerance=1e-8)
    once = simulate(trial, 1e-6 * dt_us, REFERENCE_THETA, tolerance=1e-8)
    setting = f"reference: theta {REFERENCE_THETA:g}, dt {in_words(dt_us)}"
    return once, row(setting, once, twice, "error bounded by step doubling")


def implicit_row(trial: Trial, reference: Motion, theta: float, dt_us: float) -> dict[str, Any]:
    """`gel.step` at a theta and a time step."""
    return row(f"theta {theta:g}, dt {in_words(dt_us)}", simulate(trial, 1e-6 * dt_us, theta), reference)


def explicit_row(trial: Trial, reference: Motion, dt_us: float) -> dict[str, Any]:
    """The explicit integrator at a time step, also where it blows up."""
    return row(f"explicit, dt {in_words(dt_us)}", simulate_explicit(trial, 1e-6 * dt_us), reference)


def node_rows(
    trial: Trial,
    counts: Iterable[tuple[int, int]] = USUAL.nodes,
    finest: tuple[int, int] = USUAL.finest,
    dt_s: float = 1e-3,
) -> Iterator[dict[str, Any]]:
    """Grids against a much finer one, all at theta 0.55 and the same time step; the gel is compared at 8 x 7 points."""
    x, y = 0.45 * PAD_M[0], 0.45 * PAD_M[1]
    points = pad_nodes(8, 7, (-x, x), (-y, y)).reshape(-1, 2)

    def motion(columns: int, rows: int) -> Motion:
        return simulate(replace(trial, columns=columns, rows=rows), dt_s, 0.55, points_xy_m=points)

    reference = motion(*finest)
    for columns, rows in counts:
        yield row(f"{columns} x {rows} nodes", motion(columns, rows), reference)
    yield row(f"{finest[0]} x {finest[1]} nodes", reference, None, "the reference of the grids")


def layer_rows(trial: Trial, dt_s: float = 1e-3) -> Iterator[dict[str, Any]]:
    """Layers of order 0 and 1 by `gel.step` against order 2 by its cosine modes, same grid and time step."""
    reference = simulate_modes(trial, 2, dt_s, 0.55)
    for order in (0, 1):
        there = replace(trial, material=replace(trial.material, coupled=order == 1))
        yield row(f"layer order {order}", simulate(there, dt_s, 0.55), reference)
    yield row("layer order 2, cosine modes", reference, None, "the reference of the layers")


def mechanics_cost(seed: int = 0, extent: Extent = USUAL) -> Iterator[dict[str, Any]]:
    """All rows of the mechanics, one after the other: `extent.rows` of them."""
    trial = draw_trial(seed)
    short = replace(trial, seconds=SAMPLE_S)
    simulate(short, 1e-3, 0.55)  # compiles
    simulate_explicit(short, 1e-5)
    reference, bound = time_reference(trial, extent.reference_us)
    yield bound
    for theta in THETAS:
        for dt_us in extent.steps_us:
            yield implicit_row(trial, reference, theta, dt_us)
    for dt_us in extent.explicit_us:
        yield explicit_row(trial, reference, dt_us)
    yield from node_rows(trial, extent.nodes, extent.finest)
    yield from layer_rows(trial)
