"""Where the dots are: one slice of events at a time, by the paper's descent or by fitting the rims of the dots.

Every event near the rim of a dot says where the rim is. The paper's tracker and its relatives (presets `paper`,
`official`, `unregularised`) add up a gradient step an event, and an elastic term keeps dots at the distance from their
neighbours that they had at the start (paper, "Signal Processing - Dot Tracking"). The preset `stable` solves for the
motion that the events of a slice speak of (tracker_fit.py). `start` and `step` are the only way in, for a file and for
a live camera alike.

Why so:
- What events add up to is summed as integers of 2**-36. Integer sums do not depend on the order of their terms, so the
  positions are the same bits in whatever order the events of a slice arrive. A term is cut off by less than 1.5e-11.
- The paper moves a dot only "if more than 10 events are triggered at its location". We count the events in the ring,
  those that pull: events inside the dot say nothing about where it is.
- Whether an event lies in a ring is close to a coin toss, and a wrong guess of the processor costs more than the pull.
  So every event adds its pull, times 0 or 1.
- The published code moves centres up the gradient of its data term, with an edge 1.25 times as wide as the dots it was
  calibrated with and a ring inside them: sign, edge and ring hold each other up. So `official` is one setting, for dots
  whose true radius is about 8 px; with dots of 15 px it loses them, as the code does.
- A dot that has lost track finds no rim of its own. When few events have come for a while and its neighbours are back
  where they began, its place is known without events: there it starts anew (only with `rest_slices`, so that the
  paper's presets stay what they are).
"""

from dataclasses import dataclass, replace
from math import inf, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels import hot_pixels, tracker_buckets, tracker_fit
from evetac_cli.kernels.grid import pitch

MAX_NEIGHBOURS = tracker_fit.MAX_NEIGHBOURS
LOST_PX = 40.0  # with the paper's constants, no event of a dot's own edge is in its ring from 35 px on
AT_REST_PX = 3.0  # neighbours displaced by less than this, in the mean, are at rest
NEIGHBOUR_PITCHES = 1.7  # between the diagonal (1.41) and the next dot but one (2)
MAX_REACH_PX = 128.0  # keeps the integer sum of 1e6 pulls below 2**63

_UNITS = tracker_fit.UNITS
_NO_POLARITY = np.empty(0, np.uint8)


def _check(name: str, value: float, low: float, high: float = inf, *, low_included: bool = True) -> None:
    above = value >= low if low_included else value > low
    if not (above and value <= high and np.isfinite(value)):
        bound = f"finite and {'>=' if low_included else '>'} {low:g}" + (f", <= {high:g}" if high < inf else "")
        raise ValueError(f"{name}: expected {bound}, found {value}")


