"""Track the dots, one slice of events at a time, by the paper's gradient descent or by fitting the rims of the dots.

Every event near the rim of a dot shows where the rim is. The paper's tracker and its variants (presets `paper`,
`official`, `unregularised`) add up one gradient step per event, and an elastic term keeps dots at their initial
distance from their neighbours (descent.py). The preset `stable` solves for the motion that caused the events of a
slice (fit.py). `start` and `step` are the only entry points, for files and for live cameras.

Reasons:
- The whole state of the tracker is one numpy record of the dtype STATE. It is passed to numba as one argument, and is
  copied, saved, compared and placed in shared memory as a whole. Its size depends neither on the dots nor on the
  preset, because numba compiles again for every dtype. Everything else is allocated per slice.
- The record is passed as an array of one: for a numpy scalar, numba requests its buffer, which takes 3.2 us longer.
- The published code moves centres up the gradient of its data term. Its edge is 1.25 times as large as the dots it was
  calibrated with, and its ring is inside them: sign, edge and ring only work together. So `official` is one setting,
  for dots whose true radius is about 8 px. It loses dots of 15 px, as that code does.
"""

import math
from collections.abc import Sequence
from dataclasses import fields
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.tracking import buckets, descent, fit, lost_dots
from evetac_cli.kernels.tracking.presets import MAX_REACH_PX, TrackerConstants

CAPACITY = grid.MOST_DOTS  # number of dots that a state has room for
# Largest curvature of the distance term over regulariser_weight * pitch**2, over all patterns of dots with edges.
STIFFNESS = 98.8
_PIXEL, _POLARITY = np.dtype(np.uint16), np.dtype(np.uint8)
_NO_POLARITY = np.empty(0, np.uint8)


# n is the number of dots. Arrays have room for CAPACITY dots, of which the first n rows are used. The fields are
# ordered by the size of their numbers, so that there are no gaps whose bytes would differ between equal states.
STATE = np.dtype(
    [
        ("dots", np.int64),  # n
        ("slices", np.int64),  # number so far
        ("frame_px", np.int64, 2),  # width, height
        ("slices_at_rest", np.int64),  # consecutive, until now; see lost_dots.py
        *((item.name, np.int64) for item in fields(TrackerConstants) if item.type is int),
        *((item.name, np.float64) for item in fields(TrackerConstants) if item.type is float),
        ("gathered", np.int64, (CAPACITY + 1, descent.SUMS)),  # sums of the slices since the last step, see descent.py
        ("light_slices", np.float64),  # recent slices with changing light, see fit.py
        ("busy_share", np.float64),  # of dots with ring events in a slice, recent mean
        ("noise_rate", np.float64),  # ring events of a dot and slice that are noise, 0 while unknown
        ("ring_rate", np.float64, CAPACITY),  # recent ring events of a dot and slice
        ("polarity_weight", np.float64, 2),  # sum of the weights of ring events so far, darker and brighter
        ("centre_xy_px", np.float64, (CAPACITY + 1, 2)),  # see dot_xy_px; row n is the dummy dot (buckets.py)
        ("rest_xy_px", np.float64, (CAPACITY, 2)),  # centres at the start
        ("rest_distance_px2", np.float64, (CAPACITY, grid.MAX_NEIGHBOURS)),  # squared, to each neighbour at the start
        ("listed_xy_px", np.float64, (CAPACITY, 2)),  # centres when the buckets were filled, see buckets.py
        # With `fit`, for lost_dots.py: recent motion shown by one rim alone, recent paths of dots and neighbours.
        ("one_rim_px", np.float64, (CAPACITY, 2)),
        ("own_way_px", np.float64, (CAPACITY, 2)),
        ("near_way_px", np.float64, (CAPACITY, 2)),
        ("way_events", np.float64, CAPACITY),
        ("neighbours", np.int32, (CAPACITY, grid.MAX_NEIGHBOURS)),  # indices first, then -1
        ("neighbour_count", np.int32, CAPACITY),  # number of those indices
        ("events", np.int32, CAPACITY + 1),  # see events_per_dot; row n is the dummy dot
        ("first_dot", np.uint32, buckets.BUCKETS + 1),  # the dot near a bucket, if only one is
        ("bucket_start", np.uint32, buckets.BUCKETS + 1),  # index in bucket_dots at which each bucket's dots begin
        ("bucket_dots", np.uint32, buckets.most_entries(CAPACITY, MAX_REACH_PX)),
        ("pixel_events", np.uint16, (grid.MOST_FRAME_PX + 2) ** 2),  # recent events of every pixel, see buckets.py
        ("lost", np.uint8, CAPACITY),  # 1: not to be trusted, see lost_dots.py
        ("left_behind", np.uint8, CAPACITY),  # 1: lost for a reason other than its distance
        ("too_far", np.uint8, CAPACITY),  # 1: in this slice both rims show more motion than may be followed
        *((item.name, np.uint8) for item in fields(TrackerConstants) if item.type is bool),
        ("_end", np.uint8, 2),  # padding to a multiple of 8 bytes
    ],
    align=True,
)


