"""An ideal event camera: every pixel fires at the very moment its log brightness has changed by its threshold.

The counterpart of the scanning camera in camera.py, which shares its optics, individuals, noise and interface. Here a
pixel fires as often as its level passes a threshold, several times a slice if need be, and an event's time is that of
the crossing, rounded down to a microsecond. Use it to tell what a scanning camera loses, or as a camera without scans.

Crossings are solved, not stepped through. A pixel's level depends only on its distance rho to the nearest dot, so its
reference +- threshold are two radii: it gets darker when rho falls below `lower` and brighter when rho exceeds `upper`.
On a straight piece of a dot's path rho meets a radius at the root of a quadratic. What is not straight the caller cuts
into pieces: the time error falls with the square of their number.

Most pixels are asleep (why so: 63 dots have 22,000 ring pixels, and make 800 events in a millisecond of shear):
- the box of a dot's path within the slice bounds rho from both sides; while both bounds stay between the two radii the
  pixel cannot fire and costs a comparison. Unlike a bound on path length alone this knows the direction of motion, and
  a dot that shakes to and fro does not use it up;
- a pixel that may fire has a slack, rho's distance to the nearer radius, and jumps along the dot's cumulative path
  length to the first piece in which the slack can be used up.

The window's texture is bilinear, so along a straight path a pixel's level is a quadratic in time until the object has
moved on by a whole texel, which happens to all pixels at once. The slice is cut there; each part is solved exactly.

Lines that are not dots (see rims) have no such closed form. A slice in which they move is cut into sub-steps, in which
they move by at most `line_step_px`; the level of a gel pixel that they may touch, dots included, is linear in a
sub-step, that of a window pixel a parabola. The error of a time falls with the square of the step.

Leak is that of camera.py: an event comes late by up to the 40 ms between two visits.

Left out: bandwidth (a low pass has no closed form for the crossing), and what camera.py leaves out.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evetac_cli.events import SLICE_US, Events
from evetac_cli.sim import camera, optics, rings
from evetac_cli.sim.camera import LEAK_SLICES, CameraModel, CameraState
from evetac_cli.sim.rims import Outline, Place, Rims, cut_run, outline_rows, outline_runs, sample_cut, sample_row

# An object faster than this many texels a slice (8 m/s) is sampled at as many equal parts instead of at each texel.
MOST_TEXELS = 256
# A rim 4 px wide at 1 and 3 px/ms: events lie 0.25 us (median) and 0.48 us (p95) from those of steps of 2.5 us,
# which is what whole microseconds cost. With dots in motion under a line, which are steeper, it is shorter.
LINE_STEP_PX = 0.25
DOT_STEP_PX = 0.05
MOST_LINE_STEPS = 64


# As many lines as `_solve_window` gets where none moves.
NO_LINES = (
    0,
    Outline(np.zeros((0, 0), np.float32), np.empty((0, 4), np.int64), 0.0, 0.0),
    0.0,
    0.0,
    Place(np.zeros(2), 0.0, np.zeros(0)),
    Place(np.zeros(2), 0.0, np.zeros(0)),
    np.zeros((0, 0), np.float32),
    np.zeros((0, 0), np.float32),
)


@dataclass
class IdealState:
    """What an ideal camera remembers from slice to slice; `step` changes it in place.

    `shared` has what both cameras have; its references and those of the strip are NaN while a pixel is refractory.
    `lower2_px2` and `upper2_px2` are the squares of a pixel's two radii, -1 and infinity where there is none; single
    precision keeps a radius to 1e-6 px. A pixel whose reference has been changed by a line has infinity for the
    first: its radii are found anew when a dot comes near. `level_index` helps to find them. `solved_in` is the last
    slice in which a pixel near several dots or under a line was solved, so that it is solved once. `*_release_us` is
    the time at which a refractory pixel sees again; without a refractory time both are empty. `line_step_px` is how
    far lines move in a sub-step.
    """

    shared: CameraState
    level_index: NDArray[np.int16]
    lower2_px2: NDArray[np.float32]
    upper2_px2: NDArray[np.float32]
    solved_in: NDArray[np.int64]
    release_us: NDArray[np.float64]
    strip_release_us: NDArray[np.float64]
    line_step_px: float
    slices: int = 0

    @property
    def dropped(self) -> int:
        """Events lost so far because a slice was full."""
        return self.shared.dropped


def start(
    model: CameraModel,
    dot_xy_px: ArrayLike,
    dot_radius_px: float | None,
    window_px: tuple[int, int, int, int] | None,
    texture: NDArray[np.float32] | None,
    rng: np.random.Generator,
    individual: np.random.Generator | None = None,
    rims: Rims | None = None,
    line_step_px: float = LINE_STEP_PX,
) -> IdealState:
    """Switch the camera on; arguments, draws and errors are those of `camera.start`.

    Equal generators give both cameras the same thresholds, phases and hot pixels.
    """
    shared = camera.start(model, dot_xy_px, dot_radius_px, window_px, texture, rng, individual, rims)
    return from_references(shared, line_step_px)


def from_references(shared: CameraState, line_step_px: float = LINE_STEP_PX) -> IdealState:
    """An ideal camera that goes on from the references in `shared`, which it owns from now on; ValueError on NaN."""
    if np.isnan(shared.reference).any() or np.isnan(shared.strip_reference).any():
        raise ValueError("reference: expected finite levels, found those of refractory pixels")
    if not 1e-3 <= line_step_px <= 10.0:
        raise ValueError(f"line_step_px: expected 0.001 to 10, found {line_step_px}")
    shape = shared.reference.shape
    blind = shared.model.refractory_us > 0.0
    state = IdealState(
        shared=shared,
        level_index=optics.level_index(shared.profile),
        lower2_px2=np.empty(shape, np.float32),
        upper2_px2=np.empty(shape, np.float32),
        solved_in=np.zeros(shape, np.int64),
        release_us=np.zeros(shape if blind else (0, 0)),
        strip_release_us=np.zeros(shared.strip_reference.shape if blind else (0, 0)),
        line_step_px=float(line_step_px),
    )
    inner, _, steps_per_px, profile = shared.profile
    table = (inner, steps_per_px, profile, state.level_index)
    _all_radii(shared.reference, shared.threshold, *table, state.lower2_px2, state.upper2_px2)
    return state


def step(
    state: IdealState,
    dot_xy_px_start: ArrayLike,
    dot_xy_px_end: ArrayLike,
    object_xy_px_start: ArrayLike,
    object_xy_px_end: ArrayLike,
    texture_contrast: float,
    t0_us: int,
    rng: np.random.Generator,
    dot_path_px: ArrayLike | None = None,
    rims_start: Place | None = None,
    rims_end: Place | None = None,
) -> Events:
    """The events of one millisecond, sorted by time, t0_us <= t < t0_us + 1000.

    Dots (dots, 2) and the object's displacement (2,) move on straight lines from start to end, in px, the contrast
    holds for the whole slice. Dots on curved paths come with `dot_path_px` (k + 1, dots, 2): where they are at k + 1
    equally spaced times, from their start to their end. A camera with rims needs `rims_start` and
    `rims_end`, between which they move and fade evenly. What lies elsewhere than at the end of the last slice, or has
    another contrast, has jumped there at t0_us. ValueError on values that are not finite, farther than 1e6 px, of
    another shape than at `start`, or a path with other ends; the state is then as before.
    """
    shared = state.shared
    t0_us = int(t0_us)
    dots = len(shared.seen_dot_xy_px)
    dots_start = camera._positions("dot_xy_px_start", dot_xy_px_start, dots)
    dots_end = camera._positions("dot_xy_px_end", dot_xy_px_end, dots)
    path = camera._path(dot_path_px, dots_start, dots_end)
    object_start = camera._positions("object_xy_px_start", np.atleast_2d(object_xy_px_start), 1)[0]
    object_end = camera._positions("object_xy_px_end", np.atleast_2d(object_xy_px_end), 1)[0]
    camera._check_range("texture_contrast", texture_contrast, 0.0, 1e3)

    lines = camera._places(shared.rims, rims_start, rims_end)
    refractory_us = shared.model.refractory_us

    state.slices += 1
    made = 0
    when = (refractory_us, state.strip_release_us, t0_us, shared.keys)
    window = (
        object_start,
        object_end,
        float(texture_contrast),
        shared.seen_object,
        shared.texture,
        shared.window_px[0],
        shared.window_px[1],
        shared.strip_level,
        shared.strip_reference,
        shared.strip_threshold,
    )
    gel = (*shared.profile, state.level_index, shared.reference, shared.threshold, state.lower2_px2, state.upper2_px2)
    solved = (state.solved_in, state.slices, refractory_us, state.release_us, t0_us, shared.keys)
    if shared.rims is not None and lines is not None:
        made = _solve_lines(state, shared.rims, *lines, path, window, when, gel, solved)
    elif shared.strip_level.size:
        made = _solve_window(*window, NO_LINES, *when, made)
    if shared.rims is not None and lines is None:
        shared.rims.events = 0
    made = _solve_dots(path, shared.seen_dot_xy_px, *gel, *solved, made)
    if shared.model.leak_hz > 0.0:
        made = _leak(state, t0_us, made)
    made = camera._add_noise(shared, rng, made)
    kept = min(made, len(shared.keys))
    shared.dropped += made - kept
    return Events(*camera._sorted_columns(shared.keys[:kept], t0_us))


@njit(cache=True)
def _all_radii(
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    inner: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    index: NDArray[np.int16],
    lower2: NDArray[np.float32],
    upper2: NDArray[np.float32],
) -> None:
    height, width = reference.shape
    for y in range(height):
        for x in range(width):
            level = np.float64(reference[y, x])
            step = np.float64(threshold[y, x])
            lower2[y, x] = optics.squared_radius(level - step, inner, steps_per_px, profile, index)
            upper2[y, x] = optics.squared_radius(level + step, inner, steps_per_px, profile, index)


@njit(cache=True)
def _solve_dots(
    path: NDArray[np.float64],
    seen_xy: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    index: NDArray[np.int16],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    lower2: NDArray[np.float32],
    upper2: NDArray[np.float32],
    solved_in: NDArray[np.int64],
    this_slice: int,
    refractory_us: float,
    release_us: NDArray[np.float64],
    t0_us: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Wake the pixels that may fire in the rings of dots that move; returns the number of events, kept or not.

    The rings of a slice are all pixels that are ever between `inner` and `outer` from a dot on its path. The others
    have one and the same level throughout.
    """
    height, width = reference.shape
    dots, vertices, _ = path.shape
    box = rings.boxes(path, seen_xy)
    near_path = np.empty((dots, vertices, 2))
    near_box = np.empty((dots, 4))
    travelled = np.empty(vertices)
    awake = np.empty(reference.size, np.int64)
    for dot in range(dots):
        centre_x = box[dot, 0]
        centre_y = box[dot, 1]
        half_x = box[dot, 2]
        half_y = box[dot, 3]
        if half_x == 0.0 and half_y == 0.0:
            continue
        near = rings.dots_near(dot, path, box, outer, near_path, near_box)
        wakes = 0
        for y in range(*rings.ring_rows(box[dot], outer, height)):
            down = abs(y - centre_y)
            nearest_down = max(down - half_y, 0.0)
            farthest_down = down + half_y
            left, left_end, right, right_end = rings.ring_runs(box[dot], inner, outer, y, width)
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
                        if solved_in[y, x] == this_slice:  # with the lines
                            continue
                    else:
                        if solved_in[y, x] == this_slice:
                            continue
                        nearest2, farthest2 = rings.bounds(x, y, near_box[:near])
                        if nearest2 >= lower2[y, x] and farthest2 <= upper2[y, x]:
                            continue
                        solved_in[y, x] = this_slice
                    awake[wakes] = y * width + x
                    wakes += 1
        _travel(near_path[:near], travelled)
        made = _solve_pixels(
            awake[:wakes],
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
            made,
        )
    seen_xy[:] = path[:, vertices - 1]
    return made


