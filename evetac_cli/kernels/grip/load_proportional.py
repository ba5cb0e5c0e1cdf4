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
  and then, until the load no longer answers: then the gripper carries the object, and what was spare joins the ratio.
- What stopped a slide is `slide` times what holds at rest, as sliding friction is less; what is needed follows, and the
  grip aims at `margin` times that. Where nothing slid, the ratio falls slowly, by the same share per second whatever
  the object weighs, until the load or its turn moves more than the fall itself explains, until little sticks, or until
  slip.
- An object that slides under its whole weight pulls no more when gripped more firmly, and slides on under a grip that
  would hold it at rest. So a load that jumps or falls is gripped `slide` times as firmly until it has settled; and slip
  of what is carried that the load does not confirm makes the grip a little firmer for good, up to a bound.
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
    of scripts/grip_trials.py, those of a release also on 200 to 213; slide, knee, probe, jolt and doubt last on 0 to
    19. Doubt, and that what is spare joins the ratio, came after a look at two grasps that fell, 307 and 311.
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
    close_ticks_s: float = 10.0  # ... and so fast beside it
    answer_s: float = 0.03  # after which the load is asked whether it answers to the grip
    answer: float = 0.2  # share of the grip's growth by which the load has to grow where something slides
    ignore_s: float = 0.3  # slip that was not confirmed is not believed for so long, twice as long the next time
    most_ignore_s: float = 2.4
    little_sticks: float = 0.3  # of the contact: counts as slip in the lift, and ends a release
    quiet_s: float = 0.06  # without slip: it is over
    steady: float = 0.03  # share by which a load may change in quiet_s that is steady
    wait_s: float = 0.5  # ... and asked without it after so long: a slide may shake
    probe: float = 0.15  # share by which the lift closes to ask whether the object is carried
    probe_ticks: float = 1.5  # ... and by so much at least, which the encoder sees
    probe_s: float = 0.06
    probe_most_s: float = 0.25  # fingers that have not closed by so much by then are at their limit
    slide: float = 1.6  # what stops a slide over what just holds at rest: friction falls to 0.5 to 0.7 as it slides
    knee: float = 1.25  # ... what holds where a release first shows in the load over that
    release_s: float = 4.0  # time constant of the release
    settle_s: float = 0.6  # ... of a load that settles, and of the way to what is known to be needed
    window: float = 0.12  # share of the grip in whose release changes are looked at
    moves: float = 0.025  # share of load and turn that a change in a window has to exceed
    moves_px: float = 0.02
    moves_times: float = 1.5  # ... and so many times the change in the first window
    jolt: float = 0.1  # share by which a load that changes within settle_s may have made a carried object slide
    doubt: float = 1.15  # slip of what is carried that the load does not confirm makes what is needed so much more,
    most_doubt: float = 1.4  # ... up to so many times what is known
    gear: Gear = Gear()

    def __post_init__(self) -> None:
        """Refuse constants that are out of range."""
        check_range("margin", self.margin, 1.0, MOST_MARGIN)
        times = ("close_s", "probe_s", "release_s", "settle_s", "answer_s", "approach_dry_s", "quiet_s")
        for item in fields(self):
            if item.name not in ("margin", "gear"):
                check_range(item.name, getattr(self, item.name), above=item.name in times)
        for name in ("slide", "knee", "doubt", "most_doubt"):
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
    slow_px: float = 0.0  # load, over some quiet_s
    settled_px: float = 0.0  # ... over some settle_s
    steady_s: float = 0.0  # for which the load has been steady
    slip_steps: int = 0  # in a row
    quiet_s: float = math.inf  # since slip
    ignore_s: float = 0.0  # slip is not believed for so long
    next_ignore_s: float = 0.0
    closes: bool = False  # on slip
    slid: bool = False  # ... that the load has confirmed
    asked_s: float = 0.0  # since the grip and the load were noted, below, to be asked whether one answers the other
    asked_ticks: float = 0.0
    asked_px: float = 0.0
    ratio_at_slip: float = 0.0
    spare_at_slip: float = 0.0
    waited_s: float = 0.0  # with a load, for it to be steady
    probing: bool = False
    probed_s: float = 0.0  # since the probe has closed
    carried: bool = False
    needed: float = 0.0  # ratio that the grip aims at, once it is known; 0 before
    known: float = 0.0  # ... but for doubt
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
    state.phase = phase
    fingers.observe(state, position_ticks)
    moved = _moved(felt, state.rest_px)
    state.load_px = math.hypot(moved[0], moved[1])
    _watch_load(state, dt_s, law)
    if phase is GraspPhase.BALANCE and not state.carried:
        _carry(state, state.ratio, law)
    slips = _slips(state, felt, dt_s, law)
    if slips and state.load_px > law.least_px:
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
    load_px = state.load_px
    if state.needed and _jolts(state, law):
        load_px = law.slide * max(load_px, state.settled_px)
    wanted = state.rest_ticks + state.spare + state.ratio * load_px
    before = min(state.wanted_ticks, state.place_ticks)  # fingers that are behind need go no further
    state.wanted_ticks = max(wanted, before - (before - state.rest_ticks) * dt_s / law.settle_s)
    state.x_ref = state.wanted_ticks
    push = fingers.push(state, state.wanted_ticks, state.rest_ticks, dt_s, law.gear)
    state.u_ff = -float(push)
    return _clip_whole(position_ticks + push, law.gear.last_tick)


