"""The ideal camera's gel: the times at which moving dots take a pixel's level past its threshold, solved.

A pixel's level depends only on its distance rho to the nearest dot, so reference +- threshold correspond to two radii.
The pixel gets darker when rho falls below `lower` and brighter when rho exceeds `upper`. On a straight piece of a dot's
path, rho reaches a radius at the root of a quadratic. The caller divides curved paths into pieces: the time error falls
with the square of their number.

Few pixels are solved, because 63 dots have 22,000 ring pixels but cause 800 events in a millisecond of shear:
- The box of a dot's path within the slice bounds rho from both sides. While both bounds stay between the two radii the
  pixel cannot fire and costs one comparison. Unlike a bound on path length, this takes the direction of motion into
  account, and a dot that vibrates does not use it up.
- A pixel that may fire has a slack, rho's distance to the nearer radius. It jumps along the dot's cumulative path
  length to the first piece in which the slack can be used up.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import dot_rings, optics
from evetac_cli.sim.camera.event_keys import event_key
from evetac_cli.sim.camera.ideal.pixels import IdealGelPixels, SliceTimes


@njit(cache=True)
def find_all_radii(
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    inner: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    index: NDArray[np.int16],
    lower2: NDArray[np.float32],
    upper2: NDArray[np.float32],
) -> None:
    """Fill in the squares of the two radii of every pixel (height, width)."""
    height, width = reference.shape
    for y in range(height):
        for x in range(width):
            level = np.float64(reference[y, x])
            step = np.float64(threshold[y, x])
            lower2[y, x] = optics.squared_radius(level - step, inner, steps_per_px, profile, index)
            upper2[y, x] = optics.squared_radius(level + step, inner, steps_per_px, profile, index)


@njit(cache=True)
def solve_dots(
    path: NDArray[np.float64], gel: IdealGelPixels, times: SliceTimes, keys: NDArray[np.int64], event_count: int
) -> int:
    """Solve the pixels that may fire in the rings of moving dots; return the number of events, stored or not.

    Dots move along paths (dots, k + 1, 2). The rings of a slice are all pixels that are ever between the profile's
    inner and outer radius from a dot on its path. All other pixels keep the same level.
    """
    seen_xy, (inner, outer, steps_per_px, profile), index = gel.seen_dot_xy_px, gel.profile, gel.level_index
    reference, threshold, lower2, upper2 = gel.reference, gel.threshold, gel.lower2_px2, gel.upper2_px2
    solved_in, release_us = gel.solved_in, gel.release_us
    this_slice, t0_us, refractory_us = times
    height, width = reference.shape
    dots, vertices, _ = path.shape
    box = np.empty((len(path), 4))
    dot_rings.boxes(path, seen_xy, box)
    near_path = np.empty((dots, vertices, 2))
    near_box = np.empty((dots, 4))
    travelled = np.empty(vertices)
    active = np.empty(reference.size, np.int64)
    for dot in range(dots):
        centre_x = box[dot, 0]
        centre_y = box[dot, 1]
        half_x = box[dot, 2]
        half_y = box[dot, 3]
        if half_x == 0.0 and half_y == 0.0:
            continue
        near = dot_rings.dots_near(dot, path, box, outer, near_path, near_box)
        count = 0
        for y in range(*dot_rings.ring_rows(box[dot], outer, height)):
            down = abs(y - centre_y)
            nearest_down = max(down - half_y, 0.0)
            farthest_down = down + half_y
            left, left_end, right, right_end = dot_rings.ring_runs(box[dot], inner, outer, y, width)
            for first, end in ((left, left_end), (right, right_end)):
                for x in range(first, end):
                    across = abs(x - centre_x)
                    nearest_across = max(across - half_x, 0.0)
                    farthest_across = across + half_x
                    nearest2 = nearest_across * nearest_across + nearest_down * nearest_down
                    farthest2 = farthest_across * farthest_across + farthest_down * farthest_down
                    if near == 1:
                        if nearest2 >= lower2[y, x] and farthest2 <= upper2[y, x]:
                            continue
                        if solved_in[y, x] == this_slice:  # already solved with the lines
                            continue
                    else:
                        if solved_in[y, x] == this_slice:
                            continue
                        nearest2, farthest2 = dot_rings.bounds(x, y, near_box[:near])
                        if nearest2 >= lower2[y, x] and farthest2 <= upper2[y, x]:
                            continue
                        solved_in[y, x] = this_slice
                    active[count] = y * width + x
                    count += 1
        _travel(near_path[:near], travelled)
        event_count = _solve_pixels(
            active[:count],
            near_path[:near],
            travelled,
            inner,
            steps_per_px,
            profile,
            index,
            reference,
            threshold,
            lower2,
            upper2,
            refractory_us,
            release_us,
            t0_us,
            keys,
            event_count,
        )
    seen_xy[:] = path[:, vertices - 1]
    return event_count


@njit(cache=True)
def _travel(near_path: NDArray[np.float64], travelled: NDArray[np.float64]) -> None:
    """Fill in the path length to each vertex, always that of the fastest dot: a pixel's rho changes by no more."""
    near, vertices, _ = near_path.shape
    travelled[0] = 0.0
    for vertex in range(1, vertices):
        longest2 = 0.0
        for dot in range(near):
            across = near_path[dot, vertex, 0] - near_path[dot, vertex - 1, 0]
            down = near_path[dot, vertex, 1] - near_path[dot, vertex - 1, 1]
            longest2 = max(longest2, across * across + down * down)
        travelled[vertex] = travelled[vertex - 1] + math.sqrt(longest2)


