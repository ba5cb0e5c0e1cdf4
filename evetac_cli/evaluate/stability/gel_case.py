"""A pad, an object and their load, for the cases of `evaluate stability sim`: initial state and steps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.cost.gel_trial import GRAVITY_M_S2
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.contact import pad_nodes

X_RANGE_M, Y_RANGE_M = (-10e-3, 10e-3), (-7.5e-3, 7.5e-3)
AREA_M2 = 300e-6
COULOMB = gel.Friction(0.8, 0.8)


@dataclass(frozen=True)
class GelCase:
    """A pad, an object, and their load; by default 100 g, held with 2 N per finger.

    - load: normal force in N over time in s;
    - force: on the object, x, y in N and moment in N m, over time; None is its weight;
    - shares: of the load on each node; None is even;
    - becomes: a time in s and the friction from then;
    - residual: the residual at which the search for a step's balance stops.
    """

    name: str
    columns: int = 24
    rows: int = 18
    material: gel.GelMaterial = gel.GelMaterial()
    mass_kg: float = 0.1
    inertia_kg_m2: float = 4e-5
    centre_m: tuple[float, float] = (0.0, 0.0)
    friction: gel.Friction = COULOMB
    becomes: tuple[float, gel.Friction] | None = None
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    load: Callable[[float], float] = lambda _: 2.0
    force: Callable[[float], Sequence[float] | Floats] | None = None
    shares: Callable[[Floats], Floats] | None = None
    dt_s: float = 1e-3
    residual: float = 1e-6

    def start(self) -> tuple[gel.GelState, Floats]:
        """Return the state before the first step, and the share of the load on each node."""
        nodes = pad_nodes(self.columns, self.rows, X_RANGE_M, Y_RANGE_M)
        area_m2 = AREA_M2 / self.columns / self.rows
        at_m = self.centre_m
        state = gel.start(nodes, self.material, self.mass_kg, self.inertia_kg_m2, body_xy_m=at_m, cell_area_m2=area_m2)
        state.twist[:] = self.twist
        shares = np.full(state.stuck.shape, 1 / state.stuck.size) if self.shares is None else self.shares(nodes)
        return state, shares

    def force_at(self, time_s: float) -> Sequence[float] | Floats:
        """Return the force on the object, x, y in N and moment in N m."""
        return (self.mass_kg * GRAVITY_M_S2, 0.0, 0.0) if self.force is None else self.force(time_s)

    def friction_at(self, time_s: float) -> gel.Friction:
        """Return the friction at a time."""
        return self.friction if self.becomes is None or time_s < self.becomes[0] else self.becomes[1]

    def step(
        self, state: gel.GelState, shares: Floats, number: int, dt_s: float, theta: float
    ) -> tuple[gel.StepInfo, float]:
        """Compute step `number`; return its step info and the work of outer forces in J.

        Outer forces are the force on the object, and that with which pressure squeezes the gel of all pads aside.
        """
        time_s = (number + theta) * dt_s
        force, friction = self.force_at(time_s), self.friction_at(time_s)
        nodal = self.load(time_s) * shares
        before, before_m = state.pose.copy(), state.displacement_m.copy()
        info = gel.step(state, nodal, force, friction, dt_s, theta=theta, tolerance=self.residual)
        squeezing_j = state.pads * float((state.squeezed(nodal) * (state.displacement_m - before_m)).sum())
        return info, float(np.dot(force, state.pose - before)) + squeezing_j


def stiff(factor: float) -> gel.GelMaterial:
    """Return the default gel with `factor` times its stiffness."""
    return gel.GelMaterial(shear_modulus_pa=factor * gel.GelMaterial().shear_modulus_pa)
