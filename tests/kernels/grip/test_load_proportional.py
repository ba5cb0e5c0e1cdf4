"""The grip in proportion to the load: against hand-made loads, and against an ideal gripper."""

import math
from dataclasses import fields

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.kernels.grip.load_proportional import LoadLaw, LoadState, start, step
from evetac_cli.kernels.grip.paper import GraspPhase

CONTACT, LIFT, BALANCE = GraspPhase.CONTACT, GraspPhase.LIFT, GraspPhase.BALANCE
DT_S = 0.002
LAW = LoadLaw()


class Fingers:
    """A gripper that moves by what its push is beyond the band of friction, as fast as it likes."""

    def __init__(self, at_ticks: float = 100.0) -> None:
        self.at_ticks = at_ticks
        self.state = start()

    @property
    def position(self) -> int:
        return math.floor(self.at_ticks)

    def follow(self, phase: GraspPhase, load_px: float, slip: bool = False, seconds: float = DT_S) -> None:
        for _ in range(round(seconds / DT_S)):
            goal = step(self.state, phase, slip, (load_px, 0.0), self.position, DT_S, LAW)
            push = goal - self.position
            if abs(push) > LAW.band_ticks:
                closed = max(self.at_ticks - self.state.rest_ticks, 0.0) * LAW.push_per_tick
                beyond = push - closed - math.copysign(LAW.band_ticks, push)
                self.at_ticks += 0.1 * beyond if push > 0 else min(0.03 * beyond, 0.0)

    @property
    def closed_ticks(self) -> float:
        return self.at_ticks - self.state.rest_ticks


def touching() -> Fingers:
    """Fingers at rest in light contact, and one step of lifting."""
    fingers = Fingers()
    step(fingers.state, CONTACT, False, (0.0, 0.0), fingers.position, DT_S, LAW)
    fingers.follow(LIFT, 0.0)
    return fingers


def balancing(load_px: float = 4.0) -> Fingers:
    """Fingers that hold a load, and have begun to balance it."""
    fingers = touching()
    fingers.follow(LIFT, load_px, seconds=1.0)
    fingers.follow(BALANCE, load_px, seconds=0.2)
    return fingers


def test_contact_is_the_paper_s() -> None:
    """Assert that light contact closes two ticks ahead of wherever the fingers are, slip or not."""
    state = start()
    for position, slip in ((0, False), (57, True), (300, False)):
        assert step(state, CONTACT, slip, (0.3, -0.2), position, DT_S, LAW) == position + 2


@pytest.mark.parametrize("load_px", [0.5, 2.0, 6.0])
def test_the_grip_follows_the_load(load_px: float) -> None:
    """Assert that in the lift the fingers come to rest where ratio times load, and a little more, wants them."""
    fingers = touching()
    fingers.follow(LIFT, load_px, seconds=1.0)
    wanted = LAW.lift_ticks + LAW.first_ratio * load_px
    assert fingers.closed_ticks == pytest.approx(wanted, abs=1.5)
    assert fingers.state.wanted_ticks - fingers.state.rest_ticks == pytest.approx(wanted)


def test_the_load_has_no_direction() -> None:
    """Assert that displacement in any direction is a load, and that only what came since light contact counts."""
    wanted = []
    for shear in ((3.0, 0.0), (0.0, 3.0), (-1.8, -2.4)):
        state = start()
        step(state, CONTACT, False, (7.0, -5.0), 100, DT_S, LAW)
        step(state, LIFT, False, (7.0 + shear[0], -5.0 + shear[1]), 100, DT_S, LAW)
        wanted.append(state.wanted_ticks)
    assert wanted == pytest.approx([wanted[0]] * 3)


def test_the_grip_does_not_fall_in_the_lift() -> None:
    """Assert that in the lift a load that falls leaves the grip where it is: the object may bounce."""
    fingers = touching()
    fingers.follow(LIFT, 4.0, seconds=1.0)
    before = fingers.state.wanted_ticks
    fingers.follow(LIFT, 1.0, seconds=1.0)
    assert fingers.state.wanted_ticks == before


def test_slip_in_the_lift_raises_the_ratio() -> None:
    """Assert that slip under a load raises the ratio by first_ratio in rise_s, and slip without a load does not."""
    fingers = touching()
    fingers.follow(LIFT, 0.0, slip=True, seconds=LAW.rise_s)
    assert fingers.state.ratio == LAW.first_ratio
    fingers.follow(LIFT, 2.0, slip=True, seconds=LAW.rise_s)
    assert fingers.state.ratio == pytest.approx(2 * LAW.first_ratio, rel=0.01)


def test_release_is_the_same_share_a_second() -> None:
    """Assert that in balance the ratio falls to 1/e in release_s, until it holds as little as it may."""
    fingers = balancing()
    before = fingers.state.ratio
    fingers.follow(BALANCE, 4.0, seconds=LAW.release_s / 2)
    assert fingers.state.ratio == pytest.approx(before * math.exp(-0.5), rel=0.01)
    fingers.follow(BALANCE, 4.0, seconds=10.0)
    assert fingers.state.ratio == pytest.approx(LAW.least_ratio)
    assert fingers.closed_ticks == pytest.approx(LAW.least_ratio * 4.0 + LAW.spare_ticks, abs=1.0)


