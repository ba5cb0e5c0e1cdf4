"""Where the dots are: one slice of events at a time, by the paper's descent or by fitting the rims of the dots.

Every event near the rim of a dot says where the rim is. The paper's tracker and its relatives (presets `paper`,
`official`, `unregularised`) add up a gradient step an event, and an elastic term keeps dots at the distance from their
neighbours that they had at the start (descent.py). The preset `stable` solves for the motion that the events of
a slice speak of (fit.py). `start` and `step` are the only way in, for a file and for a live camera alike; what
they do with a slice, in which order, is in step.py.

Why so: the published code moves centres up the gradient of its data term, with an edge 1.25 times as wide as the dots
it was calibrated with and a ring inside them: sign, edge and ring hold each other up. So `official` is one setting, for
dots whose true radius is about 8 px; with dots of 15 px it loses them, as the code does.
"""

from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.tracking import buckets, hot_pixels
from evetac_cli.kernels.tracking import fit as tracker_fit
from evetac_cli.kernels.tracking import step as tracker_step

MAX_REACH_PX = 128.0  # keeps the integer sum of 1e6 pulls below 2**63
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

    With `fit` (fit.py), a dot's rim is the middle of its ring, all its neighbours together weigh as much as
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
    centre_xy_px: NDArray[np.float64]  # (n + 1, 2), see dot_xy_px; the last row is nobody (buckets.py)
    events: NDArray[np.int32]  # (n + 1,), see events_per_dot
    lost: NDArray[np.bool_]  # (n,), far from where its neighbours say, see lost_dots.py
    rest_xy_px: NDArray[np.float64]  # (n, 2), centres at the start
    neighbours: NDArray[np.int32]  # (n, 8), indices first, then -1
    rest_distance_px2: NDArray[np.float64]  # (n, 8), squared distance to each neighbour at the start
    sums: NDArray[np.int64]  # (n + 1, 2), of pulls, or (n + 1, 10), see fit.py; in units of 2**-36
    ring_events: NDArray[np.int32]  # (n + 1,), how many events those sums have
    quiet: NDArray[np.int64]  # (1,), slices of rest up to now
    told: NDArray[np.float64]  # (2,), sum of the weights of ring events that got darker and brighter up to now
    shift_px: NDArray[np.float64]  # (n, 2), work space
    solver: NDArray[np.float64]  # (n, 8), work space
    listed_xy_px: NDArray[np.float64]  # (n, 2), centres when the buckets were filled, see buckets.py
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
    `grid.neighbours` if not given. ValueError if the dots or the neighbours are not like this.
    """
    rest = _checked_dots(dot_xy_px)
    n = len(rest)
    pairs = grid.neighbours(rest) if neighbours is None else _checked_neighbours(neighbours, rest)
    entries = buckets.most_entries(n, max(constants.ring_outer_px, constants.count_radius_px))
    state = TrackerState(
        constants=constants,
        centre_xy_px=np.vstack([rest, buckets.DUMMY_DOT_XY_PX]),
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
        first_dot=np.zeros(buckets.BUCKETS + 1, np.uint32),
        bucket_start=np.zeros(buckets.BUCKETS + 1, np.uint32),
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
    gradient is clipped to gradient_clip, the motion to radius_px, per axis. With `fit` see fit.py: this needs
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
        tracker_step.by_fit(
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
        tracker_step.by_descent(
            x, y, _NO_POLARITY, *common, state.rest_distance_px2, constants.gradient_clip, constants.ascend
        )
    state.slices += 1


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
    if pairs.shape != (n, grid.MAX_NEIGHBOURS) or pairs.dtype.kind not in "iu":
        raise ValueError(
            f"neighbours: expected integers of shape {(n, grid.MAX_NEIGHBOURS)}, found {pairs.dtype} {pairs.shape}"
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
