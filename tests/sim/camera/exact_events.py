"""Exact events of moving dots and a sliding texture, pixel by pixel: what the scanning camera is compared with.

Every pixel near a dot is followed many times per millisecond. Its level is the closed form of the edge instead of a
table, linear between samples. It shares no code with the camera, but starts from its references and thresholds.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera.scanning.camera import CameraState

EDGE_SIGMAS = 6.0  # an edge farther away changes a level by less than 1e-8

# times in us, columns, rows and polarities of events, side by side
Columns = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


def reference_events(state: CameraState, path_px: NDArray[np.float64], step_us: float) -> Events:
    """Return every crossing of every pixel near a path (steps + 1, dots, 2) of dots, without a window.

    The path is sampled every `step_us`. `state` provides reference levels and thresholds at the start and is not
    changed. A level is the erf edge of the nearest dot, linear between samples.
    """
    arguments = (
        path_px,
        float(step_us),
        state.reference,
        state.threshold,
        state.model.dot_radius_px,
        state.model.edge_sigma_px,
        state.model.log_contrast,
    )
    columns = _empty_columns(_crossings(*arguments, _empty_columns(0)))  # first count
    _crossings(*arguments, columns)
    return _events(columns)


def window_events(state: CameraState, object_px: NDArray[np.float64], step_us: float) -> Events:
    """Return every crossing of every pixel of the window, for an object displaced along a path (steps + 1, 2) in px.

    As `reference_events`; a level is the texture, bilinear and periodic, at full contrast, linear between samples.
    """
    arguments = (
        np.ascontiguousarray(object_px),
        float(step_us),
        state.texture,
        state.window_px[:2],
        state.window_reference,
        state.window_threshold,
    )
    columns = _empty_columns(_window_crossings(*arguments, _empty_columns(0)))  # first count
    _window_crossings(*arguments, columns)
    return _events(columns)


def _events(columns: Columns) -> Events:
    """Events in time order, rounded down to whole microseconds as a camera does."""
    t, x, y, p = (column[np.argsort(columns[0], kind="stable")] for column in columns)
    return Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def _empty_columns(size: int) -> Columns:
    return np.empty(size), np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)


@njit(cache=True)
def _cross(
    level: float,
    step: float,
    ends: tuple[float, float],
    piece: tuple[int, float],
    pixel: tuple[int, int],
    events: Columns,
    event_count: int,
) -> tuple[float, int]:
    """Write the events of a pixel while its light changes linearly; return its new level and the event count.

    piece: the sample at the end, and the time between two samples in us.
    """
    before, after = ends
    sample, step_us = piece
    times, columns, rows, polarities = events
    while abs(after - level) >= step:
        brighter = after > level
        level += step if brighter else -step
        if event_count < len(times):
            times[event_count] = (sample - 1 + (level - before) / (after - before)) * step_us
            columns[event_count], rows[event_count] = pixel
            polarities[event_count] = int(brighter)
        event_count += 1
    return level, event_count


@njit(cache=True)
def _crossings(
    path: NDArray[np.float64],
    step_us: float,
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    radius: float,
    sigma: float,
    contrast: float,
    events: Columns,
) -> int:
    """Write as many events as there is room for, and return the total number."""
    samples, dots, _ = path.shape
    height, width = reference.shape
    reach = radius + EDGE_SIGMAS * sigma
    near = np.empty(dots, np.int64)
    event_count = 0
    low = np.empty((dots, 2))
    high = np.empty((dots, 2))
    for dot in range(dots):
        for axis in range(2):
            low[dot, axis] = path[:, dot, axis].min() - reach
            high[dot, axis] = path[:, dot, axis].max() + reach
    for y in range(height):
        for x in range(width):
            count = 0
            for dot in range(dots):
                if low[dot, 0] <= x <= high[dot, 0] and low[dot, 1] <= y <= high[dot, 1]:
                    near[count] = dot
                    count += 1
            if count == 0:
                continue
            level = np.float64(reference[y, x])
            step = np.float64(threshold[y, x])
            before = _edge_level(x, y, path[0], near[:count], radius, sigma, contrast)
            for sample in range(1, samples):
                after = _edge_level(x, y, path[sample], near[:count], radius, sigma, contrast)
                level, event_count = _cross(
                    level, step, (before, after), (sample, step_us), (x, y), events, event_count
                )
                before = after
    return event_count


@njit(cache=True)
def _window_crossings(
    path: NDArray[np.float64],
    step_us: float,
    texture: NDArray[np.float32],
    corner: tuple[int, int],
    phase: NDArray[np.float32],
    threshold: NDArray[np.float32],
    events: Columns,
) -> int:
    """Write as many events as there is room for, and return the total number.

    phase: offset of each reference level from the first level, as in a camera before its first slice.
    """
    event_count = 0
    for row in range(phase.shape[0]):
        for column in range(phase.shape[1]):
            x, y = corner[0] + column, corner[1] + row
            before = _texture_level(texture, x - path[0, 0], y - path[0, 1])
            level = before + phase[row, column]
            step = np.float64(threshold[row, column])
            for sample in range(1, len(path)):
                after = _texture_level(texture, x - path[sample, 0], y - path[sample, 1])
                level, event_count = _cross(
                    level, step, (before, after), (sample, step_us), (x, y), events, event_count
                )
                before = after
    return event_count


@njit(cache=True)
def _texture_level(texture: NDArray[np.float32], x: float, y: float) -> float:
    """Return a periodic texture interpolated between its texels, in double precision."""
    rows, columns = texture.shape
    left, top = math.floor(x), math.floor(y)
    part_x, part_y = x - left, y - top
    upper = (1.0 - part_x) * texture[top % rows, left % columns] + part_x * texture[top % rows, (left + 1) % columns]
    under = (top + 1) % rows
    lower = (1.0 - part_x) * texture[under, left % columns] + part_x * texture[under, (left + 1) % columns]
    return float((1.0 - part_y) * upper + part_y * lower)


@njit(cache=True)
def _edge_level(
    x: int,
    y: int,
    dot_xy: NDArray[np.float64],
    near: NDArray[np.int64],
    radius: float,
    sigma: float,
    contrast: float,
) -> float:
    """Return the log intensity at a pixel by the nearest of some dots: 0 on the gel, -contrast in the ink."""
    least2 = np.inf
    for dot in near:
        least2 = min(least2, (x - dot_xy[dot, 0]) ** 2 + (y - dot_xy[dot, 1]) ** 2)
    sigmas = (math.sqrt(least2) - radius) / sigma
    if sigmas > EDGE_SIGMAS:
        return 0.0
    if sigmas < -EDGE_SIGMAS:
        return -contrast
    ink = math.exp(-contrast)
    return math.log(ink + (1.0 - ink) * 0.5 * math.erfc(-sigmas / math.sqrt(2.0)))
