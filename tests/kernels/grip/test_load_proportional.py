"""The grip in proportion to the load: against an object on a table or in the air, in fingers of an ideal gripper."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.kernels.grip.load_law import FingerState, Gear, LawInput, LoadLaw, Mode, observe, push
from evetac_cli.kernels.grip.load_proportional import start, step
from evetac_cli.kernels.grip.paper import GraspPhase

CONTACT, LIFT, BALANCE = GraspPhase.CONTACT, GraspPhase.LIFT, GraspPhase.BALANCE
DT_S = 0.002
LAW = LoadLaw()
STATIC = 1.5


class World:
    """Fingers that move by what their push is beyond the gear's friction, and an object that a hand lifts with them.

    needs: ticks of grip for each pixel of load that slides; at rest friction bears STATIC times as much. While the
    object slides the load is what friction bears, and it slides until the fingers bear all of its weight.
    """

    def __init__(self, weight_px: float, needs: float, law: LoadLaw = LAW, *, tells: bool = True) -> None:
        self.weight_px, self.needs, self.law, self.tells = weight_px, needs, law, tells
        self.at_ticks, self.state = 100.0, start()
        self.pulled_px = 0.0  # what the object would pull if nothing slid
        self.cries = self.slides = False
        self.share = 1.0  # of the contact sticks while the object does not slide
        self.most_ticks = 0.0
        for _ in range(50):
            self._step(CONTACT, 0.0)
        self.touched_ticks = self.at_ticks

    @property
    def grip_ticks(self) -> float:
        return max(self.at_ticks - self.touched_ticks + LAW.light_ticks, 0.0)

    @property
    def load_px(self) -> float:
        return min(self.pulled_px, (1.0 if self.slides else STATIC) * self.grip_ticks / self.needs)

    def _step(self, phase: GraspPhase, px: float) -> None:
        slip = self.cries or (self.tells and phase is not CONTACT and self.slides)
        share = min(self.share, 0.5) if self.tells and self.slides else self.share
        position = math.floor(self.at_ticks)
        goal = step(self.state, phase, LawInput(slip, px, 0.0, 0.0, share), position, DT_S, self.law)
        ahead = goal - position - Gear().push_per_tick * max(self.at_ticks - self.state.rest_ticks, 0.0)
        beyond = abs(ahead) - Gear().band_ticks
        if beyond > 0.0 and phase is not CONTACT:
            self.at_ticks += math.copysign(0.08 * beyond, ahead)

    def follow(self, phase: GraspPhase, seconds: float, px_s: float = 20.0) -> "World":
        """Pull the object up by px_s more each second, until it hangs."""
        for _ in range(round(seconds / DT_S)):
            self.pulled_px = min(self.pulled_px + px_s * DT_S, self.weight_px)
            self.slides = self.load_px < self.pulled_px
            self._step(phase, self.load_px)
            self.most_ticks = max(self.most_ticks, self.grip_ticks)
        return self


def test_contact_is_the_paper_s_until_something_is_felt() -> None:
    """Assert that light contact closes two ticks ahead of the fingers, and rests once the contact is felt."""
    state = start()
    for position in (0, 57, 300):
        assert step(state, CONTACT, LawInput(slip=True), position, DT_S, LAW) == position + 2
    assert step(state, CONTACT, LawInput(sticking_share=1.0), 300, DT_S, LAW) == 300


def test_a_stiff_gear_is_pushed_harder_until_it_moves() -> None:
    """Assert that fingers which do not move for a while are pushed by a tick more, one step in four."""
    state = start()
    goals = [step(state, CONTACT, LawInput(), 100, DT_S, LAW) for _ in range(200)]
    dry = round(LAW.approach_dry_s / DT_S)
    assert set(goals[:dry]) == {102}
    assert sorted(goals[dry + 4 : dry + 12]) == [102] * 6 + [103] * 2
    assert max(goals) == 104


@pytest.mark.parametrize(("weight_px", "needs"), [(0.6, 4.0), (3.0, 2.5), (12.0, 3.0), (5.0, 8.0)])
def test_the_lift_closes_while_the_object_slides(weight_px: float, needs: float) -> None:
    """Assert that objects of other weight and friction hang in the end, and are held by the margin over what holds."""
    world = World(weight_px, needs).follow(LIFT, 5.0)
    assert world.load_px == weight_px
    assert world.state.mode is Mode.HOLD
    world.follow(BALANCE, 4.0)
    assert world.load_px == pytest.approx(weight_px)
    assert 1.0 <= world.grip_ticks / (weight_px * needs / STATIC) < 2.5


def test_without_a_slip_signal_the_lift_asks_the_load() -> None:
    """Assert that a silent detector leaves the object on the table no longer than the probes need."""
    world = World(4.0, 5.0, tells=False).follow(LIFT, 6.0)
    assert world.load_px == 4.0
    assert world.state.mode is Mode.HOLD
    assert world.grip_ticks < 2.0 * 20.0  # at most a probe beyond what stopped it


def test_a_detector_that_cries_closes_by_a_bounded_share() -> None:
    """Assert that slip all the time closes an object that hangs to a bounded grip, and that most of it comes back."""
    world = World(4.0, 1.5).follow(LIFT, 4.0).follow(BALANCE, 4.0)
    before = max(world.grip_ticks, world.state.ratio * world.load_px)
    world.cries, world.most_ticks = True, 0.0
    world.follow(BALANCE, 6.0)
    assert before < world.most_ticks < LAW.margin * LAW.most_boost * LAW.most_doubt * before
    assert world.most_ticks < LAW.most_ticks + LAW.most_ticks_px * world.load_px + 1.0
    world.cries = False
    world.follow(BALANCE, 4.0)
    assert world.grip_ticks < 1.1 * LAW.margin * LAW.most_doubt * before


def test_a_release_ends_where_the_load_shows_it_twice() -> None:
    """Assert that an object which never slid is released slowly, until its load has moved twice as the grip falls."""
    world = World(4.0, 0.3).follow(LIFT, 2.0)
    assert world.state.mode is Mode.HOLD
    assert world.state.friction.needed == 0.0
    before = world.state.ratio
    world.follow(BALANCE, 1.0)
    assert world.state.friction.needed == 0.0
    assert world.state.ratio == pytest.approx(before * math.exp(-1.0 / LAW.release_s), rel=0.02)
    before = world.state.ratio
    world.weight_px += 0.6
    while not world.state.friction.doubted:
        world.follow(BALANCE, DT_S, px_s=1.0)
    doubted = world.state.friction.doubted
    assert 0.6 * before < doubted < before
    assert world.state.friction.needed == 0.0
    world.follow(BALANCE, 0.7)
    assert 1.0 < world.state.boost.factor < LAW.slide
    assert world.state.friction.calm
    assert world.state.ratio == doubted  # a grip that is firmer than the ratio shows nothing of it
    while world.state.boost.factor > 1.0:
        world.follow(BALANCE, DT_S)
    world.follow(BALANCE, 1.1 * LAW.window * LAW.release_s)
    world.weight_px += 0.6
    world.follow(BALANCE, 1.0, px_s=2.5)
    needed = world.state.friction.needed
    assert LAW.again * LAW.margin * doubted < needed < LAW.margin * doubted
    world.follow(BALANCE, 4.0)
    assert world.state.ratio == pytest.approx(needed, rel=1e-2)


def test_a_release_waits_for_the_fingers() -> None:
    """Assert that fingers which do not open as they are told say nothing of the grip that is needed."""
    world = World(4.0, 0.3).follow(LIFT, 2.0).follow(BALANCE, 0.5)
    before, at_ticks = world.state.ratio, world.at_ticks
    for _ in range(1000):
        world.follow(BALANCE, DT_S)
        world.at_ticks = at_ticks
    assert world.state.finger.place_ticks >= math.floor(at_ticks)
    assert before * (1.0 - 4.0 * LAW.lags_ticks / world.grip_ticks) < world.state.ratio < before


def test_a_release_without_a_sign_ends() -> None:
    """Assert that a grip which nothing shows to be too light is opened to a tick, and more weight finds more of it."""
    world = World(2.0, 0.01, tells=False).follow(LIFT, 2.0).follow(BALANCE, 12.0)
    assert world.state.friction.needed == 0.0
    assert world.state.ratio * world.load_px == pytest.approx(LAW.least_ticks, rel=0.01)
    world.weight_px = 4.0
    world.follow(BALANCE, 0.1, px_s=40.0)
    assert world.state.ratio * world.load_px == pytest.approx(2.0 * LAW.least_ticks, rel=0.1)


def test_a_gripper_at_its_limit_carries() -> None:
    """Assert that an object whose load swings is carried at last by fingers which can close no further."""
    world = World(20.0, 0.3, tells=False).follow(LIFT, 0.1)
    limit_ticks, steps = world.at_ticks, 0
    while world.state.mode is not Mode.HOLD and steps < 2000:
        behind_ticks = world.state.wanted_ticks - world.state.finger.place_ticks
        world.pulled_px = 10.0 + 3.0 * math.sin(0.05 * steps)
        world.follow(LIFT, DT_S, px_s=0.0)
        world.at_ticks, steps = min(world.at_ticks, limit_ticks), steps + 1
    assert world.state.mode is Mode.HOLD
    assert behind_ticks > LAW.gear.most_push


def test_a_grip_as_firm_as_the_law_has_it_carries() -> None:
    """Assert that the law asks for no more than its firmest grip, and takes what that holds as carried."""
    law = replace(LAW, most_ticks=5.0, most_ticks_px=1.0)
    world = World(4.0, 0.3, law, tells=False).follow(LIFT, 2.0)
    assert world.state.mode is Mode.HOLD
    assert world.most_ticks < 5.0 + 4.0 + 1.0


def test_a_slide_that_shows_no_longer_is_closed_on() -> None:
    """Assert that the lift goes on closing on an object that slides on, though the detector has fallen silent."""
    world = World(6.0, 6.0)
    while world.state.mode is not Mode.TIGHTEN:
        world.follow(LIFT, DT_S)
    world.tells = False
    world.follow(LIFT, 0.4)
    assert not world.slides
    assert world.load_px == 6.0


def test_a_load_that_jumps_up_is_followed_and_ends_no_release() -> None:
    """Assert that what a hand's jerk adds at once to the load says nothing of friction."""
    world = World(4.0, 0.3).follow(LIFT, 2.0).follow(BALANCE, 1.0)
    before = world.state.wanted_ticks - world.state.rest_ticks
    world.weight_px += 2.0
    world.follow(BALANCE, 0.1, px_s=200.0)
    assert world.state.friction.needed == 0.0
    assert world.state.wanted_ticks - world.state.rest_ticks == pytest.approx(1.5 * before, rel=0.1)


