"""Grip law in proportion to the load: the grip is the shear load on the gel, times the ratio that its friction needs.

The gel is a load cell. A layer bonded to its back answers a shear force with a displacement whose integral over the gel
is the force over G/H, for any position and patch of the force. So the mean displacement of the dots is the shear
force in pixels, and their rotation about their centre is its moment. An object is held by friction in proportion to the
grip, and friction carries force and moment together (Howe and Cutkosky, Int. J. Robotics Research 15, 1996). So this
controller closes at every step to

    wanted = rest + spare + ratio * load,      load = hypot(displacement, turn times a constant) since light contact

The grip thus follows a growing load before anything slips. The number of ticks needed per pixel depends on gel, object
and friction, so each grasp finds the ratio again:

- Lift: the object is still on the table, where a slide costs little. While the object sticks, the load grows as fast as
  the hand rises, so a sign of slip counts only once the load grows more slowly. The grip then closes while the load
  answers, that is while it grows with the grip: the friction of a sliding object does, a weight does not. The grip
  keeps closing while the load stalls, because a steady slide moves no dots and shows no slip.
- Lift without a sign of slip: the grip closes in small probes until the load no longer answers or the gripper is at
  its limit. Then the gripper carries the object, and the spare becomes part of the ratio.
- Release: the grip on a carried object opens slowly, by the same share per second for every weight, as far as the
  fingers follow. It opens until a sign comes twice at about the same grip: slip, or a change of the load beyond what
  the opening explains. Slip that lasts, or recurs at a firmer grip, is not a false alarm and counts at once. From
  then on the grip is `margin` times the grip at that sign.
- Stopping a slide: an object that slides under its whole weight pulls no harder when it is gripped more firmly, and
  keeps sliding under a grip that would hold it at rest. So at the end of a release, after slip and when the load
  falls, the grip is `slide` times as firm for a while. Each slip also raises the needed ratio a little, up to a bound.
- A heavier object leads to the same ratio. A detector with false alarms adds a bounded share; without a detector the
  load alone shows the slip.
"""

import math

from evetac_cli.kernels.grip import load_law
from evetac_cli.kernels.grip.load_law import Felt, LoadLaw, LoadState
from evetac_cli.kernels.grip.paper import GraspPhase


def start() -> LoadState:
    """Return the state before the first step."""
    return LoadState()


def step(state: LoadState, phase: GraspPhase, felt: Felt, position_ticks: int, dt_s: float, law: LoadLaw) -> int:
    """Do one control step of dt_s and return the goal in ticks."""
    if phase is GraspPhase.CONTACT:
        return _touch(state, felt, position_ticks, dt_s, law)
    if state.phase is GraspPhase.CONTACT:
        state.ratio, state.spare = law.first_ratio, state.light_ticks + law.first_ticks
        state.next_ignore_s, state.probe_share = law.ignore_s, law.probe
    state.phase = phase
    load_law.observe(state, position_ticks)
    load = _load(felt, state.rest_px, law)
    _watch_load(state, math.hypot(*load), dt_s, law)
    if phase is GraspPhase.BALANCE and not state.carried:
        _carry(state, law)
    slips = _slips(state, felt, dt_s, law)
    if state.carried:
        _hold(state, load, felt, slips, dt_s, law)
    else:
        _lift(state, slips, dt_s, law)
    load_px = max(state.load_px, state.held_px)
    if state.carried:
        load_px = min(load_px, law.most_load * state.base_px)
    grip = min(state.spare + state.ratio * state.boost * load_px, _most_ticks(load_px, law))
    wanted = state.rest_ticks + grip
    before = min(state.wanted_ticks, state.place_ticks)  # fingers that are behind have less to open
    opens = (before - state.rest_ticks) * dt_s / (law.settle_s if state.carried else law.leaks_s)
    state.wanted_ticks = max(wanted, before - opens)
    state.x_ref = state.wanted_ticks
    push = load_law.push(state, state.wanted_ticks, state.rest_ticks, dt_s, law.gear)
    state.u_ff = -float(push)
    return _clip_whole(position_ticks + push, law.gear.last_tick)


