"""A simulated DVXplorer Mini: the events that moving dots and a sliding texture make.

An ideal event camera follows every crossing of the threshold; this one scans. At a fixed rate it holds all pixels at
once, compares each with the level at its last event, and reads the changed ones out: at most one event a pixel and
scan, after which the present level is the new reference (5000 scans/s, global hold, no global reset: libcaer's
defaults). Several threshold steps within one scan become one event.

Timing: scan s of a slice holds the picture of its first instant, dots where their path has led them by then, and its
time stamps run on over the columns, t = scan start + column / width * scan period, rounded down. So an event comes up
to one scan after the change that made it, never before it, and the motion of the last scan period belongs to the next
slice.

Only what can have changed is looked at: the ring of a dot, both where it is and where it was last looked at, once it
has moved by RESOLUTION_PX; the window once the object has moved as far or the contrast is another. A dot's ring is
finite (see optics), so no pixel that is left behind misses its last event.

Lines that are not dots (see rims) change no picture but the references, by as much with the other sign; then the
pixels of both are compared. So a scan shows dots, lines and texture of one moment, and a pixel still has at most one
event.

Leak lowers every reference, at such a speed that a pixel left alone gets brighter `leak_hz` times a second. A row of
pixels is visited once in LEAK_SLICES slices, so these events come late by up to that. A refractory pixel is blind: its
reference follows what it is shown, until its time is over.

Left out: bandwidth, dilation of dots. Dots beyond the cut are the caller's to leave out. Background noise and hot
pixels are added on top at uniform times: they do not wait for a scan and leave the reference alone.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.sim import optics
from evetac_cli.sim.rims import (
    Outline,
    Place,
    Rims,
    check_place,
    cut_moved,
    cut_run,
    outline_moved,
    outline_rows,
    outline_runs,
    sample_cut,
    sample_row,
)

# A rim's steepest slope is 0.53 log units per px, so a level drifts by at most 0.005 before it is looked at again.
# Against every pixel in every scan this loses 1.9 % of the events at 0.005 px/ms, 0.9 % at 0.05, next to none from 0.3
# up, and delays the rest by the time a dot takes to move this far. Tremor below it is not seen.
RESOLUTION_PX = 0.01
FARTHEST_PX = 1e6
MOST_PIECES = 1000  # of a curved path in a slice
# Slices in which leak visits every row of pixels once: a divisor of 480, so that all slices visit equally many.
LEAK_SLICES = 40
# No pixel's threshold is below this share of the nominal one, however far the mismatch falls.
LOWEST_THRESHOLD = 0.25
# While a slice is made, an event is one integer: time in the slice, column, row, polarity.
TIME_SHIFT = 33
COLUMN_SHIFT = 17
ROW_SHIFT = 1
COORDINATE_MASK = 0xFFFF
NO_PICTURE = np.zeros((0, 0), np.float32)


@dataclass(frozen=True)
class CameraModel:
    """One camera individual; ValueError where a value is out of range.

    Thresholds are in log brightness, `mismatch` is their relative standard deviation over the pixels. The noise rate
    is per pixel; every hot pixel has a rate of its own, whose distribution has the evenly spaced quantiles
    `hot_rate_hz` (two: uniform between them). `leak_hz` is the rate a pixel of the events that leak makes; after an
    event a pixel is held in reset for `refractory_us`, and its next reference is the level at the end of that time. A
    slice holds at most `max_events`; what is beyond is lost, as on a full bus (the pixels have fired nevertheless),
    and counted.
    """

    frame_px: tuple[int, int] = FRAME_PX
    scans_per_ms: int = 5
    threshold: float = 0.2
    mismatch: float = 0.03
    noise_rate_hz: float = 0.03
    hot_pixels: int = 10
    hot_rate_hz: tuple[float, ...] = (20.0, 200.0)
    edge_sigma_px: float = optics.EDGE_SIGMA_PX
    log_contrast: float = optics.LOG_CONTRAST
    dot_radius_px: float = 15.0
    leak_hz: float = 0.0
    refractory_us: float = 0.0
    max_events: int = 1_000_000

    def __post_init__(self) -> None:
        width, height = self.frame_px
        _check_whole("frame_px, width", width, 1, 4096)
        _check_whole("frame_px, height", height, 1, 4096)
        _check_whole("scans_per_ms", self.scans_per_ms, 1, 100)
        _check_range("threshold", self.threshold, 0.01, 100.0)
        _check_range("mismatch", self.mismatch, 0.0, 1.0)
        _check_range("noise_rate_hz", self.noise_rate_hz, 0.0, 1e4)
        _check_whole("hot_pixels", self.hot_pixels, 0, width * height)
        _check_whole("hot_rate_hz, how many", len(self.hot_rate_hz), 2, 1000)
        for lower, rate in zip((0.0, *self.hot_rate_hz), self.hot_rate_hz, strict=False):
            _check_range("hot_rate_hz, rising", rate, lower, 1e5)
        _check_range("edge_sigma_px", self.edge_sigma_px, 0.01, 100.0)
        _check_range("log_contrast", self.log_contrast, 0.01, 20.0)
        _check_range("dot_radius_px", self.dot_radius_px, 0.01, 1000.0)
        _check_range("leak_hz", self.leak_hz, 0.0, 10.0)
        _check_range("refractory_us", self.refractory_us, 0.0, 1e6)
        _check_whole("max_events", self.max_events, 1, 100_000_000)


@dataclass
class CameraState:
    """What a camera remembers from slice to slice; `step` changes it in place.

    `reference` and `threshold` are those of the gel's pixels, shape (height, width); under the window the threshold is
    infinite, and the strip has a pair of its own. `seen_*` is what the pixels were last compared against.
    """

    model: CameraModel
    profile: optics.DotProfile
    reference: NDArray[np.float32]
    threshold: NDArray[np.float32]
    seen_dot_xy_px: NDArray[np.float64]
    window_px: tuple[int, int, int, int]  # x0, y0, x1, y1; all 0 without a window
    texture: NDArray[np.float32]
    strip_reference: NDArray[np.float32]
    strip_threshold: NDArray[np.float32]
    strip_level: NDArray[np.float32]  # scratch
    seen_object: NDArray[np.float64]  # x, y in px, contrast; NaN before the first slice
    hot_pixel: NDArray[np.int64]  # y * width + x
    hot_cumulative_hz: NDArray[np.float64]  # summed rates before each hot pixel, and of all
    readout_us: NDArray[np.int64]  # (scans, width): time in the slice at which a column is read
    keys: NDArray[np.int64]  # as long as a slice may be, so nothing grows; memory is taken only as far as it is written
    # Until when a pixel is blind; their rows are empty without a refractory time that scans can tell.
    release_us: NDArray[np.float64]
    strip_release_us: NDArray[np.float64]
    rims: Rims | None = None
    slices: int = 0
    dropped: int = 0


def start(
    model: CameraModel,
    dot_xy_px: ArrayLike,
    dot_radius_px: float | None,
    window_px: tuple[int, int, int, int] | None,
    texture: NDArray[np.float32] | None,
    rng: np.random.Generator,
    individual: np.random.Generator | None = None,
    rims: Rims | None = None,
) -> CameraState:
    """Switch the camera on before dots (dots, 2); draw thresholds, hot pixels, and a phase for every pixel.

    A pixel's reference starts at its level plus a uniform phase in (-C_i, C_i); without it all pixels of a rim would
    fire at once. `dot_radius_px` None takes the model's. `window_px` is x0, y0, x1, y1, ends excluded: its pixels see
    the texture (sides powers of two, from `optics.texture`) and no dots. Their first level is the one from which the
    first `step` starts, so an object that is there already makes no flash. Without texture they see nothing.
    `individual` draws what belongs to the camera itself, thresholds and hot pixels; without it `rng` draws them too.
    `rims`, from `rims.start` for this frame, are lines that are not dots; the camera owns them from now on.
    ValueError on non-finite positions, a window outside the frame, a texture that cannot be used or has no window.
    """
    width, height = model.frame_px
    dots = _positions("dot_xy_px", dot_xy_px)
    radius_px = model.dot_radius_px if dot_radius_px is None else float(dot_radius_px)
    _check_range("dot_radius_px", radius_px, 0.01, 1000.0)
    profile = optics.dot_profile(radius_px, model.edge_sigma_px, model.log_contrast)
    x0, y0, x1, y1 = _window(window_px, model.frame_px)
    pattern = _texture(texture, window_px)

    built = rng if individual is None else individual
    nominal = model.threshold * (1.0 + model.mismatch * built.standard_normal((height, width)))
    threshold: NDArray[np.float32] = np.maximum(nominal, LOWEST_THRESHOLD * model.threshold).astype(np.float32)
    phase: NDArray[np.float32] = threshold * rng.uniform(-1.0, 1.0, (height, width)).astype(np.float32)
    strip_threshold = threshold[y0:y1, x0:x1].copy()
    strip_reference = phase[y0:y1, x0:x1].copy()
    threshold[y0:y1, x0:x1] = np.inf
    columns = np.arange(model.scans_per_ms * width).reshape(-1, width)
    level = optics.gel_level(model.frame_px, dots, profile)
    if rims is not None:
        if rims.dot_level.shape != level.shape:
            raise ValueError(f"rims: expected those of a frame {model.frame_px}, found shape {rims.dot_level.shape}")
        rims.dot_level[:] = level
    blind = model.refractory_us > SLICE_US / model.scans_per_ms
    return CameraState(
        model=model,
        profile=profile,
        reference=level + phase,
        threshold=threshold,
        seen_dot_xy_px=dots.copy(),
        window_px=(x0, y0, x1, y1),
        texture=pattern,
        strip_reference=strip_reference,
        strip_threshold=strip_threshold,
        strip_level=np.zeros_like(strip_reference),
        seen_object=np.full(3, np.nan),
        hot_pixel=built.choice(width * height, model.hot_pixels, replace=False),
        hot_cumulative_hz=np.append(0.0, np.cumsum(_hot_rates(model, built))),
        readout_us=columns * SLICE_US // columns.size,
        keys=np.empty(model.max_events, np.int64),
        release_us=np.zeros((height, width if blind else 0)),
        strip_release_us=np.zeros((y1 - y0, x1 - x0 if blind else 0)),
        rims=rims,
    )


def step(
    state: CameraState,
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

    Dots (dots, 2) and the object's displacement (2,) move on straight lines from start to end, in px; the contrast
    (1: the texture as drawn, 0: out of sight) holds for the whole slice. Dots on curved paths come with `dot_path_px`
    (k + 1, dots, 2): where they are at k + 1 equally spaced times, from their start to their end. A camera with rims
    needs `rims_start` and `rims_end`, between which they move and fade evenly. ValueError on values that are not
    finite, farther than 1e6 px, of another shape than at `start`, or a path with other ends; the state is then as
    before.
    """
    t0_us = int(t0_us)
    dots = len(state.seen_dot_xy_px)
    dots_start = _positions("dot_xy_px_start", dot_xy_px_start, dots)
    dots_end = _positions("dot_xy_px_end", dot_xy_px_end, dots)
    path = _path(dot_path_px, dots_start, dots_end)
    object_start = _positions("object_xy_px_start", np.atleast_2d(object_xy_px_start), 1)[0]
    object_end = _positions("object_xy_px_end", np.atleast_2d(object_xy_px_end), 1)[0]
    _check_range("texture_contrast", texture_contrast, 0.0, 1e3)

    lines = _places(state.rims, rims_start, rims_end, coarsely=True)

    gel = (state.seen_dot_xy_px, *state.profile, state.reference, state.threshold, state.release_us)
    scanned = (state.readout_us, float(t0_us), float(state.model.refractory_us))
    window = (
        object_start,
        object_end,
        float(texture_contrast),
        state.seen_object,
        state.texture,
        state.window_px[0],
        state.window_px[1],
        state.strip_level,
        state.strip_reference,
        state.strip_threshold,
        state.strip_release_us,
    )
    if state.rims is not None and lines is not None:
        rims = state.rims
        seen = (rims.seen_corner, rims.seen_cut_x, rims.seen_level, rims.seen_cut_level, rims.dot_level)
        edge = (rims.cut_contrast, rims.cut_half_px)
        made, rims.events = _scan_lines(*lines, rims.outline, *edge, seen, path, gel, window, *scanned, state.keys)
    else:
        scans = (0, state.model.scans_per_ms)
        keep = NO_PICTURE if state.rims is None else state.rims.dot_level
        made = _scan_dots(path, *gel, *scanned, *scans, keep, state.keys, 0)
        if state.strip_level.size:
            made = _scan_window(*window, *scanned, *scans, state.keys, made)
        if state.rims is not None:
            state.rims.events = 0
    if state.model.leak_hz > 0.0:
        made = _leak(state, t0_us, made)
    state.slices += 1
    made = _add_noise(state, rng, made)
    kept = min(made, len(state.keys))
    state.dropped += made - kept
    return Events(*_sorted_columns(state.keys[:kept], t0_us))


