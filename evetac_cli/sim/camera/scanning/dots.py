"""Scans of the gel: the events of moving dots, from the pixels that may fire (see pixel_culling).

Every pixel is compared with the complete image of its scan, so it has at most one event per scan; a dot at rest is not
visited.

Below the functions that Python calls, the compiled parts of both cameras take their arrays one by one. With named
tuples of arrays throughout (dots, pixels, window) the events were the same, but a mix of motions took 1.4 times as
long, and compiling 1.2 times. The reason is that numba counts references to every array of a group wherever the group
is passed.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import dot_rings, optics
from evetac_cli.sim.camera.readout import event_key
from evetac_cli.sim.camera.scanning.differing_dots import compare_crowded, forget_exchanged
from evetac_cli.sim.camera.scanning.pixel_culling import (
    COLUMN_MASK,
    PIXEL_SHIFT,
    RESOLUTION_PX,
    RUSH_PX,
    is_within,
    make_list,
    reach_of_list,
    renew_listed,
    ring_pixels,
    select_active,
    select_listed,
    select_own,
)
from evetac_cli.sim.camera.scanning.pixels import FALSE, TRUE, CandidatePixels, GelPixels, ScanTimes, slice_places

# A dot that has lost its list to a line gets a new list after this many scans without a line. In each of them its whole
# ring is compared, which costs about as much as making a list.
LEFT_ALONE_SCANS = 10
COUNTED_PX = 16  # pixels of a row that are counted together


@njit(cache=True, _nrt=False)
def scan_dots(
    path: NDArray[np.float64],
    gel: GelPixels,
    times: ScanTimes,
    first_scan: int,
    end_scan: int,
    touched: NDArray[np.uint8],
    apart: bool,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Compare the pixels that may fire in some scans; return the number of events, including those that do not fit.

    Dots move along paths (dots, k + 1, 2) over the slice. For dots that a line has `touched` nothing is stored. With
    `apart` no two rings overlap.
    """
    seen_xy = gel.seen_dot_xy_px
    inner, outer, steps_per_px, profile = gel.profile
    reference, threshold, release_us = gel.reference, gel.threshold, gel.release_us
    candidates, middle_shift = gel.candidates, gel.middle_shift
    least_inner, greatest_outer = inner, outer
    own_inner, own_outer, own_level, visited = gel.shapes
    differing = len(own_inner) > 0
    readout_us, t0_us, refractory_us = times
    dots = len(path)
    scans = len(readout_us)
    single = end_scan == first_scan + 1 and release_us.size == 0
    at_xy, near_xy, box, near_box, wider = slice_places(candidates.places, dots, end_scan - first_scan)
    at_scans(path, scans, first_scan, at_xy)
    dot_rings.boxes(at_xy, seen_xy, box)
    crowded = candidates.flags[2]
    crowded[:] = 0
    if not apart:
        dot_rings.crowded(box, outer, crowded)
    if differing:
        forget_exchanged(box, outer, visited, candidates)
    now_us = t0_us + first_scan * SLICE_US / scans
    last_us = t0_us + (end_scan - 1) * SLICE_US / scans
    for dot in range(dots):
        if max(box[dot, 2], box[dot, 3]) <= 0.5 * RESOLUTION_PX:
            continue
        near = 1
        if differing:
            inner, outer, profile = own_inner[dot], own_outer[dot], own_level[dot]
        if crowded[dot] and differing:
            candidates.list_box[dot] = np.nan
            count = ring_pixels(box[dot], least_inner, greatest_outer, FALSE, candidates)
            count = select_own(dot, count, box, least_inner, greatest_outer, candidates)
            event_count = compare_crowded(
                candidates.active[:count],
                at_xy,
                own_inner,
                own_outer,
                steps_per_px,
                own_level,
                reference,
                threshold,
                middle_shift,
                release_us,
                candidates.lower2_px2,
                readout_us,
                t0_us,
                refractory_us,
                first_scan,
                keys,
                event_count,
            )
            count = 0
        elif crowded[dot]:
            near = dot_rings.dots_near(dot, at_xy, box, outer, near_xy, near_box)
            candidates.list_box[dot] = np.nan
            count = ring_pixels(box[dot], inner, outer, FALSE, candidates)
            count = select_own(dot, count, box, inner, outer, candidates)
            count = select_active(
                candidates.active[:count],
                near_box[:near],
                inner,
                outer,
                steps_per_px,
                profile,
                reference,
                threshold,
                release_us,
                now_us,
                candidates,
            )
        elif single and (touched[dot] or _waits_for_list(dot, candidates)):
            candidates.list_length[dot] = -1 if touched[dot] else min(candidates.list_length[dot], 0) - 1
            count = 0
            reach_of_list(box[dot], wider[0])
            event_count = _compare_ring(
                wider[0],
                at_xy[dot, 0],
                inner,
                outer,
                steps_per_px,
                profile,
                reference,
                threshold,
                middle_shift,
                candidates.lower2_px2,
                readout_us[first_scan],
                keys,
                event_count,
            )
        elif touched[dot]:
            candidates.list_length[dot] = -1
            reach_of_list(box[dot], wider[0])
            count = ring_pixels(wider[0], inner, outer, TRUE, candidates)
        else:
            if not is_within(box, candidates.list_box, dot):
                make_list(
                    dot,
                    box[dot],
                    wider,
                    inner,
                    outer,
                    steps_per_px,
                    profile,
                    reference,
                    threshold,
                    release_us,
                    now_us,
                    candidates,
                )
            if candidates.list_length[dot] >= 0:
                count = select_listed(
                    dot,
                    box,
                    candidates.list_length[dot],
                    candidates.listed,
                    candidates.listed_px2,
                    candidates.active,
                    candidates.entry,
                )
            else:
                rushes = max(box[dot, 2], box[dot, 3]) > RUSH_PX
                count = ring_pixels(box[dot], inner, outer, not rushes, candidates)
                if not rushes:
                    count = select_active(
                        candidates.active[:count],
                        box[dot : dot + 1],
                        inner,
                        outer,
                        steps_per_px,
                        profile,
                        reference,
                        threshold,
                        release_us,
                        now_us,
                        candidates,
                    )
        if count > 0:
            seen_by = near_xy[:near] if crowded[dot] else at_xy[dot : dot + 1]
            event_count = _compare_pixels(
                candidates.active[:count],
                seen_by,
                inner,
                steps_per_px,
                profile,
                reference,
                threshold,
                middle_shift,
                release_us,
                candidates.lower2_px2,
                candidates.upper2_px2,
                readout_us,
                t0_us,
                refractory_us,
                first_scan,
                keys,
                event_count,
            )
            if not crowded[dot] and candidates.list_length[dot] >= 0:
                renew_listed(
                    dot,
                    count,
                    inner,
                    outer,
                    steps_per_px,
                    profile,
                    reference,
                    threshold,
                    release_us,
                    last_us,
                    candidates,
                )
        for axis in range(2):
            seen_xy[dot, axis] = at_xy[dot, end_scan - first_scan - 1, axis]
    return event_count