@dataclass(frozen=True)
class TrackerConstants:
    """All constants of the tracker; lengths in px, the defaults are the preset `paper`.

    The ring bounds are exclusive and hold for the distance of an event from the dot's centre (the paper prints them on
    its square). The paper gives no regulariser weight: ours is the effective one of the authors' published code,
    step_size * regulariser_weight = 2.25e-7 per px**2. The explicit step is stable near the rest grid while
    step_size * (4 N / 3 + 98.8 * regulariser_weight * pitch**2) < 2, N ring events per dot and slice; beyond that the
    clips keep it bounded. ValueError if a constant is out of range.

    With `fit` (tracker_fit.py), a dot's rim is the middle of its ring, all its neighbours together weigh as much as
    8 * regulariser_weight of its events, gradient_clip and ascend do not count, and the constants from `sweeps` on do.
    The steps are bounded for any of them.
    """

    radius_px: float = 15.0  # of the dot's edge; also the furthest a dot moves in one slice, per axis
    ring_inner_px: float = 10.0  # only events further away than this pull
    ring_outer_px: float = 20.0  # ... and nearer than this
    count_radius_px: float = 20.0  # events nearer than this are the dot's (`events_per_dot`)
    step_size: float = 0.003
    regulariser_weight: float = 7.5e-5  # per px**2
    min_events: int = 10  # a dot moves only if more ring events than this pull it
    gradient_clip: float = 400.0  # px per axis, on the data term: 1.2 px a slice; from the authors' published code
    ascend: bool = False  # up the gradient of the data term, as the published code does, instead of down
    hot_pixel_events: int = 16  # a pixel with more, far ahead of its neighbours, is hot (hot_pixels.py); 0: none is
    rest_slices: int = 0  # a lost dot is put back after as many slices of rest; 0: never
    fit: bool = False  # solve for the motion, with polarity, instead of a gradient step
    sweeps: int = 8  # of Gauss-Seidel over all dots
    trust_px: float = 1.5  # most motion seen in a slice, and most correction of it
    rim_lag_px: float = 0.2  # events come when the rim has gone so far beyond their pixel (hysteresis of the threshold)
    event_px: float = 1.0 / 300.0  # how far a dot has moved for each of its ring events, as far as they agree
    most_events: float = 1000.0  # a dot's rim weighs no more than so many events, however many there are

    def __post_init__(self) -> None:
        """Refuse what cannot be tracked with."""
        _check("radius_px", self.radius_px, 0.0, MAX_REACH_PX, low_included=False)
        _check("ring_outer_px", self.ring_outer_px, 0.0, MAX_REACH_PX, low_included=False)
        _check("ring_inner_px", self.ring_inner_px, 0.0, MAX_REACH_PX)
        _check("count_radius_px", self.count_radius_px, 0.0, MAX_REACH_PX, low_included=False)
        _check("step_size", self.step_size, 0.0, low_included=False)
        _check("regulariser_weight", self.regulariser_weight, 0.0)
        _check("min_events", self.min_events, 0.0, 2.0**31 - 1)
        _check("gradient_clip", self.gradient_clip, 0.0, low_included=False)
        _check("hot_pixel_events", self.hot_pixel_events, 0.0, 2.0**14)
        _check("rest_slices", self.rest_slices, 0.0, 2.0**31 - 1)
        _check("sweeps", self.sweeps, 1.0, 1e4)
        _check("trust_px", self.trust_px, 0.0, MAX_REACH_PX, low_included=False)
        _check("rim_lag_px", self.rim_lag_px, 0.0, MAX_REACH_PX)
        _check("event_px", self.event_px, 0.0, 1.0)
        _check("most_events", self.most_events, 0.0, low_included=False)
        if self.ring_inner_px >= self.ring_outer_px:
            raise ValueError(
                f"ring_inner_px: expected less than ring_outer_px = {self.ring_outer_px}, found {self.ring_inner_px}"
            )
        for name in ("min_events", "hot_pixel_events", "rest_slices", "sweeps"):
            if int(getattr(self, name)) != getattr(self, name):
                raise ValueError(f"{name}: expected a whole number, found {getattr(self, name)}")
        if self.fit and abs(self.ring_inner_px + self.ring_outer_px - 2.0 * self.radius_px) > 1e-9 * self.radius_px:
            raise ValueError(
                f"radius_px: expected the middle of the ring, {(self.ring_inner_px + self.ring_outer_px) / 2},"
                f" found {self.radius_px}"
            )

    def for_dots(self, dot_radius_px: float) -> "TrackerConstants":
        """The constants for dots of this radius: with `fit` the ring moves along, without they stay what they are.

        The widths of ring and count stay. A rim makes events in proportion to its length, so each speaks of a shorter
        way on a longer rim. The paper's presets name their radii as part of what they are. ValueError if the radius is
        not above half the width of the ring, or the ring out of reach.
        """
        if not self.fit:
            return self
        half_ring_px = self.ring_outer_px - self.radius_px
        _check("dot_radius_px", dot_radius_px, half_ring_px, MAX_REACH_PX - half_ring_px)
        return replace(
            self,
            radius_px=dot_radius_px,
            ring_inner_px=dot_radius_px - half_ring_px,
            ring_outer_px=dot_radius_px + half_ring_px,
            count_radius_px=dot_radius_px + (self.count_radius_px - self.radius_px),
            event_px=min(self.event_px * (self.radius_px / dot_radius_px), 1.0),
        )


# What the published code was calibrated with; its ring is the outer 13.75 px of the dot, its edge 1.25 times as wide.
_OFFICIAL_DOT_PX = 20.62

PRESETS: dict[str, TrackerConstants] = {
    "paper": TrackerConstants(),
    "official": TrackerConstants(
        radius_px=1.25 * _OFFICIAL_DOT_PX,
        ring_inner_px=_OFFICIAL_DOT_PX - 13.75,
        ring_outer_px=_OFFICIAL_DOT_PX,
        min_events=4,  # it asks for 10 table entries, and an event makes two
        ascend=True,
    ),
    "unregularised": TrackerConstants(regulariser_weight=0.0),
    "stable": TrackerConstants(
        ring_inner_px=11.0,
        ring_outer_px=19.0,
        step_size=0.1,
        regulariser_weight=50.0,
        min_events=0,
        hot_pixel_events=8,  # without a gate, every event of a hot pixel counts
        rest_slices=100,
        fit=True,
    ),
}


