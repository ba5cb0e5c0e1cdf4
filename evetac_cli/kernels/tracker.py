"""Where the dots are: the paper's regularised dot tracker, one slice of events at a time.

Every event near the edge of a dot pulls the dot's centre so that the edge passes through the event; an elastic term
keeps dots at the distance from their neighbours that they had at the start (paper, "Signal Processing - Dot Tracking").
`start` and `step` are the only way in, for a file and for a live camera alike.

Why so:
- Pulls are summed as integers of 2**-36 px. Integer sums do not depend on the order of their terms, so the positions
  are the same bits in whatever order the events of a slice arrive. A pull is cut off by less than 1.5e-11 px.
- The paper moves a dot only "if more than 10 events are triggered at its location". We count the events in the ring,
  those that pull: events inside the dot say nothing about where it is.
- Events find their dots through buckets of 16 x 16 px that list the dots within reach. The lists allow for 4 px of
  motion and are made again only when a dot has left that margin, so a slice without motion does not pay for them.
- Whether an event lies in a ring is close to a coin toss, and a wrong guess of the processor costs more than the pull.
  So every event adds its pull, times 0 or 1; and empty buckets list one dot more, "nobody", far outside the frame, so
  that nearly every bucket has one entry. Nobody is the last row of the arrays with n + 1 rows.
"""

from dataclasses import dataclass
from math import inf, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.grid import pitch
from evetac_cli.kernels.hot_pixels import keep_cool

MAX_NEIGHBOURS = 8
LOST_PX = 40.0  # with the paper's constants, no event of a dot's own edge is in its ring from 35 px on
NEIGHBOUR_PITCHES = 1.7  # between the diagonal (1.41) and the next dot but one (2)
MAX_REACH_PX = 128.0  # keeps the integer sum of 1e6 pulls below 2**63

