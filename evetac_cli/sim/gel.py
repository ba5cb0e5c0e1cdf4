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

Why so: a step minimises one convex function of node velocities and object twist (Moreau's time stepping), so it is
stable for any stiffness, mass, friction and time step, and sticking is exact: no creep, no regularisation speed. The
minimum is found by projected over-relaxation of the nodes, and after each sweep a Newton step of the object that takes
the sticking nodes along. The Newton step needs its exact line search: without it the object flips between the two
directions of slip on a stiff gel for ever. theta: implicit Euler over theta * dt, then extrapolated to dt. 1 damps most
and is of first order, 0.5 keeps the energy of oscillations (second order where nothing sticks or slips anew) but lets a
stick event ring on; 0.55 damps that ringing by 0.82 a step.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .contact import cell_area

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class GelMaterial:
    """What a pad is made of.

    The shear modulus and the height are those of a GelSight Mini gel (FEATS, same laboratory as Evetac); density, and
    the losses (tan delta 0.1-0.2 at 100-500 Hz), are generic values to be drawn at random. Left out on request:
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
    """Coefficients of friction, static and (at slip speeds well above stribeck_speed_m_s) kinetic."""

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
    """What one step did. Means are weighted by pressure, (x, y), and 0 without contact.

    residual: largest unbalanced force, of a node as a share of ..., see `step`.
    slip_fraction: slipping / loaded nodes; 1 without contact, where nothing sticks.
    gel_velocity_m_s, slip_velocity_m_s: mean velocity of the gel, and of the object's surface against it, over the step.
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


@dataclass(eq=False)
class GelState:
    """A pad and the object on it. The arrays are updated in place; `copy` and `restore` let a caller solve a step again.

    displacement_m, velocity_m_s, maxwell_n: (rows, columns, 2); velocity_m_s is the one at the end of a step.
    slip_m_s: (rows, columns), speed of the object's surface against the gel over the last step, exactly 0 where it sticks.
    stuck: (rows, columns), loaded and not slipping.
    pose: x, y of the object's centre of mass in m, and its rotation in rad; twist: its velocity.
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
    stuck: NDArray[np.bool_]
    _layer: Floats
    _work: Floats
    _info: Floats

    def copy(self) -> "GelState":
        """An independent copy (the node grid is shared, it never changes)."""
        twin = copy.copy(self)
        for name in (*_MOVING, "inertia", "_work", "_info"):
            setattr(twin, name, getattr(self, name).copy())
        return twin

    def restore(self, earlier: "GelState") -> None:
        """Go back to an earlier copy of this state, inertia included."""
        for name in (*_MOVING, "inertia"):
            getattr(self, name)[...] = getattr(earlier, name)


_MOVING = ("pose", "twist", "displacement_m", "velocity_m_s", "maxwell_n", "slip_m_s", "stuck")


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
    """An undeformed gel and an object at rest with its centre of mass at body_xy_m.

    node_xy_m: (rows, columns, 2), a regular grid as from `contact.pad_nodes`. cell_area_m2 is read off it, and must be
    given where there is only one row or column.
    """
    nodes = np.ascontiguousarray(node_xy_m, dtype=np.float64)
    if nodes.ndim != 3 or nodes.shape[2] != 2 or nodes.size == 0 or not np.isfinite(nodes).all():
        raise ValueError(f"node_xy_m must be finite with shape (rows, columns, 2), found shape {nodes.shape}")
    rows, columns, _ = nodes.shape
    area = cell_area(nodes) if cell_area_m2 is None else cell_area_m2
    for name, value in (
        ("body_mass_kg", body_mass_kg),
        ("body_inertia_kg_m2", body_inertia_kg_m2),
        ("pads", pads),
        ("cell_area_m2", area),
    ):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be finite and > 0, found {value}")
    pitch_x = nodes[0, 1, 0] - nodes[0, 0, 0] if columns > 1 else math.sqrt(area)
    pitch_y = nodes[1, 0, 1] - nodes[0, 0, 1] if rows > 1 else math.sqrt(area)
    regular_x = nodes[0, 0, 0] + pitch_x * np.arange(columns)
    regular_y = nodes[0, 0, 1] + pitch_y * np.arange(rows)
    regular = np.stack(np.meshgrid(regular_x, regular_y), axis=-1)
    if not (pitch_x > 0 and pitch_y > 0 and np.abs(nodes - regular).max() <= 1e-6 * min(pitch_x, pitch_y)):
        raise ValueError("node_xy_m must be a regular grid, x rising along columns and y along rows")
    shear = material.shear_modulus_pa * area / material.height_m
    in_plane = material.shear_modulus_pa * material.height_m / 3 * area if material.coupled else 0.0
    node_mass = 4 * material.density_kg_m3 * material.height_m * area / math.pi**2 if material.with_mass else 0.0
    return GelState(
        node_xy_m=nodes,
        material=material,
        pads=pads,
        cell_area_m2=area,
        inertia=np.array([body_mass_kg, body_mass_kg, body_inertia_kg_m2], dtype=np.float64),
        pose=np.array([*body_xy_m, 0.0], dtype=np.float64),
        twist=np.zeros(3),
        displacement_m=np.zeros((rows, columns, 2)),
        velocity_m_s=np.zeros((rows, columns, 2)),
        maxwell_n=np.zeros((rows, columns, 2)),
        slip_m_s=np.zeros((rows, columns)),
        stuck=np.zeros((rows, columns), dtype=np.bool_),
        _layer=np.array([node_mass, shear, in_plane / pitch_x**2, in_plane / pitch_y**2, pitch_x, pitch_y]),
        _work=np.zeros((9, rows, columns)),
        _info=np.zeros(12),
    )
