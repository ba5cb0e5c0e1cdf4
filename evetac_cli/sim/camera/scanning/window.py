"""Scans of the window: the events of a texture that slides by or fades.

A level of the window changes by at most the texture's steepest slope times the motion of the object. A short run of
pixels is not compared until that product reaches the slack of the pixel nearest to its threshold.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import ObjectMotion
from evetac_cli.sim.camera.readout import event_key
from evetac_cli.sim.camera.scanning.pixels import RUN_PX, ZERO, ScanTimes, WindowPixels

# If levels change faster per scan, or fade, a run would be skipped in too few scans to be worth the computation.
FAST_LEVEL = 0.002
# Upper bound of single precision's error of a window level, relative to the highest level.
RUN_ROUNDING = 4e-6


@njit(cache=True, _nrt=False)
def scan_window(
    motion: ObjectMotion,
    window: WindowPixels,
    times: ScanTimes,
    first_scan: int,
    end_scan: int,
    line: NDArray[np.float32],
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Compare the window's runs of pixels that may fire, in every scan in which the image has changed.

    `line` is scratch for a row.
    """
    start_xy, end_xy, contrast = motion
    first_x, first_y, seen, texture, reference, threshold, release_us, candidate_runs, middle_shift = window
    readout_us, t0_us, refractory_us = times
    scans = len(readout_us)
    rows, columns = reference.shape
    for scan in range(first_scan, end_scan):
        part = scan / scans
        x = start_xy[0] + part * (end_xy[0] - start_xy[0])
        y = start_xy[1] + part * (end_xy[1] - start_xy[1])
        change = contrast * (candidate_runs.across * abs(x - seen[0]) + candidate_runs.down * abs(y - seen[1]))
        first_look = math.isnan(seen[2])
        faded = contrast != seen[2]
        seen[0] = x
        seen[1] = y
        seen[2] = contrast
        place = optics.texture_place(texture, first_x, first_y, x, y, contrast)
        if first_look:
            for row in range(rows):
                optics.sample_texture_run(texture, place, row, ZERO, columns, line)
                for column in range(columns):
                    reference[row, column] += line[column]
            continue
        if faded:
            candidate_runs.due_at[:] = -np.inf
            candidate_runs.row_due_at[:] = -np.inf
        elif change == 0.0:
            continue
        else:
            candidate_runs.travelled[0] += change
        travelled = candidate_runs.travelled[0]
        fast = faded or change > FAST_LEVEL
        rounding = RUN_ROUNDING * contrast * candidate_runs.greatest
        now_us = t0_us + scan * SLICE_US / scans
        pixels = (reference, threshold, middle_shift, release_us)
        when = (readout_us[scan], now_us, refractory_us)
        # Below, arguments are passed one by one: with tuples for each row, a row took 1.6 times as long.
        if fast:  # runs that were not due remain valid: they have not fired
            for row in range(rows):
                optics.sample_texture_run(texture, place, row, ZERO, columns, line)
                event_count = compare_row(
                    line,
                    reference,
                    threshold,
                    middle_shift,
                    release_us,
                    row,
                    ZERO,
                    columns,
                    (first_x, first_y),
                    readout_us[scan],
                    now_us,
                    refractory_us,
                    keys,
                    event_count,
                )
            continue
        for row in range(rows):
            if travelled >= candidate_runs.row_due_at[row]:
                event_count = _compare_due(
                    texture,
                    place,
                    *pixels,
                    (first_x, first_y),
                    *when,
                    line,
                    keys,
                    event_count,
                    row,
                    candidate_runs.due_at,
                    candidate_runs.row_due_at,
                    travelled,
                    rounding,
                )
    return event_count


