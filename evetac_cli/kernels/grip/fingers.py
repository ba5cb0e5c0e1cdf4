"""Moves fingers of a geared servo to a place that is finer than their encoder, by pushes of whole ticks of the goal.

Why so:
- Fingers with a geared motor stand still within a wide band of the goal (1.94 ticks either side on the usual gripper,
  1 to 3.3 on others), and whole ticks of the goal are steps of 2 N: a goal that wanders slowly moves them in jumps.
  Here they are moved by pushes of single control steps, each of which moves them by a few hundredths of a tick, too
  little for the encoder; how far is counted up, and corrected whenever the encoder changes.
- How wide the band is shows in use: a push that moves nothing for a while is made harder.
- An encoder's noise is measured while nothing is pushed, and corrects nothing.
"""

import math
from dataclasses import dataclass, fields

from evetac_cli.checks import check_range

SLOW = 0.02
CLOSE_ENOUGH_TICKS = 0.25  # fingers that are no farther behind than this are not pushed


@dataclass(frozen=True)
class Gear:
    """Constants of how fingers are moved; ticks are those of the encoder.

    Fitted to the gripper of the sensor `evetac` (sim/gripper.py has the same numbers in N).
    """

    band_ticks: float = 1.94  # of push that the gear's friction takes
    surplus_ticks: float = 0.5  # of push beyond that: moves them
    push_per_tick: float = 0.125  # that the force of the object takes, for each tick closed
    speed: float = 1.5  # ticks of push for each tick that the fingers are behind
    most_push: float = 10.0  # ticks: 20 N
    pulse_ticks: float = 0.05  # that one push of a control step opens
    stride_ticks: float = 0.1  # ... closes, at least where the fingers are a tick behind; both are set right as they go
    pause_s: float = 0.006  # after it, so that the fingers come to rest
    dry_pulses: int = 40  # that open without a change of the encoder: push harder from then on
    dry_s: float = 0.04  # of pushes that close without one
    last_tick: int = 740

    def __post_init__(self) -> None:
        """Refuse constants that are out of range."""
        for item in fields(self):
            check_range(item.name, getattr(self, item.name), above=item.name in ("pulse_ticks", "dry_s"))


@dataclass
class FingerState:
    """Where the fingers are as far as is known, and how hard they have to be pushed."""

    place_ticks: float = 0.0  # finer than the encoder
    position: int = 0  # of the encoder
    pause_s: float = 0.0  # until the next push that opens
    noise_ticks: float = 0.0  # mean change of a noisy encoder from step to step where nothing is pushed
    holds: bool = False  # the last push was none
    pulses: int = 0  # that open, since the encoder changed by more than its noise
    open_more: int = 0  # ticks by which pushes that open have shown to have to be harder
    dry_s: float = 0.0  # of pushes that close, since the encoder changed
    harder_ticks: float = 0.0  # of push beyond the usual band, that this gear has shown to need to close


def observe(state: FingerState, position_ticks: int) -> None:
    """Correct the counted place by the encoder, which is right within one tick and its noise."""
    changed_ticks = abs(position_ticks - state.position)
    slack_ticks = 2.0 * state.noise_ticks
    if changed_ticks > 1.5 * slack_ticks:
        state.pulses, state.dry_s = 0, 0.0
    if state.holds:
        state.noise_ticks += SLOW * (changed_ticks - state.noise_ticks)
    state.position = position_ticks
    state.place_ticks = min(max(state.place_ticks, position_ticks - slack_ticks), position_ticks + 1.0 + slack_ticks)


def push(state: FingerState, wanted_ticks: float, rest_ticks: float, dt_s: float, gear: Gear) -> int:
    """How many whole ticks ahead of the fingers the goal has to be so that they move to where they are wanted.

    rest_ticks: where they touch the object without a force.
    """
    behind = wanted_ticks - state.place_ticks
    grip_push = gear.push_per_tick * max(state.place_ticks - rest_ticks, 0.0)  # that the force of the grip takes
    state.pause_s -= dt_s
    state.holds = False
    if behind > CLOSE_ENOUGH_TICKS + state.noise_ticks:
        if state.place_ticks >= state.position + 1.0:  # by count they are on, by the encoder they are not
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
    if opens:  # an encoder's noise is not to close them again
        grip_push -= 0.5 * gear.band_ticks
    return round(min(grip_push, gear.most_push))