@dataclass(slots=True)
class TrackerState:
    """What the tracker knows after the slices so far; `step` changes the arrays in place, n is the number of dots."""

    constants: TrackerConstants
    centre_xy_px: NDArray[np.float64]  # (n + 1, 2), see dot_xy_px; the last row is nobody (tracker_buckets.py)
    events: NDArray[np.int32]  # (n + 1,), see events_per_dot
    lost: NDArray[np.bool_]  # (n,), displacement more than LOST_PX from the mean displacement of its neighbours
    rest_xy_px: NDArray[np.float64]  # (n, 2), centres at the start
    neighbours: NDArray[np.int32]  # (n, 8), indices first, then -1
    rest_distance_px2: NDArray[np.float64]  # (n, 8), squared distance to each neighbour at the start
    sums: NDArray[np.int64]  # (n + 1, 2), of pulls, or (n + 1, 10), see tracker_fit.py; in units of 2**-36
    ring_events: NDArray[np.int32]  # (n + 1,), how many events those sums have
    quiet: NDArray[np.int64]  # (1,), slices of rest up to now
    told: NDArray[np.float64]  # (2,), sum of the weights of ring events that got darker and brighter up to now
    shift_px: NDArray[np.float64]  # (n, 2), work space
    solver: NDArray[np.float64]  # (n, 8), work space
    listed_xy_px: NDArray[np.float64]  # (n, 2), centres when the buckets were filled, see tracker_buckets.py
    first_dot: NDArray[np.uint32]  # (buckets + 1,), which dot is near, if only one is
    bucket_start: NDArray[np.uint32]  # (buckets + 1,), where each bucket's dots begin in bucket_dots
    bucket_dots: NDArray[np.uint32]
    fired: NDArray[np.uint16]  # recent events of every pixel, see hot_pixels.py
    passed: NDArray[np.uint32]  # (at least as many as events in a slice,), work space
    slices: int = 0

    @property
    def dot_xy_px(self) -> NDArray[np.float64]:
        """Centres now, (n, 2), a view; NaN for a missing dot."""
        return self.centre_xy_px[:-1]

    @property
    def events_per_dot(self) -> NDArray[np.int32]:
        """Events of the last slice nearer than count_radius_px to where the dot was before it, (n,), a view."""
        return self.events[:-1]


def start(
    dot_xy_px: NDArray[np.float64], constants: TrackerConstants, neighbours: NDArray[np.int32] | None = None
) -> TrackerState:
    """Begin tracking dots from their centres at rest.

    dot_xy_px: (n, 2) in any order, inside the frame and apart from each other; a row of NaN is a missing dot, which
    never moves, never has events and is no dot's neighbour. neighbours: (n, 8) indices filled up with -1; found by
    `grid_neighbours` if not given. ValueError if the dots or the neighbours are not like this.
    """
    rest = _checked_dots(dot_xy_px)
    n = len(rest)
    pairs = grid_neighbours(rest) if neighbours is None else _checked_neighbours(neighbours, rest)
    entries = tracker_buckets.most_entries(n, max(constants.ring_outer_px, constants.count_radius_px))
    state = TrackerState(
        constants=constants,
        centre_xy_px=np.vstack([rest, tracker_buckets.NOBODY_XY_PX]),
        events=np.zeros(n + 1, np.int32),
        lost=np.zeros(n, np.bool_),
        rest_xy_px=rest,
        neighbours=pairs,
        rest_distance_px2=np.where(pairs >= 0, np.sum((rest[:, None] - rest[pairs]) ** 2, axis=2), 0.0),
        sums=np.zeros((n + 1, tracker_fit.SUMS if constants.fit else 2), np.int64),
        ring_events=np.zeros(n + 1, np.int32),
        quiet=np.zeros(1, np.int64),
        told=np.zeros(2),
        shift_px=np.zeros((n, 2)),
        solver=np.zeros((n, tracker_fit.SOLVER)),
        listed_xy_px=np.full((n, 2), -inf),  # far from everywhere: the first step fills the buckets
        first_dot=np.zeros(tracker_buckets.BUCKETS + 1, np.uint32),
        bucket_start=np.zeros(tracker_buckets.BUCKETS + 1, np.uint32),
        bucket_dots=np.zeros(entries, np.uint32),
        fired=np.zeros(hot_pixels.FIRED_SHAPE, np.uint16),
        passed=np.zeros(4096, np.uint32),
    )
    nothing = np.empty(0, np.uint16)
    step(state, nothing, nothing, np.empty(0, np.uint8))  # compiles or loads the kernel now and not in the first slice
    return state


