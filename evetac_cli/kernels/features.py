"""What a slip detector sees: per dot, how far it is from rest and how many events it has, now and a few slices back.

The list is the paper's ("Evetac Touch Features"). The live form (`start`, `step`, `window`) and the one for whole
recordings (`displacement`, `windows`) give the same bits. Dots are flattened row by row from (rows, columns).

Why so:
- Places are rounded to float32 before the distance is taken, because tracks are stored that way: a live track and the
  same track read from a file then have the same features.
- The paper rotates windows of the 7 x 8 grid by quarter turns, "crop and pad" without saying how. `rotate` turns the
  middle square of the grid counter-clockwise (as seen in the image) and leaves zeros beside it. The odd column over,
  for 7 x 8 the leftmost, is the one cut. So three quarter turns undo one, and four give back the square in its place.
"""

from dataclasses import dataclass
from math import isnan, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX


@dataclass(slots=True)
class FeatureState:
    """The last `history` slices of n dots; `step` changes it in place.

    Every slice is written twice, `history` places apart, each before the slice that came earlier. So the last slices
    always lie in one piece, newest first, from `newest` on.
    """

    rest_xy_px: NDArray[np.float64]  # (n, 2)
    history: int
    ring: NDArray[np.float32]  # (n, 2, 2 * history): displacement in px, then events, of every dot
    newest: int = 0
    slices: int = 0  # taken so far

    @property
    def full(self) -> bool:
        """Whether there are `history` slices, so that there is a window."""
        return self.slices >= self.history


def start(rest_xy_px: NDArray[np.floating], history: int) -> FeatureState:
    """Begin collecting features of dots whose places at rest are rest_xy_px, (n, 2), NaN for a missing dot.

    ValueError if the places are infinite or of another shape, or if history is less than 1.
    """
    rest = _checked_rest(rest_xy_px)
    _check_history(history)
    state = FeatureState(rest, history, np.zeros((len(rest), 2, 2 * history), np.float32))
    # Compiles or loads the kernel now and not in the first slice; writes zeros over zeros.
    _push(rest, np.zeros(len(rest), np.int32), rest, state.ring, state.newest)
    return state


def step(state: FeatureState, dot_xy_px: NDArray[np.floating], events_per_dot: NDArray[np.integer]) -> None:
    """Take in one slice: the dots' places, (n, 2) in px, and their events, (n,). ValueError for other shapes."""
    if dot_xy_px.shape != state.rest_xy_px.shape or events_per_dot.shape != dot_xy_px.shape[:1]:
        raise ValueError(
            f"expected places {state.rest_xy_px.shape} and events {state.rest_xy_px.shape[:1]}, "
            f"found {dot_xy_px.shape} and {events_per_dot.shape}"
        )
    state.newest = (state.newest - 1) % state.history
    state.slices += 1
    _push(dot_xy_px, events_per_dot, state.rest_xy_px, state.ring, state.newest)


def window(state: FeatureState) -> NDArray[np.float32]:
    """Input of a network after the last slice t: (n, 2 * history), [d(t), d(t-1), ..., N(t), N(t-1), ...] per dot.

    d is the displacement in px, N the number of events. ValueError as long as the state is not `full`.
    Source: paper, table of model configurations, "hist 10".
    """
    if not state.full:
        raise ValueError(f"window: expected at least {state.history} slices, found {state.slices}")
    last = state.ring[:, :, state.newest : state.newest + state.history]
    return last.copy().reshape(len(state.rest_xy_px), 2 * state.history)


def displacement(dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.floating]) -> NDArray[np.float32]:
    """Distance of every dot from its place at rest in px, 0 for a missing dot (NaN).

    dot_xy_px: (n, 2) or (slices, n, 2), rest_xy_px: (n, 2); returns (n,) or (slices, n). ValueError for other shapes
    and infinite places. Source: paper, "Evetac Touch Features", D_C.
    """
    rest = _checked_rest(rest_xy_px)
    dots = np.asarray(dot_xy_px)
    if dots.ndim not in (2, 3) or dots.shape[-2:] != rest.shape:
        raise ValueError(f"dot_xy_px: expected (n, 2) or (slices, n, 2) with n = {len(rest)}, found {dots.shape}")
    if np.isinf(dots).any():
        raise ValueError("dot_xy_px: expected finite places, NaN for missing dots, found infinite ones")
    result = np.empty(dots.shape[:-1], np.float32)
    _distances(dots.reshape(-1, len(rest), 2), rest, result.reshape(-1, len(rest)))
    return result