def test_a_load_that_falls_in_a_release_is_a_sign() -> None:
    """Assert that a load which falls fast but step by step, as of a slide with a silent detector, is not let pass."""
    world = World(4.0, 0.3, tells=False).follow(LIFT, 2.0).follow(BALANCE, 1.0)
    before = world.state.ratio
    for _ in range(60):
        world.pulled_px = world.weight_px = 0.99 * world.weight_px
        world.follow(BALANCE, DT_S)
    assert not world.slides
    assert 0.9 * before < world.state.friction.doubted < before


def test_a_sign_of_slip_ends_a_release_once_it_comes_again() -> None:
    """Assert that little that sticks is met by a firmer grip for a while, and ends the release the second time."""
    world = World(4.0, 0.3).follow(LIFT, 2.0).follow(BALANCE, 0.5)
    world.share = 0.1
    world.follow(BALANCE, DT_S)
    assert world.state.friction.needed == 0.0
    world.share = 1.0
    world.follow(BALANCE, DT_S)
    assert world.state.boost.factor == LAW.slide
    world.follow(BALANCE, 1.0)
    assert world.state.boost.factor == 1.0
    ratio, world.share = world.state.ratio, 0.1
    assert ratio < world.state.friction.doubted
    world.follow(BALANCE, DT_S)
    assert world.state.friction.needed == pytest.approx(ratio * LAW.margin)


