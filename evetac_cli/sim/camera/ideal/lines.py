"""The ideal camera under moving lines (see contact_edges): crossings of the gel pixels that lines may touch.

Unlike dots, lines have no closed form. A slice in which they move is divided into sub-steps, in which they move by a
limited number of px. In a sub-step, the level of a gel pixel that lines may touch, dots included, is linear; that of a
window pixel is a parabola (see window). The error of a time falls with the square of the step.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.contact_edges import (
    LineMotion,
    cut_run,
    outline_rows,
    outline_runs,
    sample_cut,
    sample_row,
)
from evetac_cli.sim.camera.event_keys import event_key
from evetac_cli.sim.camera.ideal.pixels import IdealGelPixels, SliceTimes

# For an edge 4 px wide at 1 and 3 px/ms, events are 0.25 us (median) and 0.48 us (p95) from those of steps of 2.5 us.
# That is the error of rounding to whole us. With moving dots, which are steeper, under a line the step is shorter.
LINE_STEP_PX = 0.25
DOT_STEP_PX = 0.05
MOST_LINE_STEPS = 64  # most sub-steps in a slice


def line_steps(lines: LineMotion, path: NDArray[np.float64], line_step_px: float) -> int:
    """Return the number of sub-steps of a slice with moving lines, and with dots on paths (dots, k + 1, 2)."""
    start, end = lines.start, lines.end
    travel_px = np.hypot(*(end.corner_px - start.corner_px)) if lines.outline.picture.size else 0.0
    travel_px = max(travel_px, np.abs(end.cut_x_px - start.cut_x_px).max(initial=0.0))
    dots_px = np.hypot(*np.moveaxis(np.diff(path, axis=1), -1, 0)).sum(axis=1).max(initial=0.0)
    travel_px = max(travel_px, dots_px * LINE_STEP_PX / DOT_STEP_PX)
    return int(min(max(math.ceil(travel_px / line_step_px), 1), MOST_LINE_STEPS))


@njit(cache=True)
def solve_line_pixels(
    lines: LineMotion,
    steps: int,
    path: NDArray[np.float64],
    gel: IdealGelPixels,
    times: SliceTimes,
    keys: NDArray[np.int64],
    event_count: int,
) -> tuple[int, int]:
    """Solve the crossings of gel pixels that lines may touch, row by row, in sub-steps, while dots move on paths.

    Return the number of events so far, and the number of those that only lines caused.
    """
    start, end, outline, _, cut_half, seen_corner, seen_cut_x, _, _ = lines
    lower2, solved_in, reference = gel.lower2_px2, gel.solved_in, gel.reference
    this_slice, t0_us, refractory_us = times
    inner, outer, steps_per_px, profile = gel.profile
    pixels = (inner, outer, steps_per_px, profile, reference, gel.threshold, gel.release_us)
    when = (refractory_us, t0_us, keys)
    height, width = reference.shape
    dots_xy = _along(path, steps)
    rows, columns = outline.picture.shape
    low_x = min(seen_corner[0], start.corner_px[0], end.corner_px[0])
    high_x = max(seen_corner[0], start.corner_px[0], end.corner_px[0])
    low_y = min(seen_corner[1], start.corner_px[1], end.corner_px[1])
    high_y = max(seen_corner[1], start.corner_px[1], end.corner_px[1])
    faded = start.strength != end.strength or start.strength != seen_corner[2]
    changes = faded or (start.strength > 0.0 and (low_x != high_x or low_y != high_y))
    first_row, end_row = outline_rows(rows, height, low_y, high_y)
    if rows == 0 or not changes:
        end_row = first_row
    runs = np.empty((3, 2), np.int64)
    scratch = np.empty((7, width), np.float32)
    line_events = 0
    for y in range(height):
        runs[:] = 0
        if first_row <= y < end_row:
            left, left_end, right, right_end = outline_runs(
                outline.runs, columns, width, y, low_x, low_y, high_x, high_y, faded
            )
            runs[0, 0] = left
            runs[0, 1] = left_end
            runs[1, 0] = right
            runs[1, 1] = right_end
        if len(seen_cut_x):
            low = min(seen_cut_x[y], start.cut_x_px[y], end.cut_x_px[y])
            high = max(seen_cut_x[y], start.cut_x_px[y], end.cut_x_px[y])
            if low < high:
                first, beyond = cut_run(cut_half, width, low, high)
                if first < runs[1, 1] and runs[0, 0] < beyond:  # they may share pixels: take all in between
                    first = min(first, runs[0, 0])
                    beyond = max(beyond, runs[1, 1])
                    runs[:2] = 0
                runs[2, 0] = first
                runs[2, 1] = beyond
        for run in range(3):
            first = runs[run, 0]
            beyond = runs[run, 1]
            if first == beyond:
                continue
            event_count, alone = _solve_run(
                steps, lines, dots_xy, pixels, when, (y, first, beyond), scratch, event_count
            )
            line_events += alone
            lower2[y, first:beyond] = np.inf
            solved_in[y, first:beyond] = this_slice
    if rows:
        seen_corner[0] = end.corner_px[0]
        seen_corner[1] = end.corner_px[1]
        seen_corner[2] = end.strength
    seen_cut_x[:] = end.cut_x_px
    return event_count, line_events


@njit(cache=True)
def _along(path: NDArray[np.float64], steps: int) -> NDArray[np.float64]:
    """Return dot positions at the ends of equal sub-steps, (steps + 1, dots, 2); a single entry if no dot moves."""
    dots, vertices, _ = path.shape
    moves = False
    for dot in range(dots):
        for vertex in range(1, vertices):
            for axis in range(2):
                moves = moves or path[dot, vertex, axis] != path[dot, 0, axis]
    count = steps + 1 if moves else 1
    xy = np.empty((count, dots, 2))
    for step in range(count):
        at = step * (vertices - 1) / steps
        vertex = min(int(at), vertices - 2)
        for dot in range(dots):
            for axis in range(2):
                piece_px = path[dot, vertex + 1, axis] - path[dot, vertex, axis]
                xy[step, dot, axis] = path[dot, vertex, axis] + (at - vertex) * piece_px
    return xy


@njit(cache=True)
def _solve_run(
    steps: int,
    moving: LineMotion,
    dots_xy: NDArray[np.float64],
    pixels: tuple[Any, ...],
    when: tuple[Any, ...],
    run: tuple[int, int, int],
    scratch: NDArray[np.float32],
    event_count: int,
) -> tuple[int, int]:
    """Solve the crossings of pixels side by side, whose levels are linear in every sub-step.

    run: row, first column, and the column after the last. Returns the counts of `solve_line_pixels`.
    """
    start, end, outline, cut_contrast, cut_half, _, _, seen_level, seen_cut_level = moving
    y, first, beyond = run
    inner, outer, steps_per_px, profile, reference, threshold, release_us = pixels
    refractory_us, t0_us, keys = when
    count = beyond - first
    dots_now, dots_then, now, then, lines, lines_seen, line = (
        scratch[0],
        scratch[1],
        scratch[2],
        scratch[3],
        scratch[4],
        scratch[5],
        scratch[6],
    )
    lines_seen[:count] = 0.0
    if len(seen_level):
        lines_seen[:count] += seen_level[y, first:beyond]
    if len(seen_cut_level):
        lines_seen[:count] += seen_cut_level[y, first:beyond]
    line_events = 0
    for step in range(steps + 1):
        at = step / steps
        lines[:count] = 0.0
        if len(seen_level):
            x = start.corner_px[0] + at * (end.corner_px[0] - start.corner_px[0])
            down = start.corner_px[1] + at * (end.corner_px[1] - start.corner_px[1])
            strength = start.strength + at * (end.strength - start.strength)
            sample_row(outline.picture, x, down, strength, y, first, beyond, line)
            lines[:count] += line[:count]
            if step == steps:
                seen_level[y, first:beyond] = line[:count]
        if len(seen_cut_level):
            cut_x = start.cut_x_px[y] + at * (end.cut_x_px[y] - start.cut_x_px[y])
            sample_cut(cut_contrast, cut_half, cut_x, first, beyond, line)
            lines[:count] += line[:count]
            if step == steps:
                seen_cut_level[y, first:beyond] = line[:count]
        if step < len(dots_xy):
            optics.dot_row(dots_xy[step], inner, outer, steps_per_px, profile, y, first, beyond, dots_then)
        fired = 0
        for k in range(count):
            then[k] = dots_then[k] + (lines[k] - lines_seen[k])
            # NaN, a refractory pixel, also counts.
            fired += int(not (abs(then[k] - reference[y, first + k]) < threshold[y, first + k]))
            if step == 1:
                fired += int(not (abs(now[k] - reference[y, first + k]) < threshold[y, first + k]))
        if step > 0 and fired > 0:
            for k in range(count):
                before = event_count
                event_count = _solve_linear(
                    first + k,
                    y,
                    np.float64(now[k]),
                    np.float64(then[k]),
                    (step - 1) * SLICE_US / steps,
                    step * SLICE_US / steps,
                    reference,
                    threshold,
                    refractory_us,
                    release_us,
                    t0_us,
                    keys,
                    event_count,
                )
                if dots_then[k] == dots_now[k]:
                    line_events += event_count - before
        for k in range(count):
            now[k] = then[k]
            dots_now[k] = dots_then[k]
    for k in range(count):
        reference[y, first + k] -= lines[k] - lines_seen[k]
    return event_count, line_events


@njit(cache=True)
def _solve_linear(
    x: int,
    y: int,
    now: float,
    then: float,
    from_us: float,
    until_us: float,
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    refractory_us: float,
    release_us: NDArray[np.float64],
    t0_us: int,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Solve the crossings of a pixel whose level changes linearly from `now` to `then`; return the number of events."""
    level = np.float64(reference[y, x])
    step = np.float64(threshold[y, x])
    part = 0.0
    while True:
        if math.isnan(level):
            blind_until_us = release_us[y, x] - t0_us
            if blind_until_us > until_us:
                break
            part = max(part, (blind_until_us - from_us) / (until_us - from_us))
            level = now + part * (then - now)
        value = now + part * (then - now)
        if abs(value - level) >= step:
            brighter = value > level
        elif abs(then - level) >= step:
            brighter = then > level
            part = (level + (step if brighter else -step) - now) / (then - now)
        else:
            break
        time_us = from_us + part * (until_us - from_us)
        if event_count < len(keys):
            keys[event_count] = event_key(min(int(time_us), SLICE_US - 1), x, y, brighter)
        event_count += 1
        if refractory_us > 0.0:
            release_us[y, x] = t0_us + time_us + refractory_us
            level = np.float64(np.nan)
        else:
            level = level + step if brighter else level - step
    reference[y, x] = level
    return event_count
