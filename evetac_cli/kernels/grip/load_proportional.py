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
  then on the grip is `margin` times the grip at that sign. If nearly all of the contact still stuck when the detector
  warned, the grip at the sign has such a margin already, and none is added.
- Stopping a slide: an object that slides under its whole weight pulls no harder when it is gripped more firmly, and
  keeps sliding under a grip that would hold it at rest. So at the end of a release, after slip and when the load
  falls, the grip is `slide` times as firm for a while. Each slip also raises the needed ratio a little, up to a bound.
- A heavier object leads to the same ratio. A detector with false alarms adds a bounded share; without a detector the
  load alone shows the slip.
"""

import math

from evetac_cli.kernels.grip import load_law
from evetac_cli.kernels.grip.load_law import LawInput, LoadEstimate, LoadLaw, LoadState, Mode, Response
from evetac_cli.kernels.grip.paper import GraspPhase

Load = tuple[float, float, float]  # in px: shear across, shear down, and twist in px of load


def start() -> LoadState:
    """Return the state before the first step."""
    return LoadState()


def step(state: LoadState, phase: GraspPhase, felt: LawInput, position_ticks: int, dt_s: float, law: LoadLaw) -> int:
    """Do one control step of dt_s and return the goal in ticks."""
    if phase is GraspPhase.CONTACT:
        return _touch(state, felt, position_ticks, dt_s, law)
    if state.phase is GraspPhase.CONTACT:
        state.ratio, state.spare = law.first_ratio, state.light_ticks + law.first_ticks
        state.slip.next_ignore_s, state.probe.share = law.ignore_s, law.probe
    state.phase = phase
    load_law.observe(state.finger, position_ticks)
    load = _measure_load(state.load, felt, dt_s, law)
    if phase is GraspPhase.BALANCE and state.mode is not Mode.HOLD:
        _begin_to_hold(state, law)
    slips = _detect_slip(state, felt, dt_s, law)
    if state.mode is Mode.HOLD:
        _hold(state, load, felt, slips, dt_s, law)
    else:
        _lift(state, slips, dt_s, law)
    holds = state.mode is Mode.HOLD
    load_px = max(state.load.px, state.boost.carried_px)
    if holds:
        load_px = min(load_px, law.most_load * state.base_px)
    grip = min(state.spare + state.ratio * state.boost.factor * load_px, _most_ticks(load_px, law))
    wanted = state.rest_ticks + grip
    before = min(state.wanted_ticks, state.finger.place_ticks)  # fingers that are behind have less to open
    opens = (before - state.rest_ticks) * dt_s / (law.settle_s if holds else law.leaks_s)
    state.wanted_ticks = max(wanted, before - opens)
    push = load_law.push(state.finger, state.wanted_ticks, state.rest_ticks, dt_s, law.gear)
    state.u_ff = -float(push)
    return _clip_whole(position_ticks + push, law.gear.last_tick)


def _touch(state: LoadState, felt: LawInput, position_ticks: int, dt_s: float, law: LoadLaw) -> int:
    """Light contact: close by the smallest push that moves the fingers, until contact is felt."""
    approach, finger = state.approach, state.finger
    if approach.first_position < 0:
        approach.first_position = position_ticks
    approach.steps += 1
    finger.position = position_ticks
    finger.place_ticks = state.wanted_ticks = position_ticks + 0.5
    state.light_ticks = law.unfelt_ticks if math.isnan(felt.sticking_share) else law.light_ticks
    state.rest_ticks = finger.place_ticks - state.light_ticks
    state.load.rest_px = felt.x_px, felt.y_px, felt.turn_px
    push = law.approach
    if not math.isnan(felt.sticking_share):
        push = 0.0
    elif abs(position_ticks - approach.first_position) < 3:  # a stiff gear: the fingers have not begun to move
        approach.dry_s += dt_s
        if approach.dry_s > law.approach_dry_s:
            approach.dry_s, approach.more = 0.0, min(approach.more + 1, int(law.gear.most_push))
    if push and approach.more:  # in pulses, so that the fingers close no further than necessary
        push += approach.more if approach.steps % 4 == 0 else 0.0
        finger.harder_ticks = float(approach.more)
    state.u_ff = -push
    return _clip_whole(position_ticks + push, law.gear.last_tick)


def _measure_load(load: LoadEstimate, felt: LawInput, dt_s: float, law: LoadLaw) -> Load:
    """Update the load, its growth rate and averages, and the time for which it has been steady; return its parts."""
    rest_x_px, rest_y_px, rest_turn_px = load.rest_px
    parts = felt.x_px - rest_x_px, felt.y_px - rest_y_px, law.turn * (felt.turn_px - rest_turn_px)
    load_px = math.hypot(*parts)
    load.rate_px_s += ((load_px - load.px) / dt_s - load.rate_px_s) * min(dt_s / law.rate_s, 1.0)
    load.most_rate_px_s = max(load.most_rate_px_s, load.rate_px_s)
    load.px = load_px
    load.slow_px += (load_px - load.slow_px) * min(dt_s / law.quiet_s, 1.0)
    load.settled_px += (load_px - load.settled_px) * min(dt_s / law.settle_s, 1.0)
    load.mean_px += (load_px - load.mean_px) * min(dt_s / law.mean_s, 1.0)
    steady = abs(load_px - load.slow_px) <= law.steady * load_px + 0.1 * law.least_px
    load.steady_s = load.steady_s + dt_s if steady and load_px > law.least_px else 0.0
    return parts


def _detect_slip(state: LoadState, felt: LawInput, dt_s: float, law: LoadLaw) -> bool:
    """Whether a credible sign of slip is present: from the detector or from the sticking share."""
    slip = state.slip
    slip.steps = slip.steps + 1 if felt.slip else 0
    slip.ignore_s = max(slip.ignore_s - dt_s, 0.0)
    slips = slip.steps >= 2
    if state.mode is not Mode.HOLD:
        sign = slips or felt.sticking_share < law.little_sticks
        slips = sign and _load_stalls(state.load, law) and slip.ignore_s <= 0.0
    slip.begins = slips and slip.quiet_s >= law.quiet_s
    slip.quiet_s = 0.0 if slips else slip.quiet_s + dt_s
    return slips


def _load_stalls(load: LoadEstimate, law: LoadLaw) -> bool:
    """Whether the load grows more slowly than the hand rises: in the lift, the object then slides."""
    return load.rate_px_s <= law.stalls * load.most_rate_px_s and load.px > law.least_px


def _most_ticks(load_px: float, law: LoadLaw) -> float:
    """Return the firmest grip allowed for a load, in ticks."""
    return law.most_ticks + law.most_ticks_px * load_px


def _has_grown(state: LoadState, load_px: float, share: float) -> bool:
    """Whether a load is larger than before by this share of the relative growth of the grip since (see `Response`)."""
    grown = state.grip_ticks / state.response.grip_ticks - 1.0
    return load_px > state.response.load_px * (1.0 + share * max(grown, 0.0))


def _lift(state: LoadState, slips: bool, dt_s: float, law: LoadLaw) -> None:
    """Lift: close on slip while the load answers; otherwise look for a load and check whether it is carried."""
    tightens = state.mode is Mode.TIGHTEN
    if slips or (tightens and _load_stalls(state.load, law)):  # a continuing slide moves no dots
        state.slip.quiet_s = 0.0
        _tighten(state, dt_s, law)
    elif state.mode is Mode.PROBE:
        _probe(state, dt_s, law)
    elif not tightens:
        _seek_load(state, dt_s, law)
    elif state.slip.quiet_s >= law.quiet_s:  # until then, slip may return at once
        state.mode = Mode.SEEK_LOAD


def _tighten(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """Close on slip while the load answers to the grip."""
    if state.mode is not Mode.TIGHTEN:
        state.mode, state.answered = Mode.TIGHTEN, False
        state.ratio_at_slip = state.ratio
        state.response = Response(0.0, state.grip_ticks, state.load.px)
    state.response.elapsed_s += dt_s
    state.ratio = min(state.ratio * (1.0 + dt_s / law.close_s), law.most_ratio)
    _add_spare(state, law.close_ticks_s * dt_s, law)
    if state.response.elapsed_s < law.answer_s or state.grip_ticks < 1.2 * state.response.grip_ticks:
        return
    if _has_grown(state, state.load.px, law.answer):
        state.answered, state.slip.next_ignore_s, state.ratio_at_slip = True, law.ignore_s, state.ratio
        state.response = Response(0.0, state.grip_ticks, state.load.px)
        return
    state.mode, state.ratio = Mode.SEEK_LOAD, state.ratio_at_slip
    if not state.answered:
        _ignore_slip(state, law)


def _ignore_slip(state: LoadState, law: LoadLaw) -> None:
    """Ignore signs of slip for a while."""
    state.slip.ignore_s = state.slip.next_ignore_s
    state.slip.next_ignore_s = min(2.0 * state.slip.next_ignore_s, law.most_ignore_s)


def _add_spare(state: LoadState, more_ticks: float, law: LoadLaw) -> None:
    """Close by this many more ticks independently of the load, up to the upper bound."""
    state.spare = max(state.spare, min(state.spare + more_ticks, state.light_ticks + law.most_spare_ticks))


def _seek_load(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """Wait for a load that is steady, or for long enough; then begin to probe whether the gripper carries it."""
    load, probe = state.load, state.probe
    if load.px <= law.least_px:
        _add_spare(state, law.search_ticks_s * dt_s, law)
        return
    probe.waited_s += dt_s
    probe.conclusive = load.steady_s > law.quiet_s
    if probe.conclusive or probe.waited_s > law.wait_s:
        state.mode, probe.closed_s, probe.waited_s = Mode.PROBE, 0.0, 0.0
        state.response = Response(0.0, state.grip_ticks, load.px if probe.conclusive else load.mean_px)
        probe.ticks = max(probe.share * state.response.grip_ticks, law.probe_ticks)
        state.spare = max(state.spare, state.response.grip_ticks - state.ratio * load.px)


def _probe(state: LoadState, dt_s: float, law: LoadLaw) -> None:
    """Close by the probe's ticks, wait for the load to answer, and judge."""
    load, probe, before = state.load, state.probe, state.response
    if load.px <= law.least_px:
        _add_spare(state, law.search_ticks_s * dt_s, law)
        return
    before.elapsed_s += dt_s
    closed = state.grip_ticks >= before.grip_ticks + probe.ticks
    if not closed and not probe.closed_s and before.elapsed_s <= law.probe_most_s:
        most = before.grip_ticks + 2.0 * probe.ticks - state.ratio * load.px
        state.spare = max(state.spare, min(state.spare + probe.ticks * dt_s / law.probe_s, most))
        return
    probe.closed_s += dt_s
    if probe.closed_s > law.probe_s:
        _judge_probe(state, law)