@njit(cache=True, _nrt=False)
def _compare_due(
    texture: NDArray[np.float32],
    place: optics.TexturePlace,
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    middle_shift: NDArray[np.float32],
    release_us: NDArray[np.float64],
    corner: tuple[int, int],
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    line: NDArray[np.float32],
    keys: NDArray[np.int64],
    event_count: int,
    row: int,
    due_at: NDArray[np.float64],
    row_due_at: NDArray[np.float64],
    travelled: float,
    rounding: float,
) -> int:
    """Compare the runs of a row that are due, and compute when they and the row are due again."""
    columns = reference.shape[1]
    least = np.inf
    for run in range(due_at.shape[1]):
        if travelled < due_at[row, run]:
            least = min(least, due_at[row, run])
            continue
        first = run * RUN_PX
        end = min(first + RUN_PX, columns)
        optics.sample_texture_run(texture, place, row, first, end, line)
        slack = _least_slack(line, reference, threshold, release_us, row, first, end, now_us)
        if not slack > 0.0:
            event_count = compare_row(
                line,
                reference,
                threshold,
                middle_shift,
                release_us,
                row,
                first,
                end,
                corner,
                readout_us,
                now_us,
                refractory_us,
                keys,
                event_count,
            )
            slack = _least_slack(line, reference, threshold, release_us, row, first, end, now_us)
        due_at[row, run] = travelled + slack - rounding
        least = min(least, due_at[row, run])
    row_due_at[row] = least
    return event_count


@njit(cache=True, _nrt=False)
def _least_slack(
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    row: int,
    first: int,
    end: int,
    now_us: float,
) -> float:
    """Return the change of levels that pixels first to end of a row certainly allow before any fires.

    Minus infinity while one of them is blind. If the result is above 0, none fires now.
    """
    if release_us.size:
        for x in range(first, end):
            if release_us[row, x] > now_us:
                return -np.inf
    least = np.float32(np.inf)
    y, offset = np.uint64(row), np.uint64(first)
    for x in range(np.uint64(first), np.uint64(end)):
        least = min(least, threshold[y, x] * np.float32(1.0 - RUN_ROUNDING) - abs(level[x - offset] - reference[y, x]))
    return float(least)


@njit(cache=True, _nrt=False)
def compare_row(
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    middle_shift: NDArray[np.float32],
    release_us: NDArray[np.float64],
    row: int,
    first: int,
    end: int,
    corner: tuple[int, int],
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Compare pixels first to end of a row with the first levels; `corner` is pixel (0, 0)'s position in the frame.

    `release_us` is empty if no pixel becomes blind. Arguments are whole arrays, because slices of the arrays for each
    row took four times as long as the comparison.
    """
    blinding = release_us.size > 0
    shifted = middle_shift.size > 0
    if blinding:
        for x in range(first, end):
            if release_us[row, x] > now_us:
                reference[row, x] = level[x - first] + middle_shift[row, x] if shifted else level[x - first]
    # Most rows have no event, and counting vectorises.
    fired = np.int32(0)
    y, offset = np.uint64(row), np.uint64(first)
    for x in range(np.uint64(first), np.uint64(end)):
        fired += np.int32(abs(level[x - offset] - reference[y, x]) >= threshold[y, x])
    if fired == 0:
        return event_count
    for x in range(np.uint64(first), np.uint64(end)):
        change = level[x - offset] - reference[y, x]
        if abs(change) >= threshold[y, x]:
            reference[y, x] = level[x - offset] + middle_shift[y, x] if shifted else level[x - offset]
            if blinding:
                release_us[y, x] = now_us + refractory_us
            column = corner[0] + np.int64(x)
            if event_count < len(keys):
                keys[event_count] = event_key(readout_us[column], column, corner[1] + row, change > 0)
            event_count += 1
    return event_count


@njit(cache=True, _nrt=False)
def mark_due(due_at: NDArray[np.float64], row_due_at: NDArray[np.float64], row: int, first: int, end: int) -> None:
    """Make the runs of a window row that contain pixels first to end due for comparison when the object next moves."""
    for run in range(first // RUN_PX, (end - 1) // RUN_PX + 1):
        due_at[row, run] = -np.inf
    row_due_at[row] = -np.inf
