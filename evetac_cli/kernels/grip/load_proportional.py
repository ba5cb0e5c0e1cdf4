"""A grip in proportion to the load: as firm as the object pulls at the gel, times what friction shows to be needed.

The gel is a load cell. A layer bonded to its back answers a shear force with a displacement whose integral over the gel
is the force over G/H, wherever and on whatever patch it acts; so the mean displacement of the dots is the force in
pixels. What holds an object is friction in proportion to the grip. So this controller closes to

    wanted = rest + spare + ratio * load,      rest: where light contact ended; load: displacement since then, in px

at every step, which follows a load that grows before anything slips. How many ticks it takes per pixel differs by a
factor of 40 between gels, objects and friction; so the ratio is found anew in each grasp:

- In the lift the object still stands on the table, where a slide costs little. The ratio begins low, and grows while
  the contact slips. Whether it does, is asked of the load: friction of what slides goes with the grip, weight does not.
  A slip signal that closes the grip and changes no load is not believed for a while, so that a detector that cries
  closes by a bounded share, and the grip comes back. Without a slip signal the grip is made firmer by a small step now
  and then, until the load no longer answers: then the gripper carries the object.
- What stopped a slide is `slide` times what holds at rest, as sliding friction is less; what is needed follows, and the
  grip aims at `margin` times that. Where nothing slid, the ratio falls slowly in balance, by the same share per second
  whatever the object weighs, until the load or its turn moves more than the fall itself explains, until little sticks,
  or until slip.
- More weight finds the same ratio. Without a slip signal it never opens beyond what load, turn and sticking say.
"""

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

from evetac_cli.checks import check_range
from evetac_cli.kernels.grip import fingers
from evetac_cli.kernels.grip.fingers import FingerState, Gear
from evetac_cli.kernels.grip.paper import GraspPhase

MARGIN, MOST_MARGIN = 1.3, 5.0


class Felt(NamedTuple):
    """What a step of the law gets to know: slip since the step before, and what the dots show.

    x_px, y_px: mean displacement of all dots to the right and down; turn_px: how far they have turned about their
    middle, in rms; sticking_share: of the contact, NaN where nothing is felt or none is told.
    """

    slip: bool = False
    x_px: float = 0.0
    y_px: float = 0.0
    turn_px: float = 0.0
    sticking_share: float = math.nan


