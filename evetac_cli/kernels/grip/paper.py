"""The paper's grasp controller (section VII-A), one step every 2 ms, in encoder ticks.

The paper writes u_c = K_p (x_e + u_ff) in opening widths, so a negative u_ff closes. The servo itself multiplies by K_p
(its position P gain register). The host writes the goal position x_ref + u_ff. The encoder counts upwards when the
gripper closes, hence goal_ticks = reference_ticks - u_ff.

Design:
- Doubling K_p is the same as doubling the distance from the gripper to its goal. A higher gain therefore needs no
  register access and is the same for every gripper. Like the register, it doubles the errors that come from 2 ms old
  positions and whole ticks.
- The states of the grip laws are dataclasses, not numpy records as in the numba kernels. A step is a few tens of
  operations on single numbers in plain Python: 1.1 us here and 2.0 us in load_proportional.py. With the fields of a
  numpy record the same steps take 20 and 32 us.
"""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

from evetac_cli.errors import check_range

PAPER_HZ = 500.0  # rate of control for which the paper gives its increments


class GraspPhase(IntEnum):
    """Phases of a grasp."""

    CONTACT = 0
    LIFT = 1
    BALANCE = 2


@dataclass(frozen=True)
class GripLaw:
    """Constants of the law, in ticks; the defaults are the paper's values."""

    approach: float = -2.0  # u_ff in the contact phase: just enough to make the gripper move
    lift_slip: float = -1.0  # change of u_ff per step with slip
    lift_no_slip: float = 0.01  # ... per step without slip
    balance_slip: float = -2.0
    balance_no_slip: float = 0.01
    lowest: float = -5.0  # lower limit of u_ff: the strongest closing
    highest_open: float = 2.0  # upper limit of u_ff in balance until the first slip
    first_tick: int = 0
    last_tick: int = 740  # fully closed; the authors' code stops at 660, where fingers without sensors are 10 mm apart
    paper_reset: bool = False  # balance: set x_ref at every onset of slip, not only at the first
    gain: float = 1.0  # K_p in balance, as a multiple of the servo's

    def at(self, control_hz: float) -> "GripLaw":
        """Return the law for another control rate, with equal changes of u_ff per second. ValueError unless above 0."""
        check_range("control_hz", control_hz, above=True)
        times = PAPER_HZ / control_hz
        return replace(
            self,
            lift_slip=self.lift_slip * times,
            lift_no_slip=self.lift_no_slip * times,
            balance_slip=self.balance_slip * times,
            balance_no_slip=self.balance_no_slip * times,
        )


PAPER = GripLaw()
PAPER_RESET = GripLaw(paper_reset=True)


@dataclass
class GripState:
    """State of the controller between steps."""

    phase: GraspPhase = GraspPhase.CONTACT
    u_ff: float = 0.0
    x_ref: float = math.nan  # ticks; NaN: x_e is zero and the reference is the present position
    slipped: bool = False  # s(t - 1)
    position: int = 0  # x_g(t - 1)
    slipped_in_balance: bool = False  # there has been slip in this phase


def start() -> GripState:
    """Return the state before the first step."""
    return GripState()


def step(state: GripState, phase: GraspPhase, slip: bool, position_ticks: int, law: GripLaw = PAPER) -> int:
    """Do one control step and return the goal in ticks; `slip`: the detector reported slip since the previous step.

    Lift: each step with slip closes by one tick of u_ff, each step without opens by 0.01. When slip ends, the present
    position becomes the reference. Balance: each step opens by 0.01 until the first slip. The first slip closes by 2
    and makes the position of the previous step the reference; with `paper-reset` every onset of slip does. After that
    u_ff only closes. (Paper, section VII-A.)
    """
    if phase != state.phase:
        if phase is GraspPhase.LIFT:
            state.u_ff = 0.0  # "u_ff is initialized as zero"
            state.slipped = False  # slip counts from the lift onwards: making contact is not slip
        else:  # balance keeps u_ff, but x_e is zero again until slip begins in this phase
            state.x_ref = math.nan
        state.phase = phase
    gain = 1.0
    if phase is GraspPhase.CONTACT:
        state.u_ff = law.approach
        reference = float(position_ticks)
    elif phase is GraspPhase.LIFT:
        state.u_ff = _clip(state.u_ff + (law.lift_slip if slip else law.lift_no_slip), law.lowest, 0.0)
        if state.slipped and not slip:
            state.x_ref = float(position_ticks)
        reference = position_ticks if math.isnan(state.x_ref) else state.x_ref
    else:
        gain = law.gain
        state.u_ff += law.balance_slip if slip else law.balance_no_slip
        if slip and not state.slipped and (law.paper_reset or not state.slipped_in_balance):
            state.slipped_in_balance = True
            state.x_ref = float(state.position)
        state.u_ff = _clip(state.u_ff, law.lowest, 0.0 if state.slipped_in_balance else law.highest_open)
        reference = position_ticks if math.isnan(state.x_ref) else state.x_ref
    state.slipped = slip
    state.position = position_ticks
    away = gain * (round(reference - state.u_ff) - position_ticks)  # position error, before the servo multiplies by K_p
    return int(_clip(round(position_ticks + away), law.first_tick, law.last_tick))


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
