"""A simulated DVXplorer Mini: the events that moving dots and a sliding texture make.

The camera does not follow every crossing of the threshold as an ideal event camera would. It scans: at a fixed rate
it holds all pixels at once, compares each with the level at its last event, and reads the changed ones out, at most one
event a pixel and scan, after which the present level is the new reference (physics: 5000 scans/s, global hold, no global
reset). Several threshold steps within one scan become one event.

Timing: scan s of a slice holds the picture of its first instant, dots at start + (end - start) s / scans, and its time
stamps run on over the columns, t = scan start + column / width * scan period, rounded down to us. So an event comes up
to one scan after the change that made it, never before, and what moves in the last scan period is seen by the next slice.

Only what can have changed is looked at: the ring of a dot about where it is and where it was last looked at, once it
has moved `RESOLUTION_PX`; the window when the object has moved as far or the contrast is another. A dot's ring is finite
(see optics), so no pixel that is left behind misses its last event.

Left out: bandwidth, leak, dilation of dots, object rims, motion of the cut edge; dots beyond the cut are the caller's to
leave out. Background noise and hot pixels are added at uniform times: they neither wait for a scan nor move the reference.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ..events import FRAME_PX, SLICE_US, Events
from . import optics

# A rim's steepest slope is 0.53 log units per px, so a pixel drifts at most 0.005 (C 0.2) before it is looked at again.
RESOLUTION_PX = 0.01
FARTHEST_PX = 1e6
# No pixel's threshold is below this share of the nominal one, however the mismatch falls.
LOWEST_THRESHOLD = 0.25
# While a slice is made its events are single integers: time in the slice, column, row, polarity.
TIME_BITS = 33
COLUMN_BITS = 17
ROW_BITS = 1
COORDINATE_MASK = 0xFFFF


@dataclass(frozen=True)
class CameraModel:
    """One camera individual; ValueError where a value is out of range.

    Thresholds are in log brightness, `mismatch` is their relative standard deviation over the pixels. Noise is a rate
    per pixel; each of the hot pixels has a rate of its own, uniform in `hot_rate_hz`. A slice holds at most
    `max_events`; what is beyond is lost, as on a full bus, and counted.
    """

    frame_px: tuple[int, int] = FRAME_PX
    scans_per_ms: int = 5
    threshold: float = 0.2
    mismatch: float = 0.03
    noise_rate_hz: float = 0.03
    hot_pixels: int = 10
    hot_rate_hz: tuple[float, float] = (20.0, 200.0)
    edge_sigma_px: float = optics.EDGE_SIGMA_PX
    log_contrast: float = optics.LOG_CONTRAST
    dot_radius_px: float = 15.0
    max_events: int = 1_000_000

    def __post_init__(self) -> None:
        width, height = self.frame_px
        _check_range("frame width", width, 1, 4096)
        _check_range("frame height", height, 1, 4096)
        _check_range("scans_per_ms", self.scans_per_ms, 1, 100)
        _check_range("threshold", self.threshold, 0.01, 10.0)
        _check_range("mismatch", self.mismatch, 0.0, 1.0)
        _check_range("noise_rate_hz", self.noise_rate_hz, 0.0, 1e4)
        _check_range("hot_pixels", self.hot_pixels, 0, width * height)
        _check_range("hot_rate_hz, lowest", self.hot_rate_hz[0], 0.0, 1e5)
        _check_range("hot_rate_hz, highest", self.hot_rate_hz[1], self.hot_rate_hz[0], 1e5)
        _check_range("edge_sigma_px", self.edge_sigma_px, 0.01, 100.0)
        _check_range("log_contrast", self.log_contrast, 0.01, 20.0)
        _check_range("dot_radius_px", self.dot_radius_px, 0.01, 1000.0)
        _check_range("max_events", self.max_events, 1, 10_000_000)


@dataclass
class CameraState:
    """What a camera remembers from slice to slice; `step` changes it in place.

    `reference` and `threshold` belong to the gel's pixels, shape (height, width); under the window the threshold is
    infinite there, and the strip has its own pair. `seen_*` is what the pixels were last compared against.
    """

    model: CameraModel
    dot_radius_px: float
    profile: optics.DotProfile
    reference: NDArray[np.float32]
    threshold: NDArray[np.float32]
    seen_dot_xy_px: NDArray[np.float64]
    window_px: tuple[int, int, int, int]
    texture: NDArray[np.float32]
    strip_reference: NDArray[np.float32]
    strip_threshold: NDArray[np.float32]
    seen_object: NDArray[np.float64]  # x, y in px, contrast; NaN before the first slice
    hot_xy: NDArray[np.int64]
    hot_rate_hz: NDArray[np.float64]
    dropped: int = 0
    strip_level: NDArray[np.float32] = field(init=False)
    keys: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.strip_level = np.empty_like(self.strip_reference)
        # As long as a slice may be: nothing has to grow, and memory is only taken as far as it is written.
        self.keys = np.empty(self.model.max_events, np.int64)


def start(
    model: CameraModel,
    dot_xy_px: ArrayLike,
    dot_radius_px: float | None,
    window_px: tuple[int, int, int, int] | None,
    texture: NDArray[np.float32] | None,
    rng: np.random.Generator,
) -> CameraState:
    """Switch the camera on before dots (dots, 2), draw its thresholds and hot pixels, and give every pixel a random phase.

    A pixel's reference starts at its level plus a uniform phase in (-C_i, C_i); without it all pixels of a rim would fire
    at once. `dot_radius_px` None takes the model's. `window_px` is x0, y0, x1, y1, ends excluded; its pixels see the
    texture (powers of two, from `optics.texture`) and no dots, and have their first level from where the first `step`
    starts, so an object that is already there makes no flash. Without texture they see nothing.
    ValueError on non-finite positions, a window outside the frame, a texture of wrong shape or without a window.
    """
    width, height = model.frame_px
    dots = _positions("dot_xy_px", dot_xy_px)
    radius_px = model.dot_radius_px if dot_radius_px is None else float(dot_radius_px)
    _check_range("dot_radius_px", radius_px, 0.01, 1000.0)
    profile = optics.dot_profile(model.edge_sigma_px, model.log_contrast)

    threshold = model.threshold * (1.0 + model.mismatch * rng.standard_normal((height, width)))
    threshold = np.maximum(threshold, LOWEST_THRESHOLD * model.threshold)
    phase = threshold * rng.uniform(-1.0, 1.0, (height, width))
    reference = (optics.gel_level(model.frame_px, dots, radius_px, profile) + phase).astype(np.float32)
    hot = rng.choice(width * height, model.hot_pixels, replace=False)

    x0, y0, x1, y1 = _window(window_px, texture, model.frame_px)
    strip_threshold = threshold[y0:y1, x0:x1].astype(np.float32)
    strip_reference = phase[y0:y1, x0:x1].astype(np.float32)
    threshold[y0:y1, x0:x1] = np.inf
    return CameraState(
        model=model,
        dot_radius_px=radius_px,
        profile=profile,
        reference=reference,
        threshold=threshold.astype(np.float32),
        seen_dot_xy_px=dots.copy(),
        window_px=(x0, y0, x1, y1),
        texture=np.zeros((8, 8), np.float32) if texture is None else np.ascontiguousarray(texture, np.float32),
        strip_reference=strip_reference,
        strip_threshold=strip_threshold,
        seen_object=np.full(3, np.nan),
        hot_xy=np.stack([hot % width, hot // width], axis=1),
        hot_rate_hz=rng.uniform(*model.hot_rate_hz, model.hot_pixels),
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
) -> Events:
    """The events of one millisecond, sorted by time, t0_us <= t < t0_us + 1000.

    Dots (dots, 2) and the object's displacement (2,) move on straight lines from start to end, in px; the contrast
    (1: the texture as drawn, 0: out of sight) holds for the whole slice. ValueError on values that are not finite,
    farther than 1e6 px, or of another shape than at `start`; the state is then as before.
    """
    model = state.model
    dots_start = _positions("dot_xy_px_start", dot_xy_px_start, len(state.seen_dot_xy_px))
    dots_end = _positions("dot_xy_px_end", dot_xy_px_end, len(state.seen_dot_xy_px))
    object_start = _positions("object_xy_px_start", np.reshape(object_xy_px_start, (1, -1)), 1)[0]
    object_end = _positions("object_xy_px_end", np.reshape(object_xy_px_end, (1, -1)), 1)[0]
    _check_range("texture_contrast", texture_contrast, 0.0, 1e3)

    count = _scan_dots(
        dots_start,
        dots_end,
        state.seen_dot_xy_px,
        state.dot_radius_px,
        state.profile.last_px,
        state.profile.first_px,
        state.profile.steps_per_px,
        state.profile.level,
        model.scans_per_ms,
        state.reference,
        state.threshold,
        state.keys,
    )
    if state.strip_level.size:
        count = _scan_window(
            object_start,
            object_end,
            texture_contrast,
            state.seen_object,
            state.texture,
            state.window_px[0],
            state.window_px[1],
            model.scans_per_ms,
            model.frame_px[0],
            state.strip_level,
            state.strip_reference,
            state.strip_threshold,
            state.keys,
            count,
        )
    noise = _noise_keys(state, rng)
    kept = min(count, model.max_events)
    kept_noise = min(len(noise), model.max_events - kept)
    state.keys[kept : kept + kept_noise] = noise[:kept_noise]
    state.dropped += count - kept + len(noise) - kept_noise
    return _events(state.keys[: kept + kept_noise], int(t0_us))


@njit(cache=True)
def _scan_dots(
    start_xy: NDArray[np.float64],
    end_xy: NDArray[np.float64],
    seen_xy: NDArray[np.float64],
    radius_px: float,
    last_px: float,
    first_px: float,
    steps_per_px: float,
    profile: NDArray[np.float64],
    scans: int,
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    keys: NDArray[np.int64],
) -> int:
    """Compare the rings of dots that moved, scan by scan; write event keys as far as they fit, return how many there are.

    A pixel is compared against the whole picture of its scan, so where two rings cross, the second visit finds nothing
    left to report: at most one event a pixel and scan.
    """
    dots = len(start_xy)
    now_xy = np.empty((dots, 2))
    near_xy = np.empty((dots, 2))
    outer = radius_px + last_px
    inner = radius_px + first_px
    width = threshold.shape[1]
    count = 0
    for scan in range(scans):
        part = scan / scans
        for dot in range(dots):
            now_xy[dot, 0] = start_xy[dot, 0] + part * (end_xy[dot, 0] - start_xy[dot, 0])
            now_xy[dot, 1] = start_xy[dot, 1] + part * (end_xy[dot, 1] - start_xy[dot, 1])
        for dot in range(dots):
            x = now_xy[dot, 0]
            y = now_xy[dot, 1]
            moved_x = x - seen_xy[dot, 0]
            moved_y = y - seen_xy[dot, 1]
            moved = math.sqrt(moved_x * moved_x + moved_y * moved_y)
            if moved < RESOLUTION_PX:
                continue
            # Half way between, a ring wider by half the path covers both rings; after a jump two rings are less.
            jumped = moved > outer - inner
            widened = 0.0 if jumped else 0.5 * moved
            for place in range(2 if jumped else 1):
                back = float(place) if jumped else 0.5
                centre_x = x - back * moved_x
                centre_y = y - back * moved_y
                near_xy[0, 0] = x
                near_xy[0, 1] = y
                near = 1
                reach = 2.0 * outer + widened
                for other in range(dots):
                    apart_x = now_xy[other, 0] - centre_x
                    apart_y = now_xy[other, 1] - centre_y
                    if other != dot and apart_x * apart_x + apart_y * apart_y < reach * reach:
                        near_xy[near, 0] = now_xy[other, 0]
                        near_xy[near, 1] = now_xy[other, 1]
                        near += 1
                count = _compare_ring(
                    centre_x,
                    centre_y,
                    inner - widened,
                    outer + widened,
                    near_xy[:near],
                    radius_px,
                    first_px,
                    steps_per_px,
                    profile,
                    reference,
                    threshold,
                    scan * width,
                    scans * width,
                    keys,
                    count,
                )
            seen_xy[dot, 0] = x
            seen_xy[dot, 1] = y
    return count


@njit(cache=True)
def _compare_ring(
    centre_x: float,
    centre_y: float,
    inner: float,
    outer: float,
    near_xy: NDArray[np.float64],
    radius_px: float,
    first_px: float,
    steps_per_px: float,
    profile: NDArray[np.float64],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    columns_before: int,
    columns_per_slice: int,
    keys: NDArray[np.int64],
    count: int,
) -> int:
    """Compare the pixels between two circles with the level that the nearest of `near_xy` gives them."""
    height, width = threshold.shape
    # Clip as floats: the integer of a far coordinate is undefined.
    first_row = int(max(0.0, math.ceil(centre_y - outer)))
    end_row = int(min(float(height), math.floor(centre_y + outer) + 1.0))
    for y in range(first_row, end_row):
        down = y - centre_y
        outer_half = math.sqrt(max(0.0, outer * outer - down * down))
        inner_half = math.sqrt(inner * inner - down * down) if inner > abs(down) else 0.0
        left = int(max(0.0, math.ceil(centre_x - outer_half)))
        end = int(max(0.0, min(float(width), math.floor(centre_x + outer_half) + 1.0)))
        hole = end
        hole_end = end
        if inner_half > 0.0:
            hole = int(max(float(left), min(float(end), math.floor(centre_x - inner_half) + 1.0)))
            hole_end = int(max(float(hole), min(float(end), math.ceil(centre_x + inner_half))))
        for side in range(2):
            for x in range(left if side == 0 else hole_end, hole if side == 0 else end):
                distance2 = math.inf
                for near in range(len(near_xy)):
                    across = x - near_xy[near, 0]
                    along = y - near_xy[near, 1]
                    distance2 = min(distance2, across * across + along * along)
                distance = math.sqrt(distance2) - radius_px
                level = np.float32(optics.rim_level(distance, first_px, steps_per_px, profile))
                change = level - reference[y, x]
                if abs(change) >= threshold[y, x]:
                    reference[y, x] = level
                    if count < len(keys):
                        keys[count] = _key((columns_before + x) * SLICE_US // columns_per_slice, x, y, change > 0)
                    count += 1
    return count


@njit(cache=True)
def _scan_window(
    start_xy: NDArray[np.float64],
    end_xy: NDArray[np.float64],
    contrast: float,
    seen: NDArray[np.float64],
    texture: NDArray[np.float32],
    first_x: int,
    first_y: int,
    scans: int,
    width: int,
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    keys: NDArray[np.int64],
    count: int,
) -> int:
    """Compare the window's pixels in every scan before which the object moved or the contrast changed."""
    rows, columns = level.shape
    for scan in range(scans):
        part = scan / scans
        x = start_xy[0] + part * (end_xy[0] - start_xy[0])
        y = start_xy[1] + part * (end_xy[1] - start_xy[1])
        first_look = math.isnan(seen[2])
        moved = math.hypot(x - seen[0], y - seen[1]) >= RESOLUTION_PX and contrast > 0.0
        if not (first_look or moved or contrast != seen[2]):
            continue
        optics.sample_texture(texture, first_x, first_y, x, y, contrast, level)
        seen[0] = x
        seen[1] = y
        seen[2] = contrast
        if first_look:
            reference += level
            continue
        for row in range(rows):
            for column in range(columns):
                change = level[row, column] - reference[row, column]
                if abs(change) >= threshold[row, column]:
                    reference[row, column] = level[row, column]
                    if count < len(keys):
                        pixel_x = first_x + column
                        time = (scan * width + pixel_x) * SLICE_US // (scans * width)
                        keys[count] = _key(time, pixel_x, first_y + row, change > 0)
                    count += 1
    return count