@pytest.mark.parametrize(
    ("steps", "share", "margin"),
    [((LAW.sure_steps,), 1.0, LAW.margin), ((3, 3), 0.8, LAW.margin), ((3, 3), 0.9, 1.0)],
)
def test_slip_that_lasts_or_comes_again_at_once_ends_a_release(
    steps: tuple[int, ...], share: float, margin: float
) -> None:
    """Assert that slip ends a release where it lasts, and where it comes again though the grip is firmer by then.

    A grip at which most of the contact stuck as the warning came has its margin already.
    """
    world = World(4.0, 0.3).follow(LIFT, 2.0).follow(BALANCE, 0.5)
    ratio, world.share = world.state.ratio, share
    for count in steps:
        assert world.state.friction.needed == 0.0
        world.cries = True
        world.follow(BALANCE, count * DT_S)
        world.cries = False
        world.follow(BALANCE, 0.1)
        assert world.state.boost.factor > 1.0
    assert world.state.friction.needed == pytest.approx(ratio * margin, rel=0.01)


def test_more_weight_is_gripped_in_proportion() -> None:
    """Assert that twice the load finds about twice the grip, by the ratio that is known."""
    world = World(3.0, 2.5).follow(LIFT, 5.0).follow(BALANCE, 3.0)
    before = world.grip_ticks
    world.weight_px = 6.0
    world.follow(BALANCE, 2.0, px_s=30.0)
    assert world.load_px == 6.0
    assert world.grip_ticks == pytest.approx(2.0 * before, rel=0.4)


