"""The gel's surface in shear, its friction, and the rigid object that it holds: one implicit step at a time.

Model, in SI units, x down, y to the side, rotation from x to y:

- Layer. A gel of height H and constant volume, bonded to a stiff back. It resists shear as a vector, more along a wave
  than across it, and pressure squeezes it aside. A sheet of nodes inside the gel, and a force by which pressure acts on
  the surface, reproduce the response of the exact layer (see kernels/gel_layer). A surface node carries the mass
  4 rho H a/pi^2, with its area a. This mass puts the first thickness resonance where the exact layer has it, at
  sqrt(G/rho)/4H = 753 Hz. Losses: Kelvin-Voigt and one Maxwell arm; slow creep, if requested, adds arms (a Prony
  series). Arms are solved exactly for a velocity that is constant within a step.
- Friction. Set-valued Coulomb friction: the friction of a node is in the disc of radius mu * normal force. If the node
  slips, its friction is on the rim, against the slip. The coefficient mu is a state of the node, which falls from
  static to kinetic with its slip speed over a memory length (see friction).
- Object. Rigid, held by two pads. If they are mirror images, one is simulated. If not, both are, each as a GelState
  (see `Stepper`). Its lever arms follow it as it moves.

A step minimises a convex function of the node velocities and the object's twist (Moreau's time stepping). It is stable
for any stiffness, mass, friction and time step. Sticking is exact: there is no numerical creep and no regularisation
speed. For the search of the minimum see force_balance.

theta: implicit Euler over theta * dt, then extrapolation to dt. The value 1 damps most and is of first order. The value
0.5 conserves the energy of oscillations and is of second order while nothing begins to stick or slip, but oscillations
never decay. The default 0.51 damps oscillations that are too fast for the step by 0.96 per step. Larger values are less
accurate. At 0.55, object and gel were 1.5 to 2 times as far from a run in steps of 10 us while the grip is released. So
were their jumps from step to step (seeds 0 to 7, measured before the gel had its sheet).
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.errors import check_range
from evetac_cli.kernels.gel_layer import SPRING, Squeeze
from evetac_cli.sim.gel.contact import cell_area
from evetac_cli.sim.gel.force_balance import Three
from evetac_cli.sim.gel.friction import FrictionLaw, half_wavelength_m
from evetac_cli.sim.gel.pad import CONSTANTS, PadArrays, empty_pad, parts_of, settle
from evetac_cli.sim.gel.pad_equation import spring
from evetac_cli.sim.gel.sheet import rule_of, sheet_stencil
from evetac_cli.sim.gel.time_step import STEP, Allowed, Load, StepRule, step_nodes

MEMORY_M = 20e-6  # a guess: the memory length of friction is unknown for this gel


@dataclass(frozen=True)
class GelMaterial:
    """Elasticity, density, losses and height of a pad.

    Shear modulus and height are those of a GelSight Mini gel (FEATS, from the same laboratory as Evetac). Density and
    losses (tan delta 0.1-0.2 at 100-500 Hz) are generic values, meant to be sampled.

    Three effects can be switched off. `coupled` False: each node is a separate spring (Winkler). `squeezes` False:
    pressure moves no gel aside. `with_mass` False: the gel follows without inertia.

    creep_share, creep_time_s: of additional Maxwell arms. The shear modulus is that after all creep;
    the stiffness under a sudden shear is 1 + all shares times as large.
    """

    shear_modulus_pa: float = 145e3
    height_m: float = 4e-3
    density_kg_m3: float = 1e3
    viscous_time_s: float = 2.4e-4
    maxwell_share: float = 0.15
    maxwell_time_s: float = 10e-3
    coupled: bool = True
    squeezes: bool = True
    with_mass: bool = True
    creep_share: tuple[float, ...] = ()
    creep_time_s: tuple[float, ...] = ()

    @property
    def arms(self) -> tuple[tuple[float, float], ...]:
        """Return the share and the time in s of all Maxwell arms."""
        usual = (self.maxwell_share, self.maxwell_time_s)
        return (usual, *zip(self.creep_share, self.creep_time_s, strict=True))


@dataclass(frozen=True)
class Friction:
    """Coefficients of friction: static at rest, falling to kinetic at slip speeds well above stribeck_speed_m_s.

    memory_m: the slip distance over which a coefficient adapts to the slip speed; 0: at once.
    """

    static: float
    kinetic: float
    stribeck_speed_m_s: float = 0.01
    memory_m: float = MEMORY_M

    def __post_init__(self) -> None:
        for entry in fields(self):
            check_range(entry.name, getattr(self, entry.name), above=entry.name == "stribeck_speed_m_s")
        check_range("kinetic", self.kinetic, 0.0, self.static)

    @cached_property
    def law(self) -> FrictionLaw:
        """Return the friction law as `step_nodes` takes it."""
        return FrictionLaw(*(float(getattr(self, entry.name)) for entry in fields(self)))


class StepInfo(NamedTuple):
    """Results of one step. Means are (x, y), weighted by pressure, and 0 without contact.

    For a gel with a friction_factor, pressure and normal force are multiplied by each node's factor.

    residual: largest unbalanced force of a node or of the object, relative to all forces on the object. converged:
    whether the residual is within the tolerance.

    slip_fraction: slipping nodes divided by loaded nodes; 1 without contact, because nothing sticks.

    gel_velocity_m_s, slip_velocity_m_s: mean velocity, over the step, of the gel and of the object's surface against
    the gel. gel_displacement_m: mean displacement of the gel at the end of the step.

    friction_n: force of the object on one pad, x, y, and its moment about the origin in N m.

    friction_change: largest change of a node's coefficient. friction_heat_j: energy dissipated by friction, on all
    pads. slipping_force_n: largest normal force of a slipping node.

    error_m: estimated error of the displacement, the larger of two values. One is the difference of the object's
    position from the trapezoidal rule. The other is the change of the gel's displacement, at the highest pressure, if
    friction stayed as at the start of the step.
    """

    sweeps: int
    residual: float
    converged: bool
    slip_fraction: float
    gel_velocity_m_s: tuple[float, float]
    slip_velocity_m_s: tuple[float, float]
    gel_displacement_m: tuple[float, float]
    friction_n: tuple[float, float, float]
    friction_change: float
    friction_heat_j: float
    slipping_force_n: float
    error_m: float
    second_friction_n: tuple[float, float, float]


class GelState:
    """A pad and the object on it. Steps change the arrays in place; `copy` and `restore` allow a step to be repeated.

    displacement_m, velocity_m_s, maxwell_n: (rows, columns, 2), at the end of the last step. mean_m_s: of the velocity,
    over that step. creep_n: (arms, rows, columns, 2), force of the slow arms.

    sheet_m, sheet_m_s: (2, rows + 2, columns + 2), displacement of the sheet and its velocity in the last step, x and y
    separately; the border has no meaning.

    slip_m_s: (rows, columns), mean speed of the object's surface against the gel in the last step, 0 for stuck nodes.
    stuck: (rows, columns), whether a node is loaded and does not slip.

    friction_coefficient: (rows, columns), of each node; infinite for unloaded nodes, which means at rest. The bound of
    a node's friction is this times its friction_factor, (rows, columns), if the gel has one.

    pose: x, y of the object's centre of mass in m and its rotation in rad; twist: its velocity.

    inertia: mass, mass and moment of inertia of the object; may be changed between steps (for example when a weight
    lands on it).
    """

    def __init__(
        self, pad: PadArrays, material: GelMaterial, pads: int, cell_area_m2: float, friction_factor: Floats | None
    ) -> None:
        self.material, self.pads, self.cell_area_m2 = material, pads, cell_area_m2
        self.friction_factor = friction_factor
        squeezes = material.coupled and material.squeezes
        self._squeeze = Squeeze(pad.node_xy_m, material.height_m) if squeezes else None
        self._hold(pad)

    def _hold(self, pad: PadArrays) -> None:
        self.pad, self.arrays, parts = pad, pad[:], parts_of.py_func(pad)
        self.node_xy_m: Floats = parts.node_xy_m
        self.inertia: Floats = parts.inertia
        self.pose: Floats = parts.pose
        self.twist: Floats = parts.twist
        self.displacement_m: Floats = parts.displacement_m
        self.velocity_m_s: Floats = parts.velocity_m_s
        self.maxwell_n: Floats = parts.maxwell_n
        self.mean_m_s: Floats = parts.mean_m_s
        self.creep_n: Floats = parts.creep_n
        self.slip_m_s: Floats = parts.slip_m_s
        self.friction_coefficient: Floats = parts.friction_coefficient
        self.sheet_m: Floats = parts.sheet_m
        self.sheet_m_s: Floats = parts.sheet_m_s
        self.stuck: Flags = parts.stuck
        self._normal: Floats = parts.work.normal

    def constant(self, name: str) -> float:
        """Return a constant of the pad, of those in `pad.CONSTANTS`."""
        return float(self.pad.constants[name][0])

    def press(self, normal: Floats) -> None:
        """Set the normal force of each node for the next step, as it counts for friction."""
        self._normal[:] = self.gripping(normal)

    def gripping(self, normal: Floats) -> Floats:
        """Return the normal force of each node, or its share, that counts for friction: times its friction_factor.

        A factor on both coefficients is equivalent to a factor on the normal force, for the bound, the memory and the
        steepness of friction. So the steps do not need the factor.
        """
        return normal if self.friction_factor is None else normal * self.friction_factor

    def squeezed(self, normal: Floats) -> Floats:
        """Return the force (rows, columns, 2) with which the nodes' normal forces, or shares, squeeze the gel aside."""
        return np.zeros_like(self.displacement_m) if self._squeeze is None else self._squeeze.of(normal)

    def settle(self) -> bool:
        """Set motion and pull that are too small to matter to 0; return whether the gel is then at rest."""
        return bool(settle(self.arrays))

    def copy(self) -> "GelState":
        """Return an independent copy of the present state."""
        twin = copy.copy(self)
        twin._hold(self.pad._replace(state=self.pad.state.copy(), sticks=self.pad.sticks.copy()))
        return twin

    def is_as(self, earlier: "GelState") -> bool:
        """Return whether gel, friction and object are as in an earlier copy, bit for bit, whatever their motion."""
        names = ("displacement_m", "sheet_m", "slip_m_s", "friction_coefficient", "stuck", "pose")
        return all(np.array_equal(getattr(self, name), getattr(earlier, name)) for name in names)

    def restore(self, earlier: "GelState") -> None:
        """Restore an earlier copy."""
        self.pad.state[:] = earlier.pad.state
        self.stuck[:] = earlier.stuck


