"""Scans of the window: the events of a texture that slides by or fades.

Why so: a level of the window changes by no more than the texture's steepest slope times the travel of the object. A
short run of pixels is not compared until that has used up what the pixel nearest to its threshold lacks to it.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import ObjectMotion
from evetac_cli.sim.camera.event_keys import event_key
from evetac_cli.sim.camera.scanning.pixels import RUN_PX, ScanTimes, WindowPixels

# Where levels change by more in a scan, or fade, a run would be left out for too few scans to be worth its finding.
FAST_LEVEL = 0.002
# More than single precision costs a level of the window, relative to the greatest.
RUN_ROUNDING = 4e-6


@njit(cache=True)
def scan_window(
    motion: ObjectMotion,
    window: WindowPixels,
    times: ScanTimes,
    first_scan: int,
    end_scan: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare the window's runs of pixels that may fire, in every scan at which the picture is another."""
    start_xy, end_xy, contrast = motion
    first_x, first_y, seen, texture, reference, threshold, release_us, candidate_runs = window
    readout_us, t0_us, refractory_us = times
    scans = len(readout_us)
    rows, columns = reference.shape
    runs = candidate_runs.due_at.shape[1]
    line = np.empty(columns, np.float32)
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
                optics.sample_texture_run(texture, *place, row, 0, columns, line)
                reference[row] += line
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
        for row in range(rows):
            if not fast and travelled < candidate_runs.row_due_at[row]:
                continue
            due_at = candidate_runs.due_at[row]
            run = 0
            while run < runs:
                if not fast and travelled < due_at[run]:
                    run += 1
                    continue
                first_run = run
                while run < runs and (fast or travelled >= due_at[run]):
                    run += 1
                first = first_run * RUN_PX
                end = min(run * RUN_PX, columns)
                optics.sample_texture_run(texture, *place, row, first, end, line)
                blind_until_us = release_us[row, first:end]
                made = compare_row(
                    line,
                    reference[row, first:end],
                    threshold[row, first:end],
                    blind_until_us,
                    first_x + first,
                    first_y + row,
                    readout_us[scan],
                    now_us,
                    refractory_us,
                    keys,
                    made,
                )
                if fast:  # runs that were not due stay so: they have not fired
                    continue
                for due_run in range(first_run, run):
                    begin = due_run * RUN_PX
                    beyond = min(begin + RUN_PX, columns)
                    slack = _least_slack(
                        line[begin - first : beyond - first],
                        reference[row, begin:beyond],
                        threshold[row, begin:beyond],
                        blind_until_us[begin - first : beyond - first],
                        now_us,
                    )
                    due_at[due_run] = travelled + slack - rounding
            if not fast:
                candidate_runs.row_due_at[row] = due_at.min()
    return made


@njit(cache=True)
def _least_slack(
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    now_us: float,
) -> float:
    """By how much levels side by side may surely change before any pixel fires; none while one of them is blind."""
    for k in range(len(release_us)):
        if release_us[k] > now_us:
            return -np.inf
    least = np.float32(np.inf)
    for k in range(len(level)):
        least = min(least, threshold[k] * np.float32(1.0 - RUN_ROUNDING) - abs(level[k] - reference[k]))
    return float(least)


@njit(cache=True)
def compare_row(
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    first_x: int,
    y: int,
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare pixels side by side, the first of which is (first_x, y), with the first levels.

    `release_us` is empty where no pixel gets blind.
    """
    for k in range(len(release_us)):
        if release_us[k] > now_us:
            reference[k] = level[k]
    # Most rows have nothing to report, and counting vectorises.
    fired = 0
    for k in range(len(reference)):
        fired += int(abs(level[k] - reference[k]) >= threshold[k])
    if fired == 0:
        return made
    for k in range(len(reference)):
        change = level[k] - reference[k]
        if abs(change) >= threshold[k]:
            reference[k] = level[k]
            if len(release_us):
                release_us[k] = now_us + refractory_us
            if made < len(keys):
                keys[made] = event_key(readout_us[first_x + k], first_x + k, y, change > 0)
            made += 1
    return made


@njit(cache=True)
def mark_due(due_at: NDArray[np.float64], row_due_at: NDArray[np.float64], row: int, first: int, end: int) -> None:
    """Have the runs of a row of the window that hold pixels first to end compared when the object next moves."""
    for run in range(first // RUN_PX, (end - 1) // RUN_PX + 1):
        due_at[row, run] = -np.inf
    row_due_at[row] = -np.inf
