"""The gel's surface in shear, its friction, and the rigid object it holds: one implicit step at a time.

Model, in SI units, x down, y to the side, rotation from x to y:

- Layer. A gel of height H bonded to a stiff back. On a grid of nodes of area a, the surface displacement u is answered
  by K u = a G/H u - (a G H/3) laplace(u), the Galerkin form for a displacement linear in depth. Its compliance to a
  pattern of wave number k is 1/(G/H + G H k^2/3), that of the exact layer tanh(kH)/(G k): 0.1 % apart at kH = 0.5, 5 %
  at 1.5, 25 % at 3 (a wavelength of 8.4 mm). A node carries the mass 4 rho H a/pi^2, which puts the first thickness
  resonance where the exact layer has it, at sqrt(G/rho)/4H = 753 Hz. Losses: Kelvin-Voigt, and one Maxwell arm.
- Friction. Set-valued Coulomb: the friction of a node lies in the disc of radius mu * normal force; where the node
  slips it lies on the rim, against the slip. mu falls from static to kinetic with the slip speed of the step before.
- Object. Rigid, held by two mirrored pads, of which one is simulated. Its lever arms follow it as it moves.

Why so: a step minimises one convex function of the node velocities and the object's twist (Moreau's time stepping). It
is stable for any stiffness, mass, friction and time step, and sticking is exact: no creep, no regularisation speed.
The minimum is found in rounds: sweeps of projected over-relaxation over the nodes, then a Newton step of the object in
which the nodes that stick move along. Its exact line search keeps the object from flipping for ever between the two
directions of slip on a stiff gel. Catching the nodes that the step would bring to rest, so that they move along too,
keeps partial slip cheap: without it a single node about to stick stops the object again and again (400 sweeps and no
balance where now 20 are enough).

theta: implicit Euler over theta * dt, then extrapolated to dt. 1 damps most and is of first order. 0.5 keeps the energy
of oscillations and is of second order while nothing begins to stick or slip; but the velocities ring on after each
such event, and where kinetic friction is below static that ringing breaks the stick again: do not use it there. 0.55,
the default, damps the ringing by 0.82 a step.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.sim.contact import cell_area

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

DECAY_M = 2.3e-3  # lateral decay of the motion of a layer 4 mm high outside a contact: H / sqrt(3)

# How the balance is searched; measured on 24 x 18 nodes under a tilted cylinder that begins to slip.
SWEEPS_A_ROUND = 3  # 1, 2 and 3 took 120, 94 and 81 us a step
REACHES = (1.0, 0.3, 0.03, 1e-3, 1e-6, 0.0)  # a Newton step catches the nodes that this share of it brings to rest,
WORTHWHILE = 0.1  # and the first step is taken of which at least this part leads down, else the last
ROUNDING = 1e-12  # a slip below this share of the object's speed sticks: its direction is lost, and with it the search


@dataclass(frozen=True)
class GelMaterial:
    """What a pad is made of.

    Shear modulus and height are those of a GelSight Mini gel (FEATS, from the same laboratory as Evetac). Density and
    losses (tan delta 0.1-0.2 at 100-500 Hz) are generic values, to be drawn at random. To leave out on request:
    `coupled` False, each node is a spring of its own (Winkler); `with_mass` False, the gel follows without inertia.
    """

    shear_modulus_pa: float = 145e3
    height_m: float = 4e-3
    density_kg_m3: float = 1e3
    viscous_time_s: float = 2.4e-4
    maxwell_share: float = 0.15
    maxwell_time_s: float = 10e-3
    coupled: bool = True
    with_mass: bool = True

    def __post_init__(self) -> None:
        for name in ("shear_modulus_pa", "height_m", "density_kg_m3", "maxwell_time_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be finite and > 0, found {value}")
        for name in ("viscous_time_s", "maxwell_share"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be finite and >= 0, found {value}")


@dataclass(frozen=True)
class Friction:
    """Coefficients of friction: static at rest, falling to kinetic at slip speeds well above stribeck_speed_m_s."""

    static: float
    kinetic: float
    stribeck_speed_m_s: float = 0.01

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{entry.name} must be finite and >= 0, found {value}")
        if self.kinetic > self.static:
            raise ValueError(f"kinetic must be <= static, found {self.kinetic} > {self.static}")
        if self.stribeck_speed_m_s == 0:
            raise ValueError("stribeck_speed_m_s must be > 0, found 0")


class StepInfo(NamedTuple):
    """What one step did. Means are (x, y), weighted by pressure, and 0 without contact.

    residual: largest force left unbalanced, of a node or of the object, as a share of all forces on the object.
    slip_fraction: slipping / loaded nodes; 1 without contact, where nothing sticks.
    gel_velocity_m_s, slip_velocity_m_s: mean velocity over the step of the gel, and of the object's surface against it.
    gel_displacement_m: mean displacement of the gel at the end of the step.
    friction_n: force of the object on one pad, x, y, and its moment about the origin in N m.
    """

    sweeps: int
    residual: float
    converged: bool
    slip_fraction: float
    gel_velocity_m_s: tuple[float, float]
    slip_velocity_m_s: tuple[float, float]
    gel_displacement_m: tuple[float, float]
    friction_n: tuple[float, float, float]


class _Layer(NamedTuple):
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


class _Stencil(NamedTuple):
    """The matrix of the nodes in one time step: own + links on the diagonal, -link to each neighbour."""

    own: float
    link_x: float
    link_y: float
    pitch_x: float
    pitch_y: float
    pads: float


class _Work(NamedTuple):
    """Memory for one step, (rows, columns[, 2]); `velocity` and `loose` have a border of zeros all around.

    velocity: mean velocity of the nodes over the step, the unknown; right: right-hand side of their equation.
    lever: place of the nodes seen from the object's centre; bound: mu * normal force; diagonal: of the stencil.
    pull: the friction each node asks for; slip, speed: its velocity against the object's surface, and the size of that.
    loose: 1 where a node does not move along with the object; way: how the nodes answer a move of the object.
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
    way: Floats