@njit(cache=True, _nrt=False)
def _waits_for_list(dot: int, candidates: CandidatePixels) -> bool:
    """Return whether a dot has no list, and lines have not left it alone for long enough to make one."""
    return bool(math.isnan(candidates.list_box[dot, 0]) and candidates.list_length[dot] >= -LEFT_ALONE_SCANS)


@njit(cache=True, _nrt=False)
def at_scans(path: NDArray[np.float64], scans: int, first_scan: int, at_xy: NDArray[np.float64]) -> None:
    """Fill at_xy (dots, k, 2) with the positions of dots at k scans, starting with first_scan."""
    dots, vertices, _ = path.shape
    for shot in range(at_xy.shape[1]):
        vertex, over = divmod((first_scan + shot) * (vertices - 1), scans)
        part = over / scans
        for dot in range(dots):
            for axis in range(2):
                piece_px = path[dot, vertex + 1, axis] - path[dot, vertex, axis]
                at_xy[dot, shot, axis] = path[dot, vertex, axis] + part * piece_px


@njit(cache=True, _nrt=False)
def _compare_ring(
    ring: NDArray[np.float64],
    at_xy: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    middle_shift: NDArray[np.float32],
    lower2_px2: NDArray[np.float32],
    readout_us: NDArray[np.int64],
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Compare all pixels in the ring of a box (4,) in one scan with the levels of a single dot at (2,).

    Like `_compare_pixels`, without radii; not for pixels with a refractory period.
    """
    height, width = reference.shape
    ink_px, steps = np.float32(inner), np.float32(steps_per_px)
    shifted = middle_shift.size > 0
    first_row, end_row = dot_rings.ring_rows(ring, outer, height)
    for row in range(first_row, end_row):
        left, left_end, right, right_end = dot_rings.ring_runs(ring, inner, outer, row, width)
        y = np.uint64(row)
        down = np.float32(row - at_xy[1])
        down2 = down * down
        for first, end in ((left, left_end), (right, right_end)):
            # Most rows have no event, and counting vectorises: with unsigned indices, nothing written, and a constant
            # number of pixels, of which some may be outside the run, because most runs are shorter than a vector.
            fired = np.int32(width < COUNTED_PX)
            for begin in range(first, end if width >= COUNTED_PX else first, COUNTED_PX):
                offset = np.uint64(min(begin, width - COUNTED_PX))
                for k in range(COUNTED_PX):
                    column = offset + np.uint64(k)
                    across = np.float32(np.int32(column) - at_xy[0])
                    position = optics.profile_position(across * across + down2, ink_px, steps)
                    change = optics.profile_level(position, profile) - reference[y, column]
                    fired += np.int32(not (abs(change) < threshold[y, column]))
            if fired == 0:
                continue
            for x in range(first, end):
                across = np.float32(x - at_xy[0])
                position = optics.profile_position(across * across + down2, ink_px, steps)
                level = optics.profile_level(position, profile)
                change = level - reference[row, x]
                if abs(change) < threshold[row, x]:
                    continue
                reference[row, x] = level + middle_shift[row, x] if shifted else level
                lower2_px2[row, x] = np.inf
                if event_count < len(keys):
                    keys[event_count] = event_key(readout_us[x], x, row, change > 0)
                event_count += 1
    return event_count


@njit(cache=True, _nrt=False)
def _compare_pixels(
    active: NDArray[np.int32],
    near_xy: NDArray[np.float64],
    inner: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    middle_shift: NDArray[np.float32],
    release_us: NDArray[np.float64],
    lower2_px2: NDArray[np.float32],
    upper2_px2: NDArray[np.float32],
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    first_scan: int,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Compare some pixels in every scan with the level of the nearest of some dots (near, scans, 2).

    Until a pixel fires, its radii exclude it in most scans; its new radii are computed when they are next needed.
    """
    near, shots, _ = near_xy.shape
    scan_us = SLICE_US / len(readout_us)
    blinding = release_us.size > 0
    shifted = middle_shift.size > 0
    for pixel in active:
        y = pixel >> PIXEL_SHIFT
        x = pixel & COLUMN_MASK
        lower2 = lower2_px2[y, x]
        upper2 = upper2_px2[y, x]
        for shot in range(shots):
            distance2 = np.float32(np.inf)
            for dot in range(near):
                across = np.float32(x - near_xy[dot, shot, 0])
                down = np.float32(y - near_xy[dot, shot, 1])
                distance2 = min(distance2, across * across + down * down)
            if lower2 <= distance2 <= upper2:
                continue
            now_us = t0_us + (first_scan + shot) * scan_us
            position = optics.profile_position(distance2, np.float32(inner), np.float32(steps_per_px))
            level = optics.profile_level(position, profile)
            if blinding and release_us[y, x] > now_us:
                reference[y, x] = level + middle_shift[y, x] if shifted else level
                continue
            change = level - reference[y, x]
            if abs(change) < threshold[y, x]:
                continue
            reference[y, x] = level + middle_shift[y, x] if shifted else level
            if event_count < len(keys):
                keys[event_count] = event_key(readout_us[first_scan + shot, x], x, y, change > 0)
            event_count += 1
            if blinding:
                release_us[y, x] = now_us + refractory_us
            lower2 = np.float32(np.inf)
        lower2_px2[y, x] = lower2
    return event_count
