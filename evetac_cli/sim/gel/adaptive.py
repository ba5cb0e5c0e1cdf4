"""A slice of the gel in as many time steps as it needs: one while all sticks or slides evenly, more while it lets go.

A step whose estimated error is above the tolerance is made again in halves, down to a shortest step, and so is one in
which a node lets go whose friction falls too steeply for the step: see `time_step.Allowed`. Steps get longer again
where two short ones end together and their errors are far below the tolerance. What is estimated: see
`gel.StepInfo.error_m`. The estimate is that of one step, and says nothing about what a trial makes of it: what a
tolerance costs and gives in onset of slip and displacement is measured by `evaluate cost`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.time_step import Allowed
from evetac_cli.sim.solver import MOST_HALVINGS, Solver

Floats = NDArray[np.float64]

# Of `Allowed.steepness`. Why so: at the default tolerance the onset of slip is within 0.25 ms of that of steps of 10 us
# in 16 trials of each plan of tests/numerics/gel/test_letting_go.py (seeds 0 to 15); at 0.4 one is 0.47 ms off, at 0.6
# one 1.2 ms. In the slip scene it takes 1.20 steps a slice instead of 1.03 (object 8), 1.56 instead of 1.10 (18).
STEEPEST = 0.25
LONGER = 0.3  # of the tolerance: below it steps get twice as long again, which makes the error two to four times


@dataclass
class Slice:
    """What the steps of one slice did together.

    steps: how many there were. error_m: the largest estimated error of one. slip_m: how far the object slid against the
    gel, (x, y), mean over the contact. friction_n, slipping_force_n, friction_heat_j: as of `gel.StepInfo`, mean over
    time, largest and sum.
    """

    steps: int = 0
    error_m: float = 0.0
    slip_m: tuple[float, float] = (0.0, 0.0)
    friction_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slipping_force_n: float = 0.0
    friction_heat_j: float = 0.0

    def add(self, info: gel.StepInfo, dt_s: float, share: float) -> None:
        """Count a step of dt_s, which is this share of the slice."""
        self.steps += 1
        self.error_m = max(self.error_m, info.error_m)
        x, y = info.slip_velocity_m_s
        self.slip_m = (self.slip_m[0] + dt_s * x, self.slip_m[1] + dt_s * y)
        along, across, moment = self.friction_n
        self.friction_n = (
            along + share * info.friction_n[0],
            across + share * info.friction_n[1],
            moment + share * info.friction_n[2],
        )
        self.slipping_force_n = max(self.slipping_force_n, info.slipping_force_n)
        self.friction_heat_j += info.friction_heat_j


@dataclass
class Stepper:
    """Cuts slices into steps; remembers how short the last one was."""

    solver: Solver
    slice_s: float = 1e-3
    _halved: int = 0

    def advance(
        self,
        state: gel.GelState,
        shares: Floats,
        force_n: tuple[float, float],
        body_force_n: Sequence[float] | Floats,
        friction: gel.Friction,
        prescribed_twist: Sequence[float] | Floats | None = None,
        each: Callable[[gel.StepInfo, float], None] | None = None,
    ) -> Slice:
        """Move gel and object on by a slice.

        shares: (rows, columns), the part of the normal force that each node bears, together 1, or 0 without contact;
        force_n: that force in N on one pad at the start and the end of the slice. each: called after each step, with
        what it did and how long it was in s. The rest as for `gel.step`.
        """
        done = Slice()
        solver = self.solver
        first_n, last_n = force_n
        theta = solver.theta
        if prescribed_twist is not None and not any(prescribed_twist):
            theta = 1.0  # nothing swings on an object that is held still: damped most, the gel comes to rest soonest
        allowed_m = solver.tolerance_um * 1e-6
        anything = Allowed()
        part = 0.0
        while part < 1.0:
            share = 1.0 / solver.fixed_steps if solver.fixed_steps else 0.5**self._halved
            dt_s = share * self.slice_s
            nodal_n = shares * (first_n + (part + theta * share) * (last_n - first_n))
            allowed = anything
            if not solver.fixed_steps and self._halved < MOST_HALVINGS:
                allowed = Allowed(allowed_m, STEEPEST, self._halved >= solver.halvings)
            info = gel.step_within(
                state,
                nodal_n,
                body_force_n,
                friction,
                dt_s,
                allowed,
                theta=theta,
                tolerance=solver.residual,
                prescribed_twist=prescribed_twist,
            )
            if info is None:
                self._halved += 1
                continue
            done.add(info, dt_s, share)
            if each is not None:
                each(info, dt_s)
            part = done.steps / solver.fixed_steps if solver.fixed_steps else part + share
            # longer steps again, but only where two short ones end together
            if self._halved > 0 and info.error_m < LONGER * allowed_m and part / (2.0 * share) % 1.0 == 0.0:
                self._halved -= 1
        return done
