"""The grasp controllers by name, behind one `step`: slip signal and finger position in, goal position out.

Each controller is a law, a frozen dataclass of its constants. `PluginLaw` is the base class for laws of other packages.

Built in are the paper's law with both readings of its latch, evetac's `load-proportional`, and two laws without a
detector. `none`, the paper's control experiment, stays where light contact ended; `fixed:N` closes N ticks beyond that
and stays there.

`both_fingers` combines the slip signals of two detectors, one per finger:

- Slip: the slip counts of both detectors are added, so the sum rises when either finger slips. One slipping finger is
  enough to lose an object, because the other finger must then carry its share.
- Load: the mean of both fingers. The object's weight is split between the two gels according to their stiffness, so
  only the sum is independent of the split. Half of the sum is the load on each of two equal fingers, for which the
  constants of the law were chosen. If one finger slips, the gel of the other takes over and the mean stays the same.
  The maximum of both would mistake a stiffer grip for a heavier object.
- Signs: the second sensor faces the first (sim/scenes/pads.py), so downward motion and rotation have the
  opposite sign in its image. Both are therefore subtracted. Motion along the fingers has the same sign in both images.
- Sticking share: the smaller one, because that finger slips first.
- Probability: the larger one. It is for display only; evetac's laws do not read it.

Fingers with gels of different stiffness feel different loads, and the law does not know which finger is the stiffer
one. This does no harm: the law only compares loads with each other, and each finger's share of the load hardly changes
while both stick.
"""

import copy
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any, ClassVar, NamedTuple

from evetac_cli.errors import EvetacError, check_range
from evetac_cli.kernels.grip import load_proportional, paper
from evetac_cli.kernels.grip.load_law import MARGIN, LawInput, LoadLaw
from evetac_cli.kernels.grip.paper import GraspPhase, GripLaw

LAWS: dict[str, GripLaw | LoadLaw] = {
    "paper": paper.PAPER,
    "paper-reset": paper.PAPER_RESET,
    "load-proportional": LoadLaw(),
}
FIXED = "fixed:"
MOST_FIXED_TICKS = 300


class SlipSignal(NamedTuple):
    """Message from the detector to the controller: a few numbers, so that they fit into shared memory."""

    slips: int = 0  # slices with slip so far: never decreases
    probability: float = math.nan  # of slip, in the last slice
    mean_displacement_x_px: float = 0.0  # of all dots, which act as a load cell (see load_proportional.py)
    mean_displacement_y_px: float = 0.0
    # rms displacement of the dots by rotation about their centre; this and the next only on request
    turn_px: float = 0.0
    sticking_share: float = math.nan  # share of the contact that sticks; NaN without contact


@dataclass(frozen=True)
class FixedGrip:
    """Close this many ticks beyond light contact and stay; 0: stay where light contact ended, without a push."""

    beyond: int


@dataclass
class LawState:
    """State of another package's law between steps; a law that needs more derives a class from this one.

    u_ff, x_ref: feed-forward term and reference position in ticks, as recorded. u_ff must be finite, 0 if the law has
    none; x_ref is NaN if the law has none.
    """

    u_ff: float = 0.0
    x_ref: float = math.nan


@dataclass(frozen=True)
class PluginLaw:
    """Base class for a law of another package: a frozen dataclass whose fields are its constants and part of recipes.

    The law is sent to the process that commands the gripper and stepped there. A law must set `method`: 1 at first, and
    one more whenever the same constants command other goals. The method version is part of recipes, so that grasps are
    then simulated again.
    """

    method: ClassVar[int]
    needs_detector: ClassVar[bool] = True  # whether the goals depend on the slip detector
    needs_sticking: ClassVar[bool] = False  # whether the goals depend on the turn of the dots and the sticking share

    def start(self, control_hz: float) -> LawState:
        """Return the state before the first step; control_hz: control steps per second."""
        return LawState()

    def step(self, state: LawState, phase: GraspPhase, slip: bool, signal: SlipSignal, position_ticks: int) -> int:
        """Do one control step and return the goal position in whole ticks, from 0 (open) to 740 (closed).

        slip: the detector reported slip since the previous step; position_ticks: measured position of the fingers.
        """
        raise NotImplementedError(f"{type(self).__name__} has no step")


Law = GripLaw | LoadLaw | FixedGrip | PluginLaw


def make_law(name: str, gain: float = 1.0, margin: float = MARGIN, own: PluginLaw | None = None) -> Law:
    """Return the law of a controller: paper, paper-reset, load-proportional, none, or fixed:N.

    gain: K_p of the paper's laws in balance, as a multiple of the servo's. margin: safety factor of load-proportional.
    The other laws have neither. own: the law of another package that has this name. ValueError for an unknown name, or
    a gain or margin for a law without one.
    """
    if own is not None:
        law: Law = own
    elif name.startswith(FIXED):
        ticks = name.removeprefix(FIXED)
        if not (ticks.isascii() and ticks.isdigit() and 1 <= int(ticks) <= MOST_FIXED_TICKS):
            raise ValueError(f"expected fixed:1 to fixed:{MOST_FIXED_TICKS} ticks, found {name}")
        law = FixedGrip(int(ticks))
    elif name == "none":
        law = FixedGrip(0)
    elif name in LAWS:
        law = LAWS[name]
    else:
        raise ValueError(f"expected {', '.join(LAWS)}, none or fixed:N, found {name}")
    if margin != MARGIN:
        if not isinstance(law, LoadLaw):
            raise ValueError(f"only load-proportional has a margin, found {name} with margin {margin:g}")
        law = replace(law, margin=margin)
    if gain != 1.0:
        if not isinstance(law, GripLaw):
            raise ValueError(f"only paper and paper-reset have a gain, found {name} with gain {gain:g}")
        law = replace(law, gain=gain)
    return law


