"""What a slip detector may see of a slice: where each dot is, how many events it has, and the events as an image.

The list is the paper's ("Evetac Touch Features"), and the displacement with its direction besides. The live form
(`start`, `step`, `latest`) and the one for whole recordings (`displacement`, `displacement_xy`, `series`) give the same
bits. Dots are flattened row by row from (rows, columns). What a network makes of some slices of them: inputs.py.

Why so:
- Places are rounded to float32 before the distance is taken, because tracks are stored that way: a live track and the
  same track read from a file then have the same features.
- Event images are kept as their pixels that are not 0: a slice of 259,200 pixels has a few hundred of them, and trials
  of images would not fit into memory.
- The paper rotates windows of the 7 x 8 grid by quarter turns, "crop and pad" without saying how. `rotate` turns the
  middle square of the grid counter-clockwise (as seen in the image) and leaves zeros beside it. The odd column over,
  for 7 x 8 the leftmost, is the one cut. So three quarter turns undo one, and four give back the square in its place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.slip.architectures import CHANNELS, GEL_PX


@dataclass(slots=True)
class FeatureState:
    """The last `history` slices of n dots; `step` changes it in place.

    Every slice is written twice, `history` rows apart, so the last slices always lie in one piece, the newest last.
    """

    rest_xy_px: NDArray[np.float64]  # (n, 2)
    history: int
    ring: NDArray[np.float32]  # (2 * history, n, channels)
    slices: int = 0  # taken so far

    @property
    def full(self) -> bool:
        """Whether there are `history` slices."""
        return self.slices >= self.history


def start(rest_xy_px: NDArray[np.floating], history: int) -> FeatureState:
    """Begin collecting features of dots whose places at rest are rest_xy_px, (n, 2), NaN for a missing dot.

    ValueError if the places are infinite or of another shape, or if history is less than 1.
    """
    rest = _checked_rest(rest_xy_px)
    if history < 1:
        raise ValueError(f"history: expected at least 1 slice, found {history}")
    state = FeatureState(rest, history, np.zeros((2 * history, len(rest), len(CHANNELS)), np.float32))
    # Compiles or loads the kernel now and not in the first slice; writes zeros over zeros.
    _push(rest, np.zeros(len(rest), np.int32), rest, state.ring, 0)
    return state


def step(state: FeatureState, dot_xy_px: NDArray[np.floating], events_per_dot: NDArray[np.integer]) -> None:
    """Take in one slice: the dots' places, (n, 2) in px, and their events, (n,). ValueError for other shapes."""
    if dot_xy_px.shape != state.rest_xy_px.shape or events_per_dot.shape != dot_xy_px.shape[:1]:
        raise ValueError(
            f"expected places {state.rest_xy_px.shape} and events {state.rest_xy_px.shape[:1]}, "
            f"found {dot_xy_px.shape} and {events_per_dot.shape}"
        )
    _push(dot_xy_px, events_per_dot, state.rest_xy_px, state.ring, state.slices % state.history)
    state.slices += 1


def latest(state: FeatureState) -> NDArray[np.float32]:
    """The last slices, (history, n, channels) as from `series`, the newest last: a view, valid until the next step.

    ValueError as long as the state is not `full`.
    """
    if not state.full:
        raise ValueError(f"latest: expected at least {state.history} slices, found {state.slices}")
    first = state.slices % state.history
    return state.ring[first : first + state.history]


def series(
    displacement_px: NDArray[np.float32],
    events_per_dot: NDArray[np.integer],
    displacement_xy_px: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """All channels of a recording, (slices, n, channels), from (slices, n) twice and (slices, n, 2).

    Without displacement_xy_px its two channels are 0. ValueError where the shapes differ.
    """
    if displacement_px.ndim != 2 or displacement_px.shape != events_per_dot.shape:
        raise ValueError(f"expected (slices, n) twice, found {displacement_px.shape} and {events_per_dot.shape}")
    result = np.zeros((*displacement_px.shape, len(CHANNELS)), np.float32)
    result[..., 0] = displacement_px
    result[..., 1] = events_per_dot
    if displacement_xy_px is not None:
        if displacement_xy_px.shape != (*displacement_px.shape, 2):
            raise ValueError(f"expected {(*displacement_px.shape, 2)}, found {displacement_xy_px.shape}")
        result[..., 2:] = displacement_xy_px
    return result


def displacement(dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.floating]) -> NDArray[np.float32]:
    """Distance of every dot from its place at rest in px, 0 for a missing dot (NaN).

    dot_xy_px: (n, 2) or (slices, n, 2), rest_xy_px: (n, 2); returns (n,) or (slices, n). ValueError for other shapes
    and infinite places. Source: paper, "Evetac Touch Features", D_C.
    """
    dots, rest = _checked_dots(dot_xy_px, rest_xy_px)
    result = np.empty(dots.shape[:-1], np.float32)
    _distances(dots.reshape(-1, len(rest), 2), rest, result.reshape(-1, len(rest)))
    return result


def displacement_xy(dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.floating]) -> NDArray[np.float32]:
    """Displacement of every dot to the right and down in px, (n, 2) or (slices, n, 2), 0 for a missing dot.

    Takes and refuses what `displacement` does, which is its length.
    """
    dots, rest = _checked_dots(dot_xy_px, rest_xy_px)
    result = np.empty(dots.shape, np.float32)
    _offsets(dots.reshape(-1, len(rest), 2), rest, result.reshape(-1, len(rest), 2))
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


