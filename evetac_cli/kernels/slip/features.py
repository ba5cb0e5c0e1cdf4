"""Features of a slice for slip detectors: displacement and events of each dot, and the events as an image.

The list is the paper's ("Evetac Touch Features"), plus the displacement with its direction. The live functions
(`start`, `step`, `latest_slices`) and those for whole recordings (`displacement`, `displacement_xy`, `series`) return
identical bits. Dots are flattened row by row from (rows, columns). The inputs of a network are made of several slices
in inputs.py.

Reasons:
- Positions are rounded to float32 before the distance is computed, because tracks are stored that way. A live track and
  the same track read from a file then have the same features.
- Event images are stored as their non-zero pixels: a slice of 259,200 pixels has a few hundred of them, and trials of
  whole images would not fit into memory.
- The paper rotates windows of the 7 x 8 grid by quarter turns, "crop and pad" without details. `rotate` turns the
  central square of the grid counter-clockwise (as seen in the image) and pads with zeros. The excess column, for 7 x 8
  the leftmost, is cut (of a grid with more rows than columns, the uppermost row). So three quarter turns undo one, and
  four return the square unchanged.
"""

from math import isnan, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import check_range
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.kernels.calibration.grid import MOST_DOTS
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.slip.architectures import CHANNELS, GEL_PX

DOT_CAPACITY = MOST_DOTS  # number of dots that a state has room for
HISTORY_CAPACITY = 128  # slices

STATE = np.dtype(
    [
        ("dots", np.int64),  # n
        ("history", np.int64),  # number of slices that `latest_slices` returns
        ("slices", np.int64),  # number so far
        ("rest_xy_px", np.float64, (DOT_CAPACITY, 2)),  # the first n rows are used
        # (2 * history, n, channels), flat: every slice is written twice, `history` rows apart, so that the last slices
        # are always contiguous, the newest last.
        ("ring", np.float32, 2 * HISTORY_CAPACITY * DOT_CAPACITY * len(CHANNELS)),
    ],
    align=True,
)


class FeatureState:
    """The last `history` slices of n dots: `record`, an array of one STATE, and views of its fields.

    `step` changes the record in place. `FeatureState(np.frombuffer(memory, STATE, 1))` restores a state from saved
    bytes or shared memory; the reasons are those in tracker.py.
    """

    __slots__ = ("record", "rest_xy_px")

    def __init__(self, record: NDArray[np.void]) -> None:
        assert record.dtype == STATE and record.shape == (1,) and record.flags.writeable
        self.record = record
        self.rest_xy_px: NDArray[np.float64] = record["rest_xy_px"][0, : record["dots"][0]]  # (n, 2)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the record, so that the views of a copy belong to its own record."""
        return FeatureState, (self.record.copy(),)


def start(rest_xy_px: NDArray[np.floating], history: int) -> FeatureState:
    """Start collecting features of dots with positions at rest rest_xy_px, (n, 2), NaN for a missing dot.

    ValueError if history is not from 1 to HISTORY_CAPACITY.
    """
    rest = _checked_rest(rest_xy_px)
    assert len(rest) <= DOT_CAPACITY
    check_range("history", history, 1, HISTORY_CAPACITY, "slices")
    record = np.zeros(1, STATE)
    record["dots"], record["history"] = len(rest), history
    record["rest_xy_px"][0, : len(rest)] = rest
    # Compiles or loads the kernel now instead of in the first slice; on a copy, so that it does not count as a slice.
    take_slice(record.copy(), rest, np.zeros(len(rest), np.int32))
    return FeatureState(record)


def step(state: FeatureState, dot_xy_px: NDArray[np.floating], events_per_dot: NDArray[np.integer]) -> None:
    """Add one slice: the dots' positions, (n, 2) in px, and their events, (n,)."""
    rest = state.rest_xy_px
    assert dot_xy_px.shape == rest.shape and events_per_dot.shape == dot_xy_px.shape[:1]
    take_slice(state.record, dot_xy_px, events_per_dot)


def series(displacement_px: NDArray[np.float32], events_per_dot: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return the channels of a recording, (slices, n, channels), from displacement and events, (slices, n) each."""
    assert displacement_px.ndim == 2 and displacement_px.shape == events_per_dot.shape
    return np.stack([displacement_px, events_per_dot.astype(np.float32)], axis=2)


def displacement(dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the distance of every dot from its position at rest in px, 0 for a missing dot (NaN).

    dot_xy_px: (n, 2) or (slices, n, 2), rest_xy_px: (n, 2); returns (n,) or (slices, n). Source: paper,
    "Evetac Touch Features", D_C.
    """
    offset = _offsets(dot_xy_px, rest_xy_px)
    return np.nan_to_num(np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2).astype(np.float32))


