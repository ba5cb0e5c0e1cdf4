"""Position the fingers of a geared servo more finely than their encoder resolves, by pushes of whole ticks of the goal.

- Problem: a geared motor does not move while its goal is within a wide dead band around the fingers: 1.94 ticks on
  either side on the usual gripper, 1 to 3.3 on others. One tick of the goal is a step of 2 N. If the goal changes
  slowly, the fingers therefore move in jumps.
- Method: push for single control steps. Each push moves the fingers by a few hundredths of a tick, too little for the
  encoder. The pushes are added up, and the sum is corrected whenever the encoder changes.
- The width of the dead band is learned in use: if pushes have no effect for a while, the next ones are harder.
- The noise of the encoder is measured while nothing is pushed; changes within the noise correct nothing.
"""

import math
from dataclasses import dataclass

SLOW = 0.02  # smoothing factor per control step of the mean encoder noise: averages over about 50 steps
CLOSE_ENOUGH_TICKS = 0.25  # fingers less than this far behind their goal are not pushed


@dataclass(frozen=True)
class Gear:
    """Constants of the finger motion; ticks are encoder ticks, and a push is the lead of the goal over the fingers.

    Fitted to the gripper of the sensor `evetac` (sim/gripper.py has the same numbers in N).
    """

    band_ticks: float = 1.94  # push that the friction of the gear absorbs
    surplus_ticks: float = 0.5  # push beyond the friction band, so that the fingers move
    push_per_tick: float = 0.125  # push that balances the grip force, per tick of closing beyond contact
    speed: float = 1.5  # additional push per tick that the fingers are behind
    most_push: float = 10.0  # largest push: 10 ticks are 20 N
    pulse_ticks: float = 0.05  # distance that one push of one control step opens; corrected in use
    stride_ticks: float = 0.1  # distance that one push closes if the fingers are a tick or more behind; also corrected
    pause_s: float = 0.006  # wait after an opening push, so that the fingers come to rest
    dry_pulses: int = 40  # opening pushes without a change of the encoder, after which the pushes become harder
    dry_s: float = 0.04  # time of closing pushes without a change of the encoder, after which the pushes become harder
    last_tick: int = 740


@dataclass
class FingerState:
    """Estimated position of the fingers and the push that they have shown to need."""

    place_ticks: float = 0.0  # estimated position, finer than the encoder
    position: int = 0  # last encoder reading
    pause_s: float = 0.0  # time until the next opening push
    noise_ticks: float = 0.0  # mean change of the encoder from step to step while nothing is pushed
    holds: bool = False  # the last step did not push
    pulses: int = 0  # opening pushes since the encoder changed by more than its noise
    open_more: int = 0  # additional ticks that opening pushes have shown to need
    dry_s: float = 0.0  # time of closing pushes since the encoder changed
    harder_ticks: float = 0.0  # additional ticks beyond the usual band that closing pushes have shown to need


def observe(state: FingerState, position_ticks: int) -> None:
    """Correct the estimated position by the encoder, which is right within one tick plus its noise."""
    changed_ticks = abs(position_ticks - state.position)
    slack_ticks = 2.0 * state.noise_ticks
    if changed_ticks > 1.5 * slack_ticks:
        state.pulses, state.dry_s = 0, 0.0
    if state.holds:
        state.noise_ticks += SLOW * (changed_ticks - state.noise_ticks)
    state.position = position_ticks
    state.place_ticks = min(max(state.place_ticks, position_ticks - slack_ticks), position_ticks + 1.0 + slack_ticks)


def push(state: FingerState, wanted_ticks: float, rest_ticks: float, dt_s: float, gear: Gear) -> int:
    """Return the lead of the goal over the fingers, in whole ticks, that moves them towards `wanted_ticks`.

    rest_ticks: the position at which the fingers touch the object without force.
    """
    behind = wanted_ticks - state.place_ticks
    grip_push = gear.push_per_tick * max(state.place_ticks - rest_ticks, 0.0)  # push that balances the grip force
    state.pause_s -= dt_s
    state.holds = False
    if behind > CLOSE_ENOUGH_TICKS + state.noise_ticks:
        if state.place_ticks >= state.position + 1.0:  # moved according to the count, but not according to the encoder
            state.dry_s += dt_s
            if state.dry_s > gear.dry_s:
                state.dry_s, state.harder_ticks = 0.0, min(state.harder_ticks + 0.5, gear.most_push)
        harder = gear.band_ticks + gear.surplus_ticks + state.harder_ticks
        state.place_ticks = min(state.place_ticks + min(behind, 1.0) * gear.stride_ticks, state.position + 1.0)
        return round(min(grip_push + harder + gear.speed * behind, gear.most_push + state.harder_ticks))
    opens = behind < -gear.pulse_ticks - state.noise_ticks
    if opens and state.pause_s <= 0.0:
        state.pause_s = gear.pause_s
        state.place_ticks -= gear.pulse_ticks
        state.pulses += 1
        if state.pulses >= gear.dry_pulses:
            state.pulses, state.open_more = 0, min(state.open_more + 1, int(gear.most_push))
        least = math.ceil(gear.band_ticks - grip_push + gear.surplus_ticks)
        return -min(max(least, 1) + state.open_more, int(gear.most_push))
    state.holds = True
    if opens:  # lower, so that noise of the encoder does not close the fingers again
        grip_push -= 0.5 * gear.band_ticks
    return round(min(grip_push, gear.most_push))