@njit(cache=True)
def _scan_dots(
    path: NDArray[np.float64],
    seen_xy: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    first_scan: int,
    end_scan: int,
    picture: NDArray[np.float32],
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare the rings of dots that moved, scan by scan; returns the number of events, also of those that do not fit.

    Every pixel is compared against the whole picture of its scan. So where two rings cross, the second visit finds
    nothing left to report, and a pixel has at most one event a scan. `picture`, where there are rims, gets the level of
    every pixel compared.
    """
    dots, vertices, _ = path.shape
    scans = len(readout_us)
    now_xy = np.empty((dots, 2))
    near_xy = np.empty((dots, 2))
    line = np.empty(threshold.shape[1], np.float32)
    for scan in range(first_scan, end_scan):
        vertex, over = divmod(scan * (vertices - 1), scans)
        part = over / scans
        for dot in range(dots):
            for axis in range(2):
                way = path[dot, vertex + 1, axis] - path[dot, vertex, axis]
                now_xy[dot, axis] = path[dot, vertex, axis] + part * way
        for dot in range(dots):
            moved_x = now_xy[dot, 0] - seen_xy[dot, 0]
            moved_y = now_xy[dot, 1] - seen_xy[dot, 1]
            moved = math.sqrt(moved_x * moved_x + moved_y * moved_y)
            if moved < RESOLUTION_PX:
                continue
            # Outside a ring centred half way and widened by half the path, a pixel was and is under the dot, or was and
            # is not. After a jump the two discs are less: all of them, since a pixel may go from ink to gel at once.
            jumped = moved > outer
            widened = 0.0 if jumped else 0.5 * moved
            hole = 0.0 if jumped else inner - widened
            for visit in range(2 if jumped else 1):
                back = float(visit) if jumped else 0.5
                centre_x = now_xy[dot, 0] - back * moved_x
                centre_y = now_xy[dot, 1] - back * moved_y
                near = _dots_within(now_xy, centre_x, centre_y, 2.0 * outer + widened, near_xy)
                made = _compare_ring(
                    centre_x,
                    centre_y,
                    hole,
                    outer + widened,
                    near_xy[:near],
                    inner,
                    steps_per_px,
                    profile,
                    reference,
                    threshold,
                    release_us,
                    readout_us[scan],
                    t0_us + scan * SLICE_US / scans,
                    refractory_us,
                    picture,
                    line,
                    keys,
                    made,
                )
            seen_xy[dot, 0] = now_xy[dot, 0]
            seen_xy[dot, 1] = now_xy[dot, 1]
    return made


@njit(cache=True)
def _dots_within(
    dot_xy: NDArray[np.float64], centre_x: float, centre_y: float, reach: float, near_xy: NDArray[np.float64]
) -> int:
    """Collect the dots near a ring: those that can darken any of its pixels; returns their number."""
    near = 0
    for dot in range(len(dot_xy)):
        across = dot_xy[dot, 0] - centre_x
        down = dot_xy[dot, 1] - centre_y
        if across * across + down * down <= reach * reach:
            near_xy[near, 0] = dot_xy[dot, 0]
            near_xy[near, 1] = dot_xy[dot, 1]
            near += 1
    return near


@njit(cache=True)
def _compare_ring(
    centre_x: float,
    centre_y: float,
    hole: float,
    rim: float,
    near_xy: NDArray[np.float64],
    inner: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    picture: NDArray[np.float32],
    line: NDArray[np.float32],
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare the pixels between the circles of radius `hole` and `rim` with the level that the nearest dot gives them.

    `line` is scratch of a frame's width: all loops over a row but that of the comparison can be vectorised.
    """
    height, width = threshold.shape
    blinding = release_us.size > 0
    keeping = picture.size > 0
    for y in range(max(0, math.ceil(centre_y - rim)), min(height, math.floor(centre_y + rim) + 1)):
        down = y - centre_y
        rim_half = math.sqrt(max(0.0, rim * rim - down * down))
        left = max(0, math.ceil(centre_x - rim_half))
        right_end = min(width, math.floor(centre_x + rim_half) + 1)
        left_end = right_end
        right = right_end
        if hole > abs(down):
            hole_half = math.sqrt(hole * hole - down * down)
            left_end = min(right_end, math.floor(centre_x - hole_half) + 1)
            right = max(left, math.ceil(centre_x + hole_half))
        # Not a function of its own: passing its arrays takes longer than the ten pixels of a run.
        for first, end in ((left, left_end), (right, right_end)):
            line[: max(0, end - first)] = np.inf
            for near in range(len(near_xy)):
                near_x = near_xy[near, 0]
                down2 = np.float32(y - near_xy[near, 1]) ** 2
                for k in range(end - first):
                    across = np.float32(first + k - near_x)
                    line[k] = min(line[k], across * across + down2)
            for k in range(end - first):
                line[k] = optics.profile_position(line[k], np.float32(inner), np.float32(steps_per_px))
            if keeping or blinding:
                for k in range(end - first):
                    level = optics.profile_level(line[k], profile)
                    if keeping:
                        picture[y, first + k] = level
                    if blinding and release_us[y, first + k] > now_us:
                        reference[y, first + k] = level
            for k in range(end - first):
                x = first + k
                level = optics.profile_level(line[k], profile)
                change = level - reference[y, x]
                if abs(change) >= threshold[y, x]:
                    reference[y, x] = level
                    if blinding:
                        release_us[y, x] = now_us + refractory_us
                    if made < len(keys):
                        keys[made] = _key(readout_us[x], x, y, change > 0)
                    made += 1
    return made


@njit(cache=True)
def _scan_window(
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
    release_us: NDArray[np.float64],
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    first_scan: int,
    end_scan: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare the window's pixels in every scan at which the object has moved or the contrast is another."""
    scans = len(readout_us)
    for scan in range(first_scan, end_scan):
        part = scan / scans
        x = start_xy[0] + part * (end_xy[0] - start_xy[0])
        y = start_xy[1] + part * (end_xy[1] - start_xy[1])
        first_look = math.isnan(seen[2])
        moved = contrast > 0.0 and math.hypot(x - seen[0], y - seen[1]) >= RESOLUTION_PX
        if not (first_look or moved or contrast != seen[2]):
            continue
        optics.sample_texture(texture, first_x, first_y, x, y, contrast, level)
        seen[0] = x
        seen[1] = y
        seen[2] = contrast
        if first_look:
            reference += level
            continue
        now_us = t0_us + scan * SLICE_US / scans
        for row in range(len(level)):
            made = _compare_row(
                level[row],
                reference[row],
                threshold[row],
                release_us[row],
                first_x,
                first_y + row,
                readout_us[scan],
                now_us,
                refractory_us,
                keys,
                made,
            )
    return made


@njit(cache=True)
def _compare_row(
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
    """Compare pixels side by side, the first of which is (first_x, y); `release_us` is empty where none gets blind."""
    for k in range(len(release_us)):
        if release_us[k] > now_us:
            reference[k] = level[k]
    # Most rows have nothing to report, and counting vectorises.
    fired = 0
    for k in range(len(level)):
        fired += int(abs(level[k] - reference[k]) >= threshold[k])
    if fired == 0:
        return made
    for k in range(len(level)):
        change = level[k] - reference[k]
        if abs(change) >= threshold[k]:
            reference[k] = level[k]
            if len(release_us):
                release_us[k] = now_us + refractory_us
            if made < len(keys):
                keys[made] = _key(readout_us[first_x + k], first_x + k, y, change > 0)
            made += 1
    return made


@njit(cache=True)
def _scan_lines(
    start: Place,
    end: Place,
    outline: Outline,
    cut_contrast: float,
    cut_half: float,
    seen: tuple[Any, ...],
    path: NDArray[np.float64],
    gel: tuple[Any, ...],
    window: tuple[Any, ...],
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    keys: NDArray[np.int64],
) -> tuple[int, int]:
    """Scan dots and window with lines that move; returns the number of events, and of those that lines alone made.

    `seen` are the arrays of the rims, `gel` and `window` the arguments of `_scan_dots` and `_scan_window`.
    """
    seen_corner, seen_cut_x, seen_level, seen_cut_level, dot_level = seen
    reference, threshold, release_us = gel[5:]
    first_x, first_y, strip_level, strip_reference = window[5:9]
    pixels = (dot_level, *gel[5:], *window[5:])
    scans = len(readout_us)
    height, width = reference.shape
    rows, columns = outline.picture.shape
    cut_rows = len(seen_cut_x)
    moved_from = seen_corner.copy()
    cut_from = seen_cut_x.copy()
    line = np.empty(width, np.float32)
    made = 0
    of_lines = 0
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
        way = (x, y, moved_from[0], moved_from[1], faded)
        for row in range(first_row, end_row):
            left, left_end, right, right_end = outline_runs(outline.runs, columns, width, row, *way)
            for first, beyond in ((left, left_end), (right, right_end)):
                sample_row(outline.picture, x, y, strength, row, first, beyond, line)
                _shift(line, seen_level, row, first, beyond, reference, first_x, first_y, strip_reference)
        if first_row < end_row:
            seen_corner[0] = x
            seen_corner[1] = y
            seen_corner[2] = strength
        cut_from[:] = seen_cut_x
        for row in range(cut_rows):
            cut_x = start.cut_x_px[row] + part * (end.cut_x_px[row] - start.cut_x_px[row])
            if cut_moved(cut_contrast, cut_half, seen_cut_x[row], cut_x):
                first, beyond = cut_run(cut_half, width, seen_cut_x[row], cut_x)
                sample_cut(cut_contrast, cut_half, cut_x, first, beyond, line)
                _shift(line, seen_cut_level, row, first, beyond, reference, first_x, first_y, strip_reference)
                seen_cut_x[row] = cut_x

        made = _scan_dots(path, *gel, readout_us, t0_us, refractory_us, scan, scan + 1, dot_level, keys, made)
        if strip_level.size:
            made = _scan_window(*window, readout_us, t0_us, refractory_us, scan, scan + 1, keys, made)

        before = made
        when = (readout_us[scan], now_us, refractory_us)
        for row in range(first_row, end_row):
            left, left_end, right, right_end = outline_runs(outline.runs, columns, width, row, *way)
            for first, beyond in ((left, left_end), (right, right_end)):
                made = _compare_across(pixels, row, first, beyond, *when, keys, made)
        for row in range(cut_rows):
            if cut_from[row] != seen_cut_x[row]:
                first, beyond = cut_run(cut_half, width, cut_from[row], seen_cut_x[row])
                made = _compare_across(pixels, row, first, beyond, *when, keys, made)
        of_lines += made - before
    return made, of_lines


@njit(cache=True)
def _shift(
    line: NDArray[np.float32],
    seen_level: NDArray[np.float32],
    row: int,
    first: int,
    end: int,
    reference: NDArray[np.float32],
    first_x: int,
    first_y: int,
    strip_reference: NDArray[np.float32],
) -> None:
    """Take what lines add to pixels first to end of a row for seen: change their references by as much the other way.

    The pixels of the window have references of their own; under them those of the gel are of no account.
    """
    strip_rows, strip_columns = strip_reference.shape
    if first_y <= row < first_y + strip_rows:
        for x in range(max(first, first_x), min(end, first_x + strip_columns)):
            strip_reference[row - first_y, x - first_x] -= line[x - first] - seen_level[row, x]
    for k in range(end - first):
        reference[row, first + k] -= line[k] - seen_level[row, first + k]
        seen_level[row, first + k] = line[k]


@njit(cache=True)
def _compare_across(
    pixels: tuple[Any, ...],
    row: int,
    first: int,
    end: int,
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare pixels first to end of a row of the frame, those of the gel and those of the window."""
    dot_level, reference, threshold, release_us, first_x, first_y = pixels[:6]
    strip_level, strip_reference, strip_threshold, strip_release_us = pixels[6:]
    when = (readout_us, now_us, refractory_us, keys)
    if first < end:
        made = _compare_row(
            dot_level[row, first:end],
            reference[row, first:end],
            threshold[row, first:end],
            release_us[row, first:end],
            first,
            row,
            *when,
            made,
        )
    strip_rows, strip_columns = strip_level.shape
    left = max(first, first_x) - first_x
    right = min(end, first_x + strip_columns) - first_x
    if first_y <= row < first_y + strip_rows and left < right:
        made = _compare_row(
            strip_level[row - first_y, left:right],
            strip_reference[row - first_y, left:right],
            strip_threshold[row - first_y, left:right],
            strip_release_us[row - first_y, left:right],
            first_x + left,
            row,
            *when,
            made,
        )
    return made


def _places(
    rims: Rims | None, start: Place | None, end: Place | None, *, coarsely: bool = False
) -> tuple[Place, Place] | None:
    """Where lines are at both ends of a slice, checked; None if there are none, or none that moves.

    `coarsely`, a cut edge that moves less than scans look at does not, which keeps a slow shear cheap.
    """
    if rims is None:
        if start is not None or end is not None:
            raise ValueError("rims_start, rims_end: expected none before a camera without rims, found some")
        return None
    if start is None or end is None:
        raise ValueError("rims_start, rims_end: expected both before a camera with rims, found none")
    if start is end is rims.rested:
        return None
    places = check_place("rims_start", rims, start), check_place("rims_end", rims, end)
    rims.rested = end if start is end else None
    return None if rims.still(*places, rims.cut_resolution_px * 0.99 if coarsely else 0.0) else places


def _leak(state: CameraState, t0_us: int, made: int) -> int:
    """Let leak lower the references of the rows whose turn it is, and compare them."""
    return int(
        _leak_rows(
            state.slices % LEAK_SLICES,
            np.float32(state.model.leak_hz * LEAK_SLICES * SLICE_US * 1e-6),
            state.seen_dot_xy_px,
            *state.profile,
            state.reference,
            state.threshold,
            state.release_us,
            state.window_px[0],
            state.window_px[1],
            state.strip_level,
            state.strip_reference,
            state.strip_threshold,
            state.strip_release_us,
            state.readout_us,
            float(t0_us),
            float(state.model.refractory_us),
            state.keys,
            made,
        )
    )


@njit(cache=True)
def _leak_rows(
    first_row: int,
    drift: np.float32,
    dot_xy: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    first_x: int,
    first_y: int,
    strip_level: NDArray[np.float32],
    strip_reference: NDArray[np.float32],
    strip_threshold: NDArray[np.float32],
    strip_release_us: NDArray[np.float64],
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Visit every LEAK_SLICES-th row, each in one of the slice's scans; `drift` is in thresholds."""
    height, width = reference.shape
    scans = len(readout_us)
    line = np.empty(width, np.float32)
    for row in range(first_row, height, LEAK_SLICES):
        scan = (row // LEAK_SLICES) % scans
        when = (drift, row, readout_us[scan], t0_us + scan * SLICE_US / scans, refractory_us, keys)
        optics.dot_row(dot_xy, inner, outer, steps_per_px, profile, row, 0, width, line)
        made = _leak_row(line, reference[row], threshold[row], release_us[row], 0, *when, made)
        own = row - first_y
        if 0 <= own < len(strip_level):
            strip = (strip_level[own], strip_reference[own], strip_threshold[own], strip_release_us[own])
            made = _leak_row(*strip, first_x, *when, made)
    return made


@njit(cache=True)
def _leak_row(
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    first_x: int,
    drift: np.float32,
    y: int,
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Lower references side by side. After an event they keep what has leaked since the crossing, or the rate falls."""
    for k in range(len(level)):
        step = threshold[k]
        if step == np.inf:  # a pixel of the window, which has references of its own
            continue
        if len(release_us) and release_us[k] > now_us:
            reference[k] = level[k]
            continue
        reference[k] -= drift * step
        if level[k] - reference[k] < step:
            continue
        reference[k] += step
        if len(release_us):
            release_us[k] = now_us + refractory_us
        if made < len(keys):
            keys[made] = _key(readout_us[first_x + k], first_x + k, y, True)
        made += 1
    return made


def _add_noise(state: CameraState, rng: np.random.Generator, made: int) -> int:
    """Add background and hot pixels: one Poisson process of all rates; a uniform number says whose event it is."""
    height, width = state.threshold.shape
    background_hz = state.model.noise_rate_hz * width * height
    total_hz = background_hz + state.hot_cumulative_hz[-1]
    uniform = rng.random((rng.poisson(total_hz * SLICE_US * 1e-6), 2))
    hot = (state.hot_pixel, state.hot_cumulative_hz)
    return int(_place_noise(uniform, total_hz, background_hz, *hot, width, height, state.keys, made))


def _hot_rates(model: CameraModel, rng: np.random.Generator) -> NDArray[np.float64]:
    """Rate of every hot pixel, drawn by the inverse of its distribution."""
    share = np.linspace(0.0, 1.0, len(model.hot_rate_hz))
    return np.interp(rng.random(model.hot_pixels), share, model.hot_rate_hz)


@njit(cache=True)
def _place_noise(
    uniform: NDArray[np.float64],
    total_hz: float,
    background_hz: float,
    hot_pixel: NDArray[np.int64],
    hot_cumulative_hz: NDArray[np.float64],
    width: int,
    height: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    for event in range(len(uniform)):
        place_hz = uniform[event, 0] * total_hz
        if place_hz < background_hz:
            pixel = min(int(place_hz / background_hz * width * height), width * height - 1)
        else:
            hot = np.searchsorted(hot_cumulative_hz, place_hz - background_hz, side="right") - 1
            pixel = hot_pixel[min(hot, len(hot_pixel) - 1)]
        time_and_sign = int(uniform[event, 1] * 2 * SLICE_US)
        if made < len(keys):
            keys[made] = _key(time_and_sign >> 1, pixel % width, pixel // width, time_and_sign & 1 == 1)
        made += 1
    return made


@njit(cache=True)
def _key(time_us: int, x: int, y: int, brighter: bool) -> int:
    return (time_us << TIME_SHIFT) | (x << COLUMN_SHIFT) | (y << ROW_SHIFT) | int(brighter)


@njit(cache=True)
def _sorted_columns(
    keys: NDArray[np.int64], t0_us: int
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Counting sort by time, stable: 1000 times are few against the events of a busy slice."""
    place = np.zeros(SLICE_US + 1, np.int64)
    for key in keys:
        place[(key >> TIME_SHIFT) + 1] += 1
    for time in range(SLICE_US):
        place[time + 1] += place[time]
    t_us = np.empty(len(keys), np.int64)
    x = np.empty(len(keys), np.uint16)
    y = np.empty(len(keys), np.uint16)
    p = np.empty(len(keys), np.uint8)
    for key in keys:
        time = key >> TIME_SHIFT
        event = place[time]
        place[time] += 1
        t_us[event] = t0_us + time
        x[event] = (key >> COLUMN_SHIFT) & COORDINATE_MASK
        y[event] = (key >> ROW_SHIFT) & COORDINATE_MASK
        p[event] = key & 1
    return t_us, x, y, p


def _positions(name: str, given: ArrayLike, count: int | None = None) -> NDArray[np.float64]:
    xy = np.ascontiguousarray(given, np.float64)
    if xy.size == 0 and count in (0, None):
        return np.empty((0, 2))
    if xy.ndim != 2 or xy.shape[1] != 2 or count not in (None, len(xy)):
        raise ValueError(f"{name}: expected ({'n' if count is None else count}, 2), found shape {xy.shape}")
    if not _all_within(xy, FARTHEST_PX):
        raise ValueError(f"{name}: expected finite positions within {FARTHEST_PX:g} px, found {xy.min()} to {xy.max()}")
    return xy


def _path(
    given: ArrayLike | None, dots_start: NDArray[np.float64], dots_end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Vertices of every dot's path, shape (dots, k + 1, 2)."""
    if given is None:
        return np.ascontiguousarray(np.stack([dots_start, dots_end], axis=1))
    dots = len(dots_start)
    path = np.asarray(given, np.float64)
    if path.ndim != 3 or path.shape[1:] != (dots, 2) or not 2 <= len(path) <= MOST_PIECES + 1:
        raise ValueError(f"dot_path_px: expected (2 to {MOST_PIECES + 1}, {dots}, 2), found shape {path.shape}")
    _positions("dot_path_px", path.reshape(-1, 2))
    if not (np.array_equal(path[0], dots_start) and np.array_equal(path[-1], dots_end)):
        raise ValueError("dot_path_px: expected dot_xy_px_start first and dot_xy_px_end last, found other positions")
    return np.ascontiguousarray(path.transpose(1, 0, 2))


@njit(cache=True)
def _all_within(xy: NDArray[np.float64], limit: float) -> bool:
    return bool(np.all(np.abs(xy) <= limit))  # false for NaN


def _window(window_px: tuple[int, int, int, int] | None, frame_px: tuple[int, int]) -> tuple[int, int, int, int]:
    if window_px is None:
        return 0, 0, 0, 0
    x0, y0, x1, y1 = (int(corner) for corner in window_px)
    if not (0 <= x0 < x1 <= frame_px[0] and 0 <= y0 < y1 <= frame_px[1]):
        raise ValueError(f"window_px: expected x0, y0, x1, y1 within the frame {frame_px}, found {tuple(window_px)}")
    return x0, y0, x1, y1


def _texture(texture: NDArray[np.float32] | None, window_px: tuple[int, int, int, int] | None) -> NDArray[np.float32]:
    if texture is None:
        return np.zeros((1, 1), np.float32)
    if window_px is None:
        raise ValueError("texture: expected none without a window, found one")
    pattern = np.ascontiguousarray(texture, np.float32)
    if pattern.ndim != 2 or any(size < 1 or size & (size - 1) for size in pattern.shape):
        raise ValueError(f"texture: expected two dimensions that are powers of two, found shape {pattern.shape}")
    if not np.isfinite(pattern).all():
        raise ValueError("texture: expected finite levels, found NaN or infinity")
    return pattern


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name}: expected {low:g} to {high:g}, found {value}")


def _check_whole(name: str, value: int, low: int, high: int) -> None:
    if not isinstance(value, (int, np.integer)):
        raise ValueError(f"{name}: expected a whole number, found {value!r}")
    _check_range(name, value, low, high)
