"""The ideal camera's window: the times at which a sliding texture takes a pixel's level past its threshold, solved.

The texture is bilinear, so along a straight path a pixel's level is a quadratic in time until the object has moved to
the next texel, which happens to all pixels at once. The slice is divided there, and each part is solved exactly. Lines
that move over the window (see contact_edges) divide it into further parts, one per sub-step.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import ObjectMotion
from evetac_cli.sim.camera.contact_edges import EdgePlace, LineMotion, Outline, sample_cut, sample_row
from evetac_cli.sim.camera.event_keys import event_key
from evetac_cli.sim.camera.ideal.pixels import IdealWindowPixels, SliceTimes

# An object faster than this many texels per slice (8 m/s) is sampled at this many equal parts, not at each texel.
MOST_TEXELS = 256
# The `lines` of `solve_window` if no line moves.
NO_LINES = LineMotion(
    EdgePlace(np.zeros(2), 0.0, np.zeros(0)),
    EdgePlace(np.zeros(2), 0.0, np.zeros(0)),
    Outline(np.zeros((0, 0), np.float32), np.empty((0, 4), np.int64), 0.0, 0.0),
    0.0,
    1.0,
    np.zeros(3),
    np.zeros(0),
    np.zeros((0, 0), np.float32),
    np.zeros((0, 0), np.float32),
)


@njit(cache=True)
def solve_window(
    motion: ObjectMotion,
    window: IdealWindowPixels,
    lines: LineMotion,
    steps: int,
    times: SliceTimes,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Solve the crossings of the window's pixels; return the number of events so far.

    Within a part of the slice in which the object stays between whole texels, a level is the parabola through its
    values at start, middle and end. The window's `level` is set to the texture's at the end. `lines` are added, and
    divide the slice into `steps` parts; 0 if no line moves.
    """
    start_xy, end_xy, contrast = motion
    first_x, first_y, seen, texture, level, reference, _, _ = window
    across = end_xy[0] - start_xy[0]
    down = end_xy[1] - start_xy[1]
    first_look = math.isnan(seen[2])
    jumped = contrast != seen[2] or (contrast > 0.0 and (start_xy[0] != seen[0] or start_xy[1] != seen[1]))
    moves = steps > 0 or (contrast > 0.0 and (across != 0.0 or down != 0.0))
    seen[0] = end_xy[0]
    seen[1] = end_xy[1]
    seen[2] = contrast
    if not (jumped or moves):
        return event_count
    now = np.empty_like(reference)
    half_way = np.empty_like(reference)
    then = np.empty_like(reference)
    optics.sample_texture(texture, first_x, first_y, start_xy[0], start_xy[1], contrast, now)
    if first_look:
        reference += now
    _add_lines(now, first_x, first_y, 0.0, steps, lines)
    if not first_look or steps > 0:
        event_count = _solve_parabolas((now, now, now), (0.0, 0.0), window, times, keys, event_count)
    at = 0.0
    while moves and at < 1.0:
        until = _next_texel(start_xy[0], across, start_xy[1], down, at)
        if steps > 0:
            until = min(until, (math.floor(at * steps + 1e-6) + 1.0) / steps)
        middle = 0.5 * (at + until)
        optics.sample_texture(
            texture, first_x, first_y, start_xy[0] + middle * across, start_xy[1] + middle * down, contrast, half_way
        )
        _add_lines(half_way, first_x, first_y, middle, steps, lines)
        optics.sample_texture(
            texture, first_x, first_y, start_xy[0] + until * across, start_xy[1] + until * down, contrast, then
        )
        _add_lines(then, first_x, first_y, until, steps, lines)
        span_us = (at * SLICE_US, until * SLICE_US)
        event_count = _solve_parabolas((now, half_way, then), span_us, window, times, keys, event_count)
        now, then = then, now
        at = until
    level[:] = now
    if steps > 0:
        half_way[:] = 0.0
        _add_lines(half_way, first_x, first_y, 1.0, steps, lines)
        level -= half_way
        reference -= half_way
    return event_count


@njit(cache=True)
def _add_lines(
    level: NDArray[np.float32],
    first_x: int,
    first_y: int,
    at: float,
    steps: int,
    lines: LineMotion,
) -> None:
    """Add to pixels the changes by lines since they were last seen, at a part `at` of the slice."""
    if steps == 0:
        return
    start, end, outline, cut_contrast, cut_half, _, _, seen_level, seen_cut_level = lines
    rows, columns = level.shape
    x = start.corner_px[0] + at * (end.corner_px[0] - start.corner_px[0])
    y = start.corner_px[1] + at * (end.corner_px[1] - start.corner_px[1])
    strength = start.strength + at * (end.strength - start.strength)
    line = np.empty(columns, np.float32)
    last_x = first_x + columns
    for row in range(rows):
        if len(seen_level):
            sample_row(outline.picture, x, y, strength, first_y + row, first_x, last_x, line)
            level[row] += line - seen_level[first_y + row, first_x:last_x]
        if len(seen_cut_level):
            cut_x = start.cut_x_px[first_y + row]
            cut_x += at * (end.cut_x_px[first_y + row] - cut_x)
            sample_cut(cut_contrast, cut_half, cut_x, first_x, last_x, line)
            level[row] += line - seen_cut_level[first_y + row, first_x:last_x]


