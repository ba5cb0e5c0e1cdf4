"""Scans of dots and window with lines that are not dots (see contact_edges).

Lines do not change the image; they shift the references by the same amount with the opposite sign. Then the pixels of
dots and lines are compared. So a scan shows dots, lines and texture at the same time, and a pixel still has at most one
event.

Data that follow from a reference (see pixel_culling) are valid until a line moves over its pixel. For a dot that a line
touches in a scan nothing is computed, because the next scan would discard it. Its pixels are compared as they are, in
the next scans as well. Dots that no line touches keep their lists.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import dot_rings, optics
from evetac_cli.sim.camera.camera_input import ObjectMotion
from evetac_cli.sim.camera.contact_edges import (
    EdgePlace,
    cut_moved,
    cut_run,
    outline_moved,
    outline_rows,
    outline_runs,
    sample_cut,
    sample_row,
)
from evetac_cli.sim.camera.scanning.dots import at_scans, scan_dots
from evetac_cli.sim.camera.scanning.outline import compare_outline, draw_dots, shift_outline
from evetac_cli.sim.camera.scanning.pixels import RUN_PX, ZERO, ScanTimes, gel_pixels, line_motion, window_pixels
from evetac_cli.sim.camera.scanning.window import compare_row, mark_due, scan_window

ROUNDED_UP = 1.0 + 1e-6  # more than the relative error of a difference in single precision


@njit(cache=True, _nrt=False)
def scan_lines(
    plain_lines: tuple[Any, ...],
    path: NDArray[np.float64],
    plain_gel: tuple[Any, ...],
    plain_motion: tuple[Any, ...],
    plain_window: tuple[Any, ...],
    plain_times: tuple[Any, ...],
    keys: NDArray[np.int64],
) -> tuple[int, int]:
    """Scan dots and window with moving lines; return the number of events, and the number that only lines caused.

    Python passes LineMotion, GelPixels, ObjectMotion, WindowPixels and ScanTimes as plain tuples, see camera.
    """
    gel, window = gel_pixels(plain_gel), window_pixels(plain_window)
    motion = ObjectMotion(plain_motion[0], plain_motion[1], plain_motion[2])
    times = ScanTimes(plain_times[0], plain_times[1], plain_times[2])
    start, end, outline, cut_contrast, cut_half, seen_corner, seen_cut_x, seen_level, seen_cut_level = line_motion(
        plain_lines
    )
    inner, outer, steps_per_px, profile = gel.profile
    reference = gel.reference
    candidates = gel.candidates
    readout_us, t0_us, refractory_us = times
    scans = len(readout_us)
    height, width = reference.shape
    rows, columns = outline.picture.shape
    cut_rows = len(seen_cut_x)
    line, runs, cut_runs = candidates.line, candidates.runs[0], candidates.runs[1]
    (
        first_x,
        first_y,
        object_seen,
        texture,
        window_reference,
        window_threshold,
        window_release_us,
        due_runs,
        window_middle_shift,
    ) = window
    contrast = motion.contrast
    dots = len(path)
    at_xy, box, near_xy, row_xy = _places(candidates.places, dots, scans)
    at_scans(path, scans, 0, at_xy)
    dot_rings.boxes(at_xy, gel.seen_dot_xy_px, box)
    outline_reach = _reach_of_outline(start, end, rows, columns, seen_corner)
    cut_reach = _reach_of_cut(start, end, cut_half, seen_cut_x)
    touched, near, crowded = candidates.flags[0], candidates.flags[1], candidates.flags[2]
    at_lines = False
    union = (
        min(outline_reach[0], cut_reach[0]),
        outline_reach[1],
        max(outline_reach[2], cut_reach[2]),
        outline_reach[3],
    )
    if cut_rows:
        union = (union[0], -np.inf, union[2], np.inf)
    for dot in range(dots):
        near[dot] = _reaches(box[dot], outer, outline_reach) or (cut_rows > 0 and _reaches(box[dot], outer, cut_reach))
        at_lines = at_lines or _reaches(box[dot], outer, union)
    apart = not dot_rings.crowded(box, outer + 2.0, crowded)
    # If dots are apart and alike, no pixel is refractory and no texture shows, most pixels of an outline are left out.
    differing = len(gel.shapes.inner_px) > 0
    few = rows > 0 and apart and not differing and window_reference.size == 0 and gel.release_us.size == 0
    if differing:  # each dot's shape is found by its number
        near[:] = 1
    near_shapes = (gel.shapes.inner_px, gel.shapes.outer_px, gel.shapes.level)
    off_level = 0.0
    if few:
        off_level = draw_dots(
            box, near, inner, outer, steps_per_px, profile, candidates.drawn_at, candidates.drawn_dots
        )
    dots_and_error = (candidates.drawn_dots, off_level)
    outline_pixels = (reference, gel.threshold, candidates.lower2_px2, gel.middle_shift)
    doubtful = candidates.doubtful
    touched[:] = 0
    near_dots = 0
    for dot in range(dots):
        near_dots += near[dot]
    near_xy, row_xy = near_xy[:near_dots], row_xy[:near_dots]
    due = (due_runs.due_at, due_runs.row_due_at)
    shifted = (reference, candidates.lower2_px2, first_x, first_y, window_reference, *due)
    event_count = ZERO
    line_events = 0
    if not at_lines:
        event_count = scan_dots(path, gel, times, ZERO, scans, touched, apart, keys, event_count)
    for scan in range(scans):
        part = scan / scans
        now_us = t0_us + scan * SLICE_US / scans
        x = start.corner_px[0] + part * (end.corner_px[0] - start.corner_px[0])
        y = start.corner_px[1] + part * (end.corner_px[1] - start.corner_px[1])
        strength = start.strength + part * (end.strength - start.strength)
        first_row, end_row = outline_rows(rows, height, y, seen_corner[1])
        if not (rows and outline_moved(outline.slope, outline.height, seen_corner, x, y, strength)):
            end_row = first_row
        moved = (x, y, seen_corner[0], seen_corner[1], strength != seen_corner[2])
        for row in range(first_row, end_row):
            left, left_end, right, right_end = outline_runs(outline.runs, columns, width, row, *moved)
            runs[row, 0] = left
            runs[row, 1] = left_end
            runs[row, 2] = right
            runs[row, 3] = right_end
        touching = (first_row, end_row)
        if few:
            place = (x, y, strength)
            shift_outline(
                outline.picture, place, touching, runs, seen_level, outline_pixels, dots_and_error, line, doubtful
            )
        else:
            for row in range(first_row, end_row):
                left, left_end, right, right_end = runs[row]
                for first, beyond in ((left, left_end), (right, right_end)):
                    sample_row(outline.picture, x, y, strength, row, first, beyond, line)
                    _shift(line, seen_level, row, first, beyond, *shifted)
        touched[:] = 0
        if first_row < end_row:
            over = (first_row, end_row, ZERO, width)
            _touch_dots(at_xy[:, scan], gel.seen_dot_xy_px, candidates.list_box, outer, over, runs, touched)
            seen_corner[0] = x
            seen_corner[1] = y
            seen_corner[2] = strength
        cut_left = width
        cut_right = ZERO
        for row in range(cut_rows):
            cut_x = start.cut_x_px[row] + part * (end.cut_x_px[row] - start.cut_x_px[row])
            cut_runs[row, 0] = 0
            cut_runs[row, 1] = 0
            if cut_moved(cut_contrast, cut_half, seen_cut_x[row], cut_x):
                first, beyond = cut_run(cut_half, width, seen_cut_x[row], cut_x)
                sample_cut(cut_contrast, cut_half, cut_x, first, beyond, line)
                _shift(line, seen_cut_level, row, first, beyond, *shifted)
                seen_cut_x[row] = cut_x
                cut_runs[row, 0] = first
                cut_runs[row, 1] = beyond
                cut_left = min(cut_left, first)
                cut_right = max(cut_right, beyond)
                if few:
                    doubtful[row, first:beyond] = 1
        if cut_left < cut_right:
            over = (ZERO, cut_rows, cut_left, cut_right)
            _touch_dots(at_xy[:, scan], gel.seen_dot_xy_px, candidates.list_box, outer, over, cut_runs, touched)

        if at_lines:
            event_count = scan_dots(path, gel, times, scan, scan + 1, touched, apart, keys, event_count)
        if window_reference.size:
            event_count = scan_window(motion, window, times, scan, scan + 1, line, keys, event_count)

        before = event_count
        when = (readout_us[scan], now_us, refractory_us)
        texture_at = optics.texture_place(texture, first_x, first_y, object_seen[0], object_seen[1], contrast)
        ink = (inner, outer, steps_per_px, profile, near_shapes, texture, texture_at)
        of_gel = (reference, gel.threshold, gel.middle_shift, gel.release_us, candidates.lower2_px2)
        of_window = (
            first_x,
            first_y,
            window_reference,
            window_threshold,
            window_middle_shift,
            window_release_us,
            *due,
        )
        pixels = (*of_gel, *of_window)
        nearest = 0
        for dot in range(dots):
            if near[dot]:
                near_xy[nearest, 0] = at_xy[dot, scan, 0]
                near_xy[nearest, 1] = at_xy[dot, scan, 1]
                nearest += 1
        if few:
            dot_ink = (inner, outer, steps_per_px, profile)
            event_count = compare_outline(
                near_xy,
                dot_ink,
                touching,
                runs,
                doubtful,
                outline_pixels,
                dots_and_error[0],
                readout_us[scan],
                keys,
                event_count,
            )
            end_row = first_row
        what = (near_xy, row_xy, ink, pixels)
        event_count = _compare_across(*what, first_row, end_row, runs, *when, line, keys, event_count)
        if cut_left < cut_right:
            event_count = _compare_across(*what, ZERO, cut_rows, cut_runs, *when, line, keys, event_count)
        line_events += event_count - before
    return event_count, line_events


@njit(cache=True, inline="always")
def _places(
    places: NDArray[np.float64], dots: int, scans: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return scratch beyond that of `slice_places`: positions in all scans (dots, scans, 2), boxes, twice (dots, 2)."""
    first = 4 * dots * scans + 8 * dots + 4
    boxes = first + 2 * dots * scans
    last = boxes + 4 * dots
    return (
        places[first:boxes].reshape(dots, scans, 2),
        places[boxes:last].reshape(dots, 4),
        places[last : last + 2 * dots].reshape(dots, 2),
        places[last + 2 * dots : last + 4 * dots].reshape(dots, 2),
    )