@njit(cache=True)
def _travel(near_path: NDArray[np.float64], travelled: NDArray[np.float64]) -> None:
    """Path length up to each vertex, in every piece that of the fastest dot: a pixel's rho changes by no more."""
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
    awake: NDArray[np.int64],
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
    made: int,
) -> int:
    """All crossings of some pixels within the slice; returns the number of events so far.

    A pixel stands at `vertex` + `part` of the path; nothing is left to report before it.
    """
    width = reference.shape[1]
    pieces = len(travelled) - 1
    piece_us = SLICE_US / pieces
    for pixel in awake:
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
        # Released before the slice, it has seen no change since: the pixels that may are visited in every slice.
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
                # It jumped between slices, or lies on a radius but for rounding.
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
            if made < len(keys):
                keys[made] = camera._key(min(int(time_us), SLICE_US - 1), x, y, brighter)
            made += 1
            if refractory_us > 0.0:
                blind = True
                blind_until_us = time_us + refractory_us
                release_us[y, x] = t0_us + blind_until_us
            else:
                level += step if brighter else -step
                darker_below2 = optics.squared_radius(level - step, inner, steps_per_px, profile, index)
                brighter_above2 = optics.squared_radius(level + step, inner, steps_per_px, profile, index)
        reference[y, x] = np.nan if blind else level
        lower2[y, x] = np.inf if blind else darker_below2  # infinite: awake at every visit
        upper2[y, x] = brighter_above2
    return made