def step(state: TrackerState, x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8] | None = None) -> None:
    """Move the dots by the events of one slice, in any order, as columns x and y in px, p 0 or 1; updates `state`.

    A dot moves if it has more than min_events ring events. Without `fit` it moves by -step_size * (gradient of the data
    term + regulariser_weight * gradient of the distance term), all taken at the positions before the slice. The data
    gradient is clipped to gradient_clip, the motion to radius_px, per axis. With `fit` see tracker_fit.py: this needs
    the polarities p, which the others ignore. A dot stays inside the frame. Events outside the frame are ignored.
    Read-only or strided columns do, but the first of them costs a compilation. ValueError if x, y (uint16) and p
    (uint8) are no columns of equal length. Source: paper, "Signal Processing - Dot Tracking", the last three equations.
    """
    if x.dtype != np.uint16 or y.dtype != np.uint16 or x.ndim != 1 or x.shape != y.shape:
        raise ValueError(
            f"expected two uint16 columns of equal length, found {x.dtype} {x.shape} and {y.dtype} {y.shape}"
        )
    constants = state.constants
    if constants.fit and (p is None or p.dtype != np.uint8 or p.shape != x.shape):
        found = "none" if p is None else f"{p.dtype} {p.shape}"
        raise ValueError(f"p: expected uint8 polarities, as many as events {x.shape}, found {found}")
    if len(x) > len(state.passed):
        state.passed = np.zeros(2 * len(x), np.uint32)
    common = (
        state.centre_xy_px,
        state.events,
        state.lost,
        state.rest_xy_px,
        state.neighbours,
        state.sums,
        state.ring_events,
        state.quiet,
        state.shift_px,
        state.listed_xy_px,
        state.first_dot,
        state.bucket_start,
        state.bucket_dots,
        state.fired,
        state.passed,
        state.slices,
        constants.hot_pixel_events,
        constants.radius_px,
        constants.ring_inner_px,
        constants.ring_outer_px,
        constants.count_radius_px,
        constants.step_size,
        constants.regulariser_weight,
        constants.min_events,
        constants.rest_slices,
    )
    if constants.fit:
        _step_by_fit(
            x,
            y,
            p,
            *common,
            state.told,
            state.solver,
            constants.sweeps,
            constants.trust_px,
            constants.rim_lag_px,
            constants.event_px,
            constants.most_events,
        )
    else:
        _step_by_descent(
            x, y, _NO_POLARITY, *common, state.rest_distance_px2, constants.gradient_clip, constants.ascend
        )
    state.slices += 1


def grid_neighbours(dot_xy_px: NDArray[np.float64]) -> NDArray[np.int32]:
    """Find the up to 8 grid neighbours of every dot: (n, 8) indices, nearest first, filled up with -1.

    Neighbours are the dots within 1.7 pitches: along rows, columns and both diagonals. Missing dots (NaN) have none.
    """
    distance_px = np.linalg.norm(dot_xy_px[:, None] - dot_xy_px[None], axis=2)
    np.fill_diagonal(distance_px, inf)
    near = distance_px < NEIGHBOUR_PITCHES * pitch(dot_xy_px)
    neighbours = np.full((len(dot_xy_px), MAX_NEIGHBOURS), -1, np.int32)
    for dot in range(len(dot_xy_px)):
        found = np.flatnonzero(near[dot])
        found = found[np.argsort(distance_px[dot, found], kind="stable")][:MAX_NEIGHBOURS]
        neighbours[dot, : len(found)] = found
    return neighbours


def _checked_dots(dot_xy_px: NDArray[np.float64]) -> NDArray[np.float64]:
    dots = np.array(dot_xy_px, dtype=np.float64, order="C")
    if dots.ndim != 2 or dots.shape[1] != 2:
        raise ValueError(f"dot_xy_px: expected shape (n, 2), found {dots.shape}")
    missing = np.isnan(dots)
    if (missing[:, 0] != missing[:, 1]).any():
        raise ValueError("dot_xy_px: expected NaN in both coordinates of a missing dot, found it in one")
    present = dots[~missing[:, 0]]
    if len(present) == 0:
        raise ValueError(f"dot_xy_px: expected at least one dot, found {len(dots)} rows, all missing")
    if not ((present >= 0) & (present <= np.array(FRAME_PX) - 1)).all():
        raise ValueError(f"dot_xy_px: expected centres inside the frame {FRAME_PX}, found {present.tolist()}")
    if len(np.unique(present, axis=0)) != len(present):
        raise ValueError("dot_xy_px: expected dots apart from each other, found two at the same place")
    return dots


