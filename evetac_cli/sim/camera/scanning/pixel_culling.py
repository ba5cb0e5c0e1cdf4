"""The pixels of the gel that may fire while dots move: the scanning camera compares no others.

The rings of 63 dots (see dot_rings) have 46,000 pixels, but a scan causes only some 200 events if all dots vibrate, and
almost none while the gel creeps.
- Reference and threshold of a pixel determine two distances to the nearest dot between which it certainly does not
  fire. While the box of a dot's path over the slice keeps the distance between them, the pixel costs one comparison.
- For a slow dot even that is done only once in many slices: a list of the pixels that may fire is valid as long as the
  dot stays within a somewhat larger box.

A pixel is a single integer here, y << PIXEL_SHIFT | x; for boxes see dot_rings.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import dot_rings, optics
from evetac_cli.sim.camera.scanning.pixels import TRUE, CandidatePixels

# A dot that has moved by no more than this, on either axis, since it was last compared is at rest. No level has then
# changed by more than 0.0008, and smaller tremor causes no event. This saves the comparison while the gel only creeps.
RESOLUTION_PX = 0.001
RESTS_PX = RESOLUTION_PX * (1.0 - 1e-6)  # at rest regardless of how positions within the path of a slice are rounded
# A dot that moves by `travel_px` gets a list for a box wider by SKIN_PX * sqrt(travel_px) on each side. This minimises
# the sum of two costs: making the list, spread over the slices until the dot has left the box, and the length of the
# list in each slice. From FAST_PX per slice a list does not pay.
SKIN_PX = 0.7
FAST_PX = 0.2
RUSH_PX = 0.25  # half the travel in a slice above which radii do not pay either
PIXEL_SHIFT = 16
COLUMN_MASK = 0xFFFF


@njit(cache=True, _nrt=False)
def rests(
    path: NDArray[np.float64],
    seen_xy: NDArray[np.float64],
    object_start: NDArray[np.float64],
    object_end: NDArray[np.float64],
    contrast: float,
    seen_object: NDArray[np.float64],
    window_reference: NDArray[np.float32],
) -> bool:
    """Return whether a scan would change nothing: no dot moves far enough to be compared, and the object not at all.

    The gel mostly creeps, and passing the arguments of a scan takes longer than this check.
    """
    if window_reference.size:
        for axis in range(2):
            if not object_start[axis] == object_end[axis] == seen_object[axis]:
                return False
        if contrast != seen_object[2]:
            return False
    for dot in range(len(path)):
        for axis in range(2):
            low = seen_xy[dot, axis]
            high = low
            for vertex in range(path.shape[1]):
                low = min(low, path[dot, vertex, axis])
                high = max(high, path[dot, vertex, axis])
            if high - low > RESTS_PX:
                return False
    return True


@njit(cache=True, _nrt=False)
def is_within(box: NDArray[np.float64], wider: NDArray[np.float64], dot: int) -> bool:
    """Return whether a dot's box of (dots, 4) is inside its wider box; false if that is NaN."""
    across = abs(box[dot, 0] - wider[dot, 0]) + box[dot, 2] <= wider[dot, 2]
    return bool(across and abs(box[dot, 1] - wider[dot, 1]) + box[dot, 3] <= wider[dot, 3])


@njit(cache=True, _nrt=False)
def reach_of_list(box: NDArray[np.float64], wider: NDArray[np.float64]) -> None:
    """Fill the wider box (4,) for which the list of a dot in a box (4,) is valid; the same box if no list pays."""
    for side in range(4):
        wider[side] = box[side]
    travel_px = 2.0 * max(box[2], box[3])
    if travel_px < FAST_PX:
        wider[2] += SKIN_PX * math.sqrt(travel_px)
        wider[3] += SKIN_PX * math.sqrt(travel_px)