@dataclass(frozen=True)
class LoadLaw:
    """Constants of the law; ticks are those of the encoder, px those of the displacement of all dots.

    margin: how many times what is needed the grip aims at. The others were chosen on simulated grasps of seeds 0 to 35
    of scripts/grip_trials.py, those of a release also on 200 to 213.
    """

    margin: float = MARGIN
    approach: float = 2.0  # ticks ahead in light contact, as the paper's law
    approach_dry_s: float = 0.15  # without a motion of the encoder since the start: push harder
    first_ratio: float = 2.0  # ticks/px
    most_ratio: float = 60.0
    first_ticks: float = 1.0  # of spare, beyond any ratio
    search_ticks_s: float = 1.5  # the lift closes by while there is no load
    most_spare_ticks: float = 6.0
    least_px: float = 0.15  # less than this counts as no load
    close_s: float = 0.08  # time constant of closing on slip
    close_ticks_s: float = 10.0  # ... and so fast beside it,
    catch_ticks_s: float = 30.0  # where it hangs and falls if it is not caught
    answer_s: float = 0.03  # after which the load is asked whether it answers to the grip
    answer: float = 0.2  # share of the grip's growth by which the load has to grow where something slides
    again_s: float = 0.04  # after which it is asked again where the load has fallen
    ignore_s: float = 0.3  # slip that was not confirmed is not believed for so long, twice as long the next time
    most_ignore_s: float = 2.4
    little_sticks: float = 0.3  # of the contact: ends a release
    quiet_s: float = 0.06  # without slip: it is over
    steady_s: float = 0.15  # for which a load is steady before it is asked whether it is carried
    steady: float = 0.08  # share by which a load may change in quiet_s that is steady
    probe: float = 0.15  # share by which the lift closes to ask whether the object is carried
    probe_ticks: float = 3.0  # ... and by so much, which is more than the lost motion of most grippers
    probe_s: float = 0.06
    slide: float = 1.6  # what stops a slide over what just holds at rest: friction falls to 0.5 to 0.7 as it slides
    knee: float = 1.4  # ... what holds where a release first shows in the load over that
    release_s: float = 4.0  # time constant of the release
    return_s: float = 2.0  # ... of the way to what is known to be needed
    lift_more: float = 1.15  # times what carries is held until balance: the hand may shake, and an even slide hides
    settle_s: float = 0.6  # time constant of a load that is carried, and of the fastest fall of the grip
    window: float = 0.12  # share of the grip in whose release changes are looked at
    moves: float = 0.03  # share of load and turn that a change in a window has to exceed
    moves_px: float = 0.02
    moves_times: float = 1.7  # ... and so many times the change in the first window
    moves_first: float = 3.0  # in the first window, which knows no other, it has to be so many times as large
    falls: float = 0.1  # share by which the load falls at once when a carried object slides
    contact_ticks: float = 4.0  # that light contact may have closed too far already: a release may go so far below it
    gear: Gear = Gear()

    def __post_init__(self) -> None:
        """Refuse constants that are out of range."""
        check_range("margin", self.margin, 1.0, MOST_MARGIN)
        times = ("close_s", "probe_s", "release_s", "return_s", "settle_s", "answer_s", "approach_dry_s", "quiet_s")
        for item in fields(self):
            if item.name not in ("margin", "gear"):
                check_range(item.name, getattr(self, item.name), above=item.name in times)
        for name in ("slide", "knee"):
            check_range(name, getattr(self, name), 1.0)
        if self.first_ratio > self.most_ratio:
            raise ValueError(f"expected first_ratio <= most_ratio, found {self.first_ratio}, {self.most_ratio}")


@dataclass
class LoadState(FingerState):
    """What the controller remembers between steps. Flat, so that a shallow copy is a copy."""

    phase: GraspPhase = GraspPhase.CONTACT
    first_position: int = -1  # of the encoder at the first step
    approach_s: float = 0.0  # since the push was last made harder
    approach_more: int = 0
    steps: int = 0
    rest_ticks: float = 0.0  # where light contact ended: next to no force
    rest_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # displacement and turn there
    ratio: float = 0.0
    spare: float = 0.0
    wanted_ticks: float = 0.0
    load_px: float = 0.0
    pull_px: float = 0.0  # ... of which displacement
    slow_px: float = 0.0  # pull, over some quiet_s
    pulled_px: float = 0.0  # ... over some settle_s
    carried_px: float = 0.0  # load, over some settle_s
    steady_s: float = 0.0  # for which the load has been steady
    slip_steps: int = 0  # in a row
    quiet_s: float = math.inf  # since slip
    ignore_s: float = 0.0  # slip is not believed for so long
    next_ignore_s: float = 0.0
    closes: bool = False  # on slip
    slid: bool = False  # ... that the load has confirmed
    fell: bool = False  # ... or that made the load fall
    asked_s: float = 0.0  # since the grip and the load were noted, below, to be asked whether one answers the other
    asked_ticks: float = 0.0
    asked_px: float = 0.0
    ratio_at_slip: float = 0.0
    spare_at_slip: float = 0.0
    slid_on_table: bool = False
    least_ratio: float = 0.0  # that a release may come to, by what stopped that
    probing: bool = False
    carried: bool = False
    needed: float = 0.0  # ratio that is known to be what the grip aims at; 0 before
    seen_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # load and turn at the start of a window of the release
    seen_ticks: float = 0.0  # grip there; 0: none began
    usual_px: float = -1.0  # change in the first window
    u_ff: float = 0.0  # push, negative closes: for the record
    x_ref: float = math.nan  # wanted position: for the record