def _checked_neighbours(neighbours: NDArray[np.int32], rest_xy_px: NDArray[np.float64]) -> NDArray[np.int32]:
    pairs = np.array(neighbours)
    n = len(rest_xy_px)
    if pairs.shape != (n, MAX_NEIGHBOURS) or pairs.dtype.kind not in "iu":
        raise ValueError(
            f"neighbours: expected integers of shape {(n, MAX_NEIGHBOURS)}, found {pairs.dtype} {pairs.shape}"
        )
    used = pairs >= 0
    owner = np.arange(n)[:, None]
    missing = np.isnan(rest_xy_px[:, 0])
    gap = used[:, 1:] & ~used[:, :-1]
    if (pairs < -1).any() or (pairs >= n).any() or gap.any():
        raise ValueError(f"neighbours: expected indices below {n} followed by -1, found {pairs.tolist()}")
    if (used & ((pairs == owner) | missing[pairs] | missing[owner])).any():
        raise ValueError("neighbours: expected pairs of two present dots, found a dot with itself or a missing one")
    return pairs.astype(np.int32)


@njit(cache=True)
def _step_by_descent(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    centre_xy_px: NDArray[np.float64],
    events: NDArray[np.int32],
    lost: NDArray[np.bool_],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    quiet: NDArray[np.int64],
    shift_px: NDArray[np.float64],
    listed_xy_px: NDArray[np.float64],
    first_dot: NDArray[np.uint32],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    fired: NDArray[np.uint16],
    passed: NDArray[np.uint32],
    slices: int,
    hot_pixel_events: int,
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    step_size: float,
    regulariser_weight: float,
    min_events: int,
    rest_slices: int,
    rest_distance_px2: NDArray[np.float64],
    gradient_clip: float,
    ascend: bool,
) -> None:
    hot = hot_pixel_events > 0 and hot_pixels.count(x, y, fired, slices, hot_pixel_events, passed)
    if tracker_buckets.left_margin(centre_xy_px, listed_xy_px):
        reach_px = max(ring_outer_px, count_radius_px)
        tracker_buckets.fill(centre_xy_px, reach_px, listed_xy_px, first_dot, bucket_start, bucket_dots)
    sums[:] = 0
    ring_events[:] = 0
    events[:] = 0
    _pull_dots(
        x,
        y,
        p,
        fired,
        hot,
        centre_xy_px,
        first_dot,
        bucket_start,
        bucket_dots,
        radius_px,
        ring_inner_px,
        ring_outer_px,
        count_radius_px,
        sums,
        ring_events,
        events,
    )
    moved = _move_dots(
        centre_xy_px,
        neighbours,
        rest_distance_px2,
        sums,
        ring_events,
        shift_px,
        radius_px,
        step_size,
        regulariser_weight,
        min_events,
        gradient_clip,
        ascend,
    )
    _look_after_lost(moved, rest_slices, centre_xy_px, rest_xy_px, neighbours, ring_events, quiet, lost)


@njit(cache=True)
def _step_by_fit(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    centre_xy_px: NDArray[np.float64],
    events: NDArray[np.int32],
    lost: NDArray[np.bool_],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    quiet: NDArray[np.int64],
    shift_px: NDArray[np.float64],
    listed_xy_px: NDArray[np.float64],
    first_dot: NDArray[np.uint32],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    fired: NDArray[np.uint16],
    passed: NDArray[np.uint32],
    slices: int,
    hot_pixel_events: int,
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    step_size: float,
    regulariser_weight: float,
    min_events: int,
    rest_slices: int,
    told: NDArray[np.float64],
    solver: NDArray[np.float64],
    sweeps: int,
    trust_px: float,
    rim_lag_px: float,
    event_px: float,
    most_events: float,
) -> None:
    hot = hot_pixel_events > 0 and hot_pixels.count(x, y, fired, slices, hot_pixel_events, passed)
    if tracker_buckets.left_margin(centre_xy_px, listed_xy_px):
        reach_px = max(ring_outer_px, count_radius_px)
        tracker_buckets.fill(centre_xy_px, reach_px, listed_xy_px, first_dot, bucket_start, bucket_dots)
    sums[:] = 0
    ring_events[:] = 0
    events[:] = 0
    _measure_rims(
        x,
        y,
        p,
        fired,
        hot,
        centre_xy_px,
        first_dot,
        bucket_start,
        bucket_dots,
        radius_px,
        ring_outer_px - radius_px,
        rim_lag_px,
        count_radius_px,
        sums,
        ring_events,
        events,
    )
    moved = tracker_fit.solve(
        sums,
        ring_events,
        neighbours,
        min_events,
        step_size,
        regulariser_weight,
        sweeps,
        trust_px,
        event_px,
        most_events,
        told,
        solver,
        shift_px,
    )
    if moved:
        _shift_dots(centre_xy_px, shift_px, ring_events, min_events)
    _look_after_lost(moved, rest_slices, centre_xy_px, rest_xy_px, neighbours, ring_events, quiet, lost)