@dataclass(eq=False)
class GelState:
    """A pad and the object on it. Steps change the arrays in place; `copy` and `restore` allow to solve a step again.

    displacement_m, velocity_m_s, maxwell_n: (rows, columns, 2), at the end of the last step.
    slip_m_s: (rows, columns), mean speed of the object's surface against the gel in the last step, 0 where it sticks.
    stuck: (rows, columns), loaded and not slipping.
    pose: x, y of the object's centre of mass in m and its rotation in rad; twist: its velocity.
    inertia: mass, mass and moment of inertia of the object; may be changed between steps (a weight lands on it).
    """

    node_xy_m: Floats
    material: GelMaterial
    pads: int
    cell_area_m2: float
    inertia: Floats
    pose: Floats
    twist: Floats
    displacement_m: Floats
    velocity_m_s: Floats
    maxwell_n: Floats
    slip_m_s: Floats
    stuck: Flags
    _mean_m_s: Floats
    _layer: _Layer
    _info: Floats

    def copy(self) -> "GelState":
        """The state as it is now, independent of what happens to this one."""
        twin = copy.copy(self)
        for name in _CHANGING:
            setattr(twin, name, getattr(self, name).copy())
        return twin

    def restore(self, earlier: "GelState") -> None:
        """Go back to an earlier copy."""
        for name in _CHANGING:
            getattr(self, name)[...] = getattr(earlier, name)


_CHANGING = (
    "inertia",
    "pose",
    "twist",
    "displacement_m",
    "velocity_m_s",
    "maxwell_n",
    "slip_m_s",
    "stuck",
    "_mean_m_s",
)


def start(
    node_xy_m: Floats,
    material: GelMaterial,
    body_mass_kg: float,
    body_inertia_kg_m2: float,
    pads: int = 2,
    *,
    body_xy_m: tuple[float, float] = (0.0, 0.0),
    cell_area_m2: float | None = None,
) -> GelState:
    """An undeformed gel, and an object at rest with its centre of mass at body_xy_m.

    node_xy_m: (rows, columns, 2), a regular grid as from `contact.pad_nodes`. cell_area_m2 is read off it, and must be
    given where there is only one row or column.
    """
    nodes = np.ascontiguousarray(node_xy_m, dtype=np.float64)
    if nodes.ndim != 3 or nodes.shape[2] != 2 or nodes.size == 0 or not np.isfinite(nodes).all():
        raise ValueError(f"node_xy_m must be finite with shape (rows, columns, 2), found shape {nodes.shape}")
    area = cell_area(nodes) if cell_area_m2 is None else float(cell_area_m2)
    for name, value in (
        ("body_mass_kg", body_mass_kg),
        ("body_inertia_kg_m2", body_inertia_kg_m2),
        ("pads", pads),
        ("cell_area_m2", area),
    ):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be finite and > 0, found {value}")
    if len(body_xy_m) != 2 or not np.isfinite(body_xy_m).all():
        raise ValueError(f"body_xy_m must be two finite numbers, found {body_xy_m}")
    rows, columns, _ = nodes.shape
    pitch_x = float(nodes[0, 1, 0] - nodes[0, 0, 0]) if columns > 1 else math.sqrt(area)
    pitch_y = float(nodes[1, 0, 1] - nodes[0, 0, 1]) if rows > 1 else math.sqrt(area)
    regular = np.stack(np.meshgrid(pitch_x * np.arange(columns), pitch_y * np.arange(rows)), axis=-1) + nodes[0, 0]
    if not (pitch_x > 0 and pitch_y > 0 and np.abs(nodes - regular).max() <= 1e-6 * min(pitch_x, pitch_y)):
        raise ValueError("node_xy_m must be a regular grid, x rising along columns and y along rows")
    in_plane = material.shear_modulus_pa * material.height_m / 3 * area if material.coupled else 0.0
    layer = _Layer(
        node_mass=4 * material.density_kg_m3 * material.height_m * area / math.pi**2 if material.with_mass else 0.0,
        shear=material.shear_modulus_pa * area / material.height_m,
        coupling_x=in_plane / pitch_x**2,
        coupling_y=in_plane / pitch_y**2,
        pitch_x=pitch_x,
        pitch_y=pitch_y,
        viscous_time=float(material.viscous_time_s),
        maxwell_share=float(material.maxwell_share),
        maxwell_time=float(material.maxwell_time_s),
        pads=float(pads),
    )
    grid = (rows, columns)
    return GelState(
        node_xy_m=nodes,
        material=material,
        pads=pads,
        cell_area_m2=area,
        inertia=np.array([body_mass_kg, body_mass_kg, body_inertia_kg_m2], dtype=np.float64),
        pose=np.array([*body_xy_m, 0.0], dtype=np.float64),
        twist=np.zeros(3),
        displacement_m=np.zeros((*grid, 2)),
        velocity_m_s=np.zeros((*grid, 2)),
        maxwell_n=np.zeros((*grid, 2)),
        slip_m_s=np.zeros(grid),
        stuck=np.zeros(grid, dtype=np.bool_),
        _mean_m_s=np.zeros((*grid, 2)),
        _layer=layer,
        _info=np.zeros(12),
    )