def uses_detector(law: Law) -> bool:
    """Whether the goals of a law depend on the slip detector."""
    return law.needs_detector if isinstance(law, PluginLaw) else not isinstance(law, FixedGrip)


def uses_sticking(law: Law) -> bool:
    """Whether the goals of a law depend on the turn of the dots and the sticking share."""
    return law.needs_sticking if isinstance(law, PluginLaw) else isinstance(law, LoadLaw)


@dataclass
class Control:
    """A controller with its state, stepped at control_hz; slip, u_ff_ticks and x_ref_ticks are recorded.

    name: of the controller, for errors. ValueError for a rate that is not finite and above 0; EvetacError, here and in
    `step`, if a law of another package breaks its contract.
    """

    law: Law
    control_hz: float = paper.PAPER_HZ
    name: str = ""
    slip: bool = False  # since the previous step
    _slips: int = 0  # slices with slip up to the previous step
    _state: Any = None
    _law: GripLaw = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_range("control_hz", self.control_hz, above=True)
        self._law = self.law.at(self.control_hz) if isinstance(self.law, GripLaw) else paper.PAPER
        if isinstance(self.law, PluginLaw):
            self._state = self.law.start(self.control_hz)
            if not isinstance(self._state, LawState):
                raise self._fault("its start does not return a LawState", self._state)
        else:
            self._state = load_proportional.start() if isinstance(self.law, LoadLaw) else paper.start()

    def step(self, phase: GraspPhase, signal: SlipSignal, position_ticks: int) -> int:
        """Do one control step and return the goal position in ticks."""
        self.slip = signal.slips > self._slips
        self._slips = signal.slips
        if isinstance(self.law, LoadLaw):
            felt = LawInput(self.slip, *signal[2:])
            return load_proportional.step(self._state, phase, felt, position_ticks, 1.0 / self.control_hz, self.law)
        if isinstance(self.law, PluginLaw):
            return self._step_other(self.law, phase, signal, position_ticks)
        if isinstance(self.law, FixedGrip) and phase is not GraspPhase.CONTACT:
            if self._state.phase is GraspPhase.CONTACT:
                self._state = paper.GripState(phase, -float(self.law.beyond), float(position_ticks))
            if self.law.beyond == 0:
                return position_ticks
            return min(int(self._state.x_ref) + self.law.beyond, paper.PAPER.last_tick)
        return paper.step(self._state, phase, self.slip, position_ticks, self._law)

    def copy(self) -> "Control":
        """Return a controller in the same state, whose steps do not change this one.

        EvetacError if the state of another package's law cannot be copied. A shallow copy is enough for evetac's laws.
        """
        other = copy.copy(self)
        if not isinstance(self.law, PluginLaw):
            other._state = copy.copy(self._state)
            return other
        try:
            other._state = copy.deepcopy(self._state)
        except Exception:
            raise self._fault("its state cannot be copied", self._state) from None
        return other

    def _step_other(self, law: PluginLaw, phase: GraspPhase, signal: SlipSignal, position_ticks: int) -> int:
        """Step another package's law and clip its goal; EvetacError if the goal or the state is not valid."""
        goal, state = law.step(self._state, phase, self.slip, signal, position_ticks), self._state
        try:
            goal = operator.index(goal)
        except TypeError:
            raise self._fault("its goal is not a whole number of ticks", goal) from None
        if not (isinstance(state.u_ff, Real) and math.isfinite(state.u_ff)):
            raise self._fault("its u_ff is not a finite number", state.u_ff)
        if not (isinstance(state.x_ref, Real) and not math.isinf(state.x_ref)):
            raise self._fault("its x_ref is neither a finite number nor NaN", state.x_ref)
        return min(max(goal, paper.PAPER.first_tick), paper.PAPER.last_tick)

    def _fault(self, what: str, found: object) -> EvetacError:
        """Return the error that a law of another package breaks its contract."""
        of = f"{type(self.law).__module__}.{type(self.law).__qualname__}"
        full_name = f"{self.name} ({of})" if self.name else of
        hint = "report it to the authors of the controller: evetac_cli.testing.check_controller reproduces it"
        return EvetacError(
            f"the controller {full_name} fails: {what}", where="--controller", found=repr(found), hint=hint
        )

    @property
    def u_ff_ticks(self) -> float:
        """Feed-forward term of the paper's law; for other laws, the lead of the goal over the fingers. < 0 closes."""
        return float(self._state.u_ff)

    @property
    def x_ref_ticks(self) -> float:
        """Reference position of the law; NaN before it has one."""
        return float(self._state.x_ref)


def both_fingers(first: SlipSignal, second: SlipSignal) -> SlipSignal:
    """Return one signal for two fingers; each argument uses the coordinates of its own sensor's image."""
    return SlipSignal(
        first.slips + second.slips,
        _extreme(max, first.probability, second.probability),
        0.5 * (first.mean_displacement_x_px + second.mean_displacement_x_px),
        0.5 * (first.mean_displacement_y_px - second.mean_displacement_y_px),
        0.5 * (first.turn_px - second.turn_px),
        _extreme(min, first.sticking_share, second.sticking_share),
    )


def _extreme(choose: Callable[[float, float], float], first: float, second: float) -> float:
    """Return the larger or smaller of two values, as `choose` decides; if one is NaN (unknown), the other."""
    if math.isnan(first):
        return second
    return first if math.isnan(second) else choose(first, second)