def start() -> LoadState:
    """The state before the first step."""
    return LoadState()


def step(state: LoadState, phase: GraspPhase, felt: Felt, position_ticks: int, dt_s: float, law: LoadLaw) -> int:
    """One control step of dt_s: the goal in ticks."""
    if phase is GraspPhase.CONTACT:
        return _touch(state, felt, position_ticks, dt_s, law)
    if state.phase is GraspPhase.CONTACT:
        state.ratio, state.spare, state.next_ignore_s = law.first_ratio, law.first_ticks, law.ignore_s
    fingers.observe(state, position_ticks)
    moved = _moved(felt, state.rest_px)
    state.load_px, state.pull_px = math.hypot(*moved), math.hypot(moved[0], moved[1])
    _watch_load(state, dt_s, law)
    if phase is GraspPhase.BALANCE and state.phase is not phase:
        if not state.carried:
            state.carried, state.ratio, state.closes = True, _held_ratio(state, law), False
        state.needed, state.seen_ticks = 0.0, 0.0  # what seemed to slip while the hand moved
    state.phase = phase
    slips = _slips(state, felt, dt_s, law)
    if slips and (state.carried or state.load_px > law.least_px):
        _close(state, dt_s, law)
    elif state.closes and state.quiet_s < law.quiet_s:
        pass  # it may come again at once
    else:
        if state.closes:
            _end_close(state, law)
        if not state.carried:
            _seek(state, dt_s, law)
        else:
            _release(state, moved, felt, dt_s, law)
    # an object that slides pulls less, and must not be let go for that
    load_px = max(state.load_px, state.carried_px) if state.carried else state.load_px
    wanted = state.rest_ticks + state.spare + state.ratio * load_px
    # before it is carried a load that falls bounces, or slides over the table
    falls_s = law.settle_s if state.carried else math.inf
    slowest = (abs(state.wanted_ticks - state.rest_ticks) + 1.0) * dt_s / falls_s
    state.wanted_ticks = max(wanted, min(state.wanted_ticks, state.place_ticks) - slowest)
    state.x_ref = state.wanted_ticks
    push = fingers.push(state, state.wanted_ticks, state.rest_ticks, dt_s, law.gear)
    state.u_ff = -float(push)
    return _clip_whole(position_ticks + push, law.gear.last_tick)


def _touch(state: LoadState, felt: Felt, position_ticks: int, dt_s: float, law: LoadLaw) -> int:
    """Light contact: closing by the least push that moves the fingers, until something is felt."""
    if state.first_position < 0:
        state.first_position = position_ticks
    state.steps += 1
    state.position, state.usual_position = position_ticks, float(position_ticks)
    state.rest_ticks, state.rest_px = position_ticks - 0.5, (felt.x_px, felt.y_px, felt.turn_px)
    state.place_ticks = position_ticks + 0.5
    state.wanted_ticks = state.rest_ticks
    push = law.approach
    if not math.isnan(felt.sticking_share):
        push = 0.0
    elif abs(position_ticks - state.first_position) < 3:  # a stiff gear: it has not begun to move
        state.approach_s += dt_s
        if state.approach_s > law.approach_dry_s:
            state.approach_s, state.approach_more = 0.0, min(state.approach_more + 1, int(law.gear.most_push))
    if push and state.approach_more:  # pulses, so that they do not close further than they have to
        push += state.approach_more if state.steps % 4 == 0 else 0.0
        state.harder_ticks = float(state.approach_more)
    state.u_ff = -push
    return _clip_whole(position_ticks + push, law.gear.last_tick)


def _moved(felt: Felt, rest_px: tuple[float, float, float]) -> tuple[float, float, float]:
    return felt.x_px - rest_px[0], felt.y_px - rest_px[1], felt.turn_px - rest_px[2]


