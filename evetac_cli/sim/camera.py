"""A simulated DVXplorer Mini: the events that moving dots and a sliding texture make.

An ideal event camera follows every crossing of the threshold; this one scans. At a fixed rate it holds all pixels at
once, compares each with the level at its last event, and reads the changed ones out: at most one event a pixel and
scan, after which the present level is the new reference (5000 scans/s, global hold, no global reset: libcaer's
defaults). Several threshold steps within one scan become one event.

Timing: scan s of a slice holds the picture of its first instant, dots where their path has led them by then, and its
time stamps run on over the columns, t = scan start + column / width * scan period, rounded down. So an event comes up
to one scan after the change that made it, never before it, and the motion of the last scan period belongs to the next
slice.

The events are those of every pixel compared in every scan (but for RESOLUTION_PX), but most
pixels are asleep (why so: 63 dots have 46,000 ring pixels, and a scan makes some 200 events where all dots shake, next
to none in a creep):
- from its reference and threshold follow two distances to the nearest dot between which a pixel surely does not fire;
  while the box of a dot's path over the slice keeps it between them, it costs a comparison;
- of a slow dot even that is done once in many slices: a list of the pixels that may fire holds as long as the dot stays
  within a somewhat larger box;
- a level of the window changes by no more than the texture's steepest slope times the way of the object. A short run of
  pixels sleeps until that has used up what its most wakeful pixel lacks to its threshold.

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
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.sim import optics, rings
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

# A dot that has moved by no more, on either axis, since it was last looked at rests: no level has changed by more than
# 0.0008, and tremor below it is not seen. It saves the looking where nothing but creep goes on.
RESOLUTION_PX = 0.001
# A dot that moves by `way` in a slice gets a list that holds for a box wider by SKIN_PX * sqrt(way) on each side: what
# its making costs, spread over the slices until the dot has left the box, and what its length costs in each slice, are
# then least together. From FAST_PX a slice on a list does not pay.
SKIN_PX = 0.7
FAST_PX = 0.2
RUSH_PX = 0.25  # half the way in a slice from which on radii do not pay either
MOST_WATCHED = 512  # pixels in the list of a dot; larger or blurred dots may do without
# Pixels side by side that wake together: with more, the most wakeful has less sleep; with fewer, there is more to ask.
RUN_PX = 16
# Where levels change by more in a scan, or fade, a run gets no sleep that is worth its finding.
FAST_LEVEL = 0.002
# More than single precision costs a level of the window, relative to the greatest.
RUN_ROUNDING = 4e-6
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
PIXEL_SHIFT = 16


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


class Sleep(NamedTuple):
    """Which gel pixels may fire; a memory of what follows from references and paths, to be dropped at any time.

    Between the square roots of `lower2_px2` and `upper2_px2` (height, width) from the nearest dot a pixel surely does
    not fire; infinity for the first: found anew when a dot comes near. While a dot stays in its `watch_box` (dots, 4:
    centre and half sides, NaN without a list), only the first `watching` pixels of its list `watched` may fire, each
    y << PIXEL_SHIFT | x, with radii `watched_px2` (dots, 2, pixels) of their own, side by side in memory, which is what
    the visit of a list costs. `awake` and `entry` are scratch, for a frame and for a list. `level_index` helps to find
    radii.
    """

    level_index: NDArray[np.int16]
    lower2_px2: NDArray[np.float32]
    upper2_px2: NDArray[np.float32]
    watch_box: NDArray[np.float64]
    watched: NDArray[np.int32]
    watched_px2: NDArray[np.float32]
    watching: NDArray[np.int64]
    awake: NDArray[np.int32]
    entry: NDArray[np.int64]


class StripSleep(NamedTuple):
    """Which runs of RUN_PX pixels of the window may fire: those whose `wake_at` (rows, runs) has been travelled.

    `row_wakes_at` (rows,) is a row's least. `travelled` (1,) adds up by how much any level can have changed so far,
    from the texture's steepest slopes `across` and `down`, log units per px; `greatest` is its greatest level.
    """

    wake_at: NDArray[np.float64]
    row_wakes_at: NDArray[np.float64]
    travelled: NDArray[np.float64]
    across: float
    down: float
    greatest: float


@dataclass
class CameraState:
    """What a camera remembers from slice to slice; `step` changes it in place.

    `reference` and `threshold` are those of the gel's pixels, shape (height, width); under the window the threshold is
    infinite, and the strip has a pair of its own. `seen_*` is where things were at the last scan.
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
    sleep: Sleep
    strip_sleep: StripSleep
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
    if rims is not None and rims.frame_px != (width, height):
        raise ValueError(f"rims: expected those of a frame {model.frame_px}, found one of {rims.frame_px}")
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
        sleep=Sleep(
            level_index=optics.level_index(profile),
            lower2_px2=np.full((height, width), np.inf, np.float32),
            upper2_px2=np.full((height, width), np.inf, np.float32),
            watch_box=np.full((len(dots), 4), np.nan),
            watched=np.empty((len(dots), MOST_WATCHED), np.int32),
            watched_px2=np.empty((len(dots), 2, MOST_WATCHED), np.float32),
            watching=np.zeros(len(dots), np.int64),
            awake=np.empty(max(height * width, MOST_WATCHED) + 1, np.int32),
            entry=np.empty(MOST_WATCHED + 1, np.int64),
        ),
        strip_sleep=StripSleep(
            np.full((y1 - y0, -((x0 - x1) // RUN_PX)), -np.inf),
            np.full(y1 - y0, -np.inf),
            np.zeros(1),
            *optics.texture_slope(pattern),
        ),
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

    gel = (state.seen_dot_xy_px, *state.profile, state.reference, state.threshold, state.release_us, state.sleep)
    scanned = (state.readout_us, float(t0_us), float(state.model.refractory_us))
    window = (
        object_start,
        object_end,
        float(texture_contrast),
        state.seen_object,
        state.texture,
        state.window_px[0],
        state.window_px[1],
        state.strip_reference,
        state.strip_threshold,
        state.strip_release_us,
        state.strip_sleep,
    )
    if state.rims is not None and lines is not None:
        rims = state.rims
        seen = (rims.seen_corner, rims.seen_cut_x, rims.seen_level, rims.seen_cut_level)
        edge = (rims.cut_contrast, rims.cut_half_px)
        made, rims.events = _scan_lines(*lines, rims.outline, *edge, seen, path, gel, window, *scanned, state.keys)
    else:
        scans = (0, state.model.scans_per_ms)
        made = _scan_dots(path, *gel, *scanned, *scans, state.keys, 0)
        if state.strip_reference.size:
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
    sleep: Sleep,
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    first_scan: int,
    end_scan: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare the pixels that may fire in some scans; returns the number of events, also of those that do not fit.

    Every pixel is compared against the whole picture of its scan, so it has at most one event a scan.
    """
    dots = len(path)
    scans = len(readout_us)
    at_xy = np.empty((dots, end_scan - first_scan, 2))
    _at_scans(path, scans, first_scan, at_xy)
    box = rings.boxes(at_xy, seen_xy)
    crowded = rings.crowded(box, outer)
    near_xy = np.empty_like(at_xy)
    near_box = np.empty((dots, 4))
    table = (inner, outer, steps_per_px, profile)
    pixels = (reference, threshold, release_us)
    now_us = t0_us + first_scan * SLICE_US / scans
    last_us = t0_us + (end_scan - 1) * SLICE_US / scans
    for dot in range(dots):
        if max(box[dot, 2], box[dot, 3]) <= 0.5 * RESOLUTION_PX:
            continue
        near = 1
        if crowded[dot]:
            near = rings.dots_near(dot, at_xy, box, outer, near_xy, near_box)
            sleep.watch_box[dot] = np.nan
            found = _ring_pixels(box[dot], inner, outer, False, sleep)
            found = _keep_own(dot, found, box, inner, outer, sleep)
            found = _keep_awake(sleep.awake[:found], near_box[:near], *table, *pixels, now_us, sleep)
        else:
            if not _is_within(box, sleep.watch_box, dot):
                _make_list(dot, box[dot], *table, *pixels, now_us, sleep)
            if sleep.watching[dot] >= 0:
                found = _keep_listed(
                    dot, box, sleep.watching[dot], sleep.watched, sleep.watched_px2, sleep.awake, sleep.entry
                )
            else:
                rushes = max(box[dot, 2], box[dot, 3]) > RUSH_PX
                found = _ring_pixels(box[dot], inner, outer, not rushes, sleep)
                if not rushes:
                    found = _keep_awake(sleep.awake[:found], box[dot : dot + 1], *table, *pixels, now_us, sleep)
        if found > 0:
            seen_by = near_xy[:near] if crowded[dot] else at_xy[dot : dot + 1]
            made = _compare_pixels(
                sleep.awake[:found],
                seen_by,
                inner,
                steps_per_px,
                profile,
                *pixels,
                sleep.lower2_px2,
                sleep.upper2_px2,
                readout_us,
                t0_us,
                refractory_us,
                first_scan,
                keys,
                made,
            )
            if not crowded[dot] and sleep.watching[dot] >= 0:
                _renew_listed(dot, found, *table, *pixels, last_us, sleep)
        for axis in range(2):
            seen_xy[dot, axis] = at_xy[dot, end_scan - first_scan - 1, axis]
    return made


@njit(cache=True)
def _at_scans(path: NDArray[np.float64], scans: int, first_scan: int, at_xy: NDArray[np.float64]) -> None:
    """Where dots (dots, k, 2) are at k scans from the first on."""
    dots, vertices, _ = path.shape
    for shot in range(at_xy.shape[1]):
        vertex, over = divmod((first_scan + shot) * (vertices - 1), scans)
        part = over / scans
        for dot in range(dots):
            for axis in range(2):
                way = path[dot, vertex + 1, axis] - path[dot, vertex, axis]
                at_xy[dot, shot, axis] = path[dot, vertex, axis] + part * way


@njit(cache=True)
def _is_within(box: NDArray[np.float64], wider: NDArray[np.float64], dot: int) -> bool:
    """Whether a dot's box of (dots, 4) lies in its wider one; not if that is NaN."""
    across = abs(box[dot, 0] - wider[dot, 0]) + box[dot, 2] <= wider[dot, 2]
    return bool(across and abs(box[dot, 1] - wider[dot, 1]) + box[dot, 3] <= wider[dot, 3])


@njit(cache=True)
def _make_list(
    dot: int,
    box: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    now_us: float,
    sleep: Sleep,
) -> None:
    """List the pixels that may fire while a dot is in a box somewhat wider than (4,); none for a fast dot."""
    sleep.watch_box[dot] = np.nan
    sleep.watching[dot] = -1
    way = 2.0 * max(box[2], box[3])
    if way >= FAST_PX:
        return
    wider = np.empty((1, 4))
    wider[0] = box
    wider[0, 2:] += SKIN_PX * math.sqrt(way)
    found = _ring_pixels(wider[0], inner, outer, True, sleep)
    found = _keep_awake(
        sleep.awake[:found],
        wider,
        inner,
        outer,
        steps_per_px,
        profile,
        reference,
        threshold,
        release_us,
        now_us,
        sleep,
    )
    if found <= sleep.watched.shape[1]:
        for k in range(found):
            pixel = sleep.awake[k]
            sleep.watched[dot, k] = pixel
            sleep.watched_px2[dot, 0, k] = sleep.lower2_px2[pixel >> PIXEL_SHIFT, pixel & COORDINATE_MASK]
            sleep.watched_px2[dot, 1, k] = sleep.upper2_px2[pixel >> PIXEL_SHIFT, pixel & COORDINATE_MASK]
        sleep.watching[dot] = found
        sleep.watch_box[dot] = wider[0]


@njit(cache=True)
def _keep_listed(
    dot: int,
    box: NDArray[np.float64],
    pixels: int,
    watched: NDArray[np.int32],
    watched_px2: NDArray[np.float32],
    awake: NDArray[np.int32],
    entry: NDArray[np.int64],
) -> int:
    """As `_keep_awake`, of a dot's list, for its box of (dots, 4); `entry` gets the kept ones' places in the list."""
    centre_x = box[dot, 0]
    centre_y = box[dot, 1]
    half_x = np.float32(box[dot, 2])
    half_y = np.float32(box[dot, 3])
    kept = 0
    for k in range(pixels):
        pixel = watched[dot, k]
        across = np.float32(abs((pixel & COORDINATE_MASK) - centre_x))
        down = np.float32(abs((pixel >> PIXEL_SHIFT) - centre_y))
        nearest_across = max(across - half_x, np.float32(0.0))
        nearest_down = max(down - half_y, np.float32(0.0))
        farthest_across = across + half_x
        farthest_down = down + half_y
        least2 = nearest_across * nearest_across + nearest_down * nearest_down
        greatest2 = farthest_across * farthest_across + farthest_down * farthest_down
        awake[kept] = pixel
        entry[kept] = k
        kept += int(not ((least2 >= watched_px2[dot, 0, k]) & (greatest2 <= watched_px2[dot, 1, k])))
    return kept


@njit(cache=True)
def _renew_listed(
    dot: int,
    kept: int,
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    now_us: float,
    sleep: Sleep,
) -> None:
    """Find new radii for the kept pixels of a dot's list that have fired; not yet for blind ones."""
    for k in range(kept):
        pixel = sleep.awake[k]
        y = pixel >> PIXEL_SHIFT
        x = pixel & COORDINATE_MASK
        if sleep.lower2_px2[y, x] == np.inf and not (release_us.size > 0 and release_us[y, x] > now_us):
            radii = optics.sleeping_radii(
                reference[y, x], threshold[y, x], inner, outer, steps_per_px, profile, sleep.level_index
            )
            sleep.lower2_px2[y, x] = radii[0]
            sleep.upper2_px2[y, x] = radii[1]
        sleep.watched_px2[dot, 0, sleep.entry[k]] = sleep.lower2_px2[y, x]
        sleep.watched_px2[dot, 1, sleep.entry[k]] = sleep.upper2_px2[y, x]


@njit(cache=True)
def _ring_pixels(own: NDArray[np.float64], inner: float, outer: float, awake_only: bool, sleep: Sleep) -> int:
    """Collect the pixels of a dot's ring in `sleep.awake`, those that no place in its box (4,) lets fire left out.

    They are not unless `awake_only`. Without a branch for each pixel, which would cost more than the rest. Returns
    their number.
    """
    height, width = sleep.lower2_px2.shape
    awake = sleep.awake
    found = 0
    first_row, end_row = rings.ring_rows(own, outer, height)
    half_x = np.float32(own[2])
    for y in range(first_row, end_row):
        down = abs(y - own[1])
        nearest_down2 = np.float32(max(down - own[3], 0.0) ** 2)
        farthest_down2 = np.float32((down + own[3]) ** 2)
        left, left_end, right, right_end = rings.ring_runs(own, inner, outer, y, width)
        lower2 = sleep.lower2_px2[y]
        upper2 = sleep.upper2_px2[y]
        for first, end in ((left, left_end), (right, right_end)):
            for x in range(first, end):
                across = np.float32(abs(x - own[0]))
                nearest_across = max(across - half_x, np.float32(0.0))
                farthest_across = across + half_x
                sleeps = (nearest_across * nearest_across + nearest_down2 >= lower2[x]) & (
                    farthest_across * farthest_across + farthest_down2 <= upper2[x]
                )
                awake[found] = y << PIXEL_SHIFT | x
                found += int(not (sleeps & awake_only))
    return found


@njit(cache=True)
def _keep_own(dot: int, found: int, box: NDArray[np.float64], inner: float, outer: float, sleep: Sleep) -> int:
    """Leave pixels that are also in the ring of an earlier dot that moves to that one; returns the number kept."""
    height, width = sleep.lower2_px2.shape
    kept = 0
    for k in range(found):
        pixel = sleep.awake[k]
        y = pixel >> PIXEL_SHIFT
        x = pixel & COORDINATE_MASK
        taken = False
        for other in range(dot):
            if max(box[other, 2], box[other, 3]) <= 0.5 * RESOLUTION_PX:
                continue
            first_row, end_row = rings.ring_rows(box[other], outer, height)
            if first_row <= y < end_row:
                left, left_end, right, right_end = rings.ring_runs(box[other], inner, outer, y, width)
                taken = taken or left <= x < left_end or right <= x < right_end
        if not taken:
            sleep.awake[kept] = pixel
            kept += 1
    return kept


@njit(cache=True)
def _keep_awake(
    given: NDArray[np.int32],
    near_box: NDArray[np.float64],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    now_us: float,
    sleep: Sleep,
) -> int:
    """Collect in `sleep.awake` the given pixels that may fire while dots are in their boxes; returns how many.

    Blind pixels have no radii and are kept: their references follow what they are shown.
    """
    awake = sleep.awake
    lower2 = sleep.lower2_px2
    upper2 = sleep.upper2_px2
    alone = len(near_box) == 1
    centre_x, centre_y, half_x, half_y = near_box[0]
    kept = 0
    for pixel in given:
        y = pixel >> PIXEL_SHIFT
        x = pixel & COORDINATE_MASK
        if lower2[y, x] == np.inf and not (release_us.size > 0 and release_us[y, x] > now_us):
            radii = optics.sleeping_radii(
                reference[y, x], threshold[y, x], inner, outer, steps_per_px, profile, sleep.level_index
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
            least2, greatest2 = rings.bounds(x, y, near_box)
        awake[kept] = pixel
        kept += int(not ((least2 >= lower2[y, x]) & (greatest2 <= upper2[y, x])))
    return kept


@njit(cache=True)
def _compare_pixels(
    awake: NDArray[np.int32],
    near_xy: NDArray[np.float64],
    inner: float,
    steps_per_px: float,
    profile: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    lower2_px2: NDArray[np.float32],
    upper2_px2: NDArray[np.float32],
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    first_scan: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare some pixels in every scan with the level that the nearest of some dots (near, scans, 2) gives them.

    Until one fires, its radii say of most scans that it does not; its new ones are found when it is next needed.
    """
    near, shots, _ = near_xy.shape
    scan_us = SLICE_US / len(readout_us)
    blinding = release_us.size > 0
    for pixel in awake:
        y = pixel >> PIXEL_SHIFT
        x = pixel & COORDINATE_MASK
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
                reference[y, x] = level
                continue
            change = level - reference[y, x]
            if abs(change) < threshold[y, x]:
                continue
            reference[y, x] = level
            if made < len(keys):
                keys[made] = _key(readout_us[first_scan + shot, x], x, y, change > 0)
            made += 1
            if blinding:
                release_us[y, x] = now_us + refractory_us
            lower2 = np.float32(np.inf)
        lower2_px2[y, x] = lower2
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
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    release_us: NDArray[np.float64],
    sleep: StripSleep,
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    first_scan: int,
    end_scan: int,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare the window's runs of pixels that may fire, in every scan at which the picture is another."""
    scans = len(readout_us)
    rows, columns = reference.shape
    runs = sleep.wake_at.shape[1]
    line = np.empty(columns, np.float32)
    for scan in range(first_scan, end_scan):
        part = scan / scans
        x = start_xy[0] + part * (end_xy[0] - start_xy[0])
        y = start_xy[1] + part * (end_xy[1] - start_xy[1])
        way = contrast * (sleep.across * abs(x - seen[0]) + sleep.down * abs(y - seen[1]))
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
            sleep.wake_at[:] = -np.inf
            sleep.row_wakes_at[:] = -np.inf
        elif way == 0.0:
            continue
        else:
            sleep.travelled[0] += way
        travelled = sleep.travelled[0]
        fast = faded or way > FAST_LEVEL
        rounding = RUN_ROUNDING * contrast * sleep.greatest
        now_us = t0_us + scan * SLICE_US / scans
        for row in range(rows):
            if not fast and travelled < sleep.row_wakes_at[row]:
                continue
            wake_at = sleep.wake_at[row]
            run = 0
            while run < runs:
                if not fast and travelled < wake_at[run]:
                    run += 1
                    continue
                first_run = run
                while run < runs and (fast or travelled >= wake_at[run]):
                    run += 1
                first = first_run * RUN_PX
                end = min(run * RUN_PX, columns)
                optics.sample_texture_run(texture, *place, row, first, end, line)
                blind_until_us = release_us[row, first:end]
                made = _compare_row(
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
                if fast:  # what slept may go on to: it has not fired
                    continue
                for awake_run in range(first_run, run):
                    begin = awake_run * RUN_PX
                    beyond = min(begin + RUN_PX, columns)
                    slack = _least_slack(
                        line[begin - first : beyond - first],
                        reference[row, begin:beyond],
                        threshold[row, begin:beyond],
                        blind_until_us[begin - first : beyond - first],
                        now_us,
                    )
                    wake_at[awake_run] = travelled + slack - rounding
            if not fast:
                sleep.row_wakes_at[row] = wake_at.min()
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
    seen_corner, seen_cut_x, seen_level, seen_cut_level = seen
    outer = gel[2]
    reference = gel[5]
    sleep = gel[8]
    scans = len(readout_us)
    height, width = reference.shape
    rows, columns = outline.picture.shape
    cut_rows = len(seen_cut_x)
    moved_from = seen_corner.copy()
    cut_from = seen_cut_x.copy()
    line = np.empty(width, np.float32)
    contrast, object_seen, texture, first_x, first_y, strip_reference = window[2:8]
    reach = _reach_of_lines(start, end, cut_half, rows, columns, seen_corner, seen_cut_x)
    dot_xy, dots = _dots_at_lines(path, gel[0], scans, outer, reach)
    scanned = (readout_us, t0_us, refractory_us)
    runs_wake_at = (window[10].wake_at, window[10].row_wakes_at)
    shifted = (reference, sleep.lower2_px2, first_x, first_y, strip_reference, *runs_wake_at)
    made = 0
    of_lines = 0
    if dots == 0:
        made = _scan_dots(path, *gel, *scanned, 0, scans, keys, made)
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
        touched = (width, 0)
        for row in range(first_row, end_row):
            left, left_end, right, right_end = outline_runs(outline.runs, columns, width, row, *way)
            for first, beyond in ((left, left_end), (right, right_end)):
                sample_row(outline.picture, x, y, strength, row, first, beyond, line)
                _shift(line, seen_level, row, first, beyond, *shifted)
            touched = (min(touched[0], left), max(touched[1], right_end))
        _forget_lists(sleep.watch_box, outer, first_row, end_row, *touched)
        if first_row < end_row:
            seen_corner[0] = x
            seen_corner[1] = y
            seen_corner[2] = strength
        cut_from[:] = seen_cut_x
        touched = (width, 0)
        for row in range(cut_rows):
            cut_x = start.cut_x_px[row] + part * (end.cut_x_px[row] - start.cut_x_px[row])
            if cut_moved(cut_contrast, cut_half, seen_cut_x[row], cut_x):
                first, beyond = cut_run(cut_half, width, seen_cut_x[row], cut_x)
                sample_cut(cut_contrast, cut_half, cut_x, first, beyond, line)
                _shift(line, seen_cut_level, row, first, beyond, *shifted)
                seen_cut_x[row] = cut_x
                touched = (min(touched[0], first), max(touched[1], beyond))
        _forget_lists(sleep.watch_box, outer, 0, cut_rows, *touched)

        if dots > 0:
            made = _scan_dots(path, *gel, *scanned, scan, scan + 1, keys, made)
        if strip_reference.size:
            made = _scan_window(*window, *scanned, scan, scan + 1, keys, made)

        before = made
        when = (readout_us[scan], now_us, refractory_us)
        place = optics.texture_place(texture, first_x, first_y, object_seen[0], object_seen[1], contrast)
        picture = (dot_xy[scan, :dots], *gel[1:5], texture, place)
        pixels = (*gel[5:8], sleep.lower2_px2, first_x, first_y, *window[7:10], *runs_wake_at)
        for row in range(first_row, end_row):
            left, left_end, right, right_end = outline_runs(outline.runs, columns, width, row, *way)
            for first, beyond in ((left, left_end), (right, right_end)):
                made = _compare_across(picture, pixels, row, first, beyond, *when, line, keys, made)
        for row in range(cut_rows):
            if cut_from[row] != seen_cut_x[row]:
                first, beyond = cut_run(cut_half, width, cut_from[row], seen_cut_x[row])
                made = _compare_across(picture, pixels, row, first, beyond, *when, line, keys, made)
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
    lower2_px2: NDArray[np.float32],
    first_x: int,
    first_y: int,
    strip_reference: NDArray[np.float32],
    wake_at: NDArray[np.float64],
    row_wakes_at: NDArray[np.float64],
) -> None:
    """Take what lines add to pixels first to end of a row for seen: change their references by as much the other way.

    The pixels of the window have references of their own; under them those of the gel are of no account.
    """
    strip_rows, strip_columns = strip_reference.shape
    left = max(first, first_x) - first_x
    right = min(end, first_x + strip_columns) - first_x
    own = row - first_y
    if 0 <= own < strip_rows and left < right:
        for x in range(left, right):
            strip_reference[own, x] -= line[x + first_x - first] - seen_level[row, x + first_x]
        _wake_runs(wake_at, row_wakes_at, own, left, right)
    for k in range(end - first):
        reference[row, first + k] -= line[k] - seen_level[row, first + k]
        seen_level[row, first + k] = line[k]
        lower2_px2[row, first + k] = np.inf


@njit(cache=True)
def _wake_runs(wake_at: NDArray[np.float64], row_wakes_at: NDArray[np.float64], row: int, first: int, end: int) -> None:
    """Let the runs of a row of the window that hold pixels first to end be compared when the object next moves."""
    for run in range(first // RUN_PX, (end - 1) // RUN_PX + 1):
        wake_at[row, run] = -np.inf
    row_wakes_at[row] = -np.inf


@njit(cache=True)
def _forget_lists(watch_box: NDArray[np.float64], outer: float, top: int, bottom: int, left: int, right: int) -> None:
    """Drop the lists of dots that can come near rows top to bottom, columns left to right."""
    for dot in range(len(watch_box)):
        reach_x = watch_box[dot, 2] + outer
        reach_y = watch_box[dot, 3] + outer
        across = left <= watch_box[dot, 0] + reach_x and watch_box[dot, 0] - reach_x <= right
        if across and top <= watch_box[dot, 1] + reach_y and watch_box[dot, 1] - reach_y <= bottom:
            watch_box[dot] = np.nan


@njit(cache=True)
def _compare_across(
    picture: tuple[Any, ...],
    pixels: tuple[Any, ...],
    row: int,
    first: int,
    end: int,
    readout_us: NDArray[np.int64],
    now_us: float,
    refractory_us: float,
    line: NDArray[np.float32],
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Compare pixels first to end of a row of the frame, those of the gel and those of the window.

    `picture` is what draws both, `pixels` what they have.
    """
    dot_xy, inner, outer, steps_per_px, profile, texture, place = picture
    reference, threshold, release_us, lower2, first_x, first_y = pixels[:6]
    strip_reference, strip_threshold, strip_release_us, wake_at, row_wakes_at = pixels[6:]
    when = (readout_us, now_us, refractory_us, keys)
    if first < end:
        optics.dot_row(dot_xy, inner, outer, steps_per_px, profile, row, first, end, line)
        made = _compare_row(
            line,
            reference[row, first:end],
            threshold[row, first:end],
            release_us[row, first:end],
            first,
            row,
            *when,
            made,
        )
        lower2[row, first:end] = np.inf
    strip_rows, strip_columns = strip_reference.shape
    left = max(first, first_x) - first_x
    right = min(end, first_x + strip_columns) - first_x
    if first_y <= row < first_y + strip_rows and left < right:
        optics.sample_texture_run(texture, *place, row - first_y, left, right, line)
        made = _compare_row(
            line,
            strip_reference[row - first_y, left:right],
            strip_threshold[row - first_y, left:right],
            strip_release_us[row - first_y, left:right],
            first_x + left,
            row,
            *when,
            made,
        )
        _wake_runs(wake_at, row_wakes_at, row - first_y, left, right)
    return made


@njit(cache=True)
def _reach_of_lines(
    start: Place,
    end: Place,
    cut_half: float,
    rows: int,
    columns: int,
    seen_corner: NDArray[np.float64],
    seen_cut_x: NDArray[np.float64],
) -> tuple[float, float, float, float]:
    """A box that holds all pixels whose level lines can change in a slice: left, top, right, bottom."""
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
    for row in range(len(seen_cut_x)):
        left = min(left, start.cut_x_px[row] - cut_half, end.cut_x_px[row] - cut_half, seen_cut_x[row] - cut_half)
        right = max(right, start.cut_x_px[row] + cut_half, end.cut_x_px[row] + cut_half, seen_cut_x[row] + cut_half)
        top = -np.inf
        bottom = np.inf
    return left, top, right, bottom


@njit(cache=True)
def _dots_at_lines(
    path: NDArray[np.float64],
    seen_xy: NDArray[np.float64],
    scans: int,
    outer: float,
    reach: tuple[float, float, float, float],
) -> tuple[NDArray[np.float64], int]:
    """Where the dots that come near lines are at each scan, the first of (scans, dots, 2), and how many they are."""
    left, top, right, bottom = reach
    at_xy = np.empty((len(path), scans, 2))
    _at_scans(path, scans, 0, at_xy)
    box = rings.boxes(at_xy, seen_xy)
    near_xy = np.empty((scans, len(path), 2))
    near = 0
    for dot in range(len(path)):
        reach_x = box[dot, 2] + outer
        reach_y = box[dot, 3] + outer
        across = left <= box[dot, 0] + reach_x and box[dot, 0] - reach_x <= right
        if across and top <= box[dot, 1] + reach_y and box[dot, 1] - reach_y <= bottom:
            near_xy[:, near] = at_xy[dot]
            near += 1
    return near_xy, near


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
            state.sleep,
            state.seen_object,
            state.texture,
            state.window_px[0],
            state.window_px[1],
            state.strip_reference,
            state.strip_threshold,
            state.strip_release_us,
            state.strip_sleep,
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
    sleep: Sleep,
    object_seen: NDArray[np.float64],
    texture: NDArray[np.float32],
    first_x: int,
    first_y: int,
    strip_reference: NDArray[np.float32],
    strip_threshold: NDArray[np.float32],
    strip_release_us: NDArray[np.float64],
    strip_sleep: StripSleep,
    readout_us: NDArray[np.int64],
    t0_us: float,
    refractory_us: float,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Visit every LEAK_SLICES-th row, each in one of the slice's scans; `drift` is in thresholds."""
    height, width = reference.shape
    strip_rows, strip_columns = strip_reference.shape
    scans = len(readout_us)
    line = np.empty(width, np.float32)
    sleep.watch_box[:] = np.nan
    for row in range(first_row, height, LEAK_SLICES):
        scan = (row // LEAK_SLICES) % scans
        when = (drift, row, readout_us[scan], t0_us + scan * SLICE_US / scans, refractory_us, keys)
        optics.dot_row(dot_xy, inner, outer, steps_per_px, profile, row, 0, width, line)
        made = _leak_row(line, reference[row], threshold[row], release_us[row], 0, *when, made)
        sleep.lower2_px2[row] = np.inf
        own = row - first_y
        if 0 <= own < strip_rows:
            place = optics.texture_place(texture, first_x, first_y, object_seen[0], object_seen[1], object_seen[2])
            optics.sample_texture_run(texture, *place, own, 0, strip_columns, line)
            strip = (strip_reference[own], strip_threshold[own], strip_release_us[own])
            made = _leak_row(line, *strip, first_x, *when, made)
            strip_sleep.wake_at[own] = -np.inf
            strip_sleep.row_wakes_at[own] = -np.inf
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
    for k in range(len(reference)):
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
        ends = np.empty((len(dots_start), 2, 2))
        ends[:, 0] = dots_start
        ends[:, 1] = dots_end
        return ends
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