def displacement_xy(dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the displacement of every dot, right and down in px, (n, 2) or (slices, n, 2), 0 for a missing dot.

    Accepts the same arrays as `displacement`, which returns its length.
    """
    return np.nan_to_num(_offsets(dot_xy_px, rest_xy_px).astype(np.float32))


def rotate(windows: NDArray[np.float32], quarter_turns: int) -> NDArray[np.float32]:
    """Return windows (k, rows, columns, c), turned as if the object had been grasped in another direction.

    Half turns are exact; quarter turns keep only the central square, see the module's docstring. Source: paper,
    "Model Training & Data Selection".
    """
    assert windows.ndim == 4
    if quarter_turns % 2 == 0:
        return np.rot90(windows, quarter_turns, axes=(1, 2)).copy()
    rows, columns = windows.shape[1:3]
    side = min(rows, columns)
    top, left = (rows - side + 1) // 2, (columns - side + 1) // 2
    square = np.s_[:, top : top + side, left : left + side]
    result = np.zeros_like(windows)
    result[square] = np.rot90(windows[square], quarter_turns, axes=(1, 2))
    return result


def events_outside(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    starts: NDArray[np.int64],
    window_px: tuple[int, int, int, int] | NDArray[np.int32] | None,
) -> NDArray[np.int32]:
    """Return the number of events of each slice outside the window (x0, y0, x1, y1), ends excluded; None counts all.

    None means a closed gel. Slice k has the events [starts[k], starts[k + 1]).
    """
    assert x.ndim == 1 and x.shape == y.shape
    assert starts[0] >= 0 and starts[-1] <= len(x) and (np.diff(starts) >= 0).all()
    if window_px is None:
        return np.diff(starts).astype(np.int32)
    assert len(window_px) == 4
    x0, y0, x1, y1 = (int(edge) for edge in window_px)
    outside = (x < x0) | (x >= x1) | (y < y0) | (y >= y1)
    before = np.append(0, np.cumsum(outside))
    return np.diff(before[starts]).astype(np.int32)


class EventImages(NamedTuple):
    """The event image of every slice as its non-zero pixels, in any order within a slice."""

    start: NDArray[np.int64]  # (slices + 1,), index of the first pixel of each slice
    pixel: NDArray[np.uint32]  # (pixels,), y * 540 + x
    sign: NDArray[np.int8]  # (pixels,), +1 brighter, -1 darker

    def part(self, first: int, last: int) -> "EventImages":
        """Return the slices [first, last); pixels are views."""
        start = self.start[first : last + 1]
        return EventImages(start - start[0], self.pixel[start[0] : start[-1]], self.sign[start[0] : start[-1]])


class GelEvents(NamedTuple):
    """The events of every slice outside the window, in order of time."""

    start: NDArray[np.int64]  # (slices + 1,), index of the first event of each slice
    t_us: NDArray[np.uint16]  # (events,), from the start of their slice
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]

    def part(self, first: int, last: int) -> "GelEvents":
        """Return the slices [first, last); events are views."""
        start = self.start[first : last + 1]
        columns: list[Any] = [column[start[0] : start[-1]] for column in self[1:]]
        return GelEvents(start - start[0], *columns)


def gel_events(
    events: Events, starts: NDArray[np.int64], window_px: tuple[int, int, int, int] | NDArray[np.int32] | None
) -> GelEvents:
    """Return the events of slices outside the window (as for `events_outside`); times in `events` are the recording's.

    starts: (slices + 1,), index of the first event of each slice. Events outside a frame of 640 x 480 px are left out.
    """
    t, x, y, p = events
    kept = (x < FRAME_PX[0]) & (y < FRAME_PX[1])
    if window_px is not None:
        x0, y0, x1, y1 = (int(edge) for edge in window_px)
        kept &= (x < x0) | (x >= x1) | (y < y0) | (y >= y1)
    before = np.append(0, np.cumsum(kept))
    in_slice = (t % SLICE_US).astype(np.uint16)
    return GelEvents(before[starts], in_slice[kept], x[kept], y[kept], p[kept])


def gel_image(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    window_px: tuple[int, int, int, int] | NDArray[np.int32] | None,
    blank: NDArray[np.int8],
) -> tuple[NDArray[np.uint32], NDArray[np.int8]]:
    """Return the event image of one slice outside the window: its non-zero pixels, and their signs.

    It is `event_image` of 540 x 480 px with the window (as for `events_outside`) cut out. `blank` (480, 540) is
    workspace, 0 before and after. Source: paper, "Model Architectures".
    """
    assert x.ndim == 1 and x.shape == y.shape == p.shape
    assert blank.shape == GEL_PX[::-1]
    x0, y0, x1, y1 = (0, 0, 0, 0) if window_px is None else (int(edge) for edge in window_px)
    pixel, sign = np.empty(len(x), np.uint32), np.empty(len(x), np.int8)
    _draw(x, y, p, blank)
    pixels = _take_pixels(x, y, (x0, y0, x1, y1), blank, pixel, sign)
    return pixel[:pixels], sign[:pixels]


def _offsets(dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.floating]) -> NDArray[np.float64]:
    rest, dots = _checked_rest(rest_xy_px), np.asarray(dot_xy_px, np.float32)
    assert dots.ndim in (2, 3) and dots.shape[-2:] == rest.shape and not np.isinf(dots).any()
    return dots - rest


def _checked_rest(rest_xy_px: NDArray[np.floating]) -> NDArray[np.float64]:
    rest = np.array(rest_xy_px, dtype=np.float64, order="C")
    assert rest.ndim == 2 and rest.shape[1] == 2
    assert not np.isinf(rest).any()
    return rest


@njit(cache=True)
def _distance(x_px: float, y_px: float, rest_x_px: float, rest_y_px: float) -> np.float32:
    dx = np.float32(x_px) - rest_x_px
    dy = np.float32(y_px) - rest_y_px
    distance = sqrt(dx * dx + dy * dy)
    if isnan(distance):
        return np.float32(0.0)
    return np.float32(distance)


@njit(cache=True)
def offset(place_px: float, rest_px: float) -> np.float32:
    """Return the displacement of a dot along one axis, as `displacement_xy` does, for compiled code."""
    moved = np.float32(place_px) - rest_px
    if isnan(moved):
        return np.float32(0.0)
    return np.float32(moved)


@njit(cache=True)
def take_slice(record: NDArray[np.void], dot_xy_px: NDArray[np.floating], events_per_dot: NDArray[np.integer]) -> None:
    """Do the work of `step`, unchecked, for compiled code; record: of a `FeatureState`."""
    state = record[0]
    dots, history = state["dots"], state["history"]
    rest_xy_px, ring = state["rest_xy_px"][:dots], state["ring"][:]
    row = state["slices"] % history
    first, again = row * dots * len(CHANNELS), (row + history) * dots * len(CHANNELS)
    for i in range(dots):
        distance = _distance(dot_xy_px[i, 0], dot_xy_px[i, 1], rest_xy_px[i, 0], rest_xy_px[i, 1])
        for k in (first, again):
            ring[k], ring[k + 1] = distance, np.float32(events_per_dot[i])
        first += len(CHANNELS)
        again += len(CHANNELS)
    state["slices"] += 1


@njit(cache=True)
def latest_slices(record: NDArray[np.void]) -> NDArray[np.float32]:
    """Return the last slices, (history, n, channels) as from `series`, newest last, once there are as many.

    It is a view, until the next step; record: of a `FeatureState`.
    """
    state = record[0]
    dots, history = state["dots"], state["history"]
    first, row = state["slices"] % history, dots * len(CHANNELS)
    latest: NDArray[np.float32] = state["ring"][first * row : (first + history) * row]
    return latest.reshape(history, dots, len(CHANNELS))


@njit(cache=True)
def _draw(x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], image: NDArray[np.int8]) -> None:
    height, width = image.shape
    for k in range(x.shape[0]):
        if x[k] < width and y[k] < height:
            image[y[k], x[k]] = 1 if p[k] else -1


@njit(cache=True)
def _take_pixels(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    window_px: tuple[int, int, int, int],
    image: NDArray[np.int8],
    pixel: NDArray[np.uint32],
    sign: NDArray[np.int8],
) -> int:
    """Move the drawn pixels outside the window from the image to lists; return their length."""
    height, width = image.shape
    x0, y0, x1, y1 = window_px
    pixels = 0
    for k in range(x.shape[0]):
        if x[k] >= width or y[k] >= height or image[y[k], x[k]] == 0:
            continue
        if not (x0 <= x[k] < x1 and y0 <= y[k] < y1):
            pixel[pixels] = np.uint32(y[k]) * np.uint32(width) + np.uint32(x[k])
            sign[pixels] = image[y[k], x[k]]
            pixels += 1
        image[y[k], x[k]] = 0
    return pixels
