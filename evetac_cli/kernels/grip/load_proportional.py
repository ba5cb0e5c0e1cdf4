"""A grip in proportion to the load: as firm as the object pulls at the gel, and no firmer than slip shows to be needed.

The gel is a load cell. A layer bonded to its back answers a shear force with a displacement whose integral over the gel
is the force over G/H, wherever and on whatever patch it acts; so the mean displacement of the dots is the force in
pixels. What holds an object is friction in proportion to the grip. So this controller closes to

    wanted = rest + ratio * load,      rest: where light contact ended; load: mean displacement since then, in px

at every step, which follows a load that grows before anything slips. The ratio, in ticks a pixel, begins where the
most slippery objects would be held. Slip in the lift raises it. In balance it falls slowly, by the same share a second
whatever the object weighs, until the detector finds slip, or until the object sinks a little, as it does when the edge
of its patch begins to slip: that is the ratio which this object needs. On slip the grip closes well beyond it, because
an object that slides is held by less friction, and comes back to stay a little above it; where the object only sinks,
the grip stays as it is. Weight that is added later finds the same ratio.

Why so:
- Fingers with a geared motor stand still within a wide band of the goal (1.94 ticks either side), and whole ticks of
  the goal are steps of 2 N: a goal that wanders slowly opens them in jumps. Here the fingers are opened by pushes of
  single control steps, each of which moves them by a few hundredths of a tick, too little for the encoder; how far is
  counted up, and corrected whenever the encoder changes.
"""

import math
from dataclasses import dataclass, fields

from evetac_cli.checks import check_range
from evetac_cli.kernels.grip.paper import GraspPhase

LEAST_LOAD_PX = 0.05  # less than this counts as no load
CLOSE_ENOUGH_TICKS = 0.25  # fingers that are no farther behind than this are not pushed


@dataclass(frozen=True)
class LoadLaw:
    """Constants of the law; ticks are those of the encoder, px those of the mean displacement of all dots.

    The first group is about the object, the second about the gripper (sim/gripper.py has the same numbers in N). They
    were chosen on simulated grasps of objects 1 to 9, seeds 2000 and 2001.
    """

    approach: float = 2.0  # ticks ahead in light contact, as the paper's law
    first_ratio: float = 4.0  # ticks/px: holds what has a friction coefficient of 0.4
    least_ratio: float = 1.1  # ... of 1.2; nothing is held by less
    most_ratio: float = 15.0
    lift_ticks: float = 8.0  # beyond any ratio in the lift, while there is hardly a load
    spare_ticks: float = 1.0  # ... in balance: slip of the lightest objects is too faint for the detector
    rise_s: float = 1.0  # slip in the lift raises the ratio by first_ratio in this time
    release_s: float = 4.0  # time constant of the release in balance, until slip
    settle_s: float = 0.5  # ... back to what slip has shown to be needed
    catch: float = 0.3  # share by which slip closes at once
    catch_ticks: float = 1.0  # ... and by so much
    catch_s: float = 0.15  # slip that goes on for longer than quiet_s closes by the same share in this time
    margin: float = 0.08  # share above the ratio at slip at which the grip stays
    margin_ticks: float = 0.3
    sink: float = 0.02  # share by which the load grows under a falling grip when the object begins to slip at the edge
    sink_px: float = 0.01
    fall: float = 0.03  # share by which the load falls under a steady grip when the object slides
    fall_px: float = 0.02
    confirm: float = 0.01  # slip is confirmed if the load has changed by this share; otherwise it sets no ratio,
    confirm_px: float = 0.01
    unconfirmed_s: float = 0.008  # ... and the grip closes only after it has lasted so long
    quiet_s: float = 0.1  # without slip, before the grip is released and slip counts as new

    band_ticks: float = 1.94  # of push that the gear's friction takes
    surplus_ticks: float = 0.5  # of push beyond that: moves them
    push_per_tick: float = 0.125  # that the force of the object takes, for each tick closed
    speed: float = 1.5  # ticks of push for each tick that the fingers are behind
    most_push: float = 10.0  # ticks: 20 N
    pulse_ticks: float = 0.05  # that one push of a control step opens
    stride_ticks: float = 0.1  # ... closes, at least where the fingers are a tick behind; both are set right as they go
    pause_s: float = 0.006  # after it, so that the fingers come to rest
    dry_pulses: int = 40  # without a change of the encoder: push harder
    last_tick: int = 740

    def __post_init__(self) -> None:
        """Refuse constants that are out of range."""
        for item in fields(self):
            above = item.name in ("rise_s", "release_s", "settle_s", "catch_s", "pulse_ticks")
            check_range(item.name, getattr(self, item.name), above=above)
        if not self.least_ratio <= self.first_ratio <= self.most_ratio:
            raise ValueError(
                "expected least_ratio <= first_ratio <= most_ratio,"
                f" found {self.least_ratio}, {self.first_ratio}, {self.most_ratio}"
            )


