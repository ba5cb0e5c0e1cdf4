"""Scans of dots and window with lines that are not dots (see contact_edges).

Lines change no picture but the references, by as much with the other sign; then the pixels of both are compared. So a
scan shows dots, lines and texture of one time, and a pixel still has at most one event.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.sim.camera import dot_rings, optics
from evetac_cli.sim.camera.camera_input import ObjectMotion
from evetac_cli.sim.camera.contact_edges import (
    LineMotion,
    Place,
    cut_moved,
    cut_run,
    outline_moved,
    outline_rows,
    outline_runs,
    sample_cut,
    sample_row,
)
from evetac_cli.sim.camera.scanning.dots import at_scans, scan_dots
from evetac_cli.sim.camera.scanning.pixels import GelPixels, ScanTimes, WindowPixels
from evetac_cli.sim.camera.scanning.window import compare_row, mark_due, scan_window


@njit(cache=True)
def scan_lines(
    lines: LineMotion,
    path: NDArray[np.float64],
    gel: GelPixels,
    motion: ObjectMotion,
    window: WindowPixels,
    times: ScanTimes,
    keys: NDArray[np.int64],
) -> tuple[int, int]:
    """Scan dots and window with lines that move; returns the number of events, and of those that lines alone made."""
    start, end, outline, cut_contrast, cut_half, seen_corner, seen_cut_x, seen_level, seen_cut_level = lines
    inner, outer, steps_per_px, profile = gel.profile
    reference = gel.reference
    candidates = gel.candidates
    readout_us, t0_us, refractory_us = times
    scans = len(readout_us)
    height, width = reference.shape
    rows, columns = outline.picture.shape
    cut_rows = len(seen_cut_x)
    moved_from = seen_corner.copy()
    cut_from = seen_cut_x.copy()
    line = np.empty(width, np.float32)
    first_x, first_y, object_seen, texture, window_reference, window_threshold, window_release_us, runs = window
    contrast = motion.contrast
    reach = _reach_of_lines(start, end, cut_half, rows, columns, seen_corner, seen_cut_x)
    dot_xy, dots = _dots_at_lines(path, gel.seen_dot_xy_px, scans, outer, reach)
    due = (runs.due_at, runs.row_due_at)
    shifted = (reference, candidates.lower2_px2, first_x, first_y, window_reference, *due)
    made = 0
    line_events = 0
    if dots == 0:
        made = scan_dots(path, gel, times, 0, scans, keys, made)
    for scan in range(scans):
        part = scan / scans
        now_us = t0_us + scan * SLICE_US / scans
        x = start.corner_px[0] + part * (end.corner_px[0] - start.corner_px[0])
        y = start.corner_px[1] + part * (end.corner_px[1] - start.corner_px[1])
        strength = start.strength + part * (end.strength - start.strength)
        first_row, end_row = outline_rows(rows, height, y, seen_corner[1])
        if not (rows and outline_moved(outline.slope, outline.height, seen_corner, x, y, strength)):
            end_row = first_row
        moved_from[:] = seen_corner
        faded = strength != seen_corner[2]
        moved = (x, y, moved_from[0], moved_from[1], faded)
        touched = (width, 0)
        for row in range(first_row, end_row):
            left, left_end, right, right_end = outline_runs(outline.runs, columns, width, row, *moved)
            for first, beyond in ((left, left_end), (right, right_end)):
                sample_row(outline.picture, x, y, strength, row, first, beyond, line)
                _shift(line, seen_level, row, first, beyond, *shifted)
            touched = (min(touched[0], left), max(touched[1], right_end))
        _forget_lists(candidates.list_box, outer, first_row, end_row, *touched)
        if first_row < end_row:
            seen_corner[0] = x
            seen_corner[1] = y
            seen_corner[2] = strength
        cut_from[:] = seen_cut_x
        touched = (width, 0)
        for row in range(cut_rows):
            cut_x = start.cut_x_px[row] + part * (end.cut_x_px[row] - start.cut_x_px[row])
            if cut_moved(cut_contrast, cut_half, seen_cut_x[row], cut_x):
                first, beyond = cut_run(cut_half, width, seen_cut_x[row], cut_x)
                sample_cut(cut_contrast, cut_half, cut_x, first, beyond, line)
                _shift(line, seen_cut_level, row, first, beyond, *shifted)
                seen_cut_x[row] = cut_x
                touched = (min(touched[0], first), max(touched[1], beyond))
        _forget_lists(candidates.list_box, outer, 0, cut_rows, *touched)

        if dots > 0:
            made = scan_dots(path, gel, times, scan, scan + 1, keys, made)
        if window_reference.size:
            made = scan_window(motion, window, times, scan, scan + 1, keys, made)

        before = made
        when = (readout_us[scan], now_us, refractory_us)
        place = optics.texture_place(texture, first_x, first_y, object_seen[0], object_seen[1], contrast)
        picture = (dot_xy[scan, :dots], inner, outer, steps_per_px, profile, texture, place)
        gel_pixels = (reference, gel.threshold, gel.release_us, candidates.lower2_px2)
        window_pixels = (first_x, first_y, window_reference, window_threshold, window_release_us, *due)
        pixels = (*gel_pixels, *window_pixels)
        for row in range(first_row, end_row):
            left, left_end, right, right_end = outline_runs(outline.runs, columns, width, row, *moved)
            for first, beyond in ((left, left_end), (right, right_end)):
                made = _compare_across(picture, pixels, row, first, beyond, *when, line, keys, made)
        for row in range(cut_rows):
            if cut_from[row] != seen_cut_x[row]:
                first, beyond = cut_run(cut_half, width, cut_from[row], seen_cut_x[row])
                made = _compare_across(picture, pixels, row, first, beyond, *when, line, keys, made)
        line_events += made - before
    return made, line_events


@njit(cache=True)
def _reach_of_lines(
    start: Place,
    end: Place,
    cut_half: float,
    rows: int,
    columns: int,
    seen_corner: NDArray[np.float64],
    seen_cut_x: NDArray[np.float64],
) -> tuple[float, float, float, float]:
    """A box that holds all pixels whose level lines can change in a slice: left, top, right, bottom."""
    left = np.inf
    top = np.inf
    right = -np.inf
    bottom = -np.inf
    if rows:
        for x, y in (
            (start.corner_px[0], start.corner_px[1]),
            (end.corner_px[0], end.corner_px[1]),
            (seen_corner[0], seen_corner[1]),
        ):
            left = min(left, x - 2.0)
            top = min(top, y - 2.0)
            right = max(right, x + columns + 2.0)
            bottom = max(bottom, y + rows + 2.0)
    for row in range(len(seen_cut_x)):
        left = min(left, start.cut_x_px[row] - cut_half, end.cut_x_px[row] - cut_half, seen_cut_x[row] - cut_half)
        right = max(right, start.cut_x_px[row] + cut_half, end.cut_x_px[row] + cut_half, seen_cut_x[row] + cut_half)
        top = -np.inf
        bottom = np.inf
    return left, top, right, bottom


@njit(cache=True)
def _dots_at_lines(
    path: NDArray[np.float64],
    seen_xy: NDArray[np.float64],
    scans: int,
    outer: float,
    reach: tuple[float, float, float, float],
) -> tuple[NDArray[np.float64], int]:
    """Where the dots that come near lines are at each scan, the first of (scans, dots, 2), and how many they are."""
    left, top, right, bottom = reach
    at_xy = np.empty((len(path), scans, 2))
    at_scans(path, scans, 0, at_xy)
    box = dot_rings.boxes(at_xy, seen_xy)
    near_xy = np.empty((scans, len(path), 2))
    near = 0
    for dot in range(len(path)):
        reach_x = box[dot, 2] + outer
        reach_y = box[dot, 3] + outer
        across = left <= box[dot, 0] + reach_x and box[dot, 0] - reach_x <= right
        if across and top <= box[dot, 1] + reach_y and box[dot, 1] - reach_y <= bottom:
            near_xy[:, near] = at_xy[dot]
            near += 1
    return near_xy, near


@njit(cache=True)
def _shift(
    line: NDArray[np.float32],
    seen_level: NDArray[np.float32],
    row: int,
    first: int,
    end: int,
    reference: NDArray[np.float32],
    lower2_px2: NDArray[np.float32],
    first_x: int,
    first_y: int,
    window_reference: NDArray[np.float32],
    due_at: NDArray[np.float64],
    row_due_at: NDArray[np.float64],
) -> None:
    """Take what lines add to pixels first to end of a row as seen: change their references by as much the other way.

    The pixels of the window have references of their own; under them those of the gel are of no account.
    """
    window_rows, window_columns = window_reference.shape
    left = max(first, first_x) - first_x
    right = min(end, first_x + window_columns) - first_x
    own = row - first_y
    if 0 <= own < window_rows and left < right:
        for x in range(left, right):
            window_reference[own, x] -= line[x + first_x - first] - seen_level[row, x + first_x]
        mark_due(due_at, row_due_at, own, left, right)
    for k in range(end - first):
        reference[row, first + k] -= line[k] - seen_level[row, first + k]
        seen_level[row, first + k] = line[k]
        lower2_px2[row, first + k] = np.inf


@njit(cache=True)
def _forget_lists(list_box: NDArray[np.float64], outer: float, top: int, bottom: int, left: int, right: int) -> None:
    """Drop the lists of dots that can come near rows top to bottom, columns left to right."""
    for dot in range(len(list_box)):
        reach_x = list_box[dot, 2] + outer
        reach_y = list_box[dot, 3] + outer
        across = left <= list_box[dot, 0] + reach_x and list_box[dot, 0] - reach_x <= right
        if across and top <= list_box[dot, 1] + reach_y and list_box[dot, 1] - reach_y <= bottom:
            list_box[dot] = np.nan


@njit(cache=True)
def _compare_across(
    picture: tuple[Any, ...],
    pixels: tuple[Any, ...],
    row: int,
    first: int,
    end: int,
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    line: NDArray[np.float32],
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare pixels first to end of a row of the frame, those of the gel and those of the window.

    `picture` is what draws both, `pixels` what they have.
    """
    dot_xy, inner, outer, steps_per_px, profile, texture, place = picture
    reference, threshold, release_us, lower2, first_x, first_y = pixels[:6]
    window_reference, window_threshold, window_release_us, due_at, row_due_at = pixels[6:]
    when = (readout_us, now_us, refractory_us, keys)
    if first < end:
        optics.dot_row(dot_xy, inner, outer, steps_per_px, profile, row, first, end, line)
        made = compare_row(
            line,
            reference[row, first:end],
            threshold[row, first:end],
            release_us[row, first:end],
            first,
            row,
            *when,
            made,
        )
        lower2[row, first:end] = np.inf
    window_rows, window_columns = window_reference.shape
    left = max(first, first_x) - first_x
    right = min(end, first_x + window_columns) - first_x
    if first_y <= row < first_y + window_rows and left < right:
        optics.sample_texture_run(texture, *place, row - first_y, left, right, line)
        made = compare_row(
            line,
            window_reference[row - first_y, left:right],
            window_threshold[row - first_y, left:right],
            window_release_us[row - first_y, left:right],
            first_x + left,
            row,
            *when,
            made,
        )
        mark_due(due_at, row_due_at, row - first_y, left, right)
    return made