def _touch(state: LoadState, felt: Felt, position_ticks: int, dt_s: float, law: LoadLaw) -> int:
    """Light contact: closing by the least push that moves the fingers, until something is felt."""
    if state.first_position < 0:
        state.first_position = position_ticks
    state.steps += 1
    state.position = position_ticks
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
    """Follow the load slowly, and say for how long it has been steady."""
    state.slow_px += (state.load_px - state.slow_px) * min(dt_s / law.quiet_s, 1.0)
    state.settled_px += (state.load_px - state.settled_px) * min(dt_s / law.settle_s, 1.0)
    steady = abs(state.load_px - state.slow_px) <= law.steady * state.load_px + 0.1 * law.least_px
    state.steady_s = state.steady_s + dt_s if steady and state.load_px > law.least_px else 0.0


def _slips(state: LoadState, felt: Felt, dt_s: float, law: LoadLaw) -> bool:
    """Whether something slips, by detector or sticking share, that is believed."""
    state.slip_steps = state.slip_steps + 1 if felt.slip else 0
    state.ignore_s = max(state.ignore_s - dt_s, 0.0)
    little = felt.sticking_share < law.little_sticks and not state.carried
    slips = (state.slip_steps >= 2 or little) and state.ignore_s <= 0.0
    state.quiet_s = 0.0 if slips else state.quiet_s + dt_s
    return slips


def _jolts(state: LoadState, law: LoadLaw) -> bool:
    """Whether a load that is carried has changed of late: a slide may have begun, which takes more to stop."""
    changed_px = abs(state.load_px - state.settled_px)
    return state.carried and changed_px > state.settled_px * law.jolt + 0.2 * law.least_px


def _grip_ticks(state: LoadState) -> float:
    return max(state.place_ticks - state.rest_ticks, 0.25)


def _ask(state: LoadState) -> None:
    """Note grip and load, to be asked later whether the load answers to the grip."""
    state.asked_s, state.asked_ticks, state.asked_px = 0.0, _grip_ticks(state), state.load_px


def _answers(state: LoadState, share: float) -> bool:
    """Whether the load has grown by this share of the growth of the grip at least, since both were noted."""
    grown = _grip_ticks(state) / state.asked_ticks - 1.0
    return state.load_px > state.asked_px * (1.0 + share * max(grown, 0.0))


