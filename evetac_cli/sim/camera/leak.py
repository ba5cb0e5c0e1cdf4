"""Leak: every reference decreases at a rate at which an undisturbed pixel fires ON `leak_hz` times per second.

Each row of pixels is visited once in LEAK_SLICES slices, so leak events are late by up to that time. Each row has
one of the slice's scans. After an event the reference keeps the leak since the crossing, because the rate would
otherwise be too low.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.readout import event_key
from evetac_cli.sim.camera.scanning.pixels import GelPixels, ScanTimes, WindowPixels

# Slices in which leak visits every row once: a divisor of 480, so that all slices visit the same number of rows.
LEAK_SLICES = 40


def drift(leak_hz: float) -> float:
    """Return how far a reference decreases from one visit to the next, in thresholds."""
    return leak_hz * LEAK_SLICES * SLICE_US * 1e-6


@njit(cache=True, _nrt=False)
def leak_in_scans(
    first_row: int,
    drift: np.float32,
    gel: GelPixels,
    window: WindowPixels,
    times: ScanTimes,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Lower the references of every LEAK_SLICES-th row of a scanning camera, and compare these pixels."""
    dot_xy = gel.seen_dot_xy_px
    reference, threshold, release_us, candidates = gel.reference, gel.threshold, gel.release_us, gel.candidates
    line = candidates.line
    shifted, nothing = gel.middle_shift.size > 0, line[:0]
    inner, outer, steps_per_px, profile = gel.profile
    ink = (inner, outer, steps_per_px, profile, gel.shapes.inner_px, gel.shapes.outer_px, gel.shapes.level)
    first_x, first_y, object_seen, texture = window.first_x, window.first_y, window.seen_object, window.texture
    readout_us, t0_us, refractory_us = times
    height, width = reference.shape
    window_rows, window_columns = window.reference.shape
    scans = len(readout_us)
    candidates.list_box[:] = np.nan
    for row in range(first_row, height, LEAK_SLICES):
        scan = (row // LEAK_SLICES) % scans
        when = (drift, row, readout_us[scan], t0_us + scan * SLICE_US / scans, refractory_us, keys)
        optics.dot_row(dot_xy, *ink, row, 0, width, line)
        own_shift = gel.middle_shift[row] if shifted else nothing
        event_count = _leak_row(line, reference[row], threshold[row], own_shift, release_us[row], 0, *when, event_count)
        candidates.lower2_px2[row] = np.inf
        in_window = row - first_y
        if 0 <= in_window < window_rows:
            place = optics.texture_place(texture, first_x, first_y, object_seen[0], object_seen[1], object_seen[2])
            optics.sample_texture_run(texture, place, in_window, 0, window_columns, line)
            own_shift = window.middle_shift[in_window] if shifted else nothing
            pixels = (window.reference[in_window], window.threshold[in_window], own_shift, window.release_us[in_window])
            event_count = _leak_row(line, *pixels, first_x, *when, event_count)
            window.candidate_runs.due_at[in_window] = -np.inf
            window.candidate_runs.row_due_at[in_window] = -np.inf
    return event_count


@njit(cache=True, _nrt=False)
def _leak_row(
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    middle_shift: NDArray[np.float32],
    release_us: NDArray[np.float64],
    first_x: int,
    drift: np.float32,
    y: int,
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Lower the references of pixels side by side; a pixel whose level is a threshold above its reference fires."""
    for k in range(len(reference)):
        step = threshold[k]
        if step == np.inf:  # a pixel under the window, which has its own references
            continue
        if len(release_us) and release_us[k] > now_us:
            reference[k] = level[k] + middle_shift[k] if len(middle_shift) else level[k]
            continue
        to_on = step + middle_shift[k] if len(middle_shift) else step
        reference[k] -= drift * to_on
        if level[k] - reference[k] < step:
            continue
        reference[k] += to_on
        if len(release_us):
            release_us[k] = now_us + refractory_us
        if event_count < len(keys):
            keys[event_count] = event_key(readout_us[first_x + k], first_x + k, y, True)
        event_count += 1
    return event_count