@njit(cache=True)
def _solve_pixels(
    active: NDArray[np.int64],
    near_path: NDArray[np.float64],
    travelled: NDArray[np.float64],
    inner: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    index: NDArray[np.int16],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    lower2: NDArray[np.float32],
    upper2: NDArray[np.float32],
    refractory_us: float,
    release_us: NDArray[np.float64],
    t0_us: int,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Solve all crossings of some pixels within the slice; return the number of events so far.

    A pixel is solved up to `vertex` + `part` of the path.
    """
    width = reference.shape[1]
    pieces = len(travelled) - 1
    piece_us = SLICE_US / pieces
    for pixel in active:
        y, x = divmod(pixel, width)
        step = np.float64(threshold[y, x])
        level = np.float64(reference[y, x])
        darker_below2 = np.float64(lower2[y, x])
        brighter_above2 = np.float64(upper2[y, x])
        vertex = 0
        part = 0.0
        blind = math.isnan(level)
        if darker_below2 == np.inf and not blind:
            darker_below2 = optics.squared_radius(level - step, inner, steps_per_px, profile, index)
            brighter_above2 = optics.squared_radius(level + step, inner, steps_per_px, profile, index)
        # Released before the slice: it has seen no change since, because pixels that may fire are visited every slice.
        blind_until_us = max(0.0, release_us[y, x] - t0_us) if blind else 0.0
        while True:
            if blind:
                if blind_until_us >= SLICE_US:
                    break
                vertex = min(int(blind_until_us / piece_us), pieces - 1)
                part = min(max(blind_until_us / piece_us - vertex, 0.0), 1.0)
                rho = math.sqrt(_distance2(x, y, near_path, vertex, part))
                level = optics.level_at(rho, inner, steps_per_px, profile)
                darker_below2 = optics.squared_radius(level - step, inner, steps_per_px, profile, index)
                brighter_above2 = optics.squared_radius(level + step, inner, steps_per_px, profile, index)
                blind = False
            rho2 = _distance2(x, y, near_path, vertex, part)
            if rho2 < darker_below2 or rho2 > brighter_above2:
                # It jumped between slices, or is on a radius except for rounding.
                brighter = rho2 > brighter_above2
            else:
                if part == 0.0:
                    if vertex == pieces:
                        break
                    rho = math.sqrt(rho2)
                    slack = min(rho - math.sqrt(max(darker_below2, 0.0)), math.sqrt(brighter_above2) - rho)
                    safe = _last_within(travelled, vertex, slack)
                    if safe > vertex:
                        vertex = safe
                        continue
                darker_at = _first_inside(x, y, near_path, vertex, part, darker_below2)
                brighter_at = _first_outside(x, y, near_path, vertex, part, brighter_above2)
                if min(darker_at, brighter_at) > 1.0:
                    vertex += 1
                    part = 0.0
                    continue
                brighter = brighter_at < darker_at
                part = min(darker_at, brighter_at)
            time_us = (vertex + part) * piece_us
            if event_count < len(keys):
                keys[event_count] = event_key(min(int(time_us), SLICE_US - 1), x, y, brighter)
            event_count += 1
            if refractory_us > 0.0:
                blind = True
                blind_until_us = time_us + refractory_us
                release_us[y, x] = t0_us + blind_until_us
            else:
                level += step if brighter else -step
                darker_below2 = optics.squared_radius(level - step, inner, steps_per_px, profile, index)
                brighter_above2 = optics.squared_radius(level + step, inner, steps_per_px, profile, index)
        reference[y, x] = np.nan if blind else level
        lower2[y, x] = np.inf if blind else darker_below2  # infinity: solved at every visit
        upper2[y, x] = brighter_above2
    return event_count


@njit(cache=True)
def _distance2(x: int, y: int, near_path: NDArray[np.float64], vertex: int, part: float) -> float:
    """Return the squared distance of a pixel to the nearest dot at a point of the path."""
    least2 = np.inf
    for dot in range(len(near_path)):
        across = x - near_path[dot, vertex, 0]
        down = y - near_path[dot, vertex, 1]
        if part > 0.0:
            across -= part * (near_path[dot, vertex + 1, 0] - near_path[dot, vertex, 0])
            down -= part * (near_path[dot, vertex + 1, 1] - near_path[dot, vertex, 1])
        least2 = min(least2, across * across + down * down)
    return least2


@njit(cache=True)
def _last_within(travelled: NDArray[np.float64], vertex: int, slack: float) -> int:
    """Return the last vertex up to which at most `slack` is travelled: by galloping, then bisection."""
    last = len(travelled) - 1
    limit = travelled[vertex] + slack
    within = vertex
    stride = 1
    while within + stride <= last and travelled[within + stride] < limit:
        within += stride
        stride *= 2
    beyond = min(within + stride, last + 1)
    while beyond - within > 1:
        middle = (within + beyond) // 2
        if travelled[middle] < limit:
            within = middle
        else:
            beyond = middle
    return within


@njit(cache=True)
def _within_circle(
    x: int, y: int, near_path: NDArray[np.float64], dot: int, vertex: int, radius2: float
) -> tuple[float, float]:
    """Return the parts of a piece between which a dot is within a radius of the pixel; (inf, inf) if never."""
    velocity_x = near_path[dot, vertex + 1, 0] - near_path[dot, vertex, 0]
    velocity_y = near_path[dot, vertex + 1, 1] - near_path[dot, vertex, 1]
    across = x - near_path[dot, vertex, 0]
    down = y - near_path[dot, vertex, 1]
    speed2 = velocity_x * velocity_x + velocity_y * velocity_y
    beyond2 = across * across + down * down - radius2
    if speed2 == 0.0:
        return (-np.inf, np.inf) if beyond2 <= 0.0 else (np.inf, np.inf)
    approach = across * velocity_x + down * velocity_y
    discriminant = approach * approach - speed2 * beyond2
    if discriminant < 0.0:
        return np.inf, np.inf
    root = math.sqrt(discriminant)
    # First the root without cancellation, then the other root from their product.
    if approach > 0.0:
        later = (approach + root) / speed2
        return beyond2 / (approach + root), later
    if approach == root:
        return 0.0, 0.0
    return (approach - root) / speed2, beyond2 / (approach - root)


@njit(cache=True)
def _first_inside(x: int, y: int, near_path: NDArray[np.float64], vertex: int, part: float, radius2: float) -> float:
    """Return the part of the piece, at or after `part`, at which the first dot comes within a radius; inf if none."""
    first = np.inf
    if radius2 > 0.0:
        for dot in range(len(near_path)):
            enter, leave = _within_circle(x, y, near_path, dot, vertex, radius2)
            if leave > part:
                first = min(first, max(enter, part))
    return first


@njit(cache=True)
def _first_outside(x: int, y: int, near_path: NDArray[np.float64], vertex: int, part: float, radius2: float) -> float:
    """Return the part of the piece, at or after `part`, at which no dot is within a radius; inf if after its end."""
    if radius2 == np.inf:
        return np.inf
    outside = part
    moved = True
    while moved:
        moved = False
        for dot in range(len(near_path)):
            enter, leave = _within_circle(x, y, near_path, dot, vertex, radius2)
            if enter <= outside < leave:
                outside = leave
                moved = outside <= 1.0
    return outside if outside <= 1.0 else np.inf