@njit(cache=True)
def _key(time_us: int, x: int, y: int, brighter: bool) -> int:
    return (time_us << TIME_BITS) | (x << COLUMN_BITS) | (y << ROW_BITS) | int(brighter)


def _noise_keys(state: CameraState, rng: np.random.Generator) -> NDArray[np.int64]:
    """Background and hot pixels of one slice: Poisson numbers, uniform times, both polarities alike."""
    width, height = state.model.frame_px
    slice_s = SLICE_US * 1e-6
    background = rng.integers(width * height, size=rng.poisson(state.model.noise_rate_hz * slice_s * width * height))
    x, y = background % width, background // width
    if len(state.hot_xy):
        hot = np.repeat(state.hot_xy, rng.poisson(state.hot_rate_hz * slice_s), axis=0)
        x, y = np.concatenate([x, hot[:, 0]]), np.concatenate([y, hot[:, 1]])
    time_and_sign = rng.integers(2 * SLICE_US, size=len(x))
    keys: NDArray[np.int64] = (
        (time_and_sign >> 1 << TIME_BITS) | (x << COLUMN_BITS) | (y << ROW_BITS) | (time_and_sign & 1)
    )
    return keys


def _events(keys: NDArray[np.int64], t0_us: int) -> Events:
    keys.sort()  # by time, then column and row
    return Events(
        t=(keys >> TIME_BITS) + t0_us,
        x=((keys >> COLUMN_BITS) & COORDINATE_MASK).astype(np.uint16),
        y=((keys >> ROW_BITS) & COORDINATE_MASK).astype(np.uint16),
        p=(keys & 1).astype(np.uint8),
    )