# A box that contains all pixels whose level can change: left, top, right, bottom.
Reach = tuple[float, float, float, float]


@njit(cache=True, _nrt=False)
def _reach_of_outline(
    start: EdgePlace, end: EdgePlace, rows: int, columns: int, seen_corner: NDArray[np.float64]
) -> Reach:
    """Return the pixels whose level an outline of this size can change in a slice; none without rows."""
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
    return left, top, right, bottom


@njit(cache=True, _nrt=False)
def _reach_of_cut(start: EdgePlace, end: EdgePlace, cut_half: float, seen_cut_x: NDArray[np.float64]) -> Reach:
    """Return the columns, in all rows, whose level the cut edge can change in a slice."""
    left = np.inf
    right = -np.inf
    for row in range(len(seen_cut_x)):
        left = min(left, start.cut_x_px[row] - cut_half, end.cut_x_px[row] - cut_half, seen_cut_x[row] - cut_half)
        right = max(right, start.cut_x_px[row] + cut_half, end.cut_x_px[row] + cut_half, seen_cut_x[row] + cut_half)
    return left, -np.inf, right, np.inf


@njit(cache=True, _nrt=False)
def _reaches(box: NDArray[np.float64], outer: float, reach: Reach) -> bool:
    """Return whether the ring of a dot in a box (4,) can cover a pixel of a reach."""
    left, top, right, bottom = reach
    reach_x = box[2] + outer
    reach_y = box[3] + outer
    across = left <= box[0] + reach_x and box[0] - reach_x <= right
    return bool(across and top <= box[1] + reach_y and box[1] - reach_y <= bottom)