def _watch_load(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """Follow the load slowly, and say for how long its pull has been steady: an object off its middle swings."""
    state.slow_px += (state.pull_px - state.slow_px) * min(dt_s / law.quiet_s, 1.0)
    state.carried_px += (state.load_px - state.carried_px) * min(dt_s / law.settle_s, 1.0)
    state.pulled_px += (state.pull_px - state.pulled_px) * min(dt_s / law.settle_s, 1.0)
    steady = abs(state.pull_px - state.slow_px) <= law.steady * state.pull_px + 0.1 * law.least_px
    state.steady_s = state.steady_s + dt_s if steady and state.load_px > law.least_px else 0.0


def _slips(state: LoadState, felt: Felt, dt_s: float, law: LoadLaw) -> bool:
    """Whether something slips, by detector or load, that is believed."""
    state.slip_steps = state.slip_steps + 1 if felt.slip else 0
    state.ignore_s = max(state.ignore_s - dt_s, 0.0)
    slips = (state.slip_steps >= 2 or _fell(state, law)) and state.ignore_s <= 0.0
    state.quiet_s = 0.0 if slips else state.quiet_s + dt_s
    return slips


def _fell(state: LoadState, law: LoadLaw) -> bool:
    """Whether a load that was carried has become less: friction falls as it begins to slide."""
    return state.carried and state.pull_px < state.pulled_px * (1.0 - law.falls) - 0.2 * law.least_px


def _grip_ticks(state: LoadState) -> float:
    return max(state.place_ticks - state.rest_ticks, 0.25)


def _held_ratio(state: LoadState, law: LoadLaw) -> float:
    """The ratio by which the fingers are where they are."""
    ratio = max(_grip_ticks(state) - state.spare, 0.0) / max(state.load_px, law.least_px)
    return min(max(ratio, 0.1 * law.first_ratio), law.most_ratio)


def _ask(state: LoadState) -> None:
    """Note grip and pull, to be asked later whether one answers to the other; a turn swings by itself."""
    state.asked_s, state.asked_ticks, state.asked_px = 0.0, _grip_ticks(state), state.pull_px


def _answer(state: LoadState, law: LoadLaw) -> float:
    """Growth of the load over that of the grip, since both were noted: 1 where something slides, 0 where it hangs."""
    offset = law.contact_ticks if state.carried else 0.0  # where it hangs, rather see a slide too many
    grown = max((_grip_ticks(state) - state.asked_ticks) / (state.asked_ticks + offset), 1e-3)
    return (state.pull_px / max(state.asked_px, 1e-6) - 1.0) / grown


def _close(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """Close on slip while the load answers to it."""
    if not state.closes:
        state.closes, state.slid, state.fell, state.probing = True, False, False, False
        state.slid_on_table = state.slid_on_table or not state.carried
        state.ratio_at_slip, state.spare_at_slip = state.ratio, state.spare
        _ask(state)
    state.asked_s += dt_s
    state.fell = state.fell or _fell(state, law)
    state.slid = state.slid or state.fell
    state.ratio = min(state.ratio * (1.0 + dt_s / law.close_s), law.most_ratio)
    if state.carried:
        state.spare = max(state.spare, 0.0)
    by_ticks = (law.catch_ticks_s if state.carried else law.close_ticks_s) * dt_s
    state.spare = max(state.spare, min(state.spare + by_ticks, law.most_spare_ticks))
    if state.asked_s < law.answer_s or _grip_ticks(state) < 1.2 * state.asked_ticks:
        return
    if _answer(state, law) >= law.answer:
        state.slid = True
        state.next_ignore_s = law.ignore_s
        _ask(state)
        return
    if _fell(state, law):
        state.ignore_s, state.next_ignore_s = law.again_s, law.ignore_s
    else:
        state.ignore_s = state.next_ignore_s
        state.next_ignore_s = min(2.0 * state.next_ignore_s, law.most_ignore_s) if state.carried else law.ignore_s
    _end_close(state, law)


def _end_close(state: LoadState, law: LoadLaw) -> None:
    """Slip is over, or was none: what is needed follows from where it ended, or the grip comes back."""
    state.closes, state.seen_ticks = False, 0.0
    # fingers that are behind need go no further
    state.ratio = max(min(state.ratio, _held_ratio(state, law)), state.ratio_at_slip)
    if not state.slid:
        state.ratio, state.spare = state.ratio_at_slip, state.spare_at_slip
    elif state.carried:
        state.spare = state.spare_at_slip
        if state.fell:  # else only the detector says so
            state.needed = min(max(state.ratio_at_slip * law.margin, state.needed), state.ratio)
    _ask(state)


def _seek(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """In the lift: wait for a load, and ask by a firmer grip whether the gripper carries it."""
    if state.load_px <= law.least_px:
        state.spare = min(state.spare + law.search_ticks_s * dt_s, law.most_spare_ticks)
        return
    if not state.probing:
        if state.steady_s > law.steady_s:
            state.ratio = _held_ratio(state, law)
            state.probing, state.ratio_at_slip = True, state.ratio
            _ask(state)
        return
    state.asked_s += dt_s
    if state.asked_s <= law.probe_s:
        grow = law.probe * (state.spare + state.ratio * state.load_px) + law.probe_ticks
        grow *= dt_s / law.probe_s
        state.ratio = min(state.ratio + grow / state.load_px, law.most_ratio)
    elif state.asked_s > 2 * law.probe_s:
        state.probing = False
        if _answer(state, law) > 2 * law.answer:  # an object that swings changes the load, too
            state.slid_on_table = True
            return
        state.carried, state.ratio = True, state.ratio_at_slip
        if state.slid_on_table:
            state.least_ratio = state.ratio * law.margin / law.slide
        state.ratio *= law.lift_more


def _release(state: LoadState, moved: tuple[float, float, float], felt: Felt, dt_s: float, law: LoadLaw) -> None:
    """Open, to what is known to be needed or until the load, its turn or what sticks show it."""
    if state.needed:
        if state.phase is GraspPhase.BALANCE or state.ratio < state.needed:
            state.ratio += (state.needed - state.ratio) * dt_s / law.return_s
        return
    if _shows(state, moved, law) or felt.sticking_share < law.little_sticks:
        state.needed = state.ratio * law.margin / law.knee
        return
    if state.phase is GraspPhase.LIFT:
        return
    state.ratio = max(state.ratio - state.ratio * dt_s / law.release_s, min(state.ratio, state.least_ratio))
    state.spare = max(state.spare - (state.spare + law.contact_ticks) * dt_s / law.release_s, -law.contact_ticks)


def _shows(state: LoadState, moved: tuple[float, float, float], law: LoadLaw) -> bool:
    """Whether load and turn change more than the fall of the grip explains."""
    grip = state.spare + law.contact_ticks + state.ratio * state.load_px
    if not state.seen_ticks:
        state.seen_ticks, state.seen_px, state.usual_px = grip, moved, -1.0
        return False
    change_px = math.dist(moved, state.seen_px)
    size_px = math.hypot(*moved)
    usual_px = max(state.usual_px, 0.0)
    moves_px = law.moves * size_px + law.moves_px
    if change_px > (law.moves_first * moves_px if state.usual_px < 0.0 else max(moves_px, law.moves_times * usual_px)):
        return True
    if grip < state.seen_ticks * (1.0 - law.window):
        state.usual_px = change_px if state.usual_px < 0.0 else state.usual_px
        state.seen_ticks, state.seen_px = grip, moved
    return False


def _clip_whole(goal: float, last_tick: int) -> int:
    return int(min(max(round(goal), 0), last_tick))
