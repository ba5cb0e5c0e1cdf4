"""The controller's beat, on a clock that only these tests move."""

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from evetac_cli.trials.grasp.deadlines import FRESH_US, MOST_SHIFT_US, Deadlines, shift_us
from tests.trials.grasp.bench import MOST_S, PERIOD_S, Clock


@given(took=st.lists(st.floats(0.0, 0.02), min_size=1, max_size=50))
def test_deadlines_are_absolute_and_none_is_hidden(took: list[float]) -> None:
    """Assert that steps begin on the grid, or less than a period late, and that every deadline that passed counts."""
    clock = Clock()
    deadlines = Deadlines(PERIOD_S, clock.now_s, clock.sleep)
    began_s = clock.s
    passed = 0
    for seconds in took:
        late_us = deadlines.wait()
        assert 0.0 <= late_us < (PERIOD_S + MOST_S) * 1e6
        due_s = clock.s - late_us * 1e-6
        steps = (due_s - began_s) / PERIOD_S
        assert steps == pytest.approx(round(steps), abs=1e-5)
        clock.s += seconds
        periods = (clock.s - due_s) / PERIOD_S
        assume(not 0 < abs(periods - round(periods)) < 1e-6)  # whether it is in time is then a matter of rounding
        passed += math.floor(periods)
    deadlines.wait()
    assert deadlines.missed == passed


def test_one_long_step() -> None:
    """Assert that a step of three and a half periods costs three deadlines; the next begins half a one late."""
    clock = Clock()
    deadlines = Deadlines(PERIOD_S, clock.now_s, clock.sleep)
    assert deadlines.wait() == 0.0
    clock.s += 3.5 * PERIOD_S
    assert deadlines.wait() == pytest.approx(0.5e6 * PERIOD_S)
    assert deadlines.missed == 3
    clock.s += 0.1 * PERIOD_S
    assert deadlines.wait() == pytest.approx(0.0, abs=1e-3)
    assert deadlines.missed == 3


@given(own=st.lists(st.floats(0.0, 0.01), min_size=1, max_size=20), waited=st.lists(st.floats(0.0, 0.01), min_size=20))
def test_whose_fault_a_missed_deadline_is(own: list[float], waited: list[float]) -> None:
    """Assert that deadlines are ours where they pass without the gripper's answers being late, and else the gripper's.

    A step that took so long on its own, and so much longer because it waited, begins where the one before ended.
    """
    clock = Clock()
    deadlines = Deadlines(PERIOD_S, clock.now_s, clock.sleep)
    late_us = deadlines.wait()
    due_s = clock.s - late_us * 1e-6
    ours = gripper = 0
    for alone_s, waited_s in zip(own, waited, strict=False):
        begun_s = clock.s
        clock.s += alone_s + waited_s
        for passed_s in (clock.s - due_s, clock.s - waited_s - due_s):
            assume(abs(passed_s / PERIOD_S - round(passed_s / PERIOD_S)) > 1e-6 or passed_s == 0.0)
        alone = math.floor((begun_s + alone_s - due_s) / PERIOD_S)
        ours += alone
        gripper += math.floor((clock.s - due_s) / PERIOD_S) - alone
        late_us = deadlines.wait(waited_s)
        due_s = clock.s - late_us * 1e-6
    assert (deadlines.missed - deadlines.missed_by_gripper, deadlines.missed_by_gripper) == (ours, gripper)


@given(age_us=st.floats(0.0, 5000.0))
def test_steps_follow_the_status(age_us: float) -> None:
    """Assert that a shift is small, repeats with the slices, and brings the age of the status to what is wanted."""
    shift = shift_us(age_us)
    assert abs(shift) <= MOST_SHIFT_US
    assert shift_us(age_us + 1000.0) == pytest.approx(shift, abs=1e-6)
    for _ in range(1000):
        age_us = (age_us + shift_us(age_us)) % 1000.0
    assert age_us == pytest.approx(FRESH_US, abs=1.0)