@dataclass
class LoadState:
    """What the controller remembers between steps."""

    phase: GraspPhase = GraspPhase.CONTACT
    rest_ticks: float = 0.0  # where light contact ended: next to no force
    rest_px: tuple[float, float] = (0.0, 0.0)  # mean displacement there
    ratio: float = 0.0
    spare_ticks: float = 0.0  # wanted beyond the ratio: lift_ticks, then ever less
    least_px: float = math.inf  # smallest load since the last slip
    most_px: float = 0.0  # ... and largest
    needed: float = 0.0  # ratio that slip has shown to be needed, with its margin; 0 before
    wanted_ticks: float = 0.0
    place_ticks: float = 0.0  # where the fingers are, finer than the encoder
    position: int = 0
    quiet_s: float = 0.0  # since the last slip
    slip_s: float = 0.0  # since slip began, with the pauses in it
    slipping_s: float = 0.0  # ... without them
    closed: bool = False  # the grip has closed on it
    pause_s: float = 0.0  # until the next push that opens
    pulses: int = 0  # since the encoder changed
    u_ff: float = 0.0  # push, negative closes: for the record
    x_ref: float = math.nan  # wanted position: for the record


def start() -> LoadState:
    """The state before the first step."""
    return LoadState()


def step(
    state: LoadState,
    phase: GraspPhase,
    slip: bool,
    mean_displacement_px: tuple[float, float],
    position_ticks: int,
    dt_s: float,
    law: LoadLaw,
) -> int:
    """One control step of dt_s: the goal in ticks. mean_displacement_px: of all dots, to the right and down."""
    if phase is GraspPhase.CONTACT:
        state.rest_ticks, state.rest_px = position_ticks - 0.5, mean_displacement_px
        state.place_ticks = position_ticks + 0.5
        state.wanted_ticks = state.rest_ticks
        state.u_ff = -law.approach
        return _clip_whole(position_ticks + law.approach, law.last_tick)
    if state.phase is GraspPhase.CONTACT:
        state.ratio, state.spare_ticks = law.first_ratio, law.lift_ticks
    state.phase = phase
    load_px = math.hypot(mean_displacement_px[0] - state.rest_px[0], mean_displacement_px[1] - state.rest_px[1])
    _observe(state, position_ticks)
    if phase is GraspPhase.LIFT:
        if slip and load_px > LEAST_LOAD_PX:
            state.ratio = min(state.ratio + law.first_ratio * dt_s / law.rise_s, law.most_ratio)
    else:
        slip = slip or load_px < state.most_px * (1.0 - law.fall) - law.fall_px
        _balance(state, slip, load_px, dt_s, law)
    state.quiet_s = 0.0 if slip else state.quiet_s + dt_s
    wanted = state.rest_ticks + state.spare_ticks + state.ratio * load_px
    slowest = (state.wanted_ticks - state.rest_ticks) * dt_s / law.settle_s
    state.wanted_ticks = max(wanted, state.wanted_ticks - (0.0 if phase is GraspPhase.LIFT else slowest))
    state.x_ref = state.wanted_ticks
    push = _push(state, position_ticks, dt_s, law)
    state.u_ff = -float(push)
    return _clip_whole(position_ticks + push, law.last_tick)


