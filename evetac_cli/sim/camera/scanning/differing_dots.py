"""Scans of dots that differ: the steps that they require in addition to the scans of `dots`.

A single dot is scanned with its own radii and levels. But radii that were computed for one dot are invalid for another
(see pixel_culling), and of neighbouring dots the darkest counts instead of the nearest. Both cases are rare, because
dots are well separated, and are handled in a simple way here.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.readout import event_key
from evetac_cli.sim.camera.scanning.pixel_culling import COLUMN_MASK, PIXEL_SHIFT
from evetac_cli.sim.camera.scanning.pixels import CandidatePixels

VISITED_PX = 2.0  # margin that a dot may move beyond its visited area before it is checked again for meeting another


@njit(cache=True, _nrt=False)
def forget_exchanged(
    box: NDArray[np.float64], outer: float, visited: NDArray[np.float64], candidates: CandidatePixels
) -> None:
    """Discard all radii and lists when a dot may cover pixels that a dot of another shape may have covered.

    Radii follow from the shape of the dot for which they were computed. `visited` (dots, 4) holds left, right, top and
    bottom of the area that each dot has visited since, with a margin of VISITED_PX; NaN if it must always be checked.
    """
    dots = len(box)
    met = False
    for dot in range(dots):
        left, right = box[dot, 0] - box[dot, 2], box[dot, 0] + box[dot, 2]
        top, bottom = box[dot, 1] - box[dot, 3], box[dot, 1] + box[dot, 3]
        within = visited[dot, 0] <= left and right <= visited[dot, 1]
        if within and visited[dot, 2] <= top and bottom <= visited[dot, 3]:
            continue
        if math.isnan(visited[dot, 0]):
            met = True
        visited[dot, 0] = min(visited[dot, 0], left - VISITED_PX)
        visited[dot, 1] = max(visited[dot, 1], right + VISITED_PX)
        visited[dot, 2] = min(visited[dot, 2], top - VISITED_PX)
        visited[dot, 3] = max(visited[dot, 3], bottom + VISITED_PX)
        for other in range(dots):
            met = met or (other != dot and _meet(visited, dot, other, outer))
    if not met:
        return
    candidates.lower2_px2[:] = np.inf
    candidates.list_box[:] = np.nan
    for dot in range(dots):
        visited[dot, 0] = box[dot, 0] - box[dot, 2] - VISITED_PX
        visited[dot, 1] = box[dot, 0] + box[dot, 2] + VISITED_PX
        visited[dot, 2] = box[dot, 1] - box[dot, 3] - VISITED_PX
        visited[dot, 3] = box[dot, 1] + box[dot, 3] + VISITED_PX
    meets = candidates.flags[3]
    meets[:] = 0
    for dot in range(dots):
        for other in range(dot):
            if _meet(visited, dot, other, outer):
                meets[dot] = 1
                meets[other] = 1
    for dot in range(dots):
        if meets[dot]:
            visited[dot] = np.nan


@njit(cache=True, _nrt=False)
def _meet(visited: NDArray[np.float64], dot: int, other: int, outer: float) -> bool:
    """Return whether some pixel may have been under two dots."""
    across = visited[dot, 0] - 2.0 * outer <= visited[other, 1] and visited[other, 0] <= visited[dot, 1] + 2.0 * outer
    down = visited[dot, 2] - 2.0 * outer <= visited[other, 3] and visited[other, 2] <= visited[dot, 3] + 2.0 * outer
    return bool(across and down)


@njit(cache=True, _nrt=False)
def compare_crowded(
    active: NDArray[np.int32],
    at_xy: NDArray[np.float64],
    inner: NDArray[np.float64],
    outer: NDArray[np.float64],
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    middle_shift: NDArray[np.float32],
    release_us: NDArray[np.float64],
    lower2_px2: NDArray[np.float32],
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    first_scan: int,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Compare some pixels in every scan with the darkest level of differing dots (dots, scans, 2)."""
    dots, shots, _ = at_xy.shape
    scan_us = SLICE_US / len(readout_us)
    shifted, blinding = middle_shift.size > 0, release_us.size > 0
    for pixel in active:
        y = pixel >> PIXEL_SHIFT
        x = pixel & COLUMN_MASK
        lower2_px2[y, x] = np.inf
        for shot in range(shots):
            level = np.float32(0.0)
            for dot in range(dots):
                across = np.float32(x - at_xy[dot, shot, 0])
                down = np.float32(y - at_xy[dot, shot, 1])
                if max(abs(across), abs(down)) <= outer[dot]:
                    distance2 = across * across + down * down
                    position = optics.profile_position(distance2, np.float32(inner[dot]), np.float32(steps_per_px))
                    level = min(level, optics.profile_level(position, profile[dot]))
            now_us = t0_us + (first_scan + shot) * scan_us
            shift = middle_shift[y, x] if shifted else np.float32(0.0)
            if blinding and release_us[y, x] > now_us:
                reference[y, x] = level + shift
                continue
            change = level - reference[y, x]
            if abs(change) < threshold[y, x]:
                continue
            reference[y, x] = level + shift
            if event_count < len(keys):
                keys[event_count] = event_key(readout_us[first_scan + shot, x], x, y, change > 0)
            event_count += 1
            if blinding:
                release_us[y, x] = now_us + refractory_us
    return event_count
