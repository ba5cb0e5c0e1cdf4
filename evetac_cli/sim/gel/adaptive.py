"""A slice of the gel in as many time steps as necessary: one while all nodes stick or slide, more as they let go.

A step is repeated in halves, down to a shortest step, if its estimated error is above the tolerance. It is also
repeated if a node lets go whose friction falls too steeply for the step (see `time_step.Allowed`). Steps get longer
again when two short steps end together and their errors are far below the tolerance. For the estimate see
`gel.StepInfo.error_m`. It is the error of a single step, not of a trial: `evaluate cost` measures the effect of a
tolerance on run time, onset of slip and displacement.
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

# Limit for `Allowed.steepness`, measured on a gel as stiff along a wave as across it. At the default tolerance, the
# onset of slip is within 0.25 ms of that of steps of 10 us. This was measured in 16 trials (seeds 0 to 15) of each plan
# of tests/evaluate/cost/test_letting_go.py. At 0.4 one onset is 0.47 ms off, at 0.6 one is 1.2 ms off. The slip scene
# takes 1.20 steps per slice instead of 1.03 (object 8), and 1.56 instead of 1.10 (18). If the object's motion is
# prescribed, the motion determines the onset, and any steepness is allowed. In the scene `edge` dots are then 0.004 px
# rms off steps of 0.0125 ms (a handle, seed 1); with the limit 0.0004 px, in 1.2 times the time.
STEEPEST = 0.25
LONGER = 0.3  # share of the tolerance below which steps double in length, which raises the error two to four times
MOST_SWEEPS = 400  # limit of the search for the balance in a step


class Slice(NamedTuple):
    """Combined results of the steps of one slice.

    steps: their number. error_m: the largest estimated error of a step. slip_m: how far the object slid against the
    gel, (x, y), mean over the contact.

    friction_n, slipping_force_n, friction_heat_j: as in `gel.StepInfo`; mean over time, maximum and sum.

    second_friction_n: as friction_n, on the second finger's pad if it is simulated; the heat and the largest force are
    then those of both pads.
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
    """Divides slices into steps, and keeps the length of the last step for the next slice.

    second: the second finger's pad, if it does not mirror the first: a GelState that holds the same object, of
    which only the pad is used; both have `pads` 1.
    """

    solver: Solver
    slice_s: float = 1e-3
    second: gel.GelState | None = None

    def __post_init__(self) -> None:
        # the completed part of the slice, the number of halvings, and the last step in s
        self._progress = np.zeros(3)
        self._sums = np.zeros(12)
        self._fixed_steps = self.solver.fixed_steps or 0
        self._rule = (self.solver.tolerance_um * 1e-6, self.solver.halvings)
        # for each pad, the last shares and their squeeze
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
        """Advance gel and object by a slice.

        shares: (rows, columns), each node's share of the normal force, 1 in total, or 0 without contact. Pass a new
        array for each new pressure: the squeeze is cached for as long as the array is the same object.

        force_n: normal force in N on one pad at the start and the end of the slice. each: called after each step, with
        its results and its duration in s. The other arguments are those of `gel.step`.
        """
        solver, progress, sums = self.solver, self._progress, self._sums
        assert shares.shape == state.stuck.shape
        theta = solver.theta
        wanted = (0.0, 0.0, 0.0)
        if prescribed_twist is not None:
            wanted = _three(prescribed_twist)
            if not any(
                wanted
            ):  # nothing oscillates on an object held still: most damping brings the gel to rest soonest
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
            assert second_shares is not None and second_shares.shape == self.second.stuck.shape
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
        """Return the squeeze by pressure on a pad; computed again for another pad or another array of shares."""
        kept = self._kept.get(pad)
        if kept is None or kept[0] is not state or kept[1] is not shares:
            kept = self._kept[pad] = (state, shares, state.squeezed(shares))
        return kept[2]


def _three(values: Sequence[float] | Floats) -> Three:
    """Return three Python floats, which are the fastest to pass to compiled code."""
    x, y, turn = values
    return float(x), float(y), float(turn)


@njit(cache=True, inline="always")
def _nodal_forces(memory: Floats, shares: Floats, normal_n: float) -> Floats:
    """Return the nodes' parts (rows, columns) of a normal force, in the memory of their pad."""
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
    """Make the steps of a slice from `progress` on, or only `one`; return 0 or the number of an error.

    A loop in compiled code, because returning to Python after each step took 9 us more per step.
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
        # lengthen the steps, but only if two short ones end together
        if halved > 0 and info[15] < LONGER * allowed_m and progress[0] / (2.0 * share) % 1.0 == 0.0:
            progress[1] -= 1
        if one:
            return 0
    return 0