def _close(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """Close on slip while the load answers to it."""
    if not state.closes:
        state.closes, state.slid, state.probing = True, False, False
        state.ratio_at_slip, state.spare_at_slip = state.ratio, state.spare
        _ask(state)
    state.asked_s += dt_s
    state.ratio = min(state.ratio * (1.0 + dt_s / law.close_s), law.most_ratio)
    state.spare = min(state.spare + law.close_ticks_s * dt_s, law.most_spare_ticks)
    if state.asked_s < law.answer_s or _grip_ticks(state) < 1.2 * state.asked_ticks:
        return
    if _answers(state, law.answer):
        state.slid = True
        state.next_ignore_s = law.ignore_s
        _ask(state)
        return
    state.ignore_s = state.next_ignore_s
    state.next_ignore_s = min(2.0 * state.next_ignore_s, law.most_ignore_s)
    _end_close(state, law)


def _end_close(state: LoadState, law: LoadLaw) -> None:
    """Slip is over, or was none: what is needed follows from where it ended, or the grip comes back."""
    state.closes, state.seen_ticks = False, 0.0
    if not state.slid:
        state.ratio, state.spare = max(state.ratio_at_slip, 1e-3), state.spare_at_slip
        if state.carried and state.needed:
            state.needed = min(state.needed * law.doubt, state.known * law.most_doubt)
    elif not state.carried:  # closing stopped it on the table
        _need(state, _whole(state, state.ratio, law) * law.margin / law.slide)
        _unwind(state, law)
    else:
        _need(state, min(max(state.ratio_at_slip * law.margin, state.needed), _whole(state, state.ratio, law)))
    if state.carried:
        state.spare = 0.0
    _ask(state)


def _whole(state: LoadState, ratio: float, law: LoadLaw) -> float:
    """The ratio that alone closes as far as this one and what is spare, or as the fingers have got to."""
    wanted = ratio * state.load_px + state.spare
    return min(min(wanted, _grip_ticks(state)) / max(state.load_px, law.least_px), law.most_ratio)


def _unwind(state: LoadState, law: LoadLaw) -> None:
    """Take back what the fingers have not followed."""
    state.ratio = max(min(state.ratio, _whole(state, state.ratio, law)), state.ratio_at_slip)


def _need(state: LoadState, ratio: float) -> None:
    state.needed = state.known = ratio


def _carry(state: LoadState, ratio: float, law: LoadLaw) -> None:
    """From here on the grip follows the load alone: what was spare may be what holds."""
    state.carried, state.ratio, state.spare = True, _whole(state, ratio, law), 0.0


def _seek(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """In the lift: wait for a load, and ask by a firmer grip whether the gripper carries it."""
    if state.load_px <= law.least_px:
        state.spare = min(state.spare + law.search_ticks_s * dt_s, law.most_spare_ticks)
        return
    if not state.probing:
        state.waited_s += dt_s
        there = _grip_ticks(state) < state.spare + state.ratio * state.load_px + 0.5 * law.probe_ticks
        if (there and state.steady_s > law.quiet_s) or state.waited_s > law.wait_s:
            state.probing, state.ratio_at_slip, state.probed_s, state.waited_s = True, state.ratio, 0.0, 0.0
            _ask(state)
        return
    state.asked_s += dt_s
    grow = max(law.probe * state.asked_ticks, law.probe_ticks)
    closed = _grip_ticks(state) >= state.asked_ticks + grow
    if not closed and not state.probed_s and state.asked_s <= law.probe_most_s:
        most = min(state.ratio_at_slip + 2.0 * grow / state.load_px, law.most_ratio)
        state.ratio = min(state.ratio + grow * dt_s / law.probe_s / state.load_px, most)
        return
    state.probed_s += dt_s
    if state.probed_s <= law.probe_s:
        return
    state.probing = False
    if _answers(state, 2 * law.answer):
        state.slid, state.steady_s = True, law.quiet_s
        _unwind(state, law)
        return
    if _grip_ticks(state) < state.asked_ticks + 0.5 * grow:  # the fingers have not moved: nothing was asked
        state.ratio = state.ratio_at_slip
        return
    if state.slid and not state.needed:
        _need(state, _whole(state, state.ratio_at_slip, law) * law.margin / law.slide)
    _carry(state, state.ratio_at_slip, law)


def _release(state: LoadState, moved: tuple[float, float, float], felt: Felt, dt_s: float, law: LoadLaw) -> None:
    """Open, to what is known to be needed or until the load, its turn or what sticks show it."""
    if state.needed:
        state.ratio += (state.needed - state.ratio) * dt_s / law.settle_s
    elif _shows(state, moved, law) or felt.sticking_share < law.little_sticks:
        _need(state, state.ratio * law.margin / law.knee)
    else:
        state.ratio -= state.ratio * dt_s / law.release_s


def _shows(state: LoadState, moved: tuple[float, float, float], law: LoadLaw) -> bool:
    """Whether load and turn change more than the fall of the grip explains."""
    grip = state.spare + state.ratio * state.load_px
    if not state.seen_ticks:
        state.seen_ticks, state.seen_px, state.usual_px = grip, moved, -1.0
        return False
    change_px = math.dist(moved, state.seen_px)
    size_px = math.hypot(*moved)
    usual_px = max(state.usual_px, 0.0)
    if change_px > max(law.moves * size_px + law.moves_px, law.moves_times * usual_px):
        return True
    if grip < state.seen_ticks * (1.0 - law.window):
        state.usual_px = change_px if state.usual_px < 0.0 else state.usual_px
        state.seen_ticks, state.seen_px = grip, moved
    return False


def _clip_whole(goal: float, last_tick: int) -> int:
    return int(min(max(round(goal), 0), last_tick))
