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
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.force_balance import Three
from evetac_cli.sim.gel.friction import FrictionLaw
from evetac_cli.sim.gel.pad import Arrays, PadArrays, parts_of
from evetac_cli.sim.gel.time_step import STEP, TOO_LONG, Allowed, Load, StepRule, step_nodes
from evetac_cli.sim.setup.scene import MOST_HALVINGS, Solver

# Limit for `Allowed.steepness`, measured on a gel as stiff along a wave as across it. At the default tolerance, the
# onset of slip is within 0.25 ms of that of steps of 10 us. This was measured in 16 trials (seeds 0 to 15) of each plan
# of tests/evaluate/cost/test_letting_go.py. At 0.4 one onset is 0.47 ms off, at 0.6 one is 1.2 ms off. The slip scene
# takes 1.20 steps per slice instead of 1.03 (object 8), and 1.56 instead of 1.10 (18). If the object's motion is
# prescribed, the motion determines the onset, and any steepness is allowed. In the scene `edge` dots are then 0.004 px
# rms off steps of 0.0125 ms (a handle, seed 1); with the limit 0.0004 px, in 1.2 times the time.
STEEPEST = 0.25
LONGER = 0.3  # share of the tolerance below which steps double in length, which raises the error two to four times
MOST_SWEEPS = 400  # limit of the search for the balance in a step


Done = tuple[int, float, tuple[float, float], Three, float, float, Three]  # the values of a Slice


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


# How a slice is divided into steps, how far it is done, and the results so far, which are explained in `Slice`.
SLICE = np.dtype(
    [
        ("slice_s", np.float64),
        ("residual", np.float64),
        ("fixed_steps", np.int64),  # 0: as many as necessary
        ("allowed_m", np.float64),
        ("allowed_halvings", np.int64),
        ("done", np.float64),  # part of the slice
        ("halvings", np.int64),
        ("step_s", np.float64),  # of the last step
        ("steps", np.int64),
        ("error_m", np.float64),
        ("slip_m", np.float64, 2),
        ("friction_n", np.float64, 3),
        ("slipping_force_n", np.float64),
        ("friction_heat_j", np.float64),
        ("second_friction_n", np.float64, 3),
    ]
)


# A pad's arrays, each node's share of the normal force, and their squeeze. From Python to `_step_slice` all tuples are
# plain: numba took 6 us more to take named ones, and 3 us more to return one, half of a slice at rest.
Pressed = tuple[Arrays, Floats, Floats]


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
        solver, self._record, self._results = self.solver, np.zeros(1, SLICE), np.zeros(1, STEP)
        self._record["slice_s"], self._record["residual"] = self.slice_s, solver.residual
        self._record["fixed_steps"] = solver.fixed_steps or 0
        self._record["allowed_m"], self._record["allowed_halvings"] = solver.tolerance_um * 1e-6, solver.halvings
        self._kept: dict[int, tuple[gel.GelState, Floats, Floats]] = {}  # last shares and squeeze of each pad

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
        theta, wanted = self.solver.theta, (0.0, 0.0, 0.0)
        if prescribed_twist is not None:
            wanted = gel.three(prescribed_twist)
            # nothing oscillates on an object held still: most damping brings the gel to rest soonest
            theta = theta if any(wanted) else 1.0
        load, law = (gel.three(body_force_n), prescribed_twist is not None, wanted), friction.law[:]
        pressed, second = self._press(0, state, shares), None
        if self.second is not None:
            assert second_shares is not None
            second = self._press(1, self.second, second_shares)
        record, results = self._record, self._results
        record["done"] = 0.0
        one = each is not None
        while True:
            fault, done = _step_slice(pressed, second, force_n, load, law, theta, record, results, one)
            if fault:
                raise ValueError(gel.FAULTS[fault])
            if each is not None:
                each(gel.step_info(results, self.solver.residual), float(record["step_s"][0]))
            if each is None or record["done"][0] >= 1.0:
                return Slice(*done)

    def _press(self, pad: int, state: gel.GelState, shares: Floats) -> Pressed:
        """Return a pad under a pressure; the squeeze is computed again for another pad or another array of shares."""
        kept = self._kept.get(pad)
        if kept is None or kept[0] is not state or kept[1] is not shares:
            assert shares.shape == state.stuck.shape
            kept = self._kept[pad] = (state, shares, state.squeezed(shares))
        return state.arrays, state.gripping(shares), kept[2]