class EventImages(NamedTuple):
    """The event image of every slice as its pixels that are not 0, in any order within a slice."""

    start: NDArray[np.int64]  # (slices + 1,), where each slice begins
    pixel: NDArray[np.uint32]  # (pixels,), y * 540 + x
    sign: NDArray[np.int8]  # (pixels,), +1 brighter, -1 darker

    def part(self, first: int, last: int) -> "EventImages":
        """The slices [first, last); pixels are views."""
        start = self.start[first : last + 1]
        return EventImages(start - start[0], self.pixel[start[0] : start[-1]], self.sign[start[0] : start[-1]])


def join_images(parts: Sequence[EventImages]) -> EventImages:
    """Put runs of slices end to end."""
    ends = np.cumsum([0, *(len(part.pixel) for part in parts)])
    starts = [part.start[:-1] + end for part, end in zip(parts, ends, strict=False)]
    return EventImages(
        np.concatenate([*starts, ends[-1:]]).astype(np.int64),
        np.concatenate([np.empty(0, np.uint32), *(part.pixel for part in parts)]),
        np.concatenate([np.empty(0, np.int8), *(part.sign for part in parts)]),
    )


def gel_image(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    window_px: tuple[int, int, int, int] | NDArray[np.int32] | None,
    blank: NDArray[np.int8],
) -> tuple[NDArray[np.uint32], NDArray[np.int8]]:
    """The event image of one slice without the window: its pixels that are not 0, and their signs.

    It is `event_image` of 540 x 480 px with the window (as for `events_outside`) cut out. `blank` (480, 540) is work
    space, 0 before and after. ValueError if the columns differ in length. Source: paper, "Model Architectures".
    """
    if x.ndim != 1 or not x.shape == y.shape == p.shape:
        raise ValueError(f"expected three columns of equal length, found {x.shape}, {y.shape} and {p.shape}")
    if blank.shape != GEL_PX[::-1]:
        raise ValueError(f"blank: expected shape {GEL_PX[::-1]}, found {blank.shape}")
    x0, y0, x1, y1 = (0, 0, 0, 0) if window_px is None else (int(edge) for edge in window_px)
    pixel, sign = np.empty(len(x), np.uint32), np.empty(len(x), np.int8)
    _draw(x, y, p, blank)
    found = _lift_off(x, y, x0, y0, x1, y1, blank, pixel, sign)
    return pixel[:found], sign[:found]


def _checked_dots(
    dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.float64]]:
    rest = _checked_rest(rest_xy_px)
    dots = np.asarray(dot_xy_px)
    if dots.ndim not in (2, 3) or dots.shape[-2:] != rest.shape:
        raise ValueError(f"dot_xy_px: expected (n, 2) or (slices, n, 2) with n = {len(rest)}, found {dots.shape}")
    if np.isinf(dots).any():
        raise ValueError("dot_xy_px: expected finite places, NaN for missing dots, found infinite ones")
    return dots, rest


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
def _offset(place_px: float, rest_px: float) -> np.float32:
    offset = np.float32(place_px) - rest_px
    if isnan(offset):
        return np.float32(0.0)
    return np.float32(offset)


@njit(cache=True)
def _offsets(
    dot_xy_px: NDArray[np.floating], rest_xy_px: NDArray[np.float64], displacement_xy_px: NDArray[np.float32]
) -> None:
    for k in range(dot_xy_px.shape[0]):
        for i in range(rest_xy_px.shape[0]):
            displacement_xy_px[k, i, 0] = _offset(dot_xy_px[k, i, 0], rest_xy_px[i, 0])
            displacement_xy_px[k, i, 1] = _offset(dot_xy_px[k, i, 1], rest_xy_px[i, 1])


@njit(cache=True)
def _push(
    dot_xy_px: NDArray[np.floating],
    events_per_dot: NDArray[np.int32],
    rest_xy_px: NDArray[np.float64],
    ring: NDArray[np.float32],
    row: int,
) -> None:
    again = row + ring.shape[0] // 2
    for i in range(rest_xy_px.shape[0]):
        ring[row, i, 0] = _distance(dot_xy_px[i, 0], dot_xy_px[i, 1], rest_xy_px[i, 0], rest_xy_px[i, 1])
        ring[row, i, 1] = np.float32(events_per_dot[i])
        ring[row, i, 2] = _offset(dot_xy_px[i, 0], rest_xy_px[i, 0])
        ring[row, i, 3] = _offset(dot_xy_px[i, 1], rest_xy_px[i, 1])
        for channel in range(ring.shape[2]):
            ring[again, i, channel] = ring[row, i, channel]


@njit(cache=True)
def _draw(x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], image: NDArray[np.int8]) -> None:
    height, width = image.shape
    for k in range(x.shape[0]):
        if x[k] < width and y[k] < height:
            image[y[k], x[k]] = 1 if p[k] else -1


@njit(cache=True)
def _lift_off(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    image: NDArray[np.int8],
    pixel: NDArray[np.uint32],
    sign: NDArray[np.int8],
) -> int:
    """Move what the events drew from the image, outside the window, to lists; returns their length."""
    height, width = image.shape
    found = 0
    for k in range(x.shape[0]):
        if x[k] >= width or y[k] >= height or image[y[k], x[k]] == 0:
            continue
        if not (x0 <= x[k] < x1 and y0 <= y[k] < y1):
            pixel[found] = np.uint32(y[k]) * np.uint32(width) + np.uint32(x[k])
            sign[found] = image[y[k], x[k]]
            found += 1
        image[y[k], x[k]] = 0
    return found
