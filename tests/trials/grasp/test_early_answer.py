"""What is written ahead of a step, when slip comes to be known between two: when, how often, and when not."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from evetac_cli import testing
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.kernels.grip.control import LawState, PluginLaw, SlipSignal
from evetac_cli.kernels.grip.load_law import LoadLaw
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.realtime.shared_time import WakeSignal
from evetac_cli.trials.grasp.controller_process import OVER
from tests.trials.grasp.bench import PERIOD_S, WRITE_S, Bench, goals_by_law


def early(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row["control/early_goal_ticks"] != -1]


@pytest.mark.parametrize("every", [1, 2, 3, 25])
def test_slip_between_two_steps_is_answered_once(bench: Callable[..., Bench], every: int) -> None:
    """Assert at most one command ahead of a step, begun as slip comes, that the law gives again, and that all is paced.

    With slip in every slice, in every second one (whose news come before a step, or between two), and less often.
    """

    def slips(slice_: int) -> bool:
        return slice_ >= 100 and slice_ % every == 1 % every

    at = bench(slips=slips)
    ended, rows = at.run()
    assert (ended.ended, ended.missed, ended.steps) == (OVER, 0, len(rows))
    assert ended.steps / ended.seconds == pytest.approx(500.0, rel=0.01)
    assert goals_by_law(rows, slips) == at.hand.goals
    assert all(row["control/phase"] is not GraspPhase.CONTACT and row["control/slip"] for row in early(rows))
    for before, row in zip(rows, rows[1:], strict=False):
        if row["control/early_goal_ticks"] == -1:
            assert (row["control/early_slices_processed"], math.isnan(row["control/early_t_us"])) == (0, True)
            continue
        assert before["control/t_us"] < row["control/early_t_us"] < row["control/t_us"]
        assert before["control/slices_processed"] < row["control/early_slices_processed"]
        assert row["control/late_us"] < 0.01
    if every in (1, 3):  # of every second slice all may come just before a step
        assert len(early(rows)) > 0.3 * sum(row["control/slip"] for row in rows)


def test_the_steps_are_those_of_a_controller_that_sleeps_through(bench: Callable[..., Bench]) -> None:
    """Assert that steps are as without a wake: same times, same slices; fingers that do not move get the same goals."""
    rows: list[list[dict[str, Any]]] = []
    for hears in (True, False):
        at = bench(slips=lambda k: k % 7 == 0)
        at.hand.is_held = True
        if not hears:
            at.clock.next_s = lambda: math.inf
            at.shared.slip_wake.wait = lambda seconds: False  # type: ignore[method-assign]
        rows.append(at.run()[1])
    assert len(early(rows[0])) > 20
    assert not early(rows[1])
    for name in ("goal_ticks", "slip", "u_ff_ticks", "x_ref_ticks", "slices_processed", "phase", "t_us"):
        ours, theirs = (np.array([row[f"control/{name}"] for row in each], float) for each in rows)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)


@pytest.mark.parametrize("slice_", [150, 151])  # one of which comes while the controller sleeps
@pytest.mark.parametrize("order", ["stops_at", "key_at"])
def test_nothing_is_written_after_an_order(bench: Callable[..., Bench], order: str, slice_: int) -> None:
    """Assert that slip that comes with the order to stop, or to open, is no longer answered."""
    at = bench(slips=lambda k: k >= slice_)
    setattr(at, order, slice_ - 1)
    _, rows = at.run()
    assert slice_ - 3 <= rows[-1]["control/slices_processed"] <= slice_
    assert len(at.hand.goals) == len(rows)


def test_nothing_is_written_where_the_step_is_as_fast_or_the_process_was_stopped(bench: Callable[..., Bench]) -> None:
    """Assert that a command ahead leaves the bus to the step, and that none is given once the step is due."""
    at = bench(slips=lambda k: k >= 100)
    passing = at.clock.passing

    def stopped() -> None:
        if at.zero_s + 0.2 < at.clock.s < at.zero_s + 0.3:
            at.clock.s += 0.9 * PERIOD_S  # this and all other processes
        passing()

    at.clock.passing = stopped
    ended, rows = at.run()
    assert ended.ended == OVER
    for row in early(rows):
        due_us = row["control/t_us"] - row["control/late_us"] - 400.0  # of the step's own beginning
        assert row["control/early_t_us"] + 1e6 * (WRITE_S + 1e-4) < due_us + 1.0


def test_a_bus_that_fails_at_an_early_command(bench: Callable[..., Bench]) -> None:
    """Assert that it ends the grasp as at a step, torque off."""
    at = bench(slips=lambda k: k % 50 == 30 or k % 50 == 7)
    write, sleep, rang = at.hand.write_position, at.clock.sleep, False

    def noting_sleep(seconds: float, wake: WakeSignal | None = None) -> bool:
        nonlocal rang
        rang = sleep(seconds, wake)
        return rang

    def failing_write(goal: int) -> None:
        if rang:
            raise DeviceError("no answer", where="gripper")
        write(goal)

    at.clock.sleep, at.hand.write_position = noting_sleep, failing_write  # type: ignore[method-assign]
    ended, rows = at.run()
    assert rows[-1]["control/phase"] != GraspPhase.CONTACT
    assert ended.ended.endswith("no answer")
    assert math.isnan(ended.released_us)
    assert at.hand.closed_s is not None


@dataclass
class Counting(LawState):
    """A state that counts its steps, in a list that a shallow copy would share."""

    steps: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class CountingLaw(PluginLaw):
    """A law that commands how often it was stepped."""

    method = 1

    def start(self, control_hz: float) -> LawState:
        return Counting()

    def step(self, state: LawState, phase: GraspPhase, slip: bool, signal: SlipSignal, position_ticks: int) -> int:
        assert isinstance(state, Counting)
        state.steps.append(1)
        return len(state.steps)


@pytest.mark.parametrize("law", [LoadLaw(), CountingLaw()])
def test_other_laws(bench: Callable[..., Bench], law: Any) -> None:
    """Assert that laws with more state, and those of other packages, step as often as the grid, and no oftener."""
    at = bench(slips=lambda k: k % 3 == 0)
    _, rows = at.run(law=law)
    assert len(early(rows)) > 20
    if isinstance(law, CountingLaw):
        assert [row["control/goal_ticks"] for row in rows] == list(range(1, len(rows) + 1))
        assert all(row["control/early_goal_ticks"] == row["control/goal_ticks"] for row in early(rows))


@dataclass
class Stuck(LawState):
    """A state that cannot be copied."""

    def __deepcopy__(self, memo: Any) -> "Stuck":
        raise TypeError("no")


class StuckLaw(CountingLaw):
    """A law with such a state."""

    def start(self, control_hz: float) -> LawState:
        return Stuck()


@dataclass(frozen=True)
class HidingLaw(CountingLaw):
    """A law that remembers its steps beside its state."""

    steps: list[int] = field(default_factory=list)

    def step(self, state: LawState, phase: GraspPhase, slip: bool, signal: SlipSignal, position_ticks: int) -> int:
        self.steps.append(1)
        return len(self.steps)


def test_the_contract_test_of_controllers_finds_what_is_not_in_the_state() -> None:
    """Assert that a law which steps on a copy of its state would change is found before it commands a gripper."""
    assert len(testing.goals(CountingLaw())) == 250
    for law, said in ((HidingLaw(), "outside of its state"), (StuckLaw(), "cannot be copied")):
        with pytest.raises(AssertionError, match=said):
            testing.goals(law)


def test_a_state_that_cannot_be_copied_is_refused_before_there_is_torque(bench: Callable[..., Bench]) -> None:
    """Assert that the law's fault is named, and that nothing was commanded."""
    at = bench()
    with pytest.raises(EvetacError, match="cannot be copied"):
        at.run(law=StuckLaw(), controller="stuck")
    assert not at.hand.goals