@njit(cache=True)
def _pull_dots(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    fired: NDArray[np.uint16],
    hot: bool,
    centre_xy_px: NDArray[np.float64],
    first_dot: NDArray[np.uint32],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    events: NDArray[np.int32],
) -> None:
    """Give every event to the dots it is near: count it, and add its pull d - r d / |d|, d from centre to event."""
    room = tracker_buckets.BLOCK + centre_xy_px.shape[0]
    bucket = np.empty(tracker_buckets.BLOCK, np.uint16)
    near_dot = np.empty(room, np.uint32)
    near_px = np.empty((2, room))
    near_p = np.empty(0, np.uint8)
    pull = np.empty((2, room), np.int64)
    in_ring = np.empty(room, np.bool_)
    counts = np.empty(room, np.bool_)
    constants = radius_px, ring_inner_px, ring_outer_px, count_radius_px
    for begin in range(0, x.shape[0], tracker_buckets.BLOCK):
        end = min(begin + tracker_buckets.BLOCK, x.shape[0])
        xs = x[begin:end]
        ys = y[begin:end]
        crowd = tracker_buckets.look_up(xs, ys, fired, hot, centre_xy_px, first_dot, bucket, near_dot, near_px)
        _add_pulls(end - begin, near_dot, near_px, *constants, pull, in_ring, counts, sums, ring_events, events)
        k = 0 if crowd else len(xs)
        while k < len(xs):
            k, pairs = tracker_buckets.look_up_crowd(
                xs, ys, p, k, centre_xy_px, first_dot, bucket_start, bucket_dots, bucket, near_dot, near_px, near_p
            )
            _add_pulls(pairs, near_dot, near_px, *constants, pull, in_ring, counts, sums, ring_events, events)


@njit(cache=True)
def _add_pulls(
    pairs: int,
    near_dot: NDArray[np.uint32],
    near_px: NDArray[np.float64],
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    pull: NDArray[np.int64],
    in_ring: NDArray[np.bool_],
    counts: NDArray[np.bool_],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    events: NDArray[np.int32],
) -> None:
    """Count pairs of an event and a dot, and add the pulls; pull, in_ring and counts are work space."""
    ring_inner_px2 = ring_inner_px * ring_inner_px
    ring_outer_px2 = ring_outer_px * ring_outer_px
    count_radius_px2 = count_radius_px * count_radius_px
    for k in range(pairs):
        dx = near_px[0, k]
        dy = near_px[1, k]
        distance_px2 = dx * dx + dy * dy
        in_ring[k] = (distance_px2 > ring_inner_px2) & (distance_px2 < ring_outer_px2)
        # An event on the very centre has no direction and is in no ring: any finite stretch will do.
        stretch = (1.0 - radius_px / sqrt(max(distance_px2, 1e-12))) * (in_ring[k] * _UNITS)
        pull[0, k] = int(stretch * dx)
        pull[1, k] = int(stretch * dy)
        counts[k] = distance_px2 < count_radius_px2
    for k in range(pairs):
        i = np.uint64(near_dot[k])
        sums[i, 0] += pull[0, k]
        sums[i, 1] += pull[1, k]
        ring_events[i] += in_ring[k]
        events[i] += counts[k]


@njit(cache=True)
def _measure_rims(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    fired: NDArray[np.uint16],
    hot: bool,
    centre_xy_px: NDArray[np.float64],
    first_dot: NDArray[np.uint32],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    radius_px: float,
    half_ring_px: float,
    rim_lag_px: float,
    count_radius_px: float,
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    events: NDArray[np.int32],
) -> None:
    """Give every event to the dots it is near: count it, and add what it says of the rim (tracker_fit.py)."""
    room = tracker_buckets.BLOCK + centre_xy_px.shape[0]
    bucket = np.empty(tracker_buckets.BLOCK, np.uint16)
    near_dot = np.empty(room, np.uint32)
    near_px = np.empty((2, room))
    near_p = np.empty(room, np.uint8)
    terms = np.empty((7, room), np.int64)
    in_ring = np.empty(room, np.bool_)
    counts = np.empty(room, np.bool_)
    constants = radius_px, half_ring_px, rim_lag_px, count_radius_px
    for begin in range(0, x.shape[0], tracker_buckets.BLOCK):
        end = min(begin + tracker_buckets.BLOCK, x.shape[0])
        xs = x[begin:end]
        ys = y[begin:end]
        ps = p[begin:end]
        crowd = tracker_buckets.look_up(xs, ys, fired, hot, centre_xy_px, first_dot, bucket, near_dot, near_px)
        _add_rims(end - begin, near_dot, near_px, ps, *constants, terms, in_ring, counts, sums, ring_events, events)
        k = 0 if crowd else len(xs)
        while k < len(xs):
            k, pairs = tracker_buckets.look_up_crowd(
                xs, ys, ps, k, centre_xy_px, first_dot, bucket_start, bucket_dots, bucket, near_dot, near_px, near_p
            )
            _add_rims(pairs, near_dot, near_px, near_p, *constants, terms, in_ring, counts, sums, ring_events, events)


