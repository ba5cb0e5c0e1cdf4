"""A simulated pad that holds an object, and its load: what `evaluate cost` and `evaluate stability` solve."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.gel.contact import gap_profile, pad_nodes, pressure
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.scenes.true_slip import GroundTruthSlip
from evetac_cli.sim.setup.scene import Solver

X_RANGE_M, Y_RANGE_M = (-10e-3, 10e-3), (-7.5e-3, 7.5e-3)
MM_PER_PX = 0.0329  # of the default sensor


def under_cylinder(tilt_rad: float) -> Callable[[Floats], Floats]:
    """Return a function from nodes to the share of the load on each, under a cylinder, tilted by misaligned fingers."""
    return lambda nodes: np.asarray(pressure(0.4e-3, gap_profile(nodes, "cylinder", 0.06, tilt_rad), 1.0))


@dataclass(frozen=True)
class GelCase:
    """A pad, an object, and their load; by default 100 g, held with 2 N per finger.

    - load: normal force in N over time in s;
    - force: on the object, x, y in N and moment in N m, over time; None is its weight;
    - shares: of the load on each node, with sum 1; None is even;
    - becomes: a time in s and the friction from then;
    - dt_s, residual: of steps of equal length, and where the search for a step's balance stops;
    - seconds: duration of a slide, within which the object should begin to slip; 0: some steps of dt_s.
    """

    name: str = ""
    columns: int = 24
    rows: int = 18
    material: gel.GelMaterial = gel.GelMaterial()
    mass_kg: float = 0.1
    inertia_kg_m2: float = 4e-5
    centre_m: tuple[float, float] = (0.0, 0.0)
    friction: gel.Friction = gel.Friction(0.8, 0.8)
    becomes: tuple[float, gel.Friction] | None = None
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    load: Callable[[float], float] = lambda _: 2.0
    force: Callable[[float], Sequence[float] | Floats] | None = None
    shares: Callable[[Floats], Floats] | None = None
    dt_s: float = 1e-3
    residual: float = 1e-6
    seconds: float = 0.0

    def start(self, cell_area_m2: float | None = None) -> tuple[gel.GelState, Floats]:
        """Return the state before the first step, and the share of the load on each node; the area: see gel.start."""
        nodes = pad_nodes(self.columns, self.rows, X_RANGE_M, Y_RANGE_M)
        body = (self.mass_kg, self.inertia_kg_m2)
        state = gel.start(nodes, self.material, *body, body_xy_m=self.centre_m, cell_area_m2=cell_area_m2)
        state.twist[:] = self.twist
        return state, np.full(state.stuck.shape, 1 / state.stuck.size) if self.shares is None else self.shares(nodes)

    def force_at(self, time_s: float) -> Sequence[float] | Floats:
        """Return the force on the object, x, y in N and moment in N m."""
        return (self.mass_kg * GRAVITY_M_S2, 0.0, 0.0) if self.force is None else self.force(time_s)

    def friction_at(self, time_s: float) -> gel.Friction:
        """Return the friction at a time."""
        return self.friction if self.becomes is None or time_s < self.becomes[0] else self.becomes[1]


class SolvedSlice(NamedTuple):
    """A slice of a case that was solved: its state, which changes, the slip at its end, and its run time.

    The run time is thread time, so that other programs do not count.
    """

    state: gel.GelState
    slip: GroundTruthSlip
    took_us: float


def solved_slices(case: GelCase, solver: Solver, cell_area_m2: float | None = None) -> Iterator[SolvedSlice]:
    """Solve a case from start to end, slice by slice; all of the pad is visible."""
    state, shares = case.start(cell_area_m2)
    stepper, slip = Stepper(solver), GroundTruthSlip(state, MM_PER_PX, None)
    for number in range(round(case.seconds / stepper.slice_s)):
        begin_s, middle_s, end_s = ((number + part) * stepper.slice_s for part in (0.0, 0.5, 1.0))
        ends_n, force = (case.load(begin_s), case.load(end_s)), case.force_at(middle_s)
        started = time.thread_time()
        stepper.advance(state, shares, ends_n, force, case.friction_at(begin_s))
        took_us = (time.thread_time() - started) * 1e6
        slip.follow(state, shares, ends_n[1])
        yield SolvedSlice(state, slip, took_us)