def start(
    node_xy_m: Floats,
    material: GelMaterial,
    body_mass_kg: float,
    body_inertia_kg_m2: float,
    pads: int = 2,
    *,
    body_xy_m: tuple[float, float] = (0.0, 0.0),
    cell_area_m2: float | None = None,
    friction_factor: Floats | None = None,
) -> GelState:
    """Return an undeformed gel, and an object at rest with its centre of mass at body_xy_m.

    node_xy_m: (rows, columns, 2), a regular grid as from `contact.pad_nodes`.

    cell_area_m2: derived from the grid if None; must be given for a single row or column.

    friction_factor: (rows, columns), factor of each node on both coefficients of friction.
    """
    nodes = np.ascontiguousarray(node_xy_m, dtype=np.float64)
    assert nodes.ndim == 3 and nodes.shape[2] == 2 and nodes.size and np.isfinite(nodes).all()
    area = cell_area(nodes) if cell_area_m2 is None else float(cell_area_m2)
    assert min(body_mass_kg, body_inertia_kg_m2, pads, area) > 0
    assert len(body_xy_m) == 2 and np.isfinite(body_xy_m).all()
    rows, columns, _ = nodes.shape
    assert friction_factor is None or (friction_factor.shape == (rows, columns) and friction_factor.min() >= 0)
    pitch_x, pitch_y = _pitch_m(nodes, area)
    stretch = sheet_stencil(material.height_m, pitch_x, pitch_y)
    constants = np.zeros(1, CONSTANTS)
    values = {"pitch_x": pitch_x, "pitch_y": pitch_y, "pads": pads, **stretch._asdict(), **_constants(material, area)}
    for name, value in values.items():
        constants[name] = value
    creep_arms = np.array([material.creep_share, material.creep_time_s]).T.copy()
    pad = empty_pad(nodes, creep_arms, rule_of(stretch, rows, columns), constants)
    state = GelState(pad, material, pads, area, friction_factor)
    state.inertia[:] = body_mass_kg, body_mass_kg, body_inertia_kg_m2
    state.pose[:2] = body_xy_m
    state.friction_coefficient[:] = np.inf
    return state