def _touch(state: LoadState, felt: Felt, position_ticks: int, dt_s: float, law: LoadLaw) -> int:
    """Light contact: close by the smallest push that moves the fingers, until contact is felt."""
    if state.first_position < 0:
        state.first_position = position_ticks
    state.steps += 1
    state.position = position_ticks
    state.place_ticks = state.wanted_ticks = position_ticks + 0.5
    state.light_ticks = law.unfelt_ticks if math.isnan(felt.sticking_share) else law.light_ticks
    state.rest_ticks = state.place_ticks - state.light_ticks
    state.rest_px = felt.x_px, felt.y_px, felt.turn_px
    push = law.approach
    if not math.isnan(felt.sticking_share):
        push = 0.0
    elif abs(position_ticks - state.first_position) < 3:  # a stiff gear: the fingers have not begun to move
        state.approach_s += dt_s
        if state.approach_s > law.approach_dry_s:
            state.approach_s, state.approach_more = 0.0, min(state.approach_more + 1, int(law.gear.most_push))
    if push and state.approach_more:  # in pulses, so that the fingers close no further than necessary
        push += state.approach_more if state.steps % 4 == 0 else 0.0
        state.harder_ticks = float(state.approach_more)
    state.u_ff = -push
    return _clip_whole(position_ticks + push, law.gear.last_tick)


def _load(felt: Felt, rest_px: tuple[float, float, float], law: LoadLaw) -> tuple[float, float, float]:
    """Return the load in px: shear across, shear down, and twist in px of load."""
    return felt.x_px - rest_px[0], felt.y_px - rest_px[1], law.turn * (felt.turn_px - rest_px[2])


def _watch_load(state: LoadState, load_px: float, dt_s: float, law: LoadLaw) -> None:
    """Update the load, its growth rate and averages, and the time for which it has been steady."""
    state.rate_px_s += ((load_px - state.load_px) / dt_s - state.rate_px_s) * min(dt_s / law.rate_s, 1.0)
    state.most_rate_px_s = max(state.most_rate_px_s, state.rate_px_s)
    state.load_px = load_px
    state.slow_px += (load_px - state.slow_px) * min(dt_s / law.quiet_s, 1.0)
    state.settled_px += (load_px - state.settled_px) * min(dt_s / law.settle_s, 1.0)
    state.mean_px += (load_px - state.mean_px) * min(dt_s / law.mean_s, 1.0)
    steady = abs(load_px - state.slow_px) <= law.steady * load_px + 0.1 * law.least_px
    state.steady_s = state.steady_s + dt_s if steady and load_px > law.least_px else 0.0


def _slips(state: LoadState, felt: Felt, dt_s: float, law: LoadLaw) -> bool:
    """Whether a credible sign of slip is present: from the detector or from the sticking share."""
    state.slip_steps = state.slip_steps + 1 if felt.slip else 0
    state.ignore_s = max(state.ignore_s - dt_s, 0.0)
    slips = state.slip_steps >= 2
    if not state.carried:
        slips = (slips or felt.sticking_share < law.little_sticks) and _stalls(state, law) and state.ignore_s <= 0.0
    state.begins = slips and state.quiet_s >= law.quiet_s
    state.quiet_s = 0.0 if slips else state.quiet_s + dt_s
    return slips


def _stalls(state: LoadState, law: LoadLaw) -> bool:
    """Whether the load grows more slowly than the hand rises: in the lift, the object then slides."""
    return state.rate_px_s <= law.stalls * state.most_rate_px_s and state.load_px > law.least_px


def _grip_ticks(state: LoadState) -> float:
    return max(state.place_ticks - state.rest_ticks, 0.25)


def _most_ticks(load_px: float, law: LoadLaw) -> float:
    """Return the firmest grip allowed for a load, in ticks."""
    return law.most_ticks + law.most_ticks_px * load_px


def _ask(state: LoadState) -> None:
    """Note grip and load, so that a later step can check whether the load answers to the grip."""
    state.asked_s, state.asked_ticks, state.asked_px = 0.0, _grip_ticks(state), state.load_px


def _answers(state: LoadState, share: float) -> bool:
    """Whether the load has grown by at least this share of the relative growth of the grip since both were noted."""
    grown = _grip_ticks(state) / state.asked_ticks - 1.0
    load_px = state.mean_px if state.probing and not state.tells else state.load_px
    return load_px > state.asked_px * (1.0 + share * max(grown, 0.0))


def _lift(state: LoadState, slips: bool, dt_s: float, law: LoadLaw) -> None:
    """Lift: close on slip while the load answers; otherwise look for a load and check whether it is carried."""
    if slips or (state.closes and _stalls(state, law)):  # a continuing slide moves no dots
        state.quiet_s = 0.0
        _close(state, dt_s, law)
    elif not state.closes:
        _seek(state, dt_s, law)
    elif state.quiet_s >= law.quiet_s:  # until then, slip may return at once
        state.closes = False