def test_the_grip_closes_on_slip_and_stays_above_it() -> None:
    """Assert that slip confirmed by the load closes well beyond where it came, and the grip returns to just above."""
    fingers = balancing()
    fingers.follow(BALANCE, 4.0, seconds=2.0)
    came_at = fingers.state.ratio
    fingers.follow(BALANCE, 4.08, slip=True)
    assert fingers.state.ratio > came_at * (1 + LAW.catch)
    fingers.follow(BALANCE, 4.0, seconds=3.0)
    assert came_at < fingers.state.needed == pytest.approx(fingers.state.ratio)
    assert fingers.state.needed < 1.5 * came_at
    needed = fingers.state.needed
    fingers.follow(BALANCE, 4.0, seconds=10.0)
    assert fingers.state.ratio == needed


def test_slip_that_the_load_does_not_confirm() -> None:
    """Assert that it ends the release for a while, closes the grip only if it lasts, and sets no needed ratio."""
    fingers = balancing()
    fingers.follow(BALANCE, 4.0, seconds=1.0)
    came_at = fingers.state.ratio
    fingers.follow(BALANCE, 4.0, slip=True, seconds=LAW.unconfirmed_s - 2 * DT_S)
    fingers.follow(BALANCE, 4.0, seconds=LAW.quiet_s - DT_S)
    assert fingers.state.ratio == came_at
    fingers.follow(BALANCE, 4.0, seconds=1.0)
    released = fingers.state.ratio
    assert released < came_at
    fingers.follow(BALANCE, 4.0, slip=True, seconds=LAW.unconfirmed_s + DT_S)
    assert fingers.state.ratio > (1 + LAW.catch) * released
    assert fingers.state.needed == 0.0
    fingers.follow(BALANCE, 4.0, seconds=5.0)
    assert fingers.state.ratio < released


def test_a_falling_load_is_slip() -> None:
    """Assert that a steady grip closes on a load that falls by more than its share, without the detector."""
    fingers = balancing()
    fingers.follow(BALANCE, 4.0, seconds=1.0)
    came_at = fingers.state.ratio
    fingers.follow(BALANCE, 4.0 * (1 - 2 * LAW.fall) - LAW.fall_px)
    assert fingers.state.ratio > came_at * (1 + LAW.catch)
    assert fingers.state.needed > came_at


def test_a_sinking_object_ends_the_release() -> None:
    """Assert that a load that grows while the grip falls ends the release where it is, and does not close."""
    fingers = balancing()
    fingers.follow(BALANCE, 4.0, seconds=1.0)
    came_at = fingers.state.ratio
    fingers.follow(BALANCE, 4.0 * (1 + 1.5 * LAW.sink) + LAW.sink_px, seconds=0.1)
    assert came_at * 0.95 < fingers.state.needed == fingers.state.ratio <= came_at
    fingers.follow(BALANCE, 4.0 * (1 + 1.5 * LAW.sink) + LAW.sink_px, seconds=5.0)
    assert fingers.state.ratio == fingers.state.needed


def test_more_weight_is_gripped_at_once() -> None:
    """Assert that twice the load finds twice the grip within 50 ms, by the ratio that slip has shown before."""
    fingers = balancing(2.0)
    fingers.follow(BALANCE, 2.0, seconds=1.0)
    fingers.follow(BALANCE, 2.06, slip=True)
    fingers.follow(BALANCE, 2.0, seconds=5.0)
    before = fingers.closed_ticks
    fingers.follow(BALANCE, 4.0, seconds=0.05)
    assert fingers.closed_ticks - before == pytest.approx(2.0 * fingers.state.needed, abs=1.5)


steps = st.tuples(st.booleans(), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.integers(0, 740))


@given(st.lists(steps, max_size=10), st.lists(steps, max_size=40), st.lists(steps, max_size=80))
@settings(deadline=None, max_examples=60)
def test_bounds(contact: list, lift: list, balance: list) -> None:
    """Assert, whatever comes, that goals are whole, in range, and no further from the fingers than the most push."""
    state = start()
    for phase, sequence in ((CONTACT, contact), (LIFT, lift), (BALANCE, balance)):
        for slip, x, y, position in sequence:
            goal = step(state, phase, slip, (x, y), position, DT_S, LAW)
            assert type(goal) is int
            assert 0 <= goal <= LAW.last_tick
            assert abs(goal - position) <= LAW.most_push or position > LAW.last_tick
            assert math.isfinite(state.wanted_ticks)
            assert math.isfinite(state.ratio)
            assert 0.0 <= state.ratio <= LAW.most_ratio


@pytest.mark.parametrize("name", [item.name for item in fields(LoadLaw)])
def test_constants_out_of_range(name: str) -> None:
    """Assert that a constant that is negative or not finite is refused by its name."""
    for value in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match=name):
            LoadLaw(**{name: value})


def test_ratios_are_in_order() -> None:
    """Assert that the first ratio lies between the least and the most, and time constants are no zero."""
    with pytest.raises(ValueError, match="least_ratio"):
        LoadLaw(first_ratio=1.0, least_ratio=2.0)
    with pytest.raises(ValueError, match="release_s"):
        LoadLaw(release_s=0.0)
    assert isinstance(start(), LoadState)