@njit(cache=True)
def _add_rims(
    pairs: int,
    near_dot: NDArray[np.uint32],
    near_px: NDArray[np.float64],
    near_p: NDArray[np.uint8],
    radius_px: float,
    half_ring_px: float,
    rim_lag_px: float,
    count_radius_px: float,
    terms: NDArray[np.int64],
    in_ring: NDArray[np.bool_],
    counts: NDArray[np.bool_],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    events: NDArray[np.int32],
) -> None:
    """Count pairs of an event and a dot, and add what they say; terms (7, ...), in_ring and counts are work space."""
    per_half_ring = 1.0 / half_ring_px
    count_radius_px2 = count_radius_px * count_radius_px
    for k in range(pairs):
        dx = near_px[0, k]
        dy = near_px[1, k]
        # A leading rim makes events that get darker (p = 0), a trailing rim brighter ones, both too late.
        leading = 1.0 if near_p[k] == 0 else -1.0
        rim_px = radius_px - leading * rim_lag_px
        distance_px2 = max(dx * dx + dy * dy, 1e-12)
        distance_px = sqrt(distance_px2)
        beyond_px = distance_px - rim_px
        off = beyond_px * per_half_ring
        shape = max(1.0 - off * off, 0.0)
        weight = shape * shape * _UNITS
        nx = dx / distance_px
        ny = dy / distance_px
        terms[0, k] = int(weight * beyond_px * nx)
        terms[1, k] = int(weight * beyond_px * ny)
        terms[2, k] = int(weight * nx * nx)
        terms[3, k] = int(weight * nx * ny)
        terms[4, k] = int(weight)
        terms[5, k] = int(weight * nx)
        terms[6, k] = int(weight * ny)
        in_ring[k] = shape > 0.0
        counts[k] = distance_px2 < count_radius_px2
    for k in range(pairs):
        i = np.uint64(near_dot[k])
        side = np.uint64(4 + 3 * (near_p[k] != 0))  # no branch: the processor could not guess it
        sums[i, 0] += terms[0, k]
        sums[i, 1] += terms[1, k]
        sums[i, 2] += terms[2, k]
        sums[i, 3] += terms[3, k]
        sums[i, side] += terms[4, k]
        sums[i, side + np.uint64(1)] += terms[5, k]
        sums[i, side + np.uint64(2)] += terms[6, k]
        ring_events[i] += in_ring[k]
        events[i] += counts[k]


@njit(cache=True)
def _regulariser_gradient(
    i: int, centre_xy_px: NDArray[np.float64], neighbours: NDArray[np.int32], rest_distance_px2: NDArray[np.float64]
) -> tuple[float, float]:
    """Gradient of (8 / n) sum_j (|c_i - c_j|^2 - d_ij)^2 over the n neighbours j of dot i, with respect to c_i."""
    gradient_x = 0.0
    gradient_y = 0.0
    count = 0
    for entry in range(MAX_NEIGHBOURS):
        j = neighbours[i, entry]
        if j < 0:
            break
        dx = centre_xy_px[i, 0] - centre_xy_px[np.uint64(j), 0]
        dy = centre_xy_px[i, 1] - centre_xy_px[np.uint64(j), 1]
        stretch = 4.0 * (dx * dx + dy * dy - rest_distance_px2[i, entry])
        gradient_x += stretch * dx
        gradient_y += stretch * dy
        count += 1
    scale = MAX_NEIGHBOURS / max(count, 1)
    return scale * gradient_x, scale * gradient_y


@njit(cache=True)
def _move_dots(
    centre_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    rest_distance_px2: NDArray[np.float64],
    sums: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    shift_px: NDArray[np.float64],
    radius_px: float,
    step_size: float,
    regulariser_weight: float,
    min_events: int,
    gradient_clip: float,
    ascend: bool,
) -> bool:
    """Move the dots with enough events, all from the positions before; tell whether there was one."""
    moved = False
    # The data term's gradient is -2 times the sum of pulls.
    to_gradient = (2.0 if ascend else -2.0) / _UNITS
    for i in range(shift_px.shape[0]):
        if ring_events[i] <= min_events:
            continue
        moved = True
        elastic_x, elastic_y = _regulariser_gradient(i, centre_xy_px, neighbours, rest_distance_px2)
        data_x = _clip(to_gradient * sums[i, 0], gradient_clip)
        data_y = _clip(to_gradient * sums[i, 1], gradient_clip)
        shift_px[i, 0] = _clip(-step_size * (data_x + regulariser_weight * elastic_x), radius_px)
        shift_px[i, 1] = _clip(-step_size * (data_y + regulariser_weight * elastic_y), radius_px)
    if moved:
        _shift_dots(centre_xy_px, shift_px, ring_events, min_events)
    return moved


