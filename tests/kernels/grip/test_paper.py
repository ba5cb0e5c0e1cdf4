"""The grasp controller against the text of the paper (section VII-A), sentence by sentence, in hand-made sequences."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.kernels.grip.paper import PAPER, PAPER_RESET, GraspPhase, GripLaw, GripState, start, step

CONTACT, LIFT, BALANCE = GraspPhase.CONTACT, GraspPhase.LIFT, GraspPhase.BALANCE


def lifting(position: int = 100) -> GripState:
    """A controller that has made contact and taken one step of lifting without slip."""
    state = start()
    step(state, CONTACT, False, position)
    step(state, LIFT, False, position)
    return state


def balancing(position: int = 100, u_ff: float = 0.0, x_ref: float = math.nan) -> GripState:
    """A controller at the end of the lifting phase."""
    state = lifting(position)
    state.u_ff, state.x_ref = u_ff, x_ref
    return state


def feed(state: GripState, phase: GraspPhase, slips: str, position: int = 100) -> list[float]:
    """u_ff after each step; slips as in "..ss." with s for slip."""
    trace = []
    for slip in slips:
        step(state, phase, slip == "s", position)
        trace.append(state.u_ff)
    return trace


def test_contact_closes_by_two_ticks_from_where_it_is() -> None:
    """Assert u_ff = -2 with x_e = 0: the goal is the present position plus 2, wherever that is, slip or not."""
    state = start()
    for position, slip in ((0, False), (1, True), (57, False), (57, True), (300, False), (290, False)):
        assert step(state, CONTACT, slip, position) == position + 2
        assert state.u_ff == -2.0
        assert math.isnan(state.x_ref)


def test_lift_starts_with_zero() -> None:
    """Assert that u_ff "is initialized as zero": a first step without slip leaves it there, with slip it is -1."""
    for slip, u_ff in ((False, 0.0), (True, -1.0)):
        state = start()
        step(state, CONTACT, False, 100)
        step(state, LIFT, slip, 100)
        assert state.u_ff == u_ff


def test_lift_is_clipped_to_closing() -> None:
    """Assert that u_ff stays within [-5, 0]: six steps with slip end at -5, and 501 without at 0, exactly."""
    state = lifting()
    assert feed(state, LIFT, "ssssss") == [-1.0, -2.0, -3.0, -4.0, -5.0, -5.0]
    no_slip = feed(state, LIFT, "." * 501)
    assert no_slip[0] == pytest.approx(-4.99)
    assert no_slip[-1] == 0.0
    assert max(no_slip) == 0.0


def test_lift_reference_before_the_first_switch() -> None:
    """Assert that x_e is zero before the first switch from slip to none: the goal follows the present position."""
    state = lifting(100)
    for position, u_ff in ((100, 1), (101, 2), (105, 3), (103, 4)):
        assert step(state, LIFT, True, position) == position + u_ff
        assert math.isnan(state.x_ref)


def test_lift_reference_is_taken_where_slip_ends() -> None:
    """Assert that at each switch from slip to none the present position becomes the reference, and only there."""
    state = lifting(100)
    sequence = [
        # slip, position -> reference, goal
        (True, 100, math.nan, 101),  # u_ff -1, x_e zero
        (True, 102, math.nan, 104),  # u_ff -2
        (False, 107, 107.0, 109),  # the switch: x_ref = x_g(t); u_ff -1.99
        (False, 110, 107.0, 109),  # the reference stays; u_ff -1.98
        (True, 112, 107.0, 110),  # slip again: u_ff -2.98 against the same reference
        (True, 114, 107.0, 111),  # u_ff -3.98
        (False, 116, 116.0, 120),  # "the reference is adapted accordingly"; u_ff -3.97
    ]
    for slip, position, reference, goal in sequence:
        assert step(state, LIFT, slip, position) == goal
        assert state.x_ref == pytest.approx(reference, nan_ok=True)


def test_slip_while_making_contact_is_no_slip_of_the_lift() -> None:
    """Assert that slip reported in the last step of contact does not set a reference in the first one of lifting."""
    state = start()
    step(state, CONTACT, True, 100)
    assert step(state, LIFT, False, 100) == 100
    assert math.isnan(state.x_ref)
    assert step(state, LIFT, True, 104) == 105


def test_balance_goes_on_with_the_same_u_ff() -> None:
    """Assert "using the same time-varying feedforward term": balance starts from u_ff of the lift, x_e zero again."""
    state = balancing(u_ff=-1.5, x_ref=90.0)
    assert step(state, BALANCE, False, 120) == 121  # 120 + 1.49
    assert state.u_ff == pytest.approx(-1.49)
    assert math.isnan(state.x_ref)


def test_balance_opens_to_two_until_slip() -> None:
    """Assert +0.01 a step without slip, clipped to 2 (opening); the goal then lies 2 ticks below the position."""
    state = balancing()
    assert feed(state, BALANCE, "...") == pytest.approx([0.01, 0.02, 0.03], abs=1e-12)
    assert feed(state, BALANCE, "." * 300)[-1] == 2.0
    assert step(state, BALANCE, False, 150) == 148
    assert step(state, BALANCE, False, 80) == 78


def test_balance_reference_is_the_position_before_the_first_slip() -> None:
    """Assert that the first slip sets x_ref = x_g(t - 1), and neither its end nor a later slip changes it."""
    state = balancing(100)
    assert step(state, BALANCE, False, 99) == 99
    assert step(state, BALANCE, False, 97) == 97
    assert step(state, BALANCE, True, 92) == 99  # x_ref 97, u_ff 0.02 - 2
    assert state.x_ref == 97.0
    for slip, position in ((True, 93), (False, 95), (False, 96), (True, 90), (False, 91), (True, 80)):
        step(state, BALANCE, slip, position)
        assert state.x_ref == 97.0


def test_balance_does_not_open_beyond_the_reference_after_the_first_slip() -> None:
    """Assert that the clip becomes [-5, 0] with the first slip, at once and for good."""
    state = balancing(u_ff=0.0)
    feed(state, BALANCE, "." * 300)
    assert state.u_ff == 2.0
    assert feed(state, BALANCE, "s") == [0.0]
    assert feed(state, BALANCE, "." * 5) == [0.0] * 5
    assert feed(state, BALANCE, "s." + "." * 300)[-1] == 0.0
    assert feed(state, BALANCE, "ssss") == [-2.0, -4.0, -5.0, -5.0]


def test_balance_acts_on_slip_in_its_first_step() -> None:
    """Assert that slip between the last step of lifting and the first of balance counts: it closes and is the first."""
    state = balancing(100, u_ff=-1.0)
    assert step(state, BALANCE, True, 96) == 103  # x_ref = x_g(t - 1) = 100, u_ff = -3
    assert state.x_ref == 100.0
    assert state.u_ff == -3.0


def test_slip_that_began_in_the_lift_is_not_the_first_of_balance() -> None:
    """Assert that "s(t-1) = 0 and s(t) = 1" is asked for: slip that goes on closes, but sets no reference yet."""
    state = balancing(100)
    step(state, LIFT, True, 100)
    assert step(state, BALANCE, True, 101) == 104  # u_ff -1 - 2, x_e zero
    assert math.isnan(state.x_ref)
    step(state, BALANCE, False, 105)
    step(state, BALANCE, True, 106)
    assert state.x_ref == 105.0


def test_goal_is_in_whole_ticks() -> None:
    """Assert that reference minus u_ff is rounded to the nearest tick, and never leaves the range of the gripper."""
    state = lifting(200)
    state.u_ff, state.x_ref = -2.40, 200.0
    assert step(state, LIFT, False, 190) == 202
    state.u_ff = -2.62
    assert step(state, LIFT, False, 190) == 203
    assert step(start(), CONTACT, False, 740) == 740
    assert step(start(), CONTACT, False, 739) == 740
    state = balancing(0, u_ff=2.0)
    assert step(state, BALANCE, False, 1) == 0
    assert all(type(step(start(), phase, False, 5)) is int for phase in GraspPhase)


def test_other_constants() -> None:
    """Assert that a law with other constants is followed, each in its place."""
    law = GripLaw(
        approach=-3,
        lift_slip=-0.5,
        lift_no_slip=0.1,
        balance_slip=-1,
        balance_no_slip=0.2,
        lowest=-1.2,
        highest_open=0.3,
    )
    state = start()
    assert step(state, CONTACT, False, 50, law) == 53
    trace = []
    for phase, slip in ((LIFT, 1), (LIFT, 1), (LIFT, 1), (LIFT, 0), (BALANCE, 0), (BALANCE, 1), (BALANCE, 0)):
        step(state, phase, bool(slip), 50, law)
        trace.append(state.u_ff)
    assert trace == pytest.approx([-0.5, -1.0, -1.2, -1.1, -0.9, -1.2, -1.0])
    state = balancing(50, u_ff=0.2)
    step(state, BALANCE, False, 50, law)
    assert state.u_ff == 0.3


def test_the_paper_law() -> None:
    """Assert the constants of the paper, because every header carries them."""
    assert (PAPER.approach, PAPER.lift_slip, PAPER.lift_no_slip) == (-2.0, -1.0, 0.01)
    assert (PAPER.balance_slip, PAPER.balance_no_slip, PAPER.lowest, PAPER.highest_open) == (-2.0, 0.01, -5.0, 2.0)


steps = st.tuples(st.booleans(), st.integers(0, 740))


@given(st.lists(steps, min_size=1, max_size=20), st.lists(steps, max_size=40), st.lists(steps, max_size=40))
@settings(deadline=None)
def test_bounds(contact: list[tuple[bool, int]], lift: list[tuple[bool, int]], balance: list[tuple[bool, int]]) -> None:
    """Assert, whatever comes, that u_ff keeps its range, x_ref is a position that came, and goals are near it."""
    state, positions = start(), set()
    for phase, sequence in ((CONTACT, contact), (LIFT, lift), (BALANCE, balance)):
        switched = False
        for slip, position in sequence:
            positions.add(position)
            before = state.slipped and phase is state.phase
            goal = step(state, phase, slip, position)
            switched |= (before and not slip) if phase is LIFT else slip
            assert 0 <= goal <= 740
            assert -5.0 <= state.u_ff <= (2.0 if phase is BALANCE else 0.0)
            reference = position if math.isnan(state.x_ref) else state.x_ref
            assert reference in positions
            assert goal == min(max(round(reference - state.u_ff), 0), 740)
            if not switched:
                assert math.isnan(state.x_ref)
            if phase is not BALANCE:
                assert goal >= reference  # "the grasping force can only increase"
            elif not math.isnan(state.x_ref):
                assert state.u_ff <= 0.0


def test_paper_reset_takes_every_beginning_of_slip() -> None:
    """Assert that with paper-reset each beginning of slip sets x_ref = x_g(t - 1), and slip that goes on does not."""
    state = balancing(100)
    for slip, position, reference in (
        (False, 99, math.nan),
        (True, 97, 99.0),  # the first slip
        (True, 95, 99.0),  # goes on
        (False, 101, 99.0),
        (True, 100, 101.0),  # begins again
        (False, 104, 101.0),
        (True, 90, 104.0),
    ):
        step(state, BALANCE, slip, position, PAPER_RESET)
        assert state.x_ref == pytest.approx(reference, nan_ok=True)


def test_a_gain_moves_the_goal_away_from_the_fingers_in_balance_alone() -> None:
    """Assert that with gain 2 the goal is twice as far from the position as without, in balance and nowhere else."""
    usual, twice = start(), start()
    doubled = replace(PAPER, gain=2.0)
    for phase, slip, position in (
        (CONTACT, False, 100), (LIFT, True, 102), (LIFT, False, 104), (LIFT, False, 105),
        (BALANCE, False, 103), (BALANCE, True, 99), (BALANCE, True, 98), (BALANCE, False, 100), (BALANCE, False, 110),
    ):  # fmt: skip
        away = step(usual, phase, slip, position) - position
        assert step(twice, phase, slip, position, doubled) - position == (2 if phase is BALANCE else 1) * away
    assert twice.u_ff == usual.u_ff


def test_another_rate_changes_u_ff_as_much_a_second() -> None:
    """Assert that 0.2 s of slip, or of none, at 50, 100, 250 and 1000 Hz move u_ff as at 500 Hz, clipped alike."""
    for hz in (50, 100, 250, 500, 1000):
        law = PAPER.at(hz)
        no_slip = balancing()
        for _ in range(hz // 5):
            step(no_slip, BALANCE, False, 100, law)
        assert no_slip.u_ff == pytest.approx(1.0)
        slipping = lifting()
        step(slipping, LIFT, True, 100, law)
        assert slipping.u_ff == pytest.approx(max(-500 / hz, -5.0))
    assert PAPER.at(500) == PAPER


def test_lift_increments() -> None:
    """Assert u_i = -1 with slip and 0.01 without."""
    assert feed(lifting(), LIFT, "ss..s.") == pytest.approx([-1.0, -2.0, -1.99, -1.98, -2.98, -2.97], abs=1e-12)