def windows(
    displacement_px: NDArray[np.float32], events_per_dot: NDArray[np.integer], history: int, at: NDArray[np.integer]
) -> NDArray[np.float32]:
    """All inputs of a network at the slices `at` of a recording: (len(at), n, 2 * history), each as from `window`.

    displacement_px and events_per_dot: (slices, n). ValueError if they differ in shape, history is less than 1, or a
    slice is not there or has fewer than history - 1 slices before it.
    """
    _check_history(history)
    slices = np.asarray(at)
    if displacement_px.ndim != 2 or displacement_px.shape != events_per_dot.shape:
        raise ValueError(f"expected (slices, n) twice, found {displacement_px.shape} and {events_per_dot.shape}")
    if slices.ndim != 1 or slices.dtype.kind not in "iu":
        raise ValueError(f"at: expected whole numbers in one dimension, found {slices.dtype} {slices.shape}")
    total, n = displacement_px.shape
    if len(slices) and (slices.min() < history - 1 or slices.max() >= total):
        raise ValueError(
            f"at: expected slices from {history - 1} to {total - 1}, found {slices.min()} to {slices.max()}"
        )
    back = slices.astype(np.int64)[:, None] - np.arange(history)
    result = np.empty((len(slices), n, 2 * history), np.float32)
    result[:, :, :history] = displacement_px[back].transpose(0, 2, 1)
    result[:, :, history:] = events_per_dot[back].transpose(0, 2, 1)
    return result


def rotate(windows: NDArray[np.float32], quarter_turns: int) -> NDArray[np.float32]:
    """Turn windows (k, rows, columns, c) as if the object had been grasped in another direction; returns a new array.

    Half turns are exact; quarter turns keep only the middle square, see the head of this module. ValueError for other
    shapes and for more rows than columns. Source: paper, "Model Training & Data Selection".
    """
    if windows.ndim != 4 or windows.shape[1] > windows.shape[2]:
        raise ValueError(f"windows: expected (k, rows, columns, c) with rows <= columns, found shape {windows.shape}")
    if quarter_turns % 2 == 0:
        return np.rot90(windows, quarter_turns, axes=(1, 2)).copy()
    rows, columns = windows.shape[1:3]
    first = (columns - rows + 1) // 2
    square = slice(first, first + rows)
    result = np.zeros_like(windows)
    result[:, :, square] = np.rot90(windows[:, :, square], quarter_turns, axes=(1, 2))
    return result


def events_outside(
    x: NDArray[np.uint16], y: NDArray[np.uint16], window_px: tuple[int, int, int, int] | NDArray[np.int32] | None
) -> int:
    """Count the events outside the window (x0, y0, x1, y1), ends excluded; None (closed gel) counts all events."""
    if x.ndim != 1 or x.shape != y.shape:
        raise ValueError(f"expected two columns of equal length, found {x.shape} and {y.shape}")
    if window_px is None:
        return len(x)
    if len(window_px) != 4:
        raise ValueError(f"window_px: expected x0, y0, x1, y1, found {window_px}")
    x0, y0, x1, y1 = window_px
    inside = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
    return len(x) - int(np.count_nonzero(inside))


def event_image(
    x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], frame_px: tuple[int, int] = FRAME_PX
) -> NDArray[np.int8]:
    """Draw events, given in the order of time: (height, width), +1 brighter, -1 darker, 0 none; the last event wins.

    frame_px is (width, height); events outside it are left out. ValueError if the columns differ in length.
    Source: paper, "Evetac Touch Features", the set of events in image form.
    """
    if x.ndim != 1 or not x.shape == y.shape == p.shape:
        raise ValueError(f"expected three columns of equal length, found {x.shape}, {y.shape} and {p.shape}")
    image = np.zeros((frame_px[1], frame_px[0]), np.int8)
    _draw(x, y, p, image)
    return image


def _check_history(history: int) -> None:
    if history < 1:
        raise ValueError(f"history: expected at least 1 slice, found {history}")


def _checked_rest(rest_xy_px: NDArray[np.floating]) -> NDArray[np.float64]:
    rest = np.array(rest_xy_px, dtype=np.float64, order="C")
    if rest.ndim != 2 or rest.shape[1] != 2:
        raise ValueError(f"rest_xy_px: expected shape (n, 2), found {rest.shape}")
    if np.isinf(rest).any():
        raise ValueError("rest_xy_px: expected finite places, NaN for missing dots, found infinite ones")
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
def _distances(
    dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.float64], displacement_px: NDArray[np.float32]
) -> None:
    for k in range(dot_xy_px.shape[0]):
        for i in range(rest_xy_px.shape[0]):
            displacement_px[k, i] = _distance(
                dot_xy_px[k, i, 0], dot_xy_px[k, i, 1], rest_xy_px[i, 0], rest_xy_px[i, 1]
            )


@njit(cache=True)
def _push(
    dot_xy_px: NDArray[np.floating],
    events_per_dot: NDArray[np.int32],
    rest_xy_px: NDArray[np.float64],
    ring: NDArray[np.float32],
    newest: int,
) -> None:
    history = ring.shape[2] // 2
    for i in range(rest_xy_px.shape[0]):
        distance = _distance(dot_xy_px[i, 0], dot_xy_px[i, 1], rest_xy_px[i, 0], rest_xy_px[i, 1])
        count = np.float32(events_per_dot[i])
        ring[i, 0, newest] = distance
        ring[i, 0, newest + history] = distance
        ring[i, 1, newest] = count
        ring[i, 1, newest + history] = count


@njit(cache=True)
def _draw(x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], image: NDArray[np.int8]) -> None:
    height, width = image.shape
    for k in range(x.shape[0]):
        if x[k] < width and y[k] < height:
            image[y[k], x[k]] = 1 if p[k] else -1