def _judge_probe(state: LoadState, law: LoadLaw) -> None:
    """End a probe: an object whose load answers to the grip slides, one whose load does not is carried."""
    load, probe, before = state.load, state.probe, state.response
    slides = _has_grown(state, load.px if probe.conclusive else load.mean_px, law.probe_answer)
    state.mode = Mode.SEEK_LOAD
    moved = state.grip_ticks >= before.grip_ticks + 0.5 * probe.ticks  # otherwise the probe did not happen
    at_limit = state.wanted_ticks - state.finger.place_ticks > law.gear.most_push
    at_limit = at_limit or state.spare + state.ratio * load.px > _most_ticks(load.px, law)
    most = state.grip_ticks + 1.0 - state.ratio * load.px  # takes back ticks that the fingers did not follow
    state.spare = min(state.spare, max(most, state.light_ticks))
    if slides and moved:  # probe again with a larger share; at once if the answer is conclusive
        probe.waited_s, probe.unanswered = law.wait_s if probe.conclusive else 0.0, 0
        probe.share = min(2.0 * probe.share, law.most_probe)
    elif moved or at_limit:  # at the limit, the gripper cannot hold more firmly
        probe.unanswered, probe.share = probe.unanswered + 1, law.probe
        if probe.conclusive or probe.unanswered > 1:
            _begin_to_hold(state, law)