def _positions(name: str, given: ArrayLike, count: int | None = None) -> NDArray[np.float64]:
    xy = np.ascontiguousarray(given, np.float64)
    if xy.size == 0:
        xy = xy.reshape(0, 2)
    if xy.ndim != 2 or xy.shape[1] != 2 or (count is not None and len(xy) != count):
        raise ValueError(f"{name}: expected shape ({'n' if count is None else count}, 2), found {np.shape(given)}")
    if not (np.abs(xy) <= FARTHEST_PX).all():
        raise ValueError(f"{name}: expected finite positions within {FARTHEST_PX:g} px, found {xy.min()} to {xy.max()}")
    return xy


def _window(
    window_px: tuple[int, int, int, int] | None, texture: NDArray[np.float32] | None, frame_px: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The window's corners, all 0 where there is none, after checking that they and the texture can be used."""
    if window_px is None:
        if texture is not None:
            raise ValueError("texture: expected none without a window, found one")
        return 0, 0, 0, 0
    x0, y0, x1, y1 = (int(corner) for corner in window_px)
    if not (0 <= x0 < x1 <= frame_px[0] and 0 <= y0 < y1 <= frame_px[1]):
        raise ValueError(f"window_px: expected x0 < x1, y0 < y1 within the frame {frame_px}, found {tuple(window_px)}")
    if texture is not None:
        if texture.ndim != 2 or any(size < 1 or size & (size - 1) for size in texture.shape):
            raise ValueError(f"texture: expected two dimensions that are powers of two, found shape {texture.shape}")
        if not np.isfinite(texture).all():
            raise ValueError("texture: expected finite levels, found NaN or infinity")
    return x0, y0, x1, y1


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name}: expected {low:g} to {high:g}, found {value}")