@njit(cache=True)
def _shift_dots(
    centre_xy_px: NDArray[np.float64],
    shift_px: NDArray[np.float64],
    ring_events: NDArray[np.int32],
    min_events: int,
) -> None:
    """Shift the dots with enough events, inside the frame."""
    for i in range(shift_px.shape[0]):
        if ring_events[i] > min_events:
            centre_xy_px[i, 0] = min(max(centre_xy_px[i, 0] + shift_px[i, 0], 0.0), FRAME_PX[0] - 1.0)
            centre_xy_px[i, 1] = min(max(centre_xy_px[i, 1] + shift_px[i, 1], 0.0), FRAME_PX[1] - 1.0)


@njit(cache=True)
def _clip(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


@njit(cache=True)
def _look_after_lost(
    moved: bool,
    rest_slices: int,
    centre_xy_px: NDArray[np.float64],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    ring_events: NDArray[np.int32],
    quiet: NDArray[np.int64],
    lost: NDArray[np.bool_],
) -> None:
    """Flag the lost dots when something moved; put them back after `rest_slices` slices of rest."""
    if moved:
        _find_lost(centre_xy_px, rest_xy_px, neighbours, lost)
    if rest_slices == 0:
        return
    total = 0
    for i in range(lost.shape[0]):
        total += ring_events[i]
    quiet[0] = quiet[0] + 1 if 2 * total < lost.shape[0] else 0
    if quiet[0] >= rest_slices:
        _put_back(centre_xy_px, rest_xy_px, neighbours, lost)


@njit(cache=True)
def _mean_displacement(
    i: int,
    centre_xy_px: NDArray[np.float64],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    without: NDArray[np.bool_],
) -> tuple[float, float, int]:
    """Mean displacement (x, y) of those neighbours of dot i that are not to be left out, and how many they are."""
    away_x = 0.0
    away_y = 0.0
    count = 0
    for entry in range(MAX_NEIGHBOURS):
        j = neighbours[i, entry]
        if j < 0:
            break
        if without[j]:
            continue
        away_x += centre_xy_px[j, 0] - rest_xy_px[j, 0]
        away_y += centre_xy_px[j, 1] - rest_xy_px[j, 1]
        count += 1
    return away_x / max(count, 1), away_y / max(count, 1), count


@njit(cache=True)
def _find_lost(
    centre_xy_px: NDArray[np.float64],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    lost: NDArray[np.bool_],
) -> None:
    """Flag the dots whose displacement is more than LOST_PX from the mean displacement of all their neighbours."""
    furthest_px2 = 0.0
    for i in range(lost.shape[0]):
        away_x = centre_xy_px[i, 0] - rest_xy_px[i, 0]
        away_y = centre_xy_px[i, 1] - rest_xy_px[i, 1]
        furthest_px2 = max(furthest_px2, away_x * away_x + away_y * away_y)
    if 4.0 * furthest_px2 <= LOST_PX * LOST_PX:  # then no two are further apart, and there is no need to look
        lost[:] = False
        return
    nobody = np.zeros_like(lost)
    for i in range(lost.shape[0]):
        away_x, away_y, count = _mean_displacement(i, centre_xy_px, rest_xy_px, neighbours, nobody)
        if count == 0:
            continue
        away_x = centre_xy_px[i, 0] - rest_xy_px[i, 0] - away_x
        away_y = centre_xy_px[i, 1] - rest_xy_px[i, 1] - away_y
        lost[i] = away_x * away_x + away_y * away_y > LOST_PX * LOST_PX


@njit(cache=True)
def _put_back(
    centre_xy_px: NDArray[np.float64],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    lost: NDArray[np.bool_],
) -> None:
    """Put lost dots where their neighbours, if these are at rest, say that they are, and clear their flags."""
    for i in range(lost.shape[0]):
        if not lost[i]:
            continue
        away_x, away_y, count = _mean_displacement(i, centre_xy_px, rest_xy_px, neighbours, lost)
        if count > 0 and away_x * away_x + away_y * away_y < AT_REST_PX * AT_REST_PX:
            centre_xy_px[i, 0] = min(max(rest_xy_px[i, 0] + away_x, 0.0), FRAME_PX[0] - 1.0)
            centre_xy_px[i, 1] = min(max(rest_xy_px[i, 1] + away_y, 0.0), FRAME_PX[1] - 1.0)
            lost[i] = False