def _pitch_m(nodes: Floats, area_m2: float) -> tuple[float, float]:
    """Return the distances between nodes of a regular grid; of a single row or column, those of a square cell."""
    rows, columns, _ = nodes.shape
    x_m = float(nodes[0, 1, 0] - nodes[0, 0, 0]) if columns > 1 else math.sqrt(area_m2)
    y_m = float(nodes[1, 0, 1] - nodes[0, 0, 1]) if rows > 1 else math.sqrt(area_m2)
    regular = np.stack(np.meshgrid(x_m * np.arange(columns), y_m * np.arange(rows)), axis=-1) + nodes[0, 0]
    assert x_m > 0 and y_m > 0 and np.abs(nodes - regular).max() <= 1e-6 * min(x_m, y_m)
    return x_m, y_m


def _constants(material: GelMaterial, area_m2: float) -> dict[str, float]:
    """Return the constants of a node of this area, by their names in `pad.CONSTANTS`."""
    shear = material.shear_modulus_pa * area_m2 / material.height_m
    mass = 4 * material.density_kg_m3 * material.height_m * area_m2 / math.pi**2
    return {
        "node_mass": mass if material.with_mass else 0.0,
        "shear": shear,
        "spring": SPRING * shear if material.coupled else 0.0,
        "viscous_time": material.viscous_time_s,
        "maxwell_share": material.maxwell_share,
        "maxwell_time": material.maxwell_time_s,
    }