@njit(cache=True, _nrt=False)
def _press(pad: PadArrays, shares: Floats, normal_n: float) -> None:
    """Set the nodes' parts of a normal force in the memory of their pad."""
    normal = parts_of(pad).work.normal
    for row in range(shares.shape[0]):
        for column in range(shares.shape[1]):
            normal[row, column] = shares[row, column] * normal_n


@njit(cache=True, _nrt=False)
def _step_slice(
    pressed: Pressed,
    second: Pressed | None,
    force_n: tuple[float, float],
    load_of: tuple[Three, bool, Three],
    law_of: tuple[float, float, float, float],
    theta: float,
    record: NDArray[np.void],
    results: NDArray[np.void],
    one: bool,
) -> tuple[int, Done]:
    """Make the steps of a slice, or only one more; return the number of an error, or 0, and the results so far.

    A loop in compiled code, because returning to Python after each step took 9 us more per step.
    """
    (arrays, shares, squeeze), load, law = pressed, Load(*load_of), FrictionLaw(*law_of)
    pad, state, result = PadArrays(*arrays), record[0], results[0]
    slice_s, fixed_steps, allowed_m = state["slice_s"], state["fixed_steps"], state["allowed_m"]
    if state["done"] == 0.0:
        state["steps"], state["error_m"] = 0, 0.0
        state["slipping_force_n"], state["friction_heat_j"] = 0.0, 0.0
        state["slip_m"][:], state["friction_n"][:], state["second_friction_n"][:] = 0.0, 0.0, 0.0
    fault = 0
    while state["done"] < 1.0:
        halved = state["halvings"]
        share = 1.0 / fixed_steps if fixed_steps else math.ldexp(1.0, -halved)
        dt_s = share * slice_s
        normal_n = force_n[0] + (state["done"] + theta * share) * (force_n[1] - force_n[0])
        _press(pad, shares, normal_n)
        if second is None:
            second_pad = None
        else:
            arrays_2, shares_2, squeeze_2 = second
            pad_2 = PadArrays(*arrays_2)
            _press(pad_2, shares_2, normal_n)
            second_pad = (pad_2, (squeeze_2, normal_n))
        allowed = Allowed(math.inf, math.inf, True)
        if not fixed_steps and halved < MOST_HALVINGS:
            steepest = math.inf if load.prescribed else STEEPEST
            allowed = Allowed(allowed_m, steepest, halved >= state["allowed_halvings"])
        rule = StepRule(dt_s, theta, state["residual"], MOST_SWEEPS, allowed)
        fault = step_nodes(pad, (squeeze, normal_n), second_pad, load, law, rule, results)
        if fault == TOO_LONG:
            state["halvings"] += 1
            continue
        if fault:
            break
        state["steps"] += 1
        state["error_m"] = max(state["error_m"], result["error_m"])
        for axis in range(2):
            state["slip_m"][axis] += dt_s * result["slip_velocity_m_s"][axis]
        for axis in range(3):
            state["friction_n"][axis] += share * result["friction_n"][axis]
            state["second_friction_n"][axis] += share * result["second_friction_n"][axis]
        state["slipping_force_n"] = max(state["slipping_force_n"], result["slipping_force_n"])
        state["friction_heat_j"] += result["friction_heat_j"]
        state["step_s"] = dt_s
        state["done"] = state["steps"] / fixed_steps if fixed_steps else state["done"] + share
        # lengthen the steps, but only if two short ones end together
        if halved > 0 and result["error_m"] < LONGER * allowed_m and state["done"] / (2.0 * share) % 1.0 == 0.0:
            state["halvings"] -= 1
        if one:
            break
    slip, force, force_2 = state["slip_m"], state["friction_n"], state["second_friction_n"]
    done = (
        state["steps"],
        state["error_m"],
        (slip[0], slip[1]),
        (force[0], force[1], force[2]),
        state["slipping_force_n"],
        state["friction_heat_j"],
        (force_2[0], force_2[1], force_2[2]),
    )
    return fault, done