def _close(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """Close on slip while the load answers to the grip."""
    if not state.closes:
        state.closes, state.probing, state.answered = True, False, False
        state.ratio_at_slip = state.ratio
        _ask(state)
    state.asked_s += dt_s
    state.ratio = min(state.ratio * (1.0 + dt_s / law.close_s), law.most_ratio)
    _spare(state, law.close_ticks_s * dt_s, law)
    if state.asked_s < law.answer_s or _grip_ticks(state) < 1.2 * state.asked_ticks:
        return
    if _answers(state, law.answer):
        state.answered, state.next_ignore_s, state.ratio_at_slip = True, law.ignore_s, state.ratio
        _ask(state)
        return
    state.closes, state.ratio = False, state.ratio_at_slip
    if not state.answered:
        _ignore(state, law)


def _ignore(state: LoadState, law: LoadLaw) -> None:
    """Ignore signs of slip for a while."""
    state.ignore_s = state.next_ignore_s
    state.next_ignore_s = min(2.0 * state.next_ignore_s, law.most_ignore_s)


def _spare(state: LoadState, more_ticks: float, law: LoadLaw) -> None:
    """Close by this many more ticks independently of the load, up to the upper bound."""
    state.spare = max(state.spare, min(state.spare + more_ticks, state.light_ticks + law.most_spare_ticks))


def _seek(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """Wait for a load, then probe with a firmer grip whether the gripper carries it."""
    if state.load_px <= law.least_px:
        _spare(state, law.search_ticks_s * dt_s, law)
        return
    if not state.probing:
        state.waited_s += dt_s
        state.tells = state.steady_s > law.quiet_s
        if state.tells or state.waited_s > law.wait_s:
            _ask(state)
            state.probing, state.probed_s, state.waited_s = True, 0.0, 0.0
            state.asked_px = state.load_px if state.tells else state.mean_px
            state.probe_ticks = max(state.probe_share * state.asked_ticks, law.probe_ticks)
            state.spare = max(state.spare, state.asked_ticks - state.ratio * state.load_px)
        return
    state.asked_s += dt_s
    closed = _grip_ticks(state) >= state.asked_ticks + state.probe_ticks
    if not closed and not state.probed_s and state.asked_s <= law.probe_most_s:
        most = state.asked_ticks + 2.0 * state.probe_ticks - state.ratio * state.load_px
        state.spare = max(state.spare, min(state.spare + state.probe_ticks * dt_s / law.probe_s, most))
        return
    state.probed_s += dt_s
    if state.probed_s > law.probe_s:
        _hear(state, law)


def _hear(state: LoadState, law: LoadLaw) -> None:
    """Evaluate the end of a probe: does the load answer to the grip?"""
    answers, state.probing = _answers(state, law.probe_answer), False
    moved = _grip_ticks(state) >= state.asked_ticks + 0.5 * state.probe_ticks  # otherwise the probe did not happen
    at_limit = state.wanted_ticks - state.place_ticks > law.gear.most_push
    at_limit = at_limit or state.spare + state.ratio * state.load_px > _most_ticks(state.load_px, law)
    most = _grip_ticks(state) + 1.0 - state.ratio * state.load_px  # takes back ticks that the fingers did not follow
    state.spare = min(state.spare, max(most, state.light_ticks))
    if answers and moved:  # the object slides: probe again with a larger share; at once if the answer is conclusive
        state.waited_s, state.unanswered = law.wait_s if state.tells else 0.0, 0
        state.probe_share = min(2.0 * state.probe_share, law.most_probe)
    elif moved or at_limit:  # at the limit, the gripper cannot hold more firmly
        state.unanswered, state.probe_share = state.unanswered + 1, law.probe
        if state.tells or state.unanswered > 1:
            _carry(state, law)


def _carry(state: LoadState, law: LoadLaw) -> None:
    """Start carrying: from now on the grip follows the load alone, and the ratio includes the spare."""
    state.carried, state.closes, state.probing, state.spare = True, False, False, 0.0
    state.base_px = max(state.load_px, state.settled_px, law.least_px)
    state.ratio = min(_grip_ticks(state) / max(state.load_px, law.least_px), law.most_ratio)


def _hold(
    state: LoadState, load: tuple[float, float, float], felt: Felt, slips: bool, dt_s: float, law: LoadLaw
) -> None:
    """Carrying: stop a possible slide, and open until signs of slip show the grip that is needed."""
    state.carried_s += dt_s
    if state.phase is GraspPhase.LIFT and state.base_px < law.small_px < state.load_px:
        _lift_again(state, law)
        return
    slips = slips and state.ignore_s <= 0.0
    boosted = state.boost > 1.0  # a boosted grip contains no information about the ratio
    _stop(state, slips, dt_s, law)
    state.calm = state.calm or state.steady_s > law.calm_s or state.carried_s > law.calm_most_s
    sign = slips or felt.sticking_share < law.little_sticks
    doubted = law.again * state.doubted < state.ratio <= state.doubted
    if state.needed:
        state.ratio += (state.needed - state.ratio) * dt_s / law.settle_s
    elif slips and doubted and (state.begins or state.slip_steps == law.sure_steps):
        _know(state, law)
    elif boosted or not state.calm:
        state.seen_ticks = 0.0
    elif not (sign or _shows(state, load, law)):
        # positions that the fingers have yet to reach prove nothing
        follows = state.place_ticks - state.wanted_ticks < law.lags_ticks
        if follows and state.ratio * state.load_px > law.least_ticks:
            state.ratio -= state.ratio * dt_s / law.release_s
    elif not doubted:
        state.doubted, state.stop_s = state.ratio, law.settle_s  # possibly a false alarm: see whether a sign returns
        state.calm, state.steady_s, state.carried_s = False, 0.0, 0.0
    else:
        _know(state, law)


def _know(state: LoadState, law: LoadLaw) -> None:
    """Store the needed ratio: a sign came twice at about the present one."""
    state.stop_s = law.settle_s
    state.ratio = state.needed = state.needed_at_release = min(state.ratio * law.margin, law.most_ratio)


def _lift_again(state: LoadState, law: LoadLaw) -> None:
    """Return to the lift: the object was not carried after all."""
    state.carried, state.needed, state.boost, state.stop_s = False, 0.0, 1.0, 0.0
    state.ratio, state.spare, state.unanswered = law.first_ratio, state.light_ticks + law.first_ticks, 0


def _stop(state: LoadState, slips: bool, dt_s: float, law: LoadLaw) -> None:
    """Grip more firmly for a while after slip, and when the load falls below the carried load."""
    forgets = dt_s / law.forgets_s if state.needed else 1.0
    state.held_px = max(state.held_px * (1.0 - forgets), state.settled_px)
    slides = slips or (state.needed > 0.0 and state.load_px < state.held_px * law.falls)
    if slides and state.stop_s <= 0.0 and state.needed:
        state.needed = min(state.needed * law.doubt, state.needed_at_release * law.most_doubt, law.most_ratio)
    state.stop_s = law.settle_s if slides else max(state.stop_s - dt_s, 0.0)
    if state.stop_s <= 0.0:
        state.boost = max(state.boost * (1.0 - dt_s / law.settle_s), 1.0)
        return
    state.boost = min(max(state.boost * (1.0 + slips * dt_s / law.close_s), law.slide), law.most_boost)
    if slips and state.boost >= law.most_boost:
        _ignore(state, law)


def _shows(state: LoadState, load: tuple[float, float, float], law: LoadLaw) -> bool:
    """Whether the load, including twist, changes more than the opening of the grip explains."""
    grip = state.wanted_ticks - state.rest_ticks
    if not state.seen_ticks:
        state.seen_ticks, state.seen_px, state.usual_px = grip, load, -1.0
        return False
    if not state.steady_s:  # a jolt, which the grip follows, unless the load falls well below its recent mean
        state.seen_ticks = 0.0
        return state.load_px < law.falls * state.settled_px
    change_px = math.dist(load, state.seen_px)
    least_px = law.moves * state.load_px + law.moves_px
    usual_px = max(least_px, law.moves_times * state.usual_px)
    if change_px > (law.first_moves * least_px if state.usual_px < 0.0 else usual_px):
        return True
    if grip < state.seen_ticks * (1.0 - law.window):
        state.usual_px = change_px if state.usual_px < 0.0 else state.usual_px
        state.seen_ticks, state.seen_px = grip, load
    return False


def _clip_whole(goal: float, last_tick: int) -> int:
    return int(min(max(round(goal), 0), last_tick))