def _begin_to_hold(state: LoadState, law: LoadLaw) -> None:
    """Start carrying: from now on the grip follows the load alone, and the ratio includes the spare."""
    state.mode, state.spare = Mode.HOLD, 0.0
    state.base_px = max(state.load.px, state.load.settled_px, law.least_px)
    state.ratio = min(state.grip_ticks / max(state.load.px, law.least_px), law.most_ratio)


def _hold(state: LoadState, load: Load, felt: LawInput, slips: bool, dt_s: float, law: LoadLaw) -> None:
    """Carrying: stop a possible slide, and open until signs of slip show the grip that is needed."""
    friction = state.friction
    friction.held_s += dt_s
    if state.phase is GraspPhase.LIFT and state.base_px < law.small_px < state.load.px:
        _lift_again(state, law)
        return
    slips = slips and state.slip.ignore_s <= 0.0
    boosted = state.boost.factor > 1.0  # a boosted grip contains no information about the ratio
    _stop_slide(state, slips, dt_s, law)
    friction.calm = friction.calm or state.load.steady_s > law.calm_s or friction.held_s > law.calm_most_s
    sign = slips or felt.sticking_share < law.little_sticks
    doubted = law.again * friction.doubted < state.ratio <= friction.doubted
    if friction.needed:
        state.ratio += (friction.needed - state.ratio) * dt_s / law.settle_s
    elif slips and doubted and (state.slip.begins or state.slip.steps == law.sure_steps):
        _set_needed(state, felt, law)
    elif boosted or not friction.calm:
        friction.window_ticks = 0.0
    elif not (sign or _load_changes(state, load, law)):
        # positions that the fingers have yet to reach prove nothing
        follows = state.finger.place_ticks - state.wanted_ticks < law.lags_ticks
        if follows and state.ratio * state.load.px > law.least_ticks:
            state.ratio -= state.ratio * dt_s / law.release_s
    elif not doubted:  # possibly a false alarm: see whether a sign returns
        friction.doubted, state.boost.remaining_s = state.ratio, law.settle_s
        friction.calm, state.load.steady_s, friction.held_s = False, 0.0, 0.0
    else:
        _set_needed(state, felt, law)