@njit(cache=True)
def _distance2(x: int, y: int, near_path: NDArray[np.float64], vertex: int, part: float) -> float:
    """Squared distance of a pixel to the nearest dot at a point of the path."""
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
    """The last vertex up to which no more than `slack` is travelled: gallop, then bisect."""
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
    """From which to which part of a piece a dot is within a radius of the pixel; (inf, inf) if never."""
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
    # The root that does not cancel first, the other from their product.
    if approach > 0.0:
        later = (approach + root) / speed2
        return beyond2 / (approach + root), later
    if approach == root:
        return 0.0, 0.0
    return (approach - root) / speed2, beyond2 / (approach - root)


@njit(cache=True)
def _first_inside(x: int, y: int, near_path: NDArray[np.float64], vertex: int, part: float, radius2: float) -> float:
    """Part of the piece, from `part` on, at which the first dot comes within a radius; inf if none."""
    first = np.inf
    if radius2 > 0.0:
        for dot in range(len(near_path)):
            enter, leave = _within_circle(x, y, near_path, dot, vertex, radius2)
            if leave > part:
                first = min(first, max(enter, part))
    return first


@njit(cache=True)
def _first_outside(x: int, y: int, near_path: NDArray[np.float64], vertex: int, part: float, radius2: float) -> float:
    """Part of the piece, from `part` on, from which no dot is within a radius; inf if that lies beyond its end."""
    if radius2 == np.inf:
        return np.inf
    outside = part
    found = True
    while found:
        found = False
        for dot in range(len(near_path)):
            enter, leave = _within_circle(x, y, near_path, dot, vertex, radius2)
            if enter <= outside < leave:
                outside = leave
                found = outside <= 1.0
    return outside if outside <= 1.0 else np.inf