_PULL_UNITS_PER_PX = 2.0**36
_BUCKET_BITS = 4
_BUCKET_PX = 1 << _BUCKET_BITS
_BUCKET_COLUMNS = -(-FRAME_PX[0] // _BUCKET_PX)
_BUCKET_ROWS = -(-FRAME_PX[1] // _BUCKET_PX)
_MARGIN_PX = 4.0
_NOBODY_XY_PX = (-1000.0, -1000.0)  # beyond MAX_REACH_PX from every pixel


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
    """

    radius_px: float = 15.0  # of the dot's edge; also the furthest a dot moves in one slice, per axis
    ring_inner_px: float = 10.0  # only events further away than this pull
    ring_outer_px: float = 20.0  # ... and nearer than this
    count_radius_px: float = 20.0  # events nearer than this are the dot's (`events_per_dot`)
    step_size: float = 0.003
    regulariser_weight: float = 7.5e-5  # per px**2
    min_events: int = 10  # a dot moves only if more ring events than this pull it
    gradient_clip: float = 400.0  # px per axis, on the data term: 1.2 px a slice; from the authors' published code
    carry: bool = False  # keep the pulls of slices with too few events until there are enough, else forget them
    hot_pixel_events: int = 16  # a pixel with more, far ahead of its neighbours, is hot (hot_pixels.py); 0: none is

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
        if self.ring_inner_px >= self.ring_outer_px:
            raise ValueError(
                f"ring_inner_px: expected less than ring_outer_px = {self.ring_outer_px}, found {self.ring_inner_px}"
            )
        if int(self.min_events) != self.min_events:
            raise ValueError(f"min_events: expected a whole number, found {self.min_events}")


PRESETS: dict[str, TrackerConstants] = {
    "paper": TrackerConstants(),
    "unregularised": TrackerConstants(regulariser_weight=0.0),
    "carry": TrackerConstants(carry=True),
}


@dataclass(slots=True)
class TrackerState:
    """What the tracker knows after the slices so far; `step` changes the arrays in place, n is the number of dots."""

    constants: TrackerConstants
    centre_xy_px: NDArray[np.float64]  # (n + 1, 2), see dot_xy_px
    events: NDArray[np.int32]  # (n + 1,), see events_per_dot
    lost: NDArray[np.bool_]  # (n,), displacement more than LOST_PX from the mean displacement of the neighbours
    rest_xy_px: NDArray[np.float64]  # (n, 2), centres at the start
    neighbours: NDArray[np.int32]  # (n, 8), indices first, then -1
    rest_distance_px2: NDArray[np.float64]  # (n, 8), squared distance to each neighbour at the start
    pull: NDArray[np.int64]  # (n + 1, 2), sum of (1 - r / |d|) d over ring events, d from centre to event, in 2**-36 px
    ring_events: NDArray[np.int32]  # (n + 1,), how many events that sum has
    shift_px: NDArray[np.float64]  # (n, 2), work space
    lattice_xy_px: NDArray[np.float64]  # (n, 2), centres when the buckets were filled
    bucket_start: NDArray[np.uint32]  # (buckets + 1,), where each bucket's dots begin in bucket_dots
    bucket_dots: NDArray[np.uint32]
    fired: NDArray[np.uint16]  # (height + 2, width + 2), recent events of every pixel and its hot flag, zeros around
    cool_xy: NDArray[np.uint16]  # (2, at least as many as events in a slice), work space
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
    buckets_across = int(2 * _reach_px(constants.ring_outer_px, constants.count_radius_px)) // _BUCKET_PX + 2
    buckets = _BUCKET_COLUMNS * _BUCKET_ROWS
    state = TrackerState(
        constants=constants,
        centre_xy_px=np.vstack([rest, _NOBODY_XY_PX]),
        events=np.zeros(n + 1, np.int32),
        lost=np.zeros(n, np.bool_),
        rest_xy_px=rest,
        neighbours=pairs,
        rest_distance_px2=np.where(pairs >= 0, np.sum((rest[:, None] - rest[pairs]) ** 2, axis=2), 0.0),
        pull=np.zeros((n + 1, 2), np.int64),
        ring_events=np.zeros(n + 1, np.int32),
        shift_px=np.zeros((n, 2)),
        lattice_xy_px=np.full((n, 2), -inf),  # far from everywhere: the first step fills the buckets
        bucket_start=np.zeros(buckets + 1, np.uint32),
        bucket_dots=np.zeros(buckets + n * min(buckets, buckets_across**2), np.uint32),
        fired=np.zeros((FRAME_PX[1] + 2, FRAME_PX[0] + 2), np.uint16),
        cool_xy=np.zeros((2, 4096), np.uint16),
    )
    nothing = np.empty(0, np.uint16)
    step(state, nothing, nothing)  # compiles or loads the kernel now and not in the first slice
    return state


def step(state: TrackerState, x: NDArray[np.uint16], y: NDArray[np.uint16]) -> None:
    """Move the dots by the events of one slice, given in any order as columns x and y in px; updates `state` in place.

    A dot with more than min_events ring events moves by -step_size * (gradient of the data term + regulariser_weight *
    gradient of the distance term), all taken at the positions before the slice. The data gradient is clipped to
    gradient_clip, the motion to radius_px, per axis, and the dot stays inside the frame. Events outside the frame are
    ignored. Read-only or strided columns do, but the first of them costs a compilation. ValueError if x and y are not
    uint16 columns of equal length. Source: paper, "Signal Processing - Dot Tracking", the last three equations.
    """
    if x.dtype != np.uint16 or y.dtype != np.uint16 or x.ndim != 1 or x.shape != y.shape:
        raise ValueError(
            f"expected two uint16 columns of equal length, found {x.dtype} {x.shape} and {y.dtype} {y.shape}"
        )
    constants = state.constants
    if constants.hot_pixel_events:
        x, y = _without_hot_pixels(state, x, y)
    _step(
        x,
        y,
        state.centre_xy_px,
        state.events,
        state.lost,
        state.rest_xy_px,
        state.neighbours,
        state.rest_distance_px2,
        state.pull,
        state.ring_events,
        state.shift_px,
        state.lattice_xy_px,
        state.bucket_start,
        state.bucket_dots,
        constants.radius_px,
        constants.ring_inner_px,
        constants.ring_outer_px,
        constants.count_radius_px,
        constants.step_size,
        constants.regulariser_weight,
        constants.min_events,
        constants.gradient_clip,
        constants.carry,
    )


def _without_hot_pixels(
    state: TrackerState, x: NDArray[np.uint16], y: NDArray[np.uint16]
) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Events of a slice from pixels that are not hot; views of the state's work space."""
    if len(x) > state.cool_xy.shape[1]:
        state.cool_xy = np.zeros((2, 2 * len(x)), np.uint16)
    row = 1 + state.slices % FRAME_PX[1]
    state.slices += 1
    kept = keep_cool(x, y, state.fired, row, state.constants.hot_pixel_events, state.cool_xy[0], state.cool_xy[1])
    return (x, y) if kept < 0 else (state.cool_xy[0, :kept], state.cool_xy[1, :kept])


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
def _reach_px(ring_outer_px: float, count_radius_px: float) -> float:
    return max(ring_outer_px, count_radius_px) + _MARGIN_PX


@njit(cache=True)
def _step(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    centre_xy_px: NDArray[np.float64],
    events: NDArray[np.int32],
    lost: NDArray[np.bool_],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    rest_distance_px2: NDArray[np.float64],
    pull: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    shift_px: NDArray[np.float64],
    lattice_xy_px: NDArray[np.float64],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    step_size: float,
    regulariser_weight: float,
    min_events: int,
    gradient_clip: float,
    carry: bool,
) -> None:
    if _left_margin(centre_xy_px, lattice_xy_px):
        reach_px = _reach_px(ring_outer_px, count_radius_px)
        _fill_buckets(centre_xy_px, reach_px, lattice_xy_px, bucket_start, bucket_dots)
    if not carry:
        pull[:] = 0
        ring_events[:] = 0
    events[:] = 0
    _pull_dots(
        x,
        y,
        centre_xy_px,
        bucket_start,
        bucket_dots,
        radius_px,
        ring_inner_px,
        ring_outer_px,
        count_radius_px,
        pull,
        ring_events,
        events,
    )
    moved = _move_dots(
        centre_xy_px,
        neighbours,
        rest_distance_px2,
        pull,
        ring_events,
        shift_px,
        radius_px,
        step_size,
        regulariser_weight,
        min_events,
        gradient_clip,
    )
    if moved:
        _find_lost(centre_xy_px, rest_xy_px, neighbours, lost)


@njit(cache=True)
def _left_margin(centre_xy_px: NDArray[np.float64], lattice_xy_px: NDArray[np.float64]) -> bool:
    """Tell whether a dot is too far from where it was when the buckets were filled."""
    for i in range(lattice_xy_px.shape[0]):
        if abs(centre_xy_px[i, 0] - lattice_xy_px[i, 0]) > _MARGIN_PX:
            return True
        if abs(centre_xy_px[i, 1] - lattice_xy_px[i, 1]) > _MARGIN_PX:
            return True
    return False


@njit(cache=True)
def _buckets_within(x_px: float, y_px: float, reach_px: float) -> tuple[int, int, int, int]:
    """First and one past the last bucket row, the same of columns, that a square of half width reach_px touches."""
    first_row = max(0, int(y_px - reach_px) >> _BUCKET_BITS)
    first_column = max(0, int(x_px - reach_px) >> _BUCKET_BITS)
    last_row = min(_BUCKET_ROWS - 1, int(y_px + reach_px) >> _BUCKET_BITS)
    last_column = min(_BUCKET_COLUMNS - 1, int(x_px + reach_px) >> _BUCKET_BITS)
    return first_row, last_row + 1, first_column, last_column + 1


@njit(cache=True)
def _fill_buckets(
    centre_xy_px: NDArray[np.float64],
    reach_px: float,
    lattice_xy_px: NDArray[np.float64],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
) -> None:
    """List the dots within reach of bucket b in bucket_dots[bucket_start[b]:bucket_start[b + 1]], at least nobody."""
    nobody = lattice_xy_px.shape[0]
    bucket_start[:] = 0
    for i in range(nobody):
        if np.isnan(centre_xy_px[i, 0]):
            continue
        lattice_xy_px[i, 0] = centre_xy_px[i, 0]
        lattice_xy_px[i, 1] = centre_xy_px[i, 1]
        row, row_stop, column, column_stop = _buckets_within(centre_xy_px[i, 0], centre_xy_px[i, 1], reach_px)
        for r in range(row, row_stop):
            for c in range(column, column_stop):
                bucket_start[r * _BUCKET_COLUMNS + c] += 1
    # From counts to the end of every bucket; filling from the end then leaves its beginning.
    total = 0
    for b in range(bucket_start.shape[0] - 1):
        count = bucket_start[b]
        if count == 0:
            bucket_dots[total] = nobody
            bucket_start[b] = total
            total += 1
        else:
            total += count
            bucket_start[b] = total
    bucket_start[bucket_start.shape[0] - 1] = total
    for i in range(nobody):
        if np.isnan(centre_xy_px[i, 0]):
            continue
        row, row_stop, column, column_stop = _buckets_within(centre_xy_px[i, 0], centre_xy_px[i, 1], reach_px)
        for r in range(row, row_stop):
            for c in range(column, column_stop):
                b = r * _BUCKET_COLUMNS + c
                bucket_start[b] -= 1
                bucket_dots[bucket_start[b]] = i


@njit(cache=True)
def _pull_dots(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    centre_xy_px: NDArray[np.float64],
    bucket_start: NDArray[np.uint32],
    bucket_dots: NDArray[np.uint32],
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    count_radius_px: float,
    pull: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    events: NDArray[np.int32],
) -> None:
    """Give every event to the dots it is near: count it, and add its pull d - r d / |d|, d from centre to event."""
    ring_inner_px2 = ring_inner_px * ring_inner_px
    ring_outer_px2 = ring_outer_px * ring_outer_px
    count_radius_px2 = count_radius_px * count_radius_px
    for k in range(x.shape[0]):
        if x[k] >= FRAME_PX[0] or y[k] >= FRAME_PX[1]:
            continue
        # Unsigned, as are the buckets: numba need not look for negative indices, which saves a third of the time.
        b = np.uint64((y[k] >> _BUCKET_BITS) * _BUCKET_COLUMNS + (x[k] >> _BUCKET_BITS))
        for entry in range(np.uint64(bucket_start[b]), np.uint64(bucket_start[b + np.uint64(1)])):
            i = np.uint64(bucket_dots[entry])
            dx = x[k] - centre_xy_px[i, 0]
            dy = y[k] - centre_xy_px[i, 1]
            distance_px2 = dx * dx + dy * dy
            in_ring = (distance_px2 > ring_inner_px2) & (distance_px2 < ring_outer_px2)
            # An event on the very centre has no direction and is in no ring: any finite stretch will do.
            stretch = (1.0 - radius_px / sqrt(max(distance_px2, 1e-12))) * (in_ring * _PULL_UNITS_PER_PX)
            pull[i, 0] += int(stretch * dx)
            pull[i, 1] += int(stretch * dy)
            ring_events[i] += in_ring
            events[i] += distance_px2 < count_radius_px2


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
        dx = centre_xy_px[i, 0] - centre_xy_px[j, 0]
        dy = centre_xy_px[i, 1] - centre_xy_px[j, 1]
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
    pull: NDArray[np.int64],
    ring_events: NDArray[np.int32],
    shift_px: NDArray[np.float64],
    radius_px: float,
    step_size: float,
    regulariser_weight: float,
    min_events: int,
    gradient_clip: float,
) -> bool:
    """Move the dots with enough events, all from the positions before; tell whether there was one."""
    moved = False
    for i in range(shift_px.shape[0]):
        if ring_events[i] <= min_events:
            continue
        moved = True
        elastic_x, elastic_y = _regulariser_gradient(i, centre_xy_px, neighbours, rest_distance_px2)
        # The data term's gradient is -2 times the sum of pulls.
        data_x = _clip(-2.0 * pull[i, 0] / _PULL_UNITS_PER_PX, gradient_clip)
        data_y = _clip(-2.0 * pull[i, 1] / _PULL_UNITS_PER_PX, gradient_clip)
        shift_px[i, 0] = _clip(-step_size * (data_x + regulariser_weight * elastic_x), radius_px)
        shift_px[i, 1] = _clip(-step_size * (data_y + regulariser_weight * elastic_y), radius_px)
    if not moved:
        return False
    for i in range(shift_px.shape[0]):
        if ring_events[i] <= min_events:
            continue
        centre_xy_px[i, 0] = min(max(centre_xy_px[i, 0] + shift_px[i, 0], 0.0), FRAME_PX[0] - 1.0)
        centre_xy_px[i, 1] = min(max(centre_xy_px[i, 1] + shift_px[i, 1], 0.0), FRAME_PX[1] - 1.0)
        ring_events[i] = 0
        pull[i, 0] = 0
        pull[i, 1] = 0
    return True


@njit(cache=True)
def _clip(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


@njit(cache=True)
def _find_lost(
    centre_xy_px: NDArray[np.float64],
    rest_xy_px: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    lost: NDArray[np.bool_],
) -> None:
    """Flag the dots whose displacement is more than LOST_PX from the mean displacement of their neighbours."""
    for i in range(lost.shape[0]):
        away_x = 0.0
        away_y = 0.0
        count = 0
        for entry in range(MAX_NEIGHBOURS):
            j = neighbours[i, entry]
            if j < 0:
                break
            away_x += centre_xy_px[j, 0] - rest_xy_px[j, 0]
            away_y += centre_xy_px[j, 1] - rest_xy_px[j, 1]
            count += 1
        if count == 0:
            continue
        away_x = centre_xy_px[i, 0] - rest_xy_px[i, 0] - away_x / count
        away_y = centre_xy_px[i, 1] - rest_xy_px[i, 1] - away_y / count
        lost[i] = away_x * away_x + away_y * away_y > LOST_PX * LOST_PX