def step(
    state: GelState,
    nodal_force_n: Floats,
    body_force_n: Sequence[float] | Floats,
    friction: Friction,
    dt_s: float,
    *,
    theta: float = 0.55,
    tolerance: float = 1e-6,
    max_sweeps: int = 400,
    prescribed_twist: Sequence[float] | Floats | None = None,
) -> StepInfo:
    """Move gel and object on by dt_s.

    nodal_force_n: (rows, columns) normal force of each node of one pad, >= 0, best that at the time t + theta * dt.
    body_force_n: force on the object beside friction, x, y, and its moment about the centre of mass.
    prescribed_twist: the object moves just so (a table carries it, a stage drives it) and body_force_n has no effect.
    theta: 0.5 to 1, see the module. The search ends when the residual is within the tolerance, or with `converged`
    False after max_sweeps; the step is made in either case. ValueError, before anything is changed, where a value is
    not finite or out of range.
    """
    nodal = np.ascontiguousarray(nodal_force_n, dtype=np.float64)
    force = np.ascontiguousarray(body_force_n, dtype=np.float64)
    wanted = state.twist if prescribed_twist is None else np.ascontiguousarray(prescribed_twist, dtype=np.float64)
    if nodal.shape != state.stuck.shape:
        raise ValueError(f"nodal_force_n must have the shape of the grid {state.stuck.shape}, found {nodal.shape}")
    if force.shape != (3,) or wanted.shape != (3,):
        raise ValueError(f"body_force_n and prescribed_twist must have shape (3,), found {force.shape}, {wanted.shape}")
    if not (math.isfinite(dt_s) and dt_s > 0):
        raise ValueError(f"dt_s must be finite and > 0, found {dt_s}")
    if not (0.5 <= theta <= 1.0 and tolerance > 0 and max_sweeps >= 1):
        raise ValueError(
            "theta must be within [0.5, 1], tolerance > 0 and max_sweeps >= 1,"
            f" found {theta}, {tolerance} and {max_sweeps}"
        )
    fault = _step(
        state.displacement_m,
        state.velocity_m_s,
        state.maxwell_n,
        state._mean_m_s,
        state.slip_m_s,
        state.stuck,
        state.pose,
        state.twist,
        state.inertia,
        state.node_xy_m,
        nodal,
        force,
        prescribed_twist is not None,
        wanted,
        float(friction.static),
        float(friction.kinetic),
        float(friction.stribeck_speed_m_s),
        float(dt_s),
        float(theta),
        float(tolerance),
        max_sweeps,
        state._layer,
        state._info,
    )
    if fault:
        raise ValueError(_FAULTS[fault])
    info = state._info.tolist()
    return StepInfo(
        sweeps=int(info[0]),
        residual=info[1],
        converged=info[1] <= tolerance,
        slip_fraction=info[2],
        gel_velocity_m_s=(info[3], info[4]),
        slip_velocity_m_s=(info[5], info[6]),
        gel_displacement_m=(info[7], info[8]),
        friction_n=(info[9], info[10], info[11]),
    )


