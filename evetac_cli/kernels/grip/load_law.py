"""What the law load-proportional is told, its constants and what it remembers; what it does: load_proportional.py."""

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

from evetac_cli.checks import check_range
from evetac_cli.kernels.grip.fingers import FingerState, Gear
from evetac_cli.kernels.grip.paper import GraspPhase

MARGIN, MOST_MARGIN = 1.4, 5.0


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

    margin: how many times what is needed the grip aims at. The others were chosen on simulated grasps of seeds 0 to 35,
    200 to 213, 100 to 124, 360 to 395 and 400 to 519 of scripts/grip_trials.py: on the first two, what light contact,
    probes of the lift and fingers have; on the others, turn, rates, release, boost and bounds, with a detector
    `disp-xy-grip` at about 4 false alarms per minute.
    """

    margin: float = MARGIN
    approach: float = 2.0  # ticks ahead in light contact, as the paper's law
    approach_dry_s: float = 0.15  # without a motion of the encoder since the start: push harder
    light_ticks: float = 2.5  # by which light contact has closed
    unfelt_ticks: float = 7.0  # ... where nothing was felt until its end: a gear that rubs little went on closing
    turn: float = 2.5  # px of load per px of turn: about the spread of the dots over the arm of the contact's friction
    least_px: float = 0.35  # less than this counts as no load: a grip alone moves dots by as much
    small_px: float = 1.0  # an object whose load was less when it was found to be carried was not, if it becomes more
    first_ratio: float = 2.0  # ticks/px
    most_ratio: float = 30.0
    most_ticks: float = 15.0  # no grip is firmer than so much
    most_ticks_px: float = 8.0  # ... and so much per px of load
    first_ticks: float = 1.0  # of spare beyond light contact
    search_ticks_s: float = 1.5  # the lift closes by while there is no load
    most_spare_ticks: float = 6.0
    rate_s: float = 0.015  # over which the growth of the load is taken
    stalls: float = 0.75  # share of its fastest growth above which nothing slips in the lift
    close_s: float = 0.08  # time constant of closing on slip
    close_ticks_s: float = 10.0  # ... and so fast beside it
    answer_s: float = 0.03  # after which the load is asked whether it answers to the grip
    answer: float = 0.2  # share of the grip's growth by which the load has to grow where something slides
    ignore_s: float = 0.3  # slip that was not confirmed is not believed for so long, twice as long the next time
    most_ignore_s: float = 2.4
    little_sticks: float = 0.3  # of the contact: a sign of slip
    quiet_s: float = 0.06  # without a sign of slip: it is over
    steady: float = 0.03  # share by which a load may change in quiet_s that is steady
    mean_s: float = 0.15  # over which a load that swings is taken
    wait_s: float = 0.4  # for a load to be steady, before it is asked all the same
    probe: float = 0.15  # share by which the lift closes to ask whether the object is carried,
    most_probe: float = 1.0  # ... twice as much after each answer, up to this,
    probe_ticks: float = 1.5  # ... and by so much at least, which the encoder sees
    probe_answer: float = 0.6  # as `answer`: dots that the grip itself moves are no answer
    probe_s: float = 0.06
    probe_most_s: float = 0.25  # fingers that have not closed by so much by then are at their limit
    leaks_s: float = 2.0  # time constant of a grip that opens in the lift
    calm_s: float = 0.2  # of a steady load, before a release
    calm_most_s: float = 1.5  # ... or so long without: what is carried may swing
    release_s: float = 1.7  # time constant of the release
    lags_ticks: float = 1.0  # ... which waits for fingers that are farther behind
    least_ticks: float = 1.5  # ... and goes no further: where fingers touch is known to about a tick
    again: float = 0.8  # a sign counts that comes again before the ratio has fallen to this share
    sure_steps: int = 10  # ... or a slip that lasts
    window: float = 0.12  # share of the grip in whose release changes are looked at
    moves: float = 0.05  # share of the load that a change in a window has to exceed
    moves_px: float = 0.02
    moves_times: float = 2.5  # ... and so many times the change in the first window
    first_moves: float = 4.0  # ... in which it has to be so many times as large
    slide: float = 1.8  # what stops a slide over what just holds at rest: friction falls to 0.5 to 0.7 as it slides
    most_boost: float = 3.0  # ... while there is slip, growing by close_s
    settle_s: float = 0.6  # for so long, and time constant of a load that settles and of a grip that opens
    falls: float = 0.85  # a load that falls below this share of what was carried slides
    forgets_s: float = 6.0  # time constant of what was carried
    most_load: float = 2.0  # times what was carried first, that the grip follows
    doubt: float = 1.2  # each time that something slips, what is needed becomes so much more,
    most_doubt: float = 2.5  # ... up to so many times what the release found
    gear: Gear = Gear()

    def __post_init__(self) -> None:
        """Refuse constants that are out of range."""
        check_range("margin", self.margin, 1.0, MOST_MARGIN)
        for item in fields(self):
            if item.name not in ("margin", "gear"):
                check_range(item.name, getattr(self, item.name), above=item.name in _TIMES)
        for name in ("slide", "doubt", "most_doubt", "most_load"):
            check_range(name, getattr(self, name), 1.0)
        for less, more in (("first_ratio", "most_ratio"), ("slide", "most_boost")):
            if getattr(self, less) > getattr(self, more):
                found = f"{getattr(self, less)}, {getattr(self, more)}"
                raise ValueError(f"expected {less} <= {more}, found {found}")


_TIMES = frozenset(
    ("close_s", "probe_s", "release_s", "settle_s", "answer_s", "approach_dry_s", "quiet_s", "rate_s")
    + ("mean_s", "leaks_s", "forgets_s")
)


@dataclass
class LoadState(FingerState):
    """What the controller remembers between steps. Flat, so that a shallow copy is a copy."""

    phase: GraspPhase = GraspPhase.CONTACT
    first_position: int = -1  # of the encoder at the first step
    approach_s: float = 0.0  # since the push was last made harder
    approach_more: int = 0
    steps: int = 0
    light_ticks: float = 0.0  # by which light contact has closed
    rest_ticks: float = 0.0  # where the fingers touch without a force
    rest_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # displacement and turn in light contact
    ratio: float = 0.0
    spare: float = 0.0
    wanted_ticks: float = 0.0
    load_px: float = 0.0
    rate_px_s: float = 0.0  # of its growth
    most_rate_px_s: float = 0.0
    slow_px: float = 0.0  # load, over some quiet_s
    mean_px: float = 0.0  # ... over some mean_s
    settled_px: float = 0.0  # ... over some settle_s
    steady_s: float = 0.0  # for which the load has been steady
    slip_steps: int = 0  # in a row
    quiet_s: float = math.inf  # since slip
    begins: bool = False  # slip, after a while without
    ignore_s: float = 0.0  # slip is not believed for so long
    next_ignore_s: float = 0.0
    closes: bool = False  # on slip
    answered: bool = False  # ... and the load has grown with the grip since
    asked_s: float = 0.0  # since the grip and the load were noted, below, to be asked whether one answers the other
    asked_ticks: float = 0.0
    asked_px: float = 0.0
    ratio_at_slip: float = 0.0
    waited_s: float = 0.0  # with a load, for it to be steady
    probing: bool = False
    probe_share: float = 0.0
    probe_ticks: float = 0.0  # by which this probe is to close
    probed_s: float = 0.0  # since it has
    tells: bool = False  # ... and the load was steady before
    unanswered: int = 0  # probes in a row
    carried: bool = False
    carried_s: float = 0.0
    base_px: float = 0.0  # load when it was found to be
    held_px: float = 0.0  # load that was carried of late
    calm: bool = False  # a release may begin
    doubted: float = 0.0  # ratio at which there was a sign last
    stop_s: float = 0.0  # for which the grip is still to be what stops a slide
    boost: float = 1.0  # by how much it is firmer for that
    needed: float = 0.0  # ratio that the grip aims at, once a release has found it; 0 before
    known: float = 0.0  # ... but for doubt
    seen_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # load at the start of a window of the release
    seen_ticks: float = 0.0  # grip there; 0: none began
    usual_px: float = -1.0  # change in the first window
    u_ff: float = 0.0  # push, negative closes: for the record
    x_ref: float = math.nan  # wanted position: for the record