@njit(cache=True, _nrt=False)
def make_list(
    dot: int,
    box: NDArray[np.float64],
    wider: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    now_us: float,
    candidates: CandidatePixels,
) -> None:
    """List the pixels that may fire while a dot is in a box somewhat wider than (4,); no list for a fast dot.

    `wider` (1, 4) is scratch.
    """
    candidates.list_box[dot] = np.nan
    candidates.list_length[dot] = -1
    if 2.0 * max(box[2], box[3]) >= FAST_PX:
        return
    reach_of_list(box, wider[0])
    count = ring_pixels(wider[0], inner, outer, TRUE, candidates)
    count = select_active(
        candidates.active[:count],
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
    if count <= candidates.listed.shape[1]:
        for k in range(count):
            pixel = candidates.active[k]
            candidates.listed[dot, k] = pixel
            candidates.listed_px2[dot, 0, k] = candidates.lower2_px2[pixel >> PIXEL_SHIFT, pixel & COLUMN_MASK]
            candidates.listed_px2[dot, 1, k] = candidates.upper2_px2[pixel >> PIXEL_SHIFT, pixel & COLUMN_MASK]
        candidates.list_length[dot] = count
        for side in range(4):
            candidates.list_box[dot, side] = wider[0, side]


@njit(cache=True, _nrt=False)
def select_listed(
    dot: int,
    box: NDArray[np.float64],
    pixels: int,
    listed: NDArray[np.int32],
    listed_px2: NDArray[np.float32],
    active: NDArray[np.int32],
    entry: NDArray[np.int64],
) -> int:
    """Select from a dot's list, like `select_active`, for its box of (dots, 4); `entry` gets indices into the list."""
    centre_x = box[dot, 0]
    centre_y = box[dot, 1]
    half_x = np.float32(box[dot, 2])
    half_y = np.float32(box[dot, 3])
    count = 0
    for k in range(pixels):
        pixel = listed[dot, k]
        across = np.float32(abs((pixel & COLUMN_MASK) - centre_x))
        down = np.float32(abs((pixel >> PIXEL_SHIFT) - centre_y))
        nearest_across = max(across - half_x, np.float32(0.0))
        nearest_down = max(down - half_y, np.float32(0.0))
        farthest_across = across + half_x
        farthest_down = down + half_y
        least2 = nearest_across * nearest_across + nearest_down * nearest_down
        greatest2 = farthest_across * farthest_across + farthest_down * farthest_down
        active[count] = pixel
        entry[count] = k
        count += int(not ((least2 >= listed_px2[dot, 0, k]) & (greatest2 <= listed_px2[dot, 1, k])))
    return count


@njit(cache=True, _nrt=False)
def renew_listed(
    dot: int,
    count: int,
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    now_us: float,
    candidates: CandidatePixels,
) -> None:
    """Compute new radii for the selected pixels of a dot's list that have fired; not yet for blind pixels."""
    for k in range(count):
        pixel = candidates.active[k]
        y = pixel >> PIXEL_SHIFT
        x = pixel & COLUMN_MASK
        if candidates.lower2_px2[y, x] == np.inf and not (release_us.size > 0 and release_us[y, x] > now_us):
            radii = optics.quiet_radii(
                reference[y, x] + candidates.light[0],
                threshold[y, x] - candidates.light[1],
                inner,
                outer,
                steps_per_px,
                profile,
                candidates.level_index,
            )
            candidates.lower2_px2[y, x] = radii[0]
            candidates.upper2_px2[y, x] = radii[1]
        candidates.listed_px2[dot, 0, candidates.entry[k]] = candidates.lower2_px2[y, x]
        candidates.listed_px2[dot, 1, candidates.entry[k]] = candidates.upper2_px2[y, x]


@njit(cache=True, _nrt=False)
def ring_pixels(
    own: NDArray[np.float64], inner: float, outer: float, active_only: bool, candidates: CandidatePixels
) -> int:
    """Collect the pixels of a dot's ring in `candidates.active`; return their number.

    With `active_only`, pixels are left out that cannot fire for any position of the dot in its box (4,). The code has
    no branch for each pixel, which would cost more than all the rest.
    """
    height, width = candidates.lower2_px2.shape
    active = candidates.active
    count = 0
    first_row, end_row = dot_rings.ring_rows(own, outer, height)
    half_x = np.float32(own[2])
    for y in range(first_row, end_row):
        down = abs(y - own[1])
        nearest_down2 = np.float32(max(down - own[3], 0.0) ** 2)
        farthest_down2 = np.float32((down + own[3]) ** 2)
        left, left_end, right, right_end = dot_rings.ring_runs(own, inner, outer, y, width)
        lower2 = candidates.lower2_px2[y]
        upper2 = candidates.upper2_px2[y]
        for first, end in ((left, left_end), (right, right_end)):
            for x in range(first, end):
                across = np.float32(abs(x - own[0]))
                nearest_across = max(across - half_x, np.float32(0.0))
                farthest_across = across + half_x
                quiet = (nearest_across * nearest_across + nearest_down2 >= lower2[x]) & (
                    farthest_across * farthest_across + farthest_down2 <= upper2[x]
                )
                active[count] = y << PIXEL_SHIFT | x
                count += int(not (quiet & active_only))
    return count


@njit(cache=True, _nrt=False)
def select_own(
    dot: int, count: int, box: NDArray[np.float64], inner: float, outer: float, candidates: CandidatePixels
) -> int:
    """Drop pixels that are compared with an earlier dot, whose ring also contains them; return how many remain."""
    height, width = candidates.lower2_px2.shape
    own = 0
    for k in range(count):
        pixel = candidates.active[k]
        y = pixel >> PIXEL_SHIFT
        x = pixel & COLUMN_MASK
        taken = False
        for other in range(dot):
            if max(box[other, 2], box[other, 3]) <= 0.5 * RESOLUTION_PX:
                continue
            first_row, end_row = dot_rings.ring_rows(box[other], outer, height)
            if first_row <= y < end_row:
                left, left_end, right, right_end = dot_rings.ring_runs(box[other], inner, outer, y, width)
                taken = taken or left <= x < left_end or right <= x < right_end
        if not taken:
            candidates.active[own] = pixel
            own += 1
    return own


@njit(cache=True, _nrt=False)
def select_active(
    pixels: NDArray[np.int32],
    near_box: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    now_us: float,
    candidates: CandidatePixels,
) -> int:
    """Collect in `candidates.active` those `pixels` that may fire while dots are in their boxes; return their number.

    Blind pixels have no radii and are included: their references follow their levels.
    """
    active = candidates.active
    lower2 = candidates.lower2_px2
    upper2 = candidates.upper2_px2
    alone = len(near_box) == 1
    centre_x, centre_y, half_x, half_y = near_box[0]
    count = 0
    for pixel in pixels:
        y = pixel >> PIXEL_SHIFT
        x = pixel & COLUMN_MASK
        if lower2[y, x] == np.inf and not (release_us.size > 0 and release_us[y, x] > now_us):
            radii = optics.quiet_radii(
                reference[y, x] + candidates.light[0],
                threshold[y, x] - candidates.light[1],
                inner,
                outer,
                steps_per_px,
                profile,
                candidates.level_index,
            )
            lower2[y, x] = radii[0]
            upper2[y, x] = radii[1]
        if alone:
            across = abs(x - centre_x)
            down = abs(y - centre_y)
            nearest_across = max(across - half_x, 0.0)
            nearest_down = max(down - half_y, 0.0)
            least2 = nearest_across * nearest_across + nearest_down * nearest_down
            greatest2 = (across + half_x) * (across + half_x) + (down + half_y) * (down + half_y)
        else:
            least2, greatest2 = dot_rings.bounds(x, y, near_box)
        active[count] = pixel
        count += int(not ((least2 >= lower2[y, x]) & (greatest2 <= upper2[y, x])))
    return count
