"""Inputs, constants and state of the law load-proportional (load_proportional.py), and the motion of its fingers.

`observe` and `push` position the fingers more finely than their encoder resolves, by pushes of whole ticks of the goal.

- Problem: a geared motor does not move while its goal is within a wide dead band around the fingers: 1.94 ticks on
  either side on the usual gripper, 1 to 3.3 on others. One tick of the goal is a step of 2 N. If the goal changes
  slowly, the fingers therefore move in jumps.
- Method: push for single control steps. Each push moves the fingers by a few hundredths of a tick, too little for the
  encoder. The pushes are added up, and the sum is corrected whenever the encoder changes.
- The width of the dead band is learned in use: if pushes have no effect for a while, the next ones are harder.
- The noise of the encoder is measured while nothing is pushed; changes within the noise correct nothing.
"""

import math
from dataclasses import MISSING, dataclass, field, fields
from enum import Enum
from typing import Any, NamedTuple

from evetac_cli.kernels.grip.paper import GraspPhase

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
    dry_pulses: int = 40  # opening pushes that opened nothing, after which the next ones push harder
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
    lowest: int = 0  # lowest encoder reading since the fingers began to open
    pulses: int = 0  # opening pushes since that reading
    open_more: int = 0  # ticks by which opening pushes are harder than usual, and those between them weaker
    dry_s: float = 0.0  # time of closing pushes since the encoder changed
    harder_ticks: float = 0.0  # additional ticks beyond the usual band that closing pushes have shown to need


def observe(state: FingerState, position_ticks: int) -> None:
    """Correct the estimated position by the encoder, which is right within one tick plus its noise."""
    changed_ticks = abs(position_ticks - state.position)
    slack_ticks = 2.0 * state.noise_ticks
    if changed_ticks > 1.5 * slack_ticks:
        state.dry_s = 0.0
    if position_ticks < state.lowest - 1.5 * slack_ticks:
        state.lowest, state.pulses = position_ticks, 0
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
    opens = behind < -gear.pulse_ticks - state.noise_ticks
    if not opens:
        state.lowest, state.pulses = state.position, 0
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
    if opens and state.pause_s <= 0.0:
        state.pause_s = gear.pause_s
        state.place_ticks -= gear.pulse_ticks
        state.pulses += 1
        if state.pulses >= gear.dry_pulses:
            state.pulses, state.open_more = 0, min(state.open_more + 1, int(gear.most_push))
        least = math.ceil(gear.band_ticks - grip_push + gear.surplus_ticks)
        return -min(max(least, 1) + state.open_more, int(gear.most_push))
    state.holds = True
    if opens:  # lower, so that neither noise of the encoder nor a soft gel closes the fingers again
        grip_push -= 0.5 * gear.band_ticks + state.open_more
    return round(min(grip_push, gear.most_push))


MARGIN = 1.4  # safety factor of the grip


class LawInput(NamedTuple):
    """Inputs of one step: slip since the previous step, and quantities estimated from the dots.

    `x_px`, `y_px`: mean displacement of all dots, to the right and down. `turn_px`: rms displacement of the dots by
    their rotation about their centre. `sticking_share`: share of the contact that sticks; NaN without contact or if
    unknown.
    """

    slip: bool = False
    x_px: float = 0.0
    y_px: float = 0.0
    turn_px: float = 0.0
    sticking_share: float = math.nan