def _observe(state: LoadState, position_ticks: int) -> None:
    """Correct the counted place by the encoder, which is right within one tick."""
    if position_ticks != state.position:
        state.pulses = 0
    state.position = position_ticks
    state.place_ticks = min(max(state.place_ticks, float(position_ticks)), position_ticks + 1.0)


def _balance(state: LoadState, slip: bool, load_px: float, dt_s: float, law: LoadLaw) -> None:
    """The ratio in balance: released until slip, raised on slip, and back to a little above what was needed then."""
    state.slip_s += dt_s
    if slip and load_px > LEAST_LOAD_PX:
        if state.quiet_s >= law.quiet_s:
            state.slip_s, state.slipping_s, state.closed = 0.0, 0.0, False
        state.slipping_s += dt_s
        if not state.closed:
            _close_on_slip(state, load_px, law)
        elif state.slip_s > law.quiet_s:
            state.ratio = min(state.ratio + state.ratio * law.catch * dt_s / law.catch_s, law.most_ratio)
    elif state.quiet_s >= law.quiet_s:
        state.least_px, state.most_px = min(state.least_px, load_px), max(state.most_px, load_px)
        if not state.needed and load_px > state.least_px * (1.0 + law.sink) + law.sink_px:
            state.needed = state.ratio  # not yet slip of the whole: no margin
        lowest = max(state.needed, law.least_ratio)
        time_s = law.settle_s if state.needed else law.release_s
        state.spare_ticks = max(state.spare_ticks * (1.0 - dt_s / law.release_s), law.spare_ticks)
        state.ratio = max(state.ratio - state.ratio * dt_s / time_s, min(state.ratio, lowest))


def _close_on_slip(state: LoadState, load_px: float, law: LoadLaw) -> None:
    """Close on slip that a change of the load confirms, and take the ratio needed from it; or on slip that lasts."""
    confirmed = max(load_px - state.least_px, state.most_px - load_px) > law.confirm * load_px + law.confirm_px
    if not confirmed and state.slipping_s < law.unconfirmed_s:
        return
    ratio_now = max(state.place_ticks - state.rest_ticks - state.spare_ticks, 0.0) / load_px
    if confirmed:
        state.needed = min(ratio_now * (1.0 + law.margin) + law.margin_ticks / load_px, law.most_ratio)
    state.ratio = min(max(state.ratio, ratio_now * (1.0 + law.catch) + law.catch_ticks / load_px), law.most_ratio)
    state.least_px, state.most_px, state.closed = math.inf, 0.0, True


def _push(state: LoadState, position_ticks: int, dt_s: float, law: LoadLaw) -> int:
    """How many whole ticks ahead of the fingers the goal has to be so that they move to where they are wanted."""
    behind = state.wanted_ticks - state.place_ticks
    grip_push = law.push_per_tick * max(state.place_ticks - state.rest_ticks, 0.0)  # that the force of the grip takes
    state.pause_s -= dt_s
    if behind > CLOSE_ENOUGH_TICKS:
        push = min(grip_push + law.band_ticks + law.surplus_ticks + law.speed * behind, law.most_push)
        state.place_ticks = min(state.place_ticks + min(behind, 1.0) * law.stride_ticks, position_ticks + 1.0)
        return round(push)
    if behind < -law.pulse_ticks and state.pause_s <= 0.0:
        state.pause_s = law.pause_s
        state.place_ticks -= law.pulse_ticks
        state.pulses += 1
        harder = state.pulses // max(law.dry_pulses, 1)
        return -min(max(math.ceil(law.band_ticks - grip_push + law.surplus_ticks), 1) + harder, int(law.most_push))
    return round(min(grip_push, law.most_push))


def _clip_whole(goal: float, last_tick: int) -> int:
    return int(min(max(round(goal), 0), last_tick))