def test_a_larger_margin_holds_more_firmly() -> None:
    """Assert that the grip in the end is in proportion to the margin that is asked for."""
    held = [World(6.0, 6.0, replace(LAW, margin=m)).follow(LIFT, 5.0).follow(BALANCE, 12.0) for m in (1.2, 1.5)]
    assert held[1].state.ratio / held[0].state.ratio == pytest.approx(1.5 / 1.2, rel=0.05)
    assert held[1].grip_ticks > 1.1 * held[0].grip_ticks


def test_load_counts_from_light_contact() -> None:
    """Assert that displacement in any direction is load, from where light contact ended, and so is turn, weighted."""
    loads = []
    for x, y, turn in ((3.0, 0.0, 0.0), (0.0, -3.0, 0.0), (-1.8, 2.4, 4.0 / LAW.turn)):
        state = start()
        step(state, CONTACT, LawInput(False, 7.0, -5.0, 1.0), 100, DT_S, LAW)
        step(state, LIFT, LawInput(False, 7.0 + x, -5.0 + y, 1.0 + turn), 100, DT_S, LAW)
        loads.append(state.load.px)
    assert loads == pytest.approx([3.0, 3.0, 5.0])


def test_light_contact_that_was_not_felt_has_closed_further() -> None:
    """Assert that the grip may open further below where light contact ended, where nothing was felt until its end."""
    rests = []
    for share in (1.0, math.nan):
        state = start()
        step(state, CONTACT, LawInput(sticking_share=share), 100, DT_S, LAW)
        rests.append(100.5 - state.rest_ticks)
    assert rests == [LAW.light_ticks, LAW.unfelt_ticks]


@pytest.mark.parametrize("band_ticks", [1.0, 1.94, 3.3])
@pytest.mark.parametrize("balance_share", [0.25, 0.5, 1.0, 1.2])
def test_fingers_open_to_where_they_should_on_soft_and_stiff_gels(balance_share: float, band_ticks: float) -> None:
    """Assert that opening ends at its goal, where a gel needs another push for balance than the law's, and a gear too.

    A gel of a quarter of the stiffness was once closed further between two opening pushes than these opened.
    """
    gear, state, at_ticks = Gear(), FingerState(place_ticks=100.0, position=100), 100.0
    for _ in range(5000):
        observe(state, int(at_ticks))
        lead = push(state, 30.0, 0.0, DT_S, gear)
        free = lead - balance_share * gear.push_per_tick * at_ticks
        at_ticks += 0.1 * math.copysign(max(abs(free) - band_ticks, 0.0), free)
    assert at_ticks == pytest.approx(30.0, abs=1.0)


def test_what_was_spare_is_not_let_go_untold() -> None:
    """Assert that the grip which was found to carry the object is all in the ratio, what was spare too."""
    world = World(2.0, 5.0)
    while world.state.mode is not Mode.HOLD:
        spare = world.state.spare
        world.follow(LIFT, DT_S)
    held_ticks = world.state.finger.place_ticks - world.state.rest_ticks
    assert spare > 1.0
    assert world.state.spare == 0.0
    assert world.state.ratio * world.load_px == pytest.approx(held_ticks, rel=0.05)