@dataclass(frozen=True)
class LoadLaw:
    """Constants of the law; ticks are encoder ticks, px are px of load, which is the displacement of all dots.

    `margin` is a safety factor: the grip aims at this multiple of what just holds the object. The other constants were
    chosen on simulated grasps of scripts/studies/grip/trials.py. Seeds 0 to 35 and 200 to 213 served for light contact,
    probes of the lift and finger motion. Seeds 100 to 124, 360 to 395 and 400 to 519 served for turn, rates, release,
    boost and bounds, with a detector over dots, gripper and sticking share at about 4 false alarms per minute. Seeds
    5000 to 5029 served for opening and light contact: 23 contacts that were felt had closed 3.9 ticks (sd 0.9),
    and 7 that were not 5.7 (2.4 to 8.4). Where over 0.87 of the contact stuck as the detector ended a release, the grip
    was 1.5 times what just holds (n 2), else 0.9 to 1.3.

    "Grip" is the closing beyond the position at which the fingers touch without force. "Ratio" is grip per load, in
    ticks/px. "Spare" is the part of the grip that does not depend on the load. A "probe" closes a little to see
    whether the load answers, that is whether it grows with the grip: it grows if the object slides, and stays the same
    if the gripper carries the object.
    """

    margin: float = MARGIN
    approach: float = 2.0  # light contact: lead of the goal over the fingers, as in the paper's law
    approach_dry_s: float = 0.15  # push harder if the encoder has not moved for this long since the start (stiff gear)
    light_ticks: float = 4.0  # closing beyond first touch when light contact ends
    unfelt_ticks: float = 5.5  # ... if no contact was felt until its end: a gear with little friction kept closing
    turn: float = 2.5  # px of load per px of turn: about the spread of the dots over the lever arm of the friction
    least_px: float = 0.35  # smaller loads count as none: gripping alone moves the dots by this much
    small_px: float = 1.0  # an object carried below this load goes back to the lift if the load rises above it
    first_ratio: float = 2.0  # ticks/px at the start of the lift
    most_ratio: float = 30.0  # ticks/px, upper bound
    most_ticks: float = 15.0  # upper bound of the grip without load
    most_ticks_px: float = 8.0  # ... plus this many ticks per px of load
    first_ticks: float = 1.0  # spare at the start of the lift, beyond light contact
    search_ticks_s: float = 1.5  # ticks/s of closing in the lift while there is no load
    most_spare_ticks: float = 6.0  # upper bound of the spare beyond light contact
    rate_s: float = 0.015  # time constant of the growth rate of the load
    stalls: float = 0.75  # in the lift, signs of slip count only below this share of the load's fastest growth so far
    close_s: float = 0.08  # time constant of the ratio while closing on slip
    close_ticks_s: float = 10.0  # ... plus this many ticks/s of spare
    answer_s: float = 0.03  # time after which the answer of the load to the grip is checked
    answer: float = 0.2  # a sliding load grows by at least this share of the relative growth of the grip
    ignore_s: float = 0.3  # signs of slip are ignored for this long after unconfirmed slip; doubles each time
    most_ignore_s: float = 2.4  # ... up to this
    little_sticks: float = 0.3  # a smaller sticking share of the contact is a sign of slip
    mostly_sticks: float = 0.87  # if more of the contact sticks at a warning, the grip is firm enough without margin
    quiet_s: float = 0.06  # slip is over after this long without a sign
    steady: float = 0.03  # a steady load differs from its mean over about quiet_s by at most this share
    mean_s: float = 0.15  # averaging time constant of a load that swings
    wait_s: float = 0.4  # longest wait for a steady load before a probe starts anyway
    probe: float = 0.15  # first probe of the lift: closes by this share of the grip,
    most_probe: float = 1.0  # ... doubled after each answer up to this share,
    probe_ticks: float = 1.5  # ... and by at least this much, so that the encoder sees it
    probe_answer: float = 0.6  # like `answer`, for probes; larger, because the grip itself also moves the dots
    probe_s: float = 0.06  # duration of a probe's closing, and of the wait for its answer
    probe_most_s: float = 0.25  # fingers that have not closed by the probe's ticks after this long are at their limit
    leaks_s: float = 2.0  # time constant with which the grip may open in the lift
    calm_s: float = 0.2  # steady load before the release begins,
    calm_most_s: float = 1.5  # ... or this long without one: a carried object may swing
    release_s: float = 1.7  # time constant of the ratio during the release
    lags_ticks: float = 1.0  # the release waits while the fingers are farther behind than this
    least_ticks: float = 1.5  # the release stops at this grip: the contact position is known to about a tick
    again: float = 0.8  # a second sign counts if the ratio is still above this share of the ratio at the first sign,
    sure_steps: int = 10  # ... and so does slip that lasts for this many control steps
    window: float = 0.12  # changes of load are measured over windows in which the grip falls by this share
    moves: float = 0.05  # change within a window that is a sign of slip: this share of the load,
    moves_px: float = 0.02  # ... plus this many px,
    moves_times: float = 2.5  # ... and at least this multiple of the change in the first window
    first_moves: float = 4.0  # in the first window: this multiple of the first two terms
    slide: float = 1.8  # boost of the grip that stops a slide: kinetic friction is 0.5 to 0.7 of static friction
    most_boost: float = 3.0  # boost while slip continues, approached with time constant close_s
    settle_s: float = 0.6  # duration of a boost; time constant of a settling load and of a grip that opens
    falls: float = 0.85  # a load below this share of the carried load is a slide
    forgets_s: float = 6.0  # time constant with which the carried load is forgotten
    most_load: float = 2.0  # the grip follows the load up to this multiple of the load first carried
    doubt: float = 1.2  # each slip multiplies the needed ratio by this,
    most_doubt: float = 2.5  # ... up to this multiple of what the release found
    gear: Gear = Gear()


class Mode(Enum):
    """What the controller does after light contact; all but HOLD belong to the lift."""

    SEEK_LOAD = 0  # wait for a load, and for it to become steady
    PROBE = 1  # close a little, to see whether the load answers
    TIGHTEN = 2  # close on slip
    HOLD = 3  # the gripper carries the object