def step(
    state: GelState,
    nodal_force_n: Floats,
    body_force_n: Sequence[float] | Floats,
    friction: Friction,
    dt_s: float,
    *,
    theta: float = 0.51,
    tolerance: float = 1e-6,
    max_sweeps: int = 400,
    prescribed_twist: Sequence[float] | Floats | None = None,
) -> StepInfo:
    """Advance gel and object by dt_s.

    nodal_force_n: (rows, columns), normal force of each node of one pad, >= 0, ideally that at the time t + theta * dt.

    body_force_n: force on the object other than friction, x, y, and its moment about the centre of mass.

    prescribed_twist: the object's velocity if it is prescribed (a table carries it, a stage drives it); body_force_n
    then has no effect.

    theta: 0.5 to 1, see the module.

    The search ends when the residual is within the tolerance, or after max_sweeps with `converged` False; the step is
    made in both cases. ValueError, before any change, if a value is not finite or out of range.
    """
    nodal = np.ascontiguousarray(nodal_force_n, dtype=np.float64)
    assert nodal.shape == state.stuck.shape
    if not np.isfinite(nodal).all():  # before the squeeze is computed from it
        raise ValueError(FAULTS[1])
    assert tolerance > 0 and max_sweeps >= 1
    check_range("dt_s", dt_s, above=True)
    check_range("theta", theta, 0.5, 1.0)
    twist = (0.0, 0.0, 0.0) if prescribed_twist is None else three(prescribed_twist)
    load = Load(three(body_force_n), prescribed_twist is not None, twist)
    rule = StepRule(float(dt_s), float(theta), float(tolerance), max_sweeps, Allowed())
    state.press(nodal)
    results = np.zeros(1, STEP)
    fault = step_nodes(state.pad, (state.squeezed(nodal), 1.0), None, load, friction.law, rule, results)
    if fault:
        raise ValueError(FAULTS[fault])
    return step_info(results, tolerance)


def three(values: Sequence[float] | Floats) -> Three:
    """Return three Python floats, which are the fastest to pass to compiled code."""
    x, y, turn = values
    return float(x), float(y), float(turn)


def step_info(results: NDArray[np.void], tolerance: float) -> StepInfo:
    """Return the results of a step from the record of dtype STEP that it filled in."""
    values: dict[str, Any] = {name: results[name][0].tolist() for name in STEP.names or ()}
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    return StepInfo(**values, converged=values["residual"] <= tolerance)


FAULTS = (  # messages for the return values of `step_nodes`
    "",
    "nodal_force_n must be finite and >= 0 at every node",
    "body_force_n and prescribed_twist must be finite",
    "state.inertia must be finite and > 0",
    "the state is not finite: it was overwritten, or extreme forces made it overflow",
)


def slip_half_wavelength_nodes(state: GelState, friction: Friction, nodal_force_n: float) -> float:
    """Return half the wavelength of slip that friction makes unstable, in nodes of the grid; see friction.

    nodal_force_n: largest normal force of a slipping node. Below 4 nodes the onset of slip depends on the grid.
    """
    half_m = half_wavelength_m(
        friction.static - friction.kinetic,
        nodal_force_n / state.cell_area_m2,
        friction.memory_m,
        state.material.shear_modulus_pa,
        state.material.height_m,
    )
    return half_m / max(state.constant("pitch_x"), state.constant("pitch_y"))


def energy(state: GelState) -> float:
    """Return the kinetic energy of the object and the energy of motion and deformation of all pads, in J.

    Energy stored in the Maxwell arms is left out: it counts as lost until it is released. So the energy, minus that of
    the undeformed start, minus the work of external forces and of pressure on the gel, is never positive.
    """
    answer = np.empty_like(state.displacement_m)
    spring(state.displacement_m, state.sheet_m, state.constant("shear"), state.constant("spring"), answer)
    pad = (state.displacement_m * answer).sum() + state.constant("node_mass") * (state.velocity_m_s**2).sum()
    return 0.5 * float((state.inertia * state.twist**2).sum() + state.pads * pad)