def _set_needed(state: LoadState, felt: LawInput, law: LoadLaw) -> None:
    """Set the needed ratio: a sign came twice at about the present one."""
    state.boost.remaining_s = law.settle_s
    warns_early = state.slip.begins and felt.sticking_share > law.mostly_sticks
    state.ratio = min(state.ratio * (1.0 if warns_early else law.margin), law.most_ratio)
    state.friction.needed = state.friction.first_needed = state.ratio


def _lift_again(state: LoadState, law: LoadLaw) -> None:
    """Return to the lift: the object was not carried after all."""
    state.mode, state.friction.needed = Mode.SEEK_LOAD, 0.0
    state.boost.factor, state.boost.remaining_s = 1.0, 0.0
    state.ratio, state.spare, state.probe.unanswered = law.first_ratio, state.light_ticks + law.first_ticks, 0


def _stop_slide(state: LoadState, slips: bool, dt_s: float, law: LoadLaw) -> None:
    """Grip more firmly for a while after slip, and when the load falls below the carried load."""
    boost, friction = state.boost, state.friction
    forgets = dt_s / law.forgets_s if friction.needed else 1.0
    boost.carried_px = max(boost.carried_px * (1.0 - forgets), state.load.settled_px)
    slides = slips or (friction.needed > 0.0 and state.load.px < boost.carried_px * law.falls)
    if slides and boost.remaining_s <= 0.0 and friction.needed:
        friction.needed = min(friction.needed * law.doubt, friction.first_needed * law.most_doubt, law.most_ratio)
    boost.remaining_s = law.settle_s if slides else max(boost.remaining_s - dt_s, 0.0)
    if boost.remaining_s <= 0.0:
        boost.factor = max(boost.factor * (1.0 - dt_s / law.settle_s), 1.0)
        return
    boost.factor = min(max(boost.factor * (1.0 + slips * dt_s / law.close_s), law.slide), law.most_boost)
    if slips and boost.factor >= law.most_boost:
        _ignore_slip(state, law)


def _load_changes(state: LoadState, load: Load, law: LoadLaw) -> bool:
    """Whether the load, including twist, changes more than the opening of the grip explains."""
    friction = state.friction
    grip = state.wanted_ticks - state.rest_ticks
    if not friction.window_ticks:
        friction.window_ticks, friction.window_load_px, friction.usual_px = grip, load, -1.0
        return False
    if not state.load.steady_s:  # a jolt, which the grip follows, unless the load falls well below its recent mean
        friction.window_ticks = 0.0
        return state.load.px < law.falls * state.load.settled_px
    change_px = math.dist(load, friction.window_load_px)
    least_px = law.moves * state.load.px + law.moves_px
    usual_px = max(least_px, law.moves_times * friction.usual_px)
    if change_px > (law.first_moves * least_px if friction.usual_px < 0.0 else usual_px):
        return True
    if grip < friction.window_ticks * (1.0 - law.window):
        friction.usual_px = change_px if friction.usual_px < 0.0 else friction.usual_px
        friction.window_ticks, friction.window_load_px = grip, load
    return False


def _clip_whole(goal: float, last_tick: int) -> int:
    return int(min(max(round(goal), 0), last_tick))