@njit(cache=True, _nrt=False)
def _touch_dots(
    at_xy: NDArray[np.float64],
    seen_xy: NDArray[np.float64],
    list_box: NDArray[np.float64],
    outer: float,
    over: tuple[int, int, int, int],
    runs: NDArray[np.int64],
    touched: NDArray[np.uint8],
) -> None:
    """Mark the dots near pixels whose references a line has just changed, and discard their lists.

    `runs` (height, 4) holds these pixels: in a row those from the first column up to the second, and from the third up
    to the fourth. They are all inside the box `over`: rows from, up to, columns from, up to.
    """
    first_row, end_row, first_column, end_column = over
    for dot in range(len(list_box)):
        left = min(at_xy[dot, 0], seen_xy[dot, 0])
        right = max(at_xy[dot, 0], seen_xy[dot, 0])
        top = min(at_xy[dot, 1], seen_xy[dot, 1])
        bottom = max(at_xy[dot, 1], seen_xy[dot, 1])
        if not math.isnan(list_box[dot, 0]):
            left = min(left, list_box[dot, 0] - list_box[dot, 2])
            right = max(right, list_box[dot, 0] + list_box[dot, 2])
            top = min(top, list_box[dot, 1] - list_box[dot, 3])
            bottom = max(bottom, list_box[dot, 1] + list_box[dot, 3])
        left -= outer + 1.0
        right += outer + 1.0
        if right < first_column or left > end_column:
            continue
        first = max(first_row, math.floor(top - outer))
        end = min(end_row, math.ceil(bottom + outer) + 1)
        for row in range(first, end):
            before = runs[row, 0] < runs[row, 1] and runs[row, 0] <= right and left <= runs[row, 1]
            after = runs[row, 2] < runs[row, 3] and runs[row, 2] <= right and left <= runs[row, 3]
            if before or after:
                touched[dot] = 1
                list_box[dot] = np.nan
                break


