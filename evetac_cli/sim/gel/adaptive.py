"""A slice of the gel in as many time steps as it needs: one while all sticks or slides evenly, more while it lets go.

A step whose estimated error is above the tolerance is made again in halves, down to a shortest step, and so is one in
which a node lets go whose friction falls too steeply for the step: see `time_step.Allowed`. Steps get longer again
where two short ones end together and their errors are far below the tolerance. What is estimated: see
`gel.StepInfo.error_m`. The estimate is that of one step, and says nothing about what a trial makes of it: what a
tolerance costs and gives in onset of slip and displacement is measured by `evaluate cost`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.force_balance import Three
from evetac_cli.sim.gel.pad_equation import Fields, FrictionLaw, LayerConstants
from evetac_cli.sim.gel.time_step import TOO_LONG, NodeArrays, step_nodes
from evetac_cli.sim.setup.solver import MOST_HALVINGS, Solver

# Of `Allowed.steepness`. Why so, by figures of a gel as stiff along a wave as across it: at the default tolerance the
# onset of slip is within 0.25 ms of that of steps of 10 us in 16 trials of each plan of
# tests/evaluate/cost/test_letting_go.py (seeds 0 to 15); at 0.4 one is 0.47 ms off, at 0.6 one 1.2 ms. The slip scene
# takes 1.20 steps a slice instead of 1.03 (object 8), 1.56 instead of 1.10 (18). Where the object's motion is
# prescribed it begins to slip when it is told to, and any steepness is allowed: in the scene `edge` dots are 0.004 px
# rms off steps of 0.0125 ms (a handle, seed 1), with the rule 0.0004 px in 1.2 times the time.
STEEPEST = 0.25
LONGER = 0.3  # of the tolerance: below it steps get twice as long again, which makes the error two to four times
MOST_SWEEPS = 400


class Slice(NamedTuple):
    """What the steps of one slice did together.

    steps: how many there were. error_m: the largest estimated error of one. slip_m: how far the object slid against the
    gel, (x, y), mean over the contact. friction_n, slipping_force_n, friction_heat_j: as of `gel.StepInfo`, mean over
    time, largest and sum. second_friction_n: as friction_n, on the second finger's pad where that is simulated, too;
    the heat and the largest force are those of both.
    """

    steps: int = 0
    error_m: float = 0.0
    slip_m: tuple[float, float] = (0.0, 0.0)
    friction_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slipping_force_n: float = 0.0
    friction_heat_j: float = 0.0
    second_friction_n: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class Stepper:
    """Cuts slices into steps; remembers how short the last one was.

    second: the second finger's pad, where it is no mirror image of the first: a GelState that holds the same object,
    of which only the pad counts; both have `pads` 1.
    """

    solver: Solver
    slice_s: float = 1e-3
    second: gel.GelState | None = None

    def __post_init__(self) -> None:
        # the part of the slice that is done, how often it is halved, and the last step in s
        self._progress = np.zeros(3)
        self._sums = np.zeros(12)
        self._fixed_steps = self.solver.fixed_steps or 0
        self._rule = (self.solver.tolerance_um * 1e-6, self.solver.halvings)
        # of each pad, the shares that were squeezed last, and what that made
        self._kept: dict[int, tuple[gel.GelState, Floats, Floats]] = {}

    def advance(
        self,
        state: gel.GelState,
        shares: Floats,
        force_n: tuple[float, float],
        body_force_n: Sequence[float] | Floats,
        friction: gel.Friction,
        prescribed_twist: Sequence[float] | Floats | None = None,
        each: Callable[[gel.StepInfo, float], None] | None = None,
        second_shares: Floats | None = None,
    ) -> Slice:
        """Move gel and object on by a slice.

        shares: (rows, columns), the part of the normal force that each node bears, together 1, or 0 without contact;
        a new array for each new pressure, as what it squeezes aside is kept for as long as it is the same one.
        force_n: that force in N on one pad at the start and the end of the slice. each: called after each step, with
        what it did and how long it was in s. The rest as for `gel.step`.
        """
        solver, progress, sums = self.solver, self._progress, self._sums
        if shares.shape != state.stuck.shape:
            raise ValueError(f"shares must have the shape of the grid {state.stuck.shape}, found {shares.shape}")
        theta = solver.theta
        wanted = (0.0, 0.0, 0.0)
        if prescribed_twist is not None:
            wanted = _three(prescribed_twist)
            if not any(wanted):  # nothing swings on an object that is held still: damped most, the gel rests soonest
                theta = 1.0
        load = (
            state.gripping(shares),
            self._squeezed(0, state, shares),
            *force_n,
            _three(body_force_n),
            prescribed_twist is not None,
            wanted,
        )
        settings = (self.slice_s, theta, solver.residual, self._fixed_steps)
        arrays, law = state.arrays, friction.law
        second = None
        if self.second is not None:
            if second_shares is None or second_shares.shape != self.second.stuck.shape:
                raise ValueError(f"second_shares must have the shape of the second grid {self.second.stuck.shape}")
            squeeze = self._squeezed(1, self.second, second_shares)
            second = (self.second.fields, self.second.gripping(second_shares), squeeze, self.second.layer_constants)
        progress[0] = 0.0
        sums[:] = 0.0
        while progress[0] < 1.0:
            results = (progress, sums, state.info)
            one = each is not None
            fault = _step_slice(arrays, load, law, settings, self._rule, state.layer_constants, results, one, second)
            if fault:
                raise ValueError(gel.FAULTS[fault])
            if each is not None:
                each(gel.step_info(state.info, solver.residual), float(progress[2]))
        steps, error_m, slip_x, slip_y, x_n, y_n, moment, slipping_force_n, heat_j, x_2, y_2, moment_2 = sums.tolist()
        first_n, second_n = (x_n, y_n, moment), (x_2, y_2, moment_2)
        return Slice(int(steps), error_m, (slip_x, slip_y), first_n, slipping_force_n, heat_j, second_n)

    def _squeezed(self, pad: int, state: gel.GelState, shares: Floats) -> Floats:
        """What pressure squeezes on a pad, worked out anew where it is another pad or another array of shares."""
        kept = self._kept.get(pad)
        if kept is None or kept[0] is not state or kept[1] is not shares:
            kept = self._kept[pad] = (state, shares, state.squeezed(shares))
        return kept[2]


def _three(given: Sequence[float] | Floats) -> Three:
    """Three numbers of Python, as compiled code is handed them soonest."""
    x, y, turn = given
    return float(x), float(y), float(turn)


@njit(cache=True, inline="always")
def _nodal_forces(memory: Floats, shares: Floats, normal_n: float) -> Floats:
    """Shares of nodes (rows, columns) of a normal force, in the memory of their pad."""
    rows, columns = shares.shape
    nodal_n = memory[-3 - rows * columns : -3].reshape(rows, columns)
    for row in range(rows):
        for column in range(columns):
            nodal_n[row, column] = shares[row, column] * normal_n
    return nodal_n


@njit(cache=True, _nrt=False)
def _step_slice(
    arrays: NodeArrays,
    load: tuple[Floats, Floats, float, float, Three, bool, Three],
    friction: FrictionLaw,
    settings: tuple[float, float, float, int],
    rule: tuple[float, int],
    constants: LayerConstants,
    results: tuple[Floats, Floats, Floats],
    one: bool,
    second: tuple[Fields, Floats, Floats, LayerConstants] | None,
) -> int:
    """The steps of a slice from where `progress` says, or only `one`; returns 0, or the number of what is wrong.

    Why so: handed over to Python after each step, a slice took 9 us more for each.
    """
    shares, squeeze, first_n, last_n, force, prescribed, wanted = load
    slice_s, theta, residual, fixed_steps = settings
    allowed_m, halvings = rule
    progress, sums, info = results
    while progress[0] < 1.0:
        halved = int(progress[1])
        share = 1.0 / fixed_steps if fixed_steps else math.ldexp(1.0, -halved)
        dt_s = share * slice_s
        normal_n = first_n + (progress[0] + theta * share) * (last_n - first_n)
        nodal_n = _nodal_forces(arrays[13], shares, normal_n)
        if second is None:
            second_pad = None
        else:
            fields_2, shares_2, squeeze_2, constants_2 = second
            nodal_2_n = _nodal_forces(fields_2[10], shares_2, normal_n)
            second_pad = (fields_2, nodal_2_n, (squeeze_2, normal_n), constants_2)
        most_m, steepest, shortest = math.inf, math.inf, True
        if not fixed_steps and halved < MOST_HALVINGS:
            most_m, steepest, shortest = allowed_m, math.inf if prescribed else STEEPEST, halved >= halvings
        fault = step_nodes(
            arrays,
            (nodal_n, (squeeze, normal_n), force, prescribed, wanted),
            friction,
            (dt_s, theta, residual, MOST_SWEEPS, most_m, steepest, shortest),
            constants,
            info,
            second_pad,
        )
        if fault == TOO_LONG:
            progress[1] += 1
            continue
        if fault:
            return int(fault)
        sums[0] += 1
        sums[1] = max(sums[1], info[15])
        for axis in range(2):
            sums[2 + axis] += dt_s * info[5 + axis]
        for axis in range(3):
            sums[4 + axis] += share * info[9 + axis]
            sums[9 + axis] += share * info[16 + axis]
        sums[7] = max(sums[7], info[14])
        sums[8] += info[13]
        progress[2] = dt_s
        progress[0] = sums[0] / fixed_steps if fixed_steps else progress[0] + share
        # longer steps again, but only where two short ones end together
        if halved > 0 and info[15] < LONGER * allowed_m and progress[0] / (2.0 * share) % 1.0 == 0.0:
            progress[1] -= 1
        if one:
            return 0
    return 0
