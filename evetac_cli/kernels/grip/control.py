"""The controllers of a grasp by name, behind one `step`: slip signal and finger position in, goal position out.

Each is a law: a frozen dataclass of its constants. `OtherLaw` is what the laws of other packages have in common.

The paper's law with both readings of its latch, ours (`load-proportional`), and two that use no detector: `none`, the
paper's control experiment, stays where light contact ended; `fixed:N` closes N ticks beyond it and stays there.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

from evetac_cli.checks import check_range
from evetac_cli.kernels.grip import load_proportional, paper
from evetac_cli.kernels.grip.load_proportional import LoadLaw
from evetac_cli.kernels.grip.paper import GraspPhase, GripLaw

LAWS: dict[str, GripLaw | LoadLaw] = {
    "paper": paper.PAPER,
    "paper-reset": paper.PAPER_RESET,
    "load-proportional": LoadLaw(),
}
FIXED = "fixed:"
MOST_FIXED_TICKS = 300


class SlipSignal(NamedTuple):
    """What the detector sends to the controller: few numbers, so that they fit into shared memory."""

    slips: int = 0  # slices with slip so far: a count that only rises
    probability: float = math.nan  # of slip, in the last slice
    mean_displacement_x_px: float = 0.0  # of all dots: a load cell (see load_proportional.py)
    mean_displacement_y_px: float = 0.0


@dataclass(frozen=True)
class FixedGrip:
    """Close this far beyond light contact and stay, in ticks; 0: stay where light contact ended, without a push."""

    beyond: int


@dataclass
class LawState:
    """What a law of another package remembers between steps; what it needs beside these is in a class below this one.

    u_ff, x_ref: feed-forward term and reference position in ticks, as they are recorded; NaN where the law has none.
    """

    u_ff: float = math.nan
    x_ref: float = math.nan


@dataclass(frozen=True)
class OtherLaw:
    """A law of another package, a frozen dataclass below this one: its fields are its constants, and part of recipes.

    It is sent to the process that commands the gripper, and stepped there.
    """

    needs_detector: ClassVar[bool] = True  # whether its goals depend on the slip detector at all

    def start(self, control_hz: float) -> LawState:
        """The state before the first step; control_hz: how many there will be a second."""
        return LawState()

    def step(self, state: LawState, phase: GraspPhase, slip: bool, signal: SlipSignal, position_ticks: int) -> int:
        """One control step: the goal position in whole ticks, from 0, open, to 740, closed.

        slip: whether the detector found any since the step before; position_ticks: where the fingers are.
        """
        raise NotImplementedError(f"{type(self).__name__} has no step")


Law = GripLaw | LoadLaw | FixedGrip | OtherLaw


def make_law(name: str, gain: float = 1.0) -> Law:
    """The law of a controller: paper, paper-reset, load-proportional, none, or fixed:N.

    gain: K_p of the paper's law in balance, in multiples; the others have none. ValueError if there is no controller of
    this name, or none with a gain.
    """
    if name.startswith(FIXED):
        ticks = name.removeprefix(FIXED)
        if not (ticks.isascii() and ticks.isdigit() and 1 <= int(ticks) <= MOST_FIXED_TICKS):
            raise ValueError(f"expected fixed:1 to fixed:{MOST_FIXED_TICKS} ticks, found {name}")
        law: Law = FixedGrip(int(ticks))
    elif name == "none":
        law = FixedGrip(0)
    elif name in LAWS:
        law = LAWS[name]
    else:
        raise ValueError(f"expected {', '.join(LAWS)}, none or fixed:N, found {name}")
    if gain == 1.0:
        return law
    if not isinstance(law, GripLaw):
        raise ValueError(f"a gain is for paper and paper-reset, found {name} with gain {gain:g}")
    return replace(law, gain=gain)


def uses_detector(law: Law) -> bool:
    """Whether the goals of a controller depend on the slip detector at all."""
    return law.needs_detector if isinstance(law, OtherLaw) else not isinstance(law, FixedGrip)


@dataclass
class Control:
    """A controller with its state, stepped at control_hz; slip, u_ff_ticks and x_ref_ticks are what is recorded of it.

    ValueError for a rate that is not finite and above 0.
    """

    law: Law
    control_hz: float = paper.PAPER_HZ
    slip: bool = False  # since the step before
    _slips: int = 0  # slices with slip up to the step before
    _state: Any = None
    _law: GripLaw = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_range("control_hz", self.control_hz, above=True)
        if isinstance(self.law, LoadLaw):
            self._law, self._state = paper.PAPER, load_proportional.start()
        elif isinstance(self.law, GripLaw):
            self._law, self._state = self.law.at(self.control_hz), paper.start()
        elif isinstance(self.law, OtherLaw):
            self._law, self._state = paper.PAPER, self.law.start(self.control_hz)
        else:
            self._law, self._state = paper.PAPER, paper.start()

    def step(self, phase: GraspPhase, signal: SlipSignal, position_ticks: int) -> int:
        """One control step: the goal position in ticks."""
        self.slip = signal.slips > self._slips
        self._slips = signal.slips
        if isinstance(self.law, LoadLaw):
            return load_proportional.step(
                self._state,
                phase,
                self.slip,
                (signal.mean_displacement_x_px, signal.mean_displacement_y_px),
                position_ticks,
                1.0 / self.control_hz,
                self.law,
            )
        if isinstance(self.law, OtherLaw):
            goal = self.law.step(self._state, phase, self.slip, signal, position_ticks)
            return min(max(int(goal), paper.PAPER.first_tick), paper.PAPER.last_tick)
        if isinstance(self.law, FixedGrip) and phase is not GraspPhase.CONTACT:
            if self._state.phase is GraspPhase.CONTACT:
                self._state = paper.GripState(phase, -float(self.law.beyond), float(position_ticks))
            if self.law.beyond == 0:
                return position_ticks
            return min(int(self._state.x_ref) + self.law.beyond, paper.PAPER.last_tick)
        return paper.step(self._state, phase, self.slip, position_ticks, self._law)

    @property
    def u_ff_ticks(self) -> float:
        """Feed-forward term of the paper's law; with the others, how far the goal is beyond the fingers. < 0 closes."""
        return float(self._state.u_ff)

    @property
    def x_ref_ticks(self) -> float:
        """Reference position of the law; NaN before it has one."""
        return float(self._state.x_ref)