@dataclass
class Approach:
    """Light contact: how far the fingers have come, and how hard a stiff gear is pushed."""

    steps: int = 0
    first_position: int = -1  # encoder at the first step
    dry_s: float = 0.0  # time since the push was last made harder
    more: int = 0  # additional ticks of push


@dataclass
class LoadEstimate:
    """The shear load on the gel in px, its growth rate and its averages."""

    rest_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # displacement and turn in light contact
    px: float = 0.0
    rate_px_s: float = 0.0  # growth rate
    most_rate_px_s: float = 0.0
    slow_px: float = 0.0  # averaged over about quiet_s
    mean_px: float = 0.0  # ... over about mean_s
    settled_px: float = 0.0  # ... over about settle_s
    steady_s: float = 0.0  # time for which the load has been steady


@dataclass
class SlipSigns:
    """The detector's slip, and the time for which its signs are not believed."""

    steps: int = 0  # consecutive steps with slip
    quiet_s: float = math.inf  # time since the last slip
    begins: bool = False  # slip began in this step, after at least quiet_s without
    ignore_s: float = 0.0  # remaining time for which signs of slip are ignored
    next_ignore_s: float = 0.0  # length of the next such time


@dataclass
class Response:
    """Grip and load at an earlier time, to see whether the load has grown with the grip since."""

    elapsed_s: float = 0.0
    grip_ticks: float = 0.0
    load_px: float = 0.0


@dataclass
class Probe:
    """The present probe of the lift, and what the ones before it have shown."""

    waited_s: float = 0.0  # time with a load, waiting for it to become steady
    share: float = 0.0  # of the grip
    ticks: float = 0.0  # closing of the present probe
    closed_s: float = 0.0  # time since the present probe has closed
    conclusive: bool = False  # the load was steady before the probe, so that one answer tells
    unanswered: int = 0  # consecutive probes without an answer


@dataclass
class Boost:
    """The firmer grip that stops a slide."""

    remaining_s: float = 0.0
    factor: float = 1.0
    carried_px: float = 0.0  # load carried recently


@dataclass
class FrictionEstimate:
    """The grip per load that a carried object needs, in ticks/px, found by opening slowly until it slips."""

    calm: bool = False  # the opening may begin
    held_s: float = 0.0  # time since the object is carried, or since the last unconfirmed sign
    doubted: float = 0.0  # ratio at the last unconfirmed sign of slip
    needed: float = 0.0  # ratio that the grip aims at, once it has been found; 0 before
    first_needed: float = 0.0  # ... as it was found, before later slips raised it
    window_load_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # load at the start of a window of the opening
    window_ticks: float = 0.0  # grip at the start of that window; 0: no window has begun
    usual_px: float = -1.0  # change of load in the first window; -1: not yet measured


@dataclass
class LoadState:
    """State of the controller between steps."""

    phase: GraspPhase = GraspPhase.CONTACT
    mode: Mode = Mode.SEEK_LOAD
    finger: FingerState = field(default_factory=FingerState)
    approach: Approach = field(default_factory=Approach)
    load: LoadEstimate = field(default_factory=LoadEstimate)
    slip: SlipSigns = field(default_factory=SlipSigns)
    response: Response = field(default_factory=Response)
    probe: Probe = field(default_factory=Probe)
    boost: Boost = field(default_factory=Boost)
    friction: FrictionEstimate = field(default_factory=FrictionEstimate)
    light_ticks: float = 0.0  # closing beyond first touch when light contact ends
    rest_ticks: float = 0.0  # position at which the fingers touch without force
    ratio: float = 0.0  # grip per load, ticks/px
    spare: float = 0.0  # part of the grip that does not depend on the load, ticks
    wanted_ticks: float = 0.0  # position that the fingers should reach
    base_px: float = 0.0  # load when the object was found to be carried
    answered: bool = False  # the load has grown with the grip since the grip closes on slip
    ratio_at_slip: float = 0.0  # ratio when the grip began to close on slip, or the load last answered
    u_ff: float = 0.0  # push, negative closes; only recorded

    def __copy__(self) -> "LoadState":
        """Return an independent state; by hand, because a deep copy takes long, in each control step."""
        twin: LoadState = _shallow(self)
        for name in _PARTS:
            setattr(twin, name, _shallow(getattr(self, name)))
        return twin

    @property
    def x_ref(self) -> float:
        """Wanted position, NaN in light contact; only recorded."""
        return math.nan if self.phase is GraspPhase.CONTACT else self.wanted_ticks

    @property
    def grip_ticks(self) -> float:
        """Present grip."""
        return max(self.finger.place_ticks - self.rest_ticks, 0.25)


_PARTS = tuple(item.name for item in fields(LoadState) if item.default_factory is not MISSING)


def _shallow(record: Any) -> Any:
    twin = object.__new__(type(record))
    twin.__dict__.update(record.__dict__)
    return twin