class TrackerState:
    """State of the tracker after the slices so far: `record`, of dtype STATE, and views of its main fields.

    `step` changes the record in place. `TrackerState(np.frombuffer(memory, STATE, 1))` restores a state from saved
    bytes or shared memory.
    """

    __slots__ = ("dot_xy_px", "events_per_dot", "lost", "neighbours", "record", "rest_xy_px")

    def __init__(self, record: NDArray[np.void]) -> None:
        assert record.dtype == STATE and record.shape == (1,) and record.flags.writeable
        self.record = record
        n = int(record["dots"][0])
        self.dot_xy_px: NDArray[np.float64] = record["centre_xy_px"][0, :n]  # (n, 2) now; NaN for a missing dot
        # (n,) events of the last slice nearer than count_radius_px to where the dot was before it:
        self.events_per_dot: NDArray[np.int32] = record["events"][0, :n]
        self.lost: NDArray[np.bool_] = record["lost"][0, :n].view(np.bool_)  # (n,) see lost_dots.py
        self.rest_xy_px: NDArray[np.float64] = record["rest_xy_px"][0, :n]  # (n, 2) at the start
        self.neighbours: NDArray[np.int32] = record["neighbours"][0, :n]  # (n, 8) indices first, then -1

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the record, so that the views of a copy belong to its own record."""
        return TrackerState, (self.record.copy(),)

    @property
    def constants(self) -> TrackerConstants:
        """The constants that the tracker was started with."""
        return TrackerConstants(
            **{item.name: item.type(self.record[item.name][0]) for item in fields(TrackerConstants)}  # type: ignore[operator]
        )


def start(
    dot_xy_px: NDArray[np.float64],
    constants: TrackerConstants,
    *,
    frame_px: Sequence[int] = FRAME_PX,
) -> TrackerState:
    """Start tracking dots from their centres at rest.

    dot_xy_px: (n, 2) in any order, n up to CAPACITY, inside the frame and all different. A row of NaN is a missing dot:
    no motion, no events, no neighbour of another dot. frame_px: width and height. ValueError if the frame is too large,
    or if the constants overshoot or stall on these dots (`require_followable`).
    """
    rest = _checked_dots(dot_xy_px, frame_px)
    n = len(rest)
    pairs = grid.neighbours(rest)
    rest_distance_px2 = np.where(pairs >= 0, np.sum((rest[:, None] - rest[pairs]) ** 2, axis=2), 0.0)
    require_followable(constants, rest_distance_px2)
    array = np.zeros(1, STATE)
    record = array[0]
    for item in fields(TrackerConstants):
        record[item.name] = getattr(constants, item.name)
    record["dots"] = n
    record["frame_px"] = frame_px
    record["centre_xy_px"][:n] = rest
    record["centre_xy_px"][n] = buckets.DUMMY_DOT_XY_PX
    record["rest_xy_px"][:n] = rest
    record["neighbours"][:n] = pairs
    record["neighbour_count"][:n] = (pairs >= 0).sum(axis=1)
    record["rest_distance_px2"][:n] = rest_distance_px2
    record["listed_xy_px"][:n] = -inf  # far from everything: the first step fills the buckets
    state = TrackerState(array)
    no_events = np.empty(0, np.uint16)
    step(state, no_events, no_events, _NO_POLARITY)  # compiles or loads the kernel now instead of in the first slice
    return state


def require_followable(constants: TrackerConstants, rest_distance_px2: NDArray[np.float64]) -> None:
    """Raise ValueError for constants with which no dot could be followed; the message says which to reduce.

    rest_distance_px2: (n, 8) squared distances to neighbours, 0 for none. Without `fit`, a step overshoots by more than
    it corrects if step_size * (4 N / 3 + STIFFNESS * regulariser_weight * pitch**2) is 2 or more. N is the smallest
    number of ring events that move a dot: constants that are unstable with these are unstable with all. With `fit`, the
    sweeps end before even a dot with most_events moves if its neighbours weigh as much as that in every sweep.
    """
    weight, step_size = constants.regulariser_weight, constants.step_size
    if constants.fit:
        most = constants.sweeps * constants.most_events / grid.MAX_NEIGHBOURS
        if weight > most:
            raise ValueError(f"regulariser_weight: expected at most {most:g}, found {weight:g}: no dot would move")
        return
    nearest_px2 = np.min(rest_distance_px2, axis=1, where=rest_distance_px2 > 0.0, initial=inf)
    pitch_px2 = float(np.median(nearest_px2[np.isfinite(nearest_px2)])) if np.isfinite(nearest_px2).any() else 0.0
    ring_events = constants.min_events + 1
    by_events, by_neighbours = 4.0 * ring_events / 3.0, STIFFNESS * weight * pitch_px2
    if step_size * by_events >= 2.0:
        raise ValueError(f"step_size: expected below {2.0 / by_events:.3g}, found {step_size:g}: steps would grow")
    if step_size * (by_events + by_neighbours) >= 2.0:
        most = (2.0 / step_size - by_events) / (STIFFNESS * pitch_px2)
        raise ValueError(f"regulariser_weight: expected below {most:.3g}, found {weight:g}: steps would grow")


def step(state: TrackerState, x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8] | None = None) -> None:
    """Move the dots by the events of one slice, in any order, as columns x and y in px, p 0 or 1; updates `state`.

    A dot moves if it has more than min_events ring events. Without `fit` it moves by -step_size * (gradient of the data
    term + regulariser_weight * gradient of the distance term), all at the positions before the slice. The data gradient
    is clipped to gradient_clip, the motion to radius_px, per axis. With `fit` see fit.py; only this mode needs the
    polarities p. A dot stays inside the frame, and events outside it are ignored. Read-only or strided columns are
    accepted, but the first of them costs a compilation. ValueError if x, y (uint16) and p (uint8) are not columns of
    equal length. Source: paper, "Signal Processing - Dot Tracking", the last three equations.
    """
    take_slice(state.record, x, y, checked_polarities(state, x, y, p))


def checked_polarities(
    state: TrackerState, x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8] | None
) -> NDArray[np.uint8]:
    """Return the polarities for `take_slice`; ValueError for columns that `step` does not accept."""
    if x.dtype != _PIXEL or y.dtype != _PIXEL or x.ndim != 1 or x.shape != y.shape:
        raise ValueError(
            f"expected two uint16 columns of equal length, found {x.dtype} {x.shape} and {y.dtype} {y.shape}"
        )
    if p is None:
        if state.record["fit"][0]:
            raise ValueError(f"p: expected uint8 polarities, as many as the events {x.shape}, found none")
        return _NO_POLARITY
    if p.dtype != _POLARITY or p.shape != x.shape:
        raise ValueError(f"p: expected uint8 polarities, as many as the events {x.shape}, found {p.dtype} {p.shape}")
    return p


class Tracks(NamedTuple):
    """Output of a tracker after each of a number of slices, (slices, n, ...)."""

    dot_xy_px: NDArray[np.float32]
    events_per_dot: NDArray[np.int32]
    lost: NDArray[np.uint8]


def fold(
    state: TrackerState,
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8] | None,
    starts: NDArray[np.int64],
) -> Tracks:
    """Apply `step` to one slice after the other, for recordings: slice k has the events [starts[k], starts[k + 1]).

    Accepts the same columns as `step`.
    """
    p = checked_polarities(state, x, y, p)
    assert starts.ndim == 1 and starts[0] >= 0 and starts[-1] <= len(x) and (np.diff(starts) >= 0).all()
    slices, dots = len(starts) - 1, len(state.rest_xy_px)
    tracks = Tracks(
        np.empty((slices, dots, 2), np.float32), np.empty((slices, dots), np.int32), np.empty((slices, dots), np.uint8)
    )
    _fold(state.record, x, y, p, starts, *tracks)
    return tracks


@njit(cache=True)
def _fold(
    record: NDArray[np.void],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    starts: NDArray[np.int64],
    dot_xy_px: NDArray[np.float32],
    events_per_dot: NDArray[np.int32],
    lost: NDArray[np.uint8],
) -> None:
    state = record[0]
    for k in range(dot_xy_px.shape[0]):
        first, last = starts[k], starts[k + 1]
        take_slice(record, x[first:last], y[first:last], p[first:last])
        for i in range(dot_xy_px.shape[1]):
            dot_xy_px[k, i, 0] = state["centre_xy_px"][i, 0]
            dot_xy_px[k, i, 1] = state["centre_xy_px"][i, 1]
            events_per_dot[k, i] = state["events"][i]
            lost[k, i] = state["lost"][i]


@njit(cache=True)
def take_slice(record: NDArray[np.void], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8]) -> None:
    """Do the work of `step`, unchecked, for compiled code; record: of a `TrackerState`.

    Count hot pixels, refill the buckets, sum over the events, move the dots, look for lost dots.
    """
    state = record[0]
    dots = state["dots"]
    centre_xy_px, listed_xy_px = state["centre_xy_px"][: dots + 1], state["listed_xy_px"][:dots]
    events, ring_events = state["events"][: dots + 1], np.empty(dots + 1, np.int32)
    any_hot = False
    if state["hot_pixel_events"] > 0:
        any_hot = buckets.count_pixels(x, y, buckets.pixel_counts(state), state["slices"], state["hot_pixel_events"])
    if buckets.left_margin(centre_xy_px, listed_xy_px):
        buckets.fill(state)
    shift_px = np.empty((dots, 2))
    if state["fit"]:
        sums = np.zeros((dots + 1, fit.SUMS), np.int64)
        fit.measure_rims(state, x, y, p, any_hot, sums)
        counts = sums[:, fit.DARKER + fit.COUNTS] + sums[:, fit.BRIGHTER + fit.COUNTS]
        buckets.split_counts(counts, events, ring_events)
        moved = fit.solve(state, sums, ring_events, shift_px)
    else:
        sums = np.zeros((dots + 1, descent.SUMS), np.int64)
        descent.pull_dots(state, x, y, any_hot, sums)
        buckets.split_counts(sums[:, descent.COUNTS].copy(), events, ring_events)  # contiguous, as above
        due = True
        if state["slices_per_step"] > 1:
            due = descent.gather(state, sums)
            buckets.split_counts(sums[:, descent.COUNTS].copy(), np.empty(dots + 1, np.int32), ring_events)
        moved = due and descent.gradient_step(state, sums, ring_events, shift_px)
    if moved:
        most_x, most_y = state["frame_px"][0] - 1.0, state["frame_px"][1] - 1.0
        for i in range(dots):
            if ring_events[i] > state["min_events"]:
                centre_xy_px[i, 0] = min(max(centre_xy_px[i, 0] + shift_px[i, 0], 0.0), most_x)
                centre_xy_px[i, 1] = min(max(centre_xy_px[i, 1] + shift_px[i, 1], 0.0), most_y)
    lost_dots.update(state, moved, ring_events, shift_px)
    state["slices"] += 1


@njit(cache=True)
def mean_displacement_px(record: NDArray[np.void]) -> tuple[float, float]:
    """Return the mean displacement, right and down, of all dots that are present; record: of a `TrackerState`."""
    state = record[0]
    centre_xy_px, rest_xy_px = state["centre_xy_px"][:], state["rest_xy_px"][: state["dots"]]
    x_px = y_px = 0.0
    present = 0
    for i in range(rest_xy_px.shape[0]):
        if not np.isnan(rest_xy_px[i, 0]):
            x_px += centre_xy_px[i, 0] - rest_xy_px[i, 0]
            y_px += centre_xy_px[i, 1] - rest_xy_px[i, 1]
            present += 1
    return x_px / present, y_px / present


@njit(cache=True)
def turn_px(record: NDArray[np.void]) -> float:
    """Return the rms displacement of all present dots by rotation about their centre; > 0 from right to down.

    record: of a `TrackerState`.
    """
    state = record[0]
    centre_xy_px, rest_xy_px = state["centre_xy_px"][:], state["rest_xy_px"][: state["dots"]]
    x_px = y_px = 0.0
    present = 0
    for i in range(rest_xy_px.shape[0]):
        if not np.isnan(rest_xy_px[i, 0]):
            x_px += rest_xy_px[i, 0]
            y_px += rest_xy_px[i, 1]
            present += 1
    x_px, y_px = x_px / present, y_px / present
    moment = square = 0.0
    for i in range(rest_xy_px.shape[0]):
        if not np.isnan(rest_xy_px[i, 0]):
            across, down = rest_xy_px[i, 0] - x_px, rest_xy_px[i, 1] - y_px
            moment += across * (centre_xy_px[i, 1] - rest_xy_px[i, 1])
            moment -= down * (centre_xy_px[i, 0] - rest_xy_px[i, 0])
            square += across * across + down * down
    return moment / math.sqrt(present * square) if square > 0.0 else 0.0


def _checked_dots(dot_xy_px: NDArray[np.float64], frame_px: Sequence[int]) -> NDArray[np.float64]:
    dots = np.array(dot_xy_px, dtype=np.float64, order="C")
    assert dots.ndim == 2 and dots.shape[1] == 2 and len(dots) <= CAPACITY
    missing = np.isnan(dots)
    present = dots[~missing[:, 0]]
    assert (missing[:, 0] == missing[:, 1]).all() and len(present)
    width, height = frame_px
    if max(width, height) > grid.MOST_FRAME_PX:
        raise ValueError(f"frame_px: expected at most {grid.MOST_FRAME_PX} px, found {width} x {height}")
    assert ((present >= 0) & (present <= np.array(frame_px) - 1)).all()
    assert len(np.unique(present, axis=0)) == len(present)
    return dots