def test_what_was_not_carried_is_lifted_anew() -> None:
    """Assert that an object whose load was small when it seemed to be carried counts as on the table once it grows."""
    world = World(0.6, 4.0).follow(LIFT, 3.0)
    assert world.state.mode is Mode.HOLD
    world.weight_px = 6.0
    while world.state.mode is Mode.HOLD:
        world.follow(LIFT, DT_S)
    assert world.load_px > LAW.small_px
    world.follow(LIFT, 4.0).follow(BALANCE, 4.0)
    assert world.load_px == pytest.approx(6.0)


def test_a_load_that_falls_is_gripped_by_what_stops_a_slide() -> None:
    """Assert that a silent detector does not matter to a load that falls, as of a slide: it is gripped more firmly."""
    world = World(3.0, 2.5, tells=False).follow(LIFT, 5.0).follow(BALANCE, 8.0)
    state = world.state
    needed, before = state.friction.needed, state.wanted_ticks - state.rest_ticks
    assert needed > 0.0
    step(state, BALANCE, LawInput(False, 0.7 * world.load_px, 0.0, 0.0, 1.0), math.floor(world.at_ticks), DT_S, LAW)
    assert state.wanted_ticks - state.rest_ticks == pytest.approx(LAW.slide * before, rel=0.1)
    assert state.friction.needed == pytest.approx(min(needed * LAW.doubt, state.friction.first_needed * LAW.most_doubt))


def test_slip_that_the_load_does_not_confirm_is_doubt() -> None:
    """Assert that each such signal of an object that is carried makes the grip firmer for good, up to a bound."""
    world = World(4.0, 5.0).follow(LIFT, 5.0).follow(BALANCE, 2.0)
    state, needs = world.state, [world.state.friction.needed]
    world.cries = True
    for _ in range(30):
        world.follow(BALANCE, 1.0)
        needs.append(state.friction.needed)
    assert needs == sorted(needs)
    assert needs[0] * LAW.doubt <= needs[1] < needs[-1]
    assert needs[-1] == pytest.approx(state.friction.first_needed * LAW.most_doubt)
    assert state.friction.first_needed == needs[0]


def test_pushes_that_open_find_how_hard() -> None:
    """Assert that fingers which pushes do not open are pushed harder, step by step, until they do."""
    state, at_ticks, goals = FingerState(place_ticks=150.5, position=150), 150.0, []
    for _ in range(3000):
        observe(state, math.floor(at_ticks))
        goals.append(push(state, 120.0, 100.0, DT_S, Gear()))
        at_ticks += min(goals[-1] - 0.05 * (at_ticks - 100.0) + 5.0, 0.0) * 0.05  # a gear of twice the friction
    assert min(goals[:100]) > min(goals)
    assert at_ticks == pytest.approx(120.0, abs=2.0)


def test_fingers_at_rest_are_not_pushed_after_an_encoder_s_noise() -> None:
    """Assert that an encoder which jumps by a tick each way moves fingers that are where they are wanted no farther."""
    rng = np.random.default_rng(0)
    state = FingerState(place_ticks=150.5, position=150)
    goals = []
    for noise in rng.integers(-1, 2, 2000):
        observe(state, 150 + int(noise))
        goals.append(push(state, 150.5, 100.0, DT_S, Gear()))
    rests = round(Gear().push_per_tick * 50)
    assert sum(abs(goal - rests) > 1 for goal in goals[500:]) < 30


steps = st.tuples(
    st.booleans(), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-1e3, 1e3),
    st.one_of(st.just(math.nan), st.floats(0, 1)), st.integers(0, 740),
)  # fmt: skip


@given(st.lists(steps, max_size=10), st.lists(steps, max_size=40), st.lists(steps, max_size=80))
@settings(deadline=None, max_examples=60)
def test_bounds(contact: list, lift: list, balance: list) -> None:
    """Assert, whatever comes, that goals are whole and in range, and what is remembered is finite."""
    state = start()
    for phase, sequence in ((CONTACT, contact), (LIFT, lift), (BALANCE, balance)):
        for *felt, position in sequence:
            goal = step(state, phase, LawInput(*felt), position, DT_S, LAW)
            assert type(goal) is int
            assert 0 <= goal <= LAW.gear.last_tick
            assert math.isfinite(state.wanted_ticks)
            assert 0.0 <= state.ratio <= LAW.most_ratio