_FAULTS = (
    "",
    "nodal_force_n must be finite and >= 0 at every node",
    "body_force_n and prescribed_twist must be finite",
    "state.inertia must be finite and > 0",
    "the state is not finite: it was overwritten, or forces beyond all measure made it overflow",
)


def energy(state: GelState) -> float:
    """Energy in J of the object's motion, and of the motion and deformation of all pads.

    What the Maxwell arms store is left out: it is counted as lost until it comes back, so that energy at a time, less
    that at an undeformed start, less the work of outer forces, is never positive.
    """
    spring = np.empty_like(state.displacement_m)
    layer = state._layer
    _spring(state.displacement_m, layer.shear, layer.coupling_x, layer.coupling_y, spring)
    pad = (state.displacement_m * spring).sum() + layer.node_mass * (state.velocity_m_s**2).sum()
    return 0.5 * float((state.inertia * state.twist**2).sum() + state.pads * pad)


def interpolation(node_xy_m: Floats, points_xy_m: Floats, decay_m: float = DECAY_M) -> tuple[NDArray[np.intp], Floats]:
    """Nodes and weights, both (points, 4), that give the displacement of points on the gel from that of the nodes.

    Bilinear between nodes and constant to the border of the pad (the outer sides of its cells); beyond, the value at
    the border decays with exp(-distance / decay_m), as the motion of a bonded layer does outside a contact.
    """
    points = np.asarray(points_xy_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(f"points_xy_m must be finite with shape (points, 2), found shape {points.shape}")
    if not (math.isfinite(decay_m) and decay_m > 0):
        raise ValueError(f"decay_m must be finite and > 0, found {decay_m}")
    rows, columns, _ = node_xy_m.shape
    low = np.empty((2, len(points)), dtype=np.intp)
    high = np.empty_like(low)
    part = np.empty((2, len(points)))
    beyond = np.empty((2, len(points)))
    for axis, line in enumerate((node_xy_m[0, :, 0], node_xy_m[:, 0, 1])):
        half = (line[1] - line[0]) / 2 if len(line) > 1 else 0.0
        place = points[:, axis]
        beyond[axis] = np.maximum(0.0, np.maximum(line[0] - half - place, place - line[-1] - half))
        index = np.interp(place, line, np.arange(len(line)))
        low[axis] = np.minimum(index.astype(np.intp), len(line) - 1)
        high[axis] = np.minimum(low[axis] + 1, len(line) - 1)
        part[axis] = index - low[axis]
    reach = np.exp(-np.hypot(*beyond) / decay_m)
    corners = [(low, low, 1 - part[0], 1 - part[1]), (high, low, part[0], 1 - part[1])]
    corners += [(low, high, 1 - part[0], part[1]), (high, high, part[0], part[1])]
    indices = np.stack([at_y[1] * columns + at_x[0] for at_x, at_y, _, _ in corners], axis=-1)
    weights = np.stack([reach * share_x * share_y for _, _, share_x, share_y in corners], axis=-1)
    return indices, weights


def displacement_at(state: GelState, indices: NDArray[np.intp], weights: Floats) -> Floats:
    """Displacement in m, (points, 2), of the points for which `interpolation` gave these indices and weights."""
    displacement: Floats = field_at(state.displacement_m, indices, weights)
    return displacement


@njit(cache=True)
def field_at(field: Floats, indices: NDArray[np.intp], weights: Floats) -> Floats:
    """Values (points, parts) of a field of the nodes, (rows, columns, parts), where `interpolation` says."""
    parts = field.shape[2]
    nodes = field.reshape(field.shape[0] * field.shape[1], parts)
    found = np.zeros((len(indices), parts))
    for point in range(len(indices)):
        for corner in range(indices.shape[1]):
            for part in range(parts):
                found[point, part] += nodes[indices[point, corner], part] * weights[point, corner]
    return found


@njit(cache=True)
def _spring(field: Floats, shear: float, coupling_x: float, coupling_y: float, answer: Floats) -> None:
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
def _links(index: int, count: int) -> int:
    """How many neighbours a node has along a line of count nodes."""
    return min(index, 1) + min(count - 1 - index, 1)


@njit(cache=True)
def shrink(x: float, y: float, by: float) -> float:
    """The share of a vector that is left when its length is made less by `by`; 0 where it is not longer than that.

    This is all there is of Coulomb's law in the search: what a node would slip, less what its friction holds.
    """
    square = x * x + y * y
    return 1.0 - by / math.sqrt(square) if square > by * by else 0.0


@njit(cache=True)
def _relax(work: _Work, stencil: _Stencil, twist: Floats, stuck: Flags, factor: float) -> None:
    """One sweep of projected over-relaxation over the nodes, the object's twist held.

    Nodes go in the order of a chess board, first one colour, then the other: those of one colour do not wait for each
    other, neither in the processor nor in the result, which so keeps the symmetries of the problem.
    """
    velocity = work.velocity
    rows, columns = work.bound.shape
    for colour in range(2):
        for row in range(rows):
            for column in range((row + colour) % 2, columns, 2):
                sum_x = work.right[row, column, 0]
                sum_y = work.right[row, column, 1]
                sum_x += stencil.link_x * (velocity[row + 1, column, 0] + velocity[row + 1, column + 2, 0])
                sum_y += stencil.link_x * (velocity[row + 1, column, 1] + velocity[row + 1, column + 2, 1])
                sum_x += stencil.link_y * (velocity[row, column + 1, 0] + velocity[row + 2, column + 1, 0])
                sum_y += stencil.link_y * (velocity[row, column + 1, 1] + velocity[row + 2, column + 1, 1])
                body_x = twist[0] - twist[2] * work.lever[row, column, 1]
                body_y = twist[1] + twist[2] * work.lever[row, column, 0]
                ease = factor / work.diagonal[row, column]
                slip_x = (1.0 - factor) * velocity[row + 1, column + 1, 0] + ease * sum_x - body_x
                slip_y = (1.0 - factor) * velocity[row + 1, column + 1, 1] + ease * sum_y - body_y
                hold = ease * work.bound[row, column]
                left = shrink(slip_x, slip_y, hold)
                if left * (abs(slip_x) + abs(slip_y)) <= ROUNDING * (abs(body_x) + abs(body_y)):
                    left = 0.0
                stuck[row, column] = hold > 0.0 and left == 0.0
                velocity[row + 1, column + 1, 0] = body_x + left * slip_x
                velocity[row + 1, column + 1, 1] = body_y + left * slip_y


@njit(cache=True)
def _imbalance(work: _Work, stencil: _Stencil, twist: Floats, stuck: Flags, felt: Floats) -> float:
    """Largest force left unbalanced at a node; fills pull, slip, speed, and felt (3), what a pad does to the object."""
    velocity = work.velocity
    rows, columns = work.bound.shape
    worst = 0.0
    felt[:] = 0.0
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
                force_x = -bound * (slip_x / speed) if speed > 0.0 else 0.0
                force_y = -bound * (slip_y / speed) if speed > 0.0 else 0.0
                left = math.sqrt((pull_x - force_x) ** 2 + (pull_y - force_y) ** 2)
            worst = max(worst, left)
            work.pull[row, column, 0] = pull_x
            work.pull[row, column, 1] = pull_y
            work.slip[row, column, 0] = slip_x
            work.slip[row, column, 1] = slip_y
            work.speed[row, column] = speed
            felt[0] += force_x
            felt[1] += force_y
            felt[2] += x * force_y - y * force_x
    return worst


@njit(cache=True)
def _curvature(work: _Work, stencil: _Stencil, curvature: Floats) -> None:
    """Add a pad's stiffness against moves of the object to curvature, (3, 3), of which only the upper triangle is kept.

    Nodes that are not loose move along, and bring their springs. A loose node lags behind: its friction resists a turn
    of the slip, in series with the node's own diagonal.
    """
    loose = work.loose
    rows, columns = work.bound.shape
    for row in range(rows):
        for column in range(columns):
            x = work.lever[row, column, 0]
            y = work.lever[row, column, 1]
            speed = work.speed[row, column]
            if loose[row + 1, column + 1] == 0.0:
                free_x = loose[row + 1, column] + loose[row + 1, column + 2]
                free_y = loose[row, column + 1] + loose[row + 2, column + 1]
                # a link between two nodes that move along is bent by a rotation only; each end counts half
                turn_x = 0.5 * stencil.link_x * stencil.pitch_x**2 * (_links(column, columns) - free_x)
                turn_y = 0.5 * stencil.link_y * stencil.pitch_y**2 * (_links(row, rows) - free_y)
                stiff = stencil.own + stencil.link_x * free_x + stencil.link_y * free_y
                curvature[0, 0] += stiff
                curvature[1, 1] += stiff
                curvature[0, 2] -= stiff * y
                curvature[1, 2] += stiff * x
                curvature[2, 2] += stiff * (x * x + y * y) + turn_x + turn_y
            elif speed > 0.0 and work.bound[row, column] > 0.0:
                along_x = work.slip[row, column, 0] / speed
                along_y = work.slip[row, column, 1] / speed
                arm = x * along_x + y * along_y
                bound = work.bound[row, column]
                stiff = bound * work.diagonal[row, column] / (bound + work.diagonal[row, column] * speed)
                curvature[0, 0] += stiff * along_y * along_y
                curvature[0, 1] -= stiff * along_y * along_x
                curvature[1, 1] += stiff * along_x * along_x
                curvature[0, 2] -= stiff * along_y * arm
                curvature[1, 2] += stiff * along_x * arm
                curvature[2, 2] += stiff * arm * arm


@njit(cache=True)
def _follow(work: _Work, move: Floats, reach: float) -> int:
    """Fill way, how each node answers a move of the object; returns how many loose nodes the move would bring to rest.

    Those are caught: they are about to stick, and the move has to be found again with them coming to rest.
    """
    rows, columns = work.bound.shape
    caught = 0
    for row in range(rows):
        for column in range(columns):
            move_x = move[0] - move[2] * work.lever[row, column, 1]
            move_y = move[1] + move[2] * work.lever[row, column, 0]
            speed = work.speed[row, column]
            bound = work.bound[row, column]
            if work.loose[row + 1, column + 1] == 0.0:
                work.way[row, column, 0] = move_x - work.slip[row, column, 0]
                work.way[row, column, 1] = move_y - work.slip[row, column, 1]
            elif speed > 0.0 and bound > 0.0:
                along_x = work.slip[row, column, 0] / speed
                along_y = work.slip[row, column, 1] / speed
                if reach * (along_x * move_x + along_y * move_y) >= speed:
                    work.loose[row + 1, column + 1] = 0.0
                    caught += 1
                across = along_x * move_y - along_y * move_x
                across *= bound / (bound + work.diagonal[row, column] * speed)
                work.way[row, column, 0] = -across * along_y
                work.way[row, column, 1] = across * along_x
            else:
                work.way[row, column, 0] = 0.0
                work.way[row, column, 1] = 0.0
    return caught


@njit(cache=True)
def _smooth(work: _Work, stencil: _Stencil) -> tuple[float, float]:
    """Slope and curvature, along way, of one pad's potential without friction."""
    way = work.way
    rows, columns = work.bound.shape
    slope = 0.0
    curvature = 0.0
    for row in range(rows):
        for column in range(columns):
            for axis in range(2):
                here = way[row, column, axis]
                slope += here * work.pull[row, column, axis]
                curvature += stencil.own * here * here
                if column > 0:
                    curvature += stencil.link_x * (here - way[row, column - 1, axis]) ** 2
                if row > 0:
                    curvature += stencil.link_y * (here - way[row - 1, column, axis]) ** 2
    return slope, curvature


@njit(cache=True)
def _rubbing(work: _Work, move: Floats, part: float) -> float:
    """Slope of one pad's friction potential, the sum of bound * |slip|, after a part of a move of object and nodes."""
    rows, columns = work.bound.shape
    slope = 0.0
    for row in range(rows):
        for column in range(columns):
            if work.speed[row, column] > 0.0:
                drift_x = work.way[row, column, 0] - move[0] + move[2] * work.lever[row, column, 1]
                drift_y = work.way[row, column, 1] - move[1] - move[2] * work.lever[row, column, 0]
                slip_x = work.slip[row, column, 0] + part * drift_x
                slip_y = work.slip[row, column, 1] + part * drift_y
                speed = math.sqrt(slip_x * slip_x + slip_y * slip_y)
                if speed > 0.0:
                    slope += work.bound[row, column] * (slip_x * drift_x + slip_y * drift_y) / speed
    return slope


@njit(cache=True)
def _solve3(matrix: Floats, right: Floats, least: Floats) -> Floats:
    """Solution of a symmetric 3 x 3 system of which the upper triangle is given, and of which the pivots are >= least.

    That they are follows from the diagonal least being one positive summand of the matrix; rounding may forget it.
    """
    pivot_0 = max(matrix[0, 0], least[0])
    low_10 = matrix[0, 1] / pivot_0
    low_20 = matrix[0, 2] / pivot_0
    pivot_1 = max(matrix[1, 1] - low_10 * matrix[0, 1], least[1])
    cross = matrix[1, 2] - low_10 * matrix[0, 2]
    low_21 = cross / pivot_1
    pivot_2 = max(matrix[2, 2] - low_20 * matrix[0, 2] - low_21 * cross, least[2])
    half_1 = right[1] - low_10 * right[0]
    half_2 = right[2] - low_20 * right[0] - low_21 * half_1
    third = half_2 / pivot_2
    second = half_1 / pivot_1 - low_21 * third
    first = right[0] / pivot_0 - low_10 * second - low_20 * third
    return np.array([first, second, third])


@njit(cache=True)
def _find_move(
    work: _Work, stencil: _Stencil, weight: Floats, inertial: Floats, felt: Floats, stuck: Flags, reach: float
) -> Floats:
    """Newton step of the object, found again with the nodes that a share `reach` of it brings to rest; fills way."""
    rows, columns = stuck.shape
    for row in range(rows):
        for column in range(columns):
            work.loose[row + 1, column + 1] = 0.0 if stuck[row, column] else 1.0
    curvature = np.empty((3, 3))
    move = np.zeros(3)
    for _ in range(4):
        curvature[:] = 0.0
        _curvature(work, stencil, curvature)
        curvature *= stencil.pads
        for axis in range(3):
            curvature[axis, axis] += weight[axis]
        move = _solve3(curvature, -inertial - stencil.pads * felt, weight)
        if _follow(work, move, reach) == 0:
            break
    return move


@njit(cache=True)
def _search(work: _Work, stencil: _Stencil, move: Floats, weight: Floats, inertial: Floats) -> float:
    """Exact line search: the part, 0 to 1, of a move (with way) at which the potential is least; 0 if it only rises."""
    slope, bend = _smooth(work, stencil)
    slope = stencil.pads * slope + (inertial * move).sum()
    bend = stencil.pads * bend + (weight * move * move).sum()
    start = slope + stencil.pads * _rubbing(work, move, 0.0)
    low = 0.0
    high = 1.0
    part = 1.0
    for _ in range(50):
        here = slope + part * bend + stencil.pads * _rubbing(work, move, part)
        if here <= -1e-9 * start:
            low = part
            if part == 1.0 or here >= 1e-3 * start:
                break
        else:
            high = part
        part = 0.5 * (low + high)
    return low if start < 0.0 else 0.0


@njit(cache=True)
def _move_object(
    work: _Work, stencil: _Stencil, twist: Floats, weight: Floats, inertial: Floats, felt: Floats, stuck: Flags
) -> None:
    """Newton step of the object, and of the nodes that answer it.

    weight: inertia / (theta dt); inertial: the object's own unbalanced force; felt: what the nodes of a pad add to it.
    To catch nodes is to guess which of them will stick. Where that leads nowhere fewer are caught, at last none: with
    the nodes in balance such a step always leads down, if only as far as the next node that comes to rest.
    """
    rows, columns = stuck.shape
    move = np.zeros(3)
    part = 0.0
    for reach in REACHES:
        move = _find_move(work, stencil, weight, inertial, felt, stuck, reach)
        part = _search(work, stencil, move, weight, inertial)
        if part >= WORTHWHILE:
            break
    for axis in range(3):
        twist[axis] += part * move[axis]
    for row in range(rows):
        for column in range(columns):
            for axis in range(2):
                work.velocity[row + 1, column + 1, axis] += part * work.way[row, column, axis]


@njit(cache=True)
def _step(
    displacement: Floats,
    velocity: Floats,
    maxwell: Floats,
    mean: Floats,
    slip_speed: Floats,
    stuck: Flags,
    pose: Floats,
    twist: Floats,
    inertia: Floats,
    nodes: Floats,
    nodal: Floats,
    force: Floats,
    prescribed: bool,
    wanted: Floats,
    mu_static: float,
    mu_kinetic: float,
    stribeck: float,
    dt: float,
    theta: float,
    tolerance: float,
    max_sweeps: int,
    layer: _Layer,
    info: Floats,
) -> int:
    """One time step in place; returns 0, or the number of what is wrong, before anything is changed."""
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
    lag = h + layer.viscous_time + gain
    stencil = _Stencil(
        layer.node_mass / h + lag * layer.shear,
        lag * layer.coupling_x,
        lag * layer.coupling_y,
        layer.pitch_x,
        layer.pitch_y,
        layer.pads,
    )
    grid = (rows, columns)
    work = _Work(  # made anew: ten arrays handed over from Python took 5 us more, of 12 for a step of one node
        np.zeros((rows + 2, columns + 2, 2)),
        np.empty((rows, columns, 2)),
        np.empty((rows, columns, 2)),
        np.empty(grid),
        np.empty(grid),
        np.empty((rows, columns, 2)),
        np.empty((rows, columns, 2)),
        np.empty(grid),
        np.zeros((rows + 2, columns + 2)),
        np.empty((rows, columns, 2)),
    )
    _spring(displacement, layer.shear, layer.coupling_x, layer.coupling_y, work.right)
    scale = abs(force[0]) + abs(force[1])
    square = 0.0
    for row in range(rows):
        for column in range(columns):
            load = nodal[row, column]
            if not (load >= 0.0 and load < np.inf):
                return 1
            mu = mu_static
            if slip_speed[row, column] > 0.0:
                ratio = slip_speed[row, column] / stribeck
                mu = mu_kinetic + (mu_static - mu_kinetic) * math.exp(-ratio * ratio)
            links_x = _links(column, columns) * stencil.link_x
            links_y = _links(row, rows) * stencil.link_y
            work.bound[row, column] = mu * load
            work.diagonal[row, column] = stencil.own + links_x + links_y
            scale += layer.pads * mu * load
            for axis in range(2):
                momentum = layer.node_mass / h * velocity[row, column, axis]
                right = momentum - work.right[row, column, axis] - keep * maxwell[row, column, axis]
                if not math.isfinite(right):
                    return 4
                scale += layer.pads * abs(right)
                work.right[row, column, axis] = right
                lever = nodes[row, column, axis] - pose[axis]
                square += lever * lever
                work.lever[row, column, axis] = lever
                work.velocity[row + 1, column + 1, axis] = mean[row, column, axis]
    # a moment counts as the force that makes it at the mean distance of the nodes from the object's centre
    reach = math.sqrt(square / nodal.size + layer.pitch_x * layer.pitch_y)
    scale = max(scale + abs(force[2]) / reach, 1e-300)
    # the factor of over-relaxation that is best for a smooth pattern on this grid
    ring = 2.0 * (stencil.link_x + stencil.link_y)
    smoothness = ring / (stencil.own + ring)
    factor = 2.0 / (1.0 + math.sqrt(1.0 - smoothness * smoothness))
    body = wanted.copy()
    weight = inertia / h
    felt = np.zeros(3)
    sweeps = 0
    while True:
        # one sweep is enough where everything sticks; after that a sweep costs less than the rest of a round
        for _ in range(min(SWEEPS_A_ROUND, max_sweeps - sweeps) if sweeps > 0 else 1):
            _relax(work, stencil, body, stuck, factor)
            sweeps += 1
        worst = _imbalance(work, stencil, body, stuck, felt)
        inertial = weight * (body - twist) - force
        if not prescribed:
            left = np.abs(inertial + layer.pads * felt)
            worst = max(worst, left[0], left[1], left[2] / reach)
        if worst <= tolerance * scale or sweeps >= max_sweeps:
            break
        if not prescribed:
            _move_object(work, stencil, body, weight, inertial, felt, stuck)
    info[:] = 0.0
    info[0] = sweeps
    info[1] = worst / scale
    _advance(displacement, velocity, maxwell, mean, slip_speed, stuck, nodes, nodal, dt, theta, layer, work, info)
    for axis in range(3):
        pose[axis] += dt * body[axis]
        twist[axis] = body[axis] if prescribed else twist[axis] + (body[axis] - twist[axis]) / theta
    return 0


@njit(cache=True)
def _advance(
    displacement: Floats,
    velocity: Floats,
    maxwell: Floats,
    mean: Floats,
    slip_speed: Floats,
    stuck: Flags,
    nodes: Floats,
    nodal: Floats,
    dt: float,
    theta: float,
    layer: _Layer,
    work: _Work,
    info: Floats,
) -> None:
    """Move the gel on by dt with the velocities found, and sum up what happened in info[2:]."""
    rows, columns = nodal.shape
    mean[:] = work.velocity[1:-1, 1:-1]
    _spring(mean, layer.shear, layer.coupling_x, layer.coupling_y, work.way)
    fade = math.exp(-dt / layer.maxwell_time)
    build = -layer.maxwell_share * layer.maxwell_time * math.expm1(-dt / layer.maxwell_time)
    total = 0.0
    loaded = 0
    slipping = 0
    for row in range(rows):
        for column in range(columns):
            load = nodal[row, column]
            speed = work.speed[row, column]
            slip_speed[row, column] = speed
            total += load
            if load > 0.0:
                loaded += 1
            if load > 0.0 and not stuck[row, column]:
                slipping += 1
            push_x = work.pull[row, column, 0] if stuck[row, column] else 0.0
            push_y = work.pull[row, column, 1] if stuck[row, column] else 0.0
            if speed > 0.0:
                push_x = -work.bound[row, column] * (work.slip[row, column, 0] / speed)
                push_y = -work.bound[row, column] * (work.slip[row, column, 1] / speed)
            info[9] += push_x
            info[10] += push_y
            info[11] += nodes[row, column, 0] * push_y - nodes[row, column, 1] * push_x
            for axis in range(2):
                here = mean[row, column, axis]
                displacement[row, column, axis] += dt * here
                maxwell[row, column, axis] = fade * maxwell[row, column, axis] + build * work.way[row, column, axis]
                velocity[row, column, axis] += (here - velocity[row, column, axis]) / theta
                info[3 + axis] += load * here
                info[5 + axis] -= load * work.slip[row, column, axis]
                info[7 + axis] += load * displacement[row, column, axis]
    info[2] = slipping / loaded if loaded > 0 else 1.0
    for entry in range(3, 9):
        info[entry] = info[entry] / total if total > 0.0 else 0.0
