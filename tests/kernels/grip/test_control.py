"""Controllers by name: which law, which signals reach it, and the two that use no detector."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import EvetacError
from evetac_cli.kernels.grip import load_proportional, paper
from evetac_cli.kernels.grip.control import (
    LAWS,
    Control,
    FixedGrip,
    LawState,
    PluginLaw,
    SlipSignal,
    make_law,
    uses_detector,
    uses_sticking,
)
from evetac_cli.kernels.grip.load_law import LawInput, LoadLaw
from evetac_cli.kernels.grip.paper import GraspPhase

CONTACT, LIFT, BALANCE = GraspPhase.CONTACT, GraspPhase.LIFT, GraspPhase.BALANCE


def test_names() -> None:
    """Assert that each name is its law, and that only contact alone and fixed grips use no detector."""
    assert make_law("paper") == paper.PAPER
    assert make_law("paper-reset") == paper.PAPER_RESET
    assert make_law("load-proportional") == LoadLaw()
    assert make_law("paper", 2.0) == paper.GripLaw(gain=2.0)
    assert make_law("none") == FixedGrip(0)
    assert make_law("fixed:12") == FixedGrip(12)
    assert make_law("load-proportional", margin=1.5) == LoadLaw(margin=1.5)
    assert [uses_detector(make_law(name)) for name in (*LAWS, "none", "fixed:3")] == [True] * 3 + [False] * 2
    assert [name for name in (*LAWS, "none", "fixed:3") if uses_sticking(make_law(name))] == ["load-proportional"]


@pytest.mark.parametrize("name", ["", "Paper", "fixed", "fixed:", "fixed:0", "fixed:-3", "fixed:1.5", "fixed:9999"])
def test_no_such_controller(name: str) -> None:
    """Assert that an unknown name is refused with a list of those that exist."""
    with pytest.raises(ValueError, match="expected"):
        make_law(name)


@pytest.mark.parametrize("name", ["load-proportional", "none", "fixed:4"])
def test_only_the_paper_has_a_gain(name: str) -> None:
    """Assert that a gain is refused where it would have no effect."""
    with pytest.raises(ValueError, match="gain"):
        make_law(name, 2.0)


@pytest.mark.parametrize("name", ["paper", "none", "fixed:4"])
def test_only_the_load_has_a_margin(name: str) -> None:
    """Assert that a margin is refused where it would have no effect."""
    with pytest.raises(ValueError, match="margin"):
        make_law(name, margin=1.5)


def test_slip_is_a_count_that_rose() -> None:
    """Assert that slip counts once for however many slices, and not again until the count rises."""
    control = Control(make_law("paper"))
    slips = []
    for count in (0, 0, 3, 3, 4, 4, 9):
        control.step(LIFT, SlipSignal(count), 100)
        slips.append(control.slip)
    assert slips == [False, False, True, False, True, False, True]


@pytest.mark.parametrize("name", ["paper", "paper-reset"])
def test_the_paper_s_law_behind_its_name(name: str) -> None:
    """Assert that behind its name the law gives the goals of its own step, with u_ff and x_ref for the record."""
    control, state, seen = Control(make_law(name)), paper.start(), 0
    steps = ((CONTACT, 0, 90), (CONTACT, 2, 100), (LIFT, 2, 101), (LIFT, 5, 103), (LIFT, 5, 108), (BALANCE, 5, 107),
             (BALANCE, 6, 103), (BALANCE, 6, 104), (BALANCE, 7, 101))  # fmt: skip
    for phase, count, position in steps:
        goal = paper.step(state, phase, count > seen, position, LAWS[name])
        seen = count
        assert control.step(phase, SlipSignal(count), position) == goal
        assert control.u_ff_ticks == state.u_ff
        assert control.x_ref_ticks == pytest.approx(state.x_ref, nan_ok=True)


def test_load_proportional_gets_what_is_felt() -> None:
    """Assert that it is given displacement, turn and sticking share, and the time of a step at its own rate."""
    control, state = Control(make_law("load-proportional"), 250.0), load_proportional.start()
    for phase, signal, position in (
        (CONTACT, SlipSignal(0, 0.0, 0.1, 0.2, 0.3), 100),
        (LIFT, SlipSignal(1, 0.9, 3.1, 0.2, 0.4, 0.9), 100),
        (LIFT, SlipSignal(1, 0.1, 3.1, 0.3, 0.4, 0.8), 108),
    ):
        slip = signal.slips > 0 and position == 100
        goal = load_proportional.step(state, phase, LawInput(slip, *signal[2:]), position, 1 / 250, LoadLaw())
        assert control.step(phase, signal, position) == goal
    assert control.x_ref_ticks == state.wanted_ticks


def test_contact_alone_stays_without_a_push() -> None:
    """Assert that after light contact the goal is wherever the fingers are, slip or not."""
    control = Control(make_law("none"))
    assert control.step(CONTACT, SlipSignal(), 100) == 102
    for phase, count, position in ((LIFT, 5, 104), (LIFT, 9, 103), (BALANCE, 12, 99)):
        assert control.step(phase, SlipSignal(count), position) == position


def test_a_fixed_grip_stays_where_it_closed_to() -> None:
    """Assert that after light contact the goal is N ticks beyond where contact ended, slip or not."""
    control = Control(make_law("fixed:7"))
    control.step(CONTACT, SlipSignal(), 100)
    for phase, count, position in ((LIFT, 5, 104), (LIFT, 9, 108), (BALANCE, 12, 99)):
        assert control.step(phase, SlipSignal(count), position) == 111
    assert control.x_ref_ticks == 104
    control = Control(make_law("fixed:300"))
    control.step(CONTACT, SlipSignal(), 700)
    assert control.step(LIFT, SlipSignal(), 702) == paper.PAPER.last_tick


@dataclass(frozen=True)
class Given(PluginLaw):
    """A law of another package: it answers as it is told to."""

    method = 1
    goal: Any = 300
    u_ff: Any = 0.0
    x_ref: Any = math.nan

    def step(self, state: LawState, phase: GraspPhase, slip: bool, signal: SlipSignal, position_ticks: int) -> int:
        """The goal that was given."""
        state.u_ff, state.x_ref = self.u_ff, self.x_ref
        goal: int = self.goal
        return goal


def test_the_usual_state_of_another_law_can_be_recorded() -> None:
    """Assert that a law without a feed-forward term has one that is finite, as recordings have it."""
    assert Control(Given()).u_ff_ticks == 0.0
    assert math.isnan(Control(Given()).x_ref_ticks)


def test_another_law_s_goals_are_whole_and_clipped() -> None:
    """Assert that a whole number of any type is a goal, and that it is clipped to the gripper's range."""
    goals = [Control(Given(goal)).step(LIFT, SlipSignal(), 100) for goal in (5, np.int32(6), -3, 9999)]
    assert goals == [5, 6, 0, 740]
    assert all(type(goal) is int for goal in goals)


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (Given(goal=math.nan), "its goal is not a whole number"),
        (Given(goal=300.0), "its goal is not a whole number"),
        (Given(goal=None), "its goal is not a whole number"),
        (Given(u_ff=math.nan), "its u_ff is not a finite number"),
        (Given(u_ff=np.float32(math.inf)), "its u_ff is not a finite number"),
        (Given(u_ff="-2"), "its u_ff is not a finite number"),
        (Given(x_ref=math.inf), "its x_ref is neither"),
    ],
)
def test_another_law_that_breaks_its_contract_is_refused(law: Given, said: str) -> None:
    """Assert that what cannot be commanded or recorded is an error that names the controller."""
    with pytest.raises(EvetacError, match=rf"the controller odd \(.*Given\) fails: {said}"):
        Control(law, name="odd").step(LIFT, SlipSignal(), 100)


def test_another_law_starts_with_a_state() -> None:
    """Assert that a start which gives none is refused."""

    class Stateless(Given):
        def start(self, control_hz: float) -> LawState:
            return None  # type: ignore[return-value]

    with pytest.raises(EvetacError, match="LawState"):
        Control(Stateless())