@njit(cache=True, _nrt=False)
def _dots_in_row(dot_xy: NDArray[np.float64], row: int, outer: float, row_xy: NDArray[np.float64]) -> int:
    """Collect in `row_xy` the dots (dots, 2) whose ring reaches a row; return their number."""
    dots = 0
    for dot in range(len(dot_xy)):
        row_xy[dots, 0] = dot_xy[dot, 0]
        row_xy[dots, 1] = dot_xy[dot, 1]
        dots += int(abs(row - dot_xy[dot, 1]) <= outer)
    return dots


@njit(cache=True, _nrt=False)
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
    """Apply the lines' levels at pixels first to end of a row: shift the references by their change, opposite sign.

    The pixels of the window have their own references; those of the gel under them have no effect. The runs of the
    window become due for comparison earlier (see window), by the change that the lines have used up.
    """
    window_rows, window_columns = window_reference.shape
    left = max(first, first_x) - first_x
    right = min(end, first_x + window_columns) - first_x
    own = row - first_y
    if 0 <= own < window_rows and left < right:
        for run in range(left // RUN_PX, (right - 1) // RUN_PX + 1):
            most = np.float32(0.0)
            for x in range(max(left, run * RUN_PX), min(right, (run + 1) * RUN_PX)):
                before = window_reference[own, x]
                window_reference[own, x] -= line[x + first_x - first] - seen_level[row, x + first_x]
                most = max(most, abs(window_reference[own, x] - before))
            due_at[own, run] -= most * ROUNDED_UP
            row_due_at[own] = min(row_due_at[own], due_at[own, run])
    for k in range(end - first):
        reference[row, first + k] -= line[k] - seen_level[row, first + k]
        seen_level[row, first + k] = line[k]
        lower2_px2[row, first + k] = np.inf


@njit(cache=True, _nrt=False)
def _compare_across(
    dot_xy: NDArray[np.float64],
    row_xy: NDArray[np.float64],
    ink: tuple[Any, ...],
    pixels: tuple[Any, ...],
    first_row: int,
    end_row: int,
    runs: NDArray[np.int64],
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    line: NDArray[np.float32],
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Compare the pixels of `runs` (height, 4) in some rows of the frame, those of the gel and those of the window.

    `dot_xy` and `ink` describe the image of both, `pixels` their state; `row_xy` and `line` are scratch.
    """
    inner, outer, steps_per_px, profile, own_shapes, texture, place = ink
    reference, threshold, middle_shift, release_us, lower2, first_x, first_y = pixels[:7]
    window_reference, window_threshold, window_middle_shift, window_release_us, due_at, row_due_at = pixels[7:]
    window_rows, window_columns = window_reference.shape
    for row in range(first_row, end_row):
        if runs[row, 0] >= runs[row, 1] and runs[row, 2] >= runs[row, 3]:
            continue
        seen_xy = dot_xy  # a dot's own shape is found by its number
        if not len(own_shapes[0]):
            seen_xy = row_xy[: _dots_in_row(dot_xy, row, outer, row_xy)]
        own = row - first_y
        for side in range(2):
            first = runs[row, 2 * side]
            end = runs[row, 2 * side + 1]
            if first >= end:
                continue
            optics.dot_row(seen_xy, inner, outer, steps_per_px, profile, *own_shapes, row, first, end, line)
            event_count = compare_row(
                line,
                reference,
                threshold,
                middle_shift,
                release_us,
                row,
                first,
                end,
                (ZERO, ZERO),
                readout_us,
                now_us,
                refractory_us,
                keys,
                event_count,
            )
            for x in range(first, end):
                lower2[row, x] = np.inf
            left = max(first, first_x) - first_x
            right = min(end, first_x + window_columns) - first_x
            if not 0 <= own < window_rows or left >= right:
                continue
            optics.sample_texture_run(texture, place, own, left, right, line)
            event_count = compare_row(
                line,
                window_reference,
                window_threshold,
                window_middle_shift,
                window_release_us,
                own,
                left,
                right,
                (first_x, first_y),
                readout_us,
                now_us,
                refractory_us,
                keys,
                event_count,
            )
            if window_release_us.size:  # a pixel that fired without becoming blind is further from its threshold
                mark_due(due_at, row_due_at, own, left, right)
    return event_count