@njit(cache=True)
def _next_texel(start_x: float, across: float, start_y: float, down: float, at: float) -> float:
    """Return the part of the slice, after `at`, at which the object next reaches a whole texel; at most 1."""
    if abs(across) + abs(down) > MOST_TEXELS:
        return min(at + 1.0 / MOST_TEXELS, 1.0)
    until = 1.0
    for begin, travel in ((start_x, across), (start_y, down)):
        if travel != 0.0:
            # Beyond `at` by more than rounding, because otherwise a part could have no length.
            here = begin + (at + 1e-9) * travel
            texel = math.floor(here) + 1.0 if travel > 0.0 else math.ceil(here) - 1.0
            until = min(until, max((texel - begin) / travel, at + 1e-9))
    return until


@njit(cache=True)
def _solve_parabolas(
    pictures: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    span_us: tuple[float, float],
    window: IdealWindowPixels,
    times: SliceTimes,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Solve the crossings of levels on parabolas through three images; return the number of events so far.

    The images are those at the start, middle and end of the span. With equal times the three are the same image, to
    which the pixels have jumped.
    """
    now, half_way, then = pictures
    from_us, until_us = span_us
    first_x, first_y, _, _, _, reference, threshold, release_us = window
    _, t0_us, refractory_us = times
    rows, columns = reference.shape
    for row in range(rows):
        # Most rows have no event, and counting vectorises. A parabola leaves its chord by a quarter of its square
        # term, |now - 2 half_way + then| / 2. NaN, a refractory pixel, also counts.
        may_fire = 0
        for column in range(columns):
            bulge = np.float32(0.5) * abs(
                now[row, column] - np.float32(2.0) * half_way[row, column] + then[row, column]
            )
            change = max(
                abs(now[row, column] - reference[row, column]), abs(then[row, column] - reference[row, column])
            )
            may_fire += int(not (change + bulge < threshold[row, column]))
        if may_fire == 0:
            continue
        for column in range(columns):
            at_start = np.float64(now[row, column])
            at_end = np.float64(then[row, column])
            square = 2.0 * (at_start - 2.0 * np.float64(half_way[row, column]) + at_end)
            slope = at_end - at_start - square
            level = np.float64(reference[row, column])
            step = np.float64(threshold[row, column])
            part = 0.0
            while True:
                if math.isnan(level):
                    blind_until_us = release_us[row, column] - t0_us
                    if blind_until_us > until_us:
                        break
                    if blind_until_us > from_us:
                        part = (blind_until_us - from_us) / (until_us - from_us)
                    level = at_start + part * (slope + part * square)
                value = at_start + part * (slope + part * square)
                if abs(value - level) >= step:
                    brighter = value > level
                else:
                    brighter_at = _first_root(square, slope, at_start - level - step, part, at_end >= level + step)
                    darker_at = _first_root(-square, -slope, level - step - at_start, part, at_end <= level - step)
                    brighter = brighter_at < darker_at
                    if min(brighter_at, darker_at) > 1.0:
                        break
                    part = min(brighter_at, darker_at)
                time_us = from_us + part * (until_us - from_us)
                if event_count < len(keys):
                    keys[event_count] = event_key(
                        min(int(time_us), SLICE_US - 1), first_x + column, first_y + row, brighter
                    )
                event_count += 1
                if refractory_us > 0.0:
                    release_us[row, column] = t0_us + time_us + refractory_us
                    level = np.float64(np.nan)
                else:
                    level = level + step if brighter else level - step
            reference[row, column] = level
    return event_count


@njit(cache=True)
def _first_root(square: float, slope: float, rest: float, part: float, by_the_end: bool) -> float:
    """Return where square u^2 + slope u + rest, negative at `part`, first reaches 0; infinity if not before 1.

    `by_the_end`: the value is not negative at 1. It prevents rounding from losing a crossing.
    """
    discriminant = slope * slope - 4.0 * square * rest
    first = np.inf
    if discriminant >= 0.0:
        half_sum = -0.5 * (slope + math.copysign(math.sqrt(discriminant), slope))
        if square != 0.0 and part < half_sum / square <= 1.0:
            first = half_sum / square
        if half_sum != 0.0 and part < rest / half_sum <= 1.0:
            first = min(first, rest / half_sum)
    if first > 1.0 and by_the_end:
        first = 1.0
    return first