@njit(cache=True)
def _solve_window(
    start_xy: NDArray[np.float64],
    end_xy: NDArray[np.float64],
    contrast: float,
    seen: NDArray[np.float64],
    texture: NDArray[np.float32],
    first_x: int,
    first_y: int,
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    lines: tuple[Any, ...],
    refractory_us: float,
    release_us: NDArray[np.float64],
    t0_us: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Crossings of the window's pixels; returns the number of events so far.

    Within a part of the slice in which the object stays between whole texels, a level is the parabola through its
    values at start, middle and end. `level` is left with the texture's at the end. `lines` are what `_add_lines` takes;
    they come on top, and cut the slice into as many parts as the sub-steps in which they move.
    """
    steps = lines[0]
    across = end_xy[0] - start_xy[0]
    down = end_xy[1] - start_xy[1]
    first_look = math.isnan(seen[2])
    jumped = contrast != seen[2] or (contrast > 0.0 and (start_xy[0] != seen[0] or start_xy[1] != seen[1]))
    moves = steps > 0 or (contrast > 0.0 and (across != 0.0 or down != 0.0))
    seen[0] = end_xy[0]
    seen[1] = end_xy[1]
    seen[2] = contrast
    if not (jumped or moves):
        return made
    now = np.empty_like(reference)
    half_way = np.empty_like(reference)
    then = np.empty_like(reference)
    optics.sample_texture(texture, first_x, first_y, start_xy[0], start_xy[1], contrast, now)
    if first_look:
        reference += now
    _add_lines(now, first_x, first_y, 0.0, *lines)
    if not first_look or steps > 0:
        made = _solve_parabolas(
            now,
            now,
            now,
            0.0,
            0.0,
            first_x,
            first_y,
            reference,
            threshold,
            refractory_us,
            release_us,
            t0_us,
            keys,
            made,
        )
    at = 0.0
    while moves and at < 1.0:
        until = _next_texel(start_xy[0], across, start_xy[1], down, at)
        if steps > 0:
            until = min(until, (math.floor(at * steps + 1e-6) + 1.0) / steps)
        middle = 0.5 * (at + until)
        optics.sample_texture(
            texture, first_x, first_y, start_xy[0] + middle * across, start_xy[1] + middle * down, contrast, half_way
        )
        _add_lines(half_way, first_x, first_y, middle, *lines)
        optics.sample_texture(
            texture, first_x, first_y, start_xy[0] + until * across, start_xy[1] + until * down, contrast, then
        )
        _add_lines(then, first_x, first_y, until, *lines)
        made = _solve_parabolas(
            now,
            half_way,
            then,
            at * SLICE_US,
            until * SLICE_US,
            first_x,
            first_y,
            reference,
            threshold,
            refractory_us,
            release_us,
            t0_us,
            keys,
            made,
        )
        now, then = then, now
        at = until
    level[:] = now
    if steps > 0:
        half_way[:] = 0.0
        _add_lines(half_way, first_x, first_y, 1.0, *lines)
        level -= half_way
        reference -= half_way
    return made


@njit(cache=True)
def _add_lines(
    level: NDArray[np.float32],
    first_x: int,
    first_y: int,
    at: float,
    steps: int,
    outline: Outline,
    cut_contrast: float,
    cut_half: float,
    start: Place,
    end: Place,
    seen_level: NDArray[np.float32],
    seen_cut_level: NDArray[np.float32],
) -> None:
    """Add to some pixels what lines have brought since they were last seen, after a part `at` of the slice."""
    if steps == 0:
        return
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


def _solve_lines(
    state: IdealState,
    rims: Rims,
    start: Place,
    end: Place,
    path: NDArray[np.float64],
    window: tuple[Any, ...],
    when: tuple[Any, ...],
    gel: tuple[Any, ...],
    solved: tuple[Any, ...],
) -> int:
    """Crossings of the pixels that moving lines may touch, in the window and on the gel; returns the number of events.

    `window` and `when`, `gel` and `solved` are arguments of `_solve_window` and `_solve_dots`.
    """
    way_px = np.hypot(*(end.corner_px - start.corner_px)) if rims.outline.picture.size else 0.0
    way_px = max(way_px, np.abs(end.cut_x_px - start.cut_x_px).max(initial=0.0))
    dots_px = np.hypot(*np.moveaxis(np.diff(path, axis=1), -1, 0)).sum(axis=1).max(initial=0.0)
    way_px = max(way_px, dots_px * LINE_STEP_PX / DOT_STEP_PX)
    steps = int(min(max(math.ceil(way_px / state.line_step_px), 1), MOST_LINE_STEPS))
    edge = (rims.cut_contrast, rims.cut_half_px)
    made = 0
    if state.shared.strip_level.size:
        lines = (steps, rims.outline, *edge, start, end, rims.seen_level, rims.seen_cut_level)
        made = _solve_window(*window, lines, *when, made)
    seen = (rims.seen_corner, rims.seen_cut_x, rims.seen_level, rims.seen_cut_level)
    given = (steps, rims.outline, *edge, start, end, seen, path, gel, solved)
    total, rims.events = _solve_line_pixels(*given, made)
    return int(total)


@njit(cache=True)
def _solve_line_pixels(
    steps: int,
    outline: Outline,
    cut_contrast: float,
    cut_half: float,
    start: Place,
    end: Place,
    seen: tuple[Any, ...],
    path: NDArray[np.float64],
    gel: tuple[Any, ...],
    solved: tuple[Any, ...],
    made: int,
) -> tuple[int, int]:
    """Crossings of gel pixels, row by row; returns the number of events so far, and of those that lines alone made."""
    seen_corner, seen_cut_x, seen_level, seen_cut_level = seen
    lower2 = gel[7]
    solved_in, this_slice = solved[:2]
    reference = gel[5]
    height, width = reference.shape
    dots_xy = _along(path, steps)
    rows, columns = outline.picture.shape
    low_x = min(seen_corner[0], start.corner_px[0], end.corner_px[0])
    high_x = max(seen_corner[0], start.corner_px[0], end.corner_px[0])
    low_y = min(seen_corner[1], start.corner_px[1], end.corner_px[1])
    high_y = max(seen_corner[1], start.corner_px[1], end.corner_px[1])
    faded = start.strength != end.strength or start.strength != seen_corner[2]
    there = faded or (start.strength > 0.0 and (low_x != high_x or low_y != high_y))
    first_row, end_row = outline_rows(rows, height, low_y, high_y)
    if rows == 0 or not there:
        end_row = first_row
    runs = np.empty((3, 2), np.int64)
    scratch = np.empty((7, width), np.float32)
    of_lines = 0
    for y in range(height):
        runs[:] = 0
        if first_row <= y < end_row:
            left, left_end, right, right_end = outline_runs(
                outline.runs, columns, width, y, low_x, low_y, high_x, high_y, faded
            )
            runs[0, 0] = left
            runs[0, 1] = left_end
            runs[1, 0] = right
            runs[1, 1] = right_end
        if len(seen_cut_x):
            low = min(seen_cut_x[y], start.cut_x_px[y], end.cut_x_px[y])
            high = max(seen_cut_x[y], start.cut_x_px[y], end.cut_x_px[y])
            if low < high:
                first, beyond = cut_run(cut_half, width, low, high)
                if first < runs[1, 1] and runs[0, 0] < beyond:  # they may share pixels: take all between
                    first = min(first, runs[0, 0])
                    beyond = max(beyond, runs[1, 1])
                    runs[:2] = 0
                runs[2, 0] = first
                runs[2, 1] = beyond
        for run in range(3):
            first = runs[run, 0]
            beyond = runs[run, 1]
            if first == beyond:
                continue
            made, alone = _solve_run(
                steps,
                outline,
                cut_contrast,
                cut_half,
                start,
                end,
                seen_level,
                seen_cut_level,
                dots_xy,
                gel,
                solved,
                y,
                first,
                beyond,
                scratch,
                made,
            )
            of_lines += alone
            lower2[y, first:beyond] = np.inf
            solved_in[y, first:beyond] = this_slice
    if rows:
        seen_corner[0] = end.corner_px[0]
        seen_corner[1] = end.corner_px[1]
        seen_corner[2] = end.strength
    seen_cut_x[:] = end.cut_x_px
    return made, of_lines


@njit(cache=True)
def _along(path: NDArray[np.float64], steps: int) -> NDArray[np.float64]:
    """Dots at the ends of equal sub-steps, (steps + 1, dots, 2); a single entry where no dot moves."""
    dots, vertices, _ = path.shape
    moves = False
    for dot in range(dots):
        for vertex in range(1, vertices):
            for axis in range(2):
                moves = moves or path[dot, vertex, axis] != path[dot, 0, axis]
    count = steps + 1 if moves else 1
    xy = np.empty((count, dots, 2))
    for step in range(count):
        at = step * (vertices - 1) / steps
        vertex = min(int(at), vertices - 2)
        for dot in range(dots):
            for axis in range(2):
                way = path[dot, vertex + 1, axis] - path[dot, vertex, axis]
                xy[step, dot, axis] = path[dot, vertex, axis] + (at - vertex) * way
    return xy


@njit(cache=True)
def _solve_run(
    steps: int,
    outline: Outline,
    cut_contrast: float,
    cut_half: float,
    start: Place,
    end: Place,
    seen_level: NDArray[np.float32],
    seen_cut_level: NDArray[np.float32],
    dots_xy: NDArray[np.float64],
    gel: tuple[Any, ...],
    solved: tuple[Any, ...],
    y: int,
    first: int,
    beyond: int,
    scratch: NDArray[np.float32],
    made: int,
) -> tuple[int, int]:
    """Crossings of pixels side by side, whose levels are linear in every sub-step; counts as `_solve_line_pixels`."""
    inner, outer, steps_per_px, profile = gel[:4]
    reference, threshold = gel[5:7]
    refractory_us, release_us, t0_us, keys = solved[2:]
    pixels = beyond - first
    dots_now, dots_then, now, then, lines, lines_seen, line = (
        scratch[0],
        scratch[1],
        scratch[2],
        scratch[3],
        scratch[4],
        scratch[5],
        scratch[6],
    )
    lines_seen[:pixels] = 0.0
    if len(seen_level):
        lines_seen[:pixels] += seen_level[y, first:beyond]
    if len(seen_cut_level):
        lines_seen[:pixels] += seen_cut_level[y, first:beyond]
    of_lines = 0
    for step in range(steps + 1):
        at = step / steps
        lines[:pixels] = 0.0
        if len(seen_level):
            x = start.corner_px[0] + at * (end.corner_px[0] - start.corner_px[0])
            down = start.corner_px[1] + at * (end.corner_px[1] - start.corner_px[1])
            strength = start.strength + at * (end.strength - start.strength)
            sample_row(outline.picture, x, down, strength, y, first, beyond, line)
            lines[:pixels] += line[:pixels]
            if step == steps:
                seen_level[y, first:beyond] = line[:pixels]
        if len(seen_cut_level):
            cut_x = start.cut_x_px[y] + at * (end.cut_x_px[y] - start.cut_x_px[y])
            sample_cut(cut_contrast, cut_half, cut_x, first, beyond, line)
            lines[:pixels] += line[:pixels]
            if step == steps:
                seen_cut_level[y, first:beyond] = line[:pixels]
        if step < len(dots_xy):
            optics.dot_row(dots_xy[step], inner, outer, steps_per_px, profile, y, first, beyond, dots_then)
        fired = 0
        for k in range(pixels):
            then[k] = dots_then[k] + (lines[k] - lines_seen[k])
            # NaN, a refractory pixel, counts.
            fired += int(not (abs(then[k] - reference[y, first + k]) < threshold[y, first + k]))
            if step == 1:
                fired += int(not (abs(now[k] - reference[y, first + k]) < threshold[y, first + k]))
        if step > 0 and fired > 0:
            for k in range(pixels):
                before = made
                made = _solve_linear(
                    first + k,
                    y,
                    np.float64(now[k]),
                    np.float64(then[k]),
                    (step - 1) * SLICE_US / steps,
                    step * SLICE_US / steps,
                    reference,
                    threshold,
                    refractory_us,
                    release_us,
                    t0_us,
                    keys,
                    made,
                )
                if dots_then[k] == dots_now[k]:
                    of_lines += made - before
        for k in range(pixels):
            now[k] = then[k]
            dots_now[k] = dots_then[k]
    for k in range(pixels):
        reference[y, first + k] -= lines[k] - lines_seen[k]
    return made, of_lines


@njit(cache=True)
def _solve_linear(
    x: int,
    y: int,
    now: float,
    then: float,
    from_us: float,
    until_us: float,
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    refractory_us: float,
    release_us: NDArray[np.float64],
    t0_us: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Crossings of a pixel whose level goes evenly from `now` to `then`; returns the number of events so far."""
    level = np.float64(reference[y, x])
    step = np.float64(threshold[y, x])
    part = 0.0
    while True:
        if math.isnan(level):
            blind_until_us = release_us[y, x] - t0_us
            if blind_until_us > until_us:
                break
            part = max(part, (blind_until_us - from_us) / (until_us - from_us))
            level = now + part * (then - now)
        value = now + part * (then - now)
        if abs(value - level) >= step:
            brighter = value > level
        elif abs(then - level) >= step:
            brighter = then > level
            part = (level + (step if brighter else -step) - now) / (then - now)
        else:
            break
        time_us = from_us + part * (until_us - from_us)
        if made < len(keys):
            keys[made] = camera._key(min(int(time_us), SLICE_US - 1), x, y, brighter)
        made += 1
        if refractory_us > 0.0:
            release_us[y, x] = t0_us + time_us + refractory_us
            level = np.float64(np.nan)
        else:
            level = level + step if brighter else level - step
    reference[y, x] = level
    return made


def _leak(state: IdealState, t0_us: int, made: int) -> int:
    """Let leak lower the references of the rows whose turn it is, and tell who fires by it."""
    shared = state.shared
    drift = shared.model.leak_hz * LEAK_SLICES * SLICE_US * 1e-6
    first_row = state.slices % LEAK_SLICES
    refractory_us = shared.model.refractory_us
    level = np.empty(shared.reference.shape, np.float32)
    inner, outer, steps_per_px, profile = shared.profile
    table = (outer, steps_per_px, profile)
    _draw_rows(shared.seen_dot_xy_px, inner, *table, first_row, level)
    state.lower2_px2[first_row::LEAK_SLICES] = np.inf
    when = (refractory_us, float(t0_us), shared.keys)
    made = _leak_rows(level, first_row, 0, 0, drift, shared.reference, shared.threshold, state.release_us, *when, made)
    first_x, first_y = shared.window_px[:2]
    strip = (shared.strip_reference, shared.strip_threshold, state.strip_release_us)
    own_first = (first_row - first_y) % LEAK_SLICES
    return int(_leak_rows(shared.strip_level, own_first, first_x, first_y, drift, *strip, *when, made))


@njit(cache=True)
def _draw_rows(
    dot_xy: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    first_row: int,
    level: NDArray[np.float32],
) -> None:
    height, width = level.shape
    for y in range(first_row, height, LEAK_SLICES):
        optics.dot_row(dot_xy, inner, outer, steps_per_px, profile, y, 0, width, level[y])


@njit(cache=True)
def _leak_rows(
    level: NDArray[np.float32],
    first_row: int,
    first_x: int,
    first_y: int,
    drift: float,
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    refractory_us: float,
    t0_us: float,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Lower the references of every LEAK_SLICES-th row, one row after the other within the slice."""
    rows, columns = reference.shape
    turn_us = SLICE_US * LEAK_SLICES / max(rows, LEAK_SLICES)
    for row in range(first_row, rows, LEAK_SLICES):
        time_us = min((row // LEAK_SLICES + 0.5) * turn_us, SLICE_US - 1.0)
        for x in range(columns):
            step = threshold[row, x]
            if step == np.inf:  # a pixel of the window, which has references of its own
                continue
            if math.isnan(reference[row, x]):
                if release_us[row, x] > t0_us + time_us:
                    continue
                reference[row, x] = level[row, x]
            reference[row, x] -= np.float32(drift) * step
            if level[row, x] - reference[row, x] < step:
                continue
            if made < len(keys):
                keys[made] = camera._key(int(time_us), first_x + x, first_y + row, True)
            made += 1
            if refractory_us > 0.0:
                release_us[row, x] = t0_us + time_us + refractory_us
                reference[row, x] = np.nan
            else:
                reference[row, x] += step
    return made


@njit(cache=True)
def _next_texel(start_x: float, across: float, start_y: float, down: float, at: float) -> float:
    """The part of the slice, after `at`, at which the object has next moved to a whole texel; at most 1."""
    if abs(across) + abs(down) > MOST_TEXELS:
        return min(at + 1.0 / MOST_TEXELS, 1.0)
    until = 1.0
    for begin, whole_way in ((start_x, across), (start_y, down)):
        if whole_way != 0.0:
            # Beyond `at` by more than rounding, or a part could have no length.
            here = begin + (at + 1e-9) * whole_way
            texel = math.floor(here) + 1.0 if whole_way > 0.0 else math.ceil(here) - 1.0
            until = min(until, max((texel - begin) / whole_way, at + 1e-9))
    return until


@njit(cache=True)
def _solve_parabolas(
    now: NDArray[np.float32],
    half_way: NDArray[np.float32],
    then: NDArray[np.float32],
    from_us: float,
    until_us: float,
    first_x: int,
    first_y: int,
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    refractory_us: float,
    release_us: NDArray[np.float64],
    t0_us: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Crossings of levels that run on parabolas through three pictures; returns the number of events so far.

    With equal times the three are one picture, to which the pixels have jumped.
    """
    rows, columns = reference.shape
    for row in range(rows):
        # Most rows have nothing to report, and counting vectorises. A parabola leaves its chord by a quarter of its
        # square term, |now - 2 half_way + then| / 2. NaN, a refractory pixel, counts.
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
                if made < len(keys):
                    keys[made] = camera._key(min(int(time_us), SLICE_US - 1), first_x + column, first_y + row, brighter)
                made += 1
                if refractory_us > 0.0:
                    release_us[row, column] = t0_us + time_us + refractory_us
                    level = np.float64(np.nan)
                else:
                    level = level + step if brighter else level - step
            reference[row, column] = level
    return made


@njit(cache=True)
def _first_root(square: float, slope: float, rest: float, part: float, by_the_end: bool) -> float:
    """Where square u^2 + slope u + rest, negative at `part`, first gets to 0; inf if it does not up to 1.

    `by_the_end` says that it is not negative at 1, so that rounding loses no crossing.
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
