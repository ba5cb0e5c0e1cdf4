"""A simulated DVXplorer Mini: the events of moving dots and a sliding texture, in scans.

An ideal event camera follows every crossing of the threshold; this one scans. At a fixed rate it holds all pixels at
once, compares each with the level at its last event, and reads out the changed pixels. A pixel has at most one event
per scan, after which its present level is the new reference (5000 scans/s, global hold, no global reset: libcaer's
defaults). Several threshold steps within one scan become one event.

Timing: scan s of a slice holds the image at its start, with the dots where their paths have led by then. Its time
stamps increase over the columns, t = scan start + column / width * scan period, rounded down. So an event comes up to
one scan after the change that caused it, never before it, and the motion of the last scan period belongs to the next
slice.

The events are those of comparing every pixel in every scan (except for RESOLUTION_PX), but few pixels are compared: see
pixel_culling (gel) and window. For lines that are not dots see lines. Leak events are up to 40 ms late: see leak. For
light that flickers or steps see light.

A refractory pixel is blind: its reference follows its level until the refractory period is over.

Not simulated here: bandwidth, and dots that grow with the gel under them. The caller leaves out dots beyond the cut.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.noise_filter import NoiseFilter
from evetac_cli.sim.camera import camera_input, leak, optics
from evetac_cli.sim.camera.camera_input import ObjectMotion, SliceMotion, Window
from evetac_cli.sim.camera.contact_edges import ContactEdges
from evetac_cli.sim.camera.noise import HotPixels, Noise, add_noise, hot_rates
from evetac_cli.sim.camera.optics import DotShapes, alike, dot_shapes, shaped_level
from evetac_cli.sim.camera.readout import Readout, sorted_columns
from evetac_cli.sim.camera.scanning.dots import scan_dots
from evetac_cli.sim.camera.scanning.light import Light
from evetac_cli.sim.camera.scanning.lines import scan_lines
from evetac_cli.sim.camera.scanning.pixel_culling import rests
from evetac_cli.sim.camera.scanning.pixels import (
    FALSE,
    ZERO,
    CandidatePixels,
    CandidateRuns,
    ScanTimes,
    all_pixels,
    all_runs,
    gel_pixels,
    window_pixels,
)
from evetac_cli.sim.camera.scanning.window import scan_window
from evetac_cli.sim.setup.scene import LightSettings
from evetac_cli.sim.setup.sensor import HotPixelTable

# No pixel's threshold is below this share of the nominal threshold, however large the mismatch.
LOWEST_THRESHOLD = 0.25


@dataclass(frozen=True)
class CameraModel:
    """The constants of one camera, within the limits of a sensor's file.

    Thresholds are in log brightness; `mismatch` is their relative standard deviation over the pixels. `threshold_off`
    separates the thresholds of ON and OFF: each pixel has two, drawn independently.

    The noise rate is per pixel. Every hot pixel has its own rate, from a distribution with the evenly spaced quantiles
    `hot_rate_hz` (two: uniform between them). `hot_pixel_table` adds hot pixels at known positions.

    `leak_hz` is the rate of leak events per pixel. After an event a pixel is held in reset for `refractory_us`, and its
    next reference is the level at the end of that time.

    A slice holds at most `max_events`. Further events are lost, as on a full bus (the pixels have fired nevertheless),
    and counted. `events_per_s` limits the readout (see readout); `support_ms` is the time of the host's noise filter
    (see noise_filter).
    """

    frame_px: tuple[int, int] = FRAME_PX
    scans_per_ms: int = 5
    threshold: float = 0.2
    threshold_off: float | None = None
    mismatch: float = 0.03
    noise_rate_hz: float = 0.03
    hot_pixels: int = 10
    hot_rate_hz: tuple[float, ...] = (20.0, 200.0)
    noise_on_share: float = 0.5
    timestamp_step_us: float = 0.0
    hot_pixel_table: HotPixelTable | None = None
    edge_sigma_px: float = optics.EDGE_SIGMA_PX
    log_contrast: float = optics.LOG_CONTRAST
    dot_radius_px: float = 15.0
    leak_hz: float = 0.0
    refractory_us: float = 0.0
    max_events: int = 1_000_000
    events_per_s: float | None = None
    support_ms: float | None = None


@dataclass
class CameraState:
    """State of a camera from slice to slice; `step` changes it in place.

    `reference` and `threshold` belong to the gel's pixels, shape (height, width). Under the window the threshold is
    infinite, and the window has its own pair. `seen_*` are positions at the last scan.
    """

    model: CameraModel
    profile: optics.DotProfile
    reference: NDArray[np.float32]
    threshold: NDArray[np.float32]
    seen_dot_xy_px: NDArray[np.float64]
    window_px: tuple[int, int, int, int]  # x0, y0, x1, y1; all 0 without a window
    texture: NDArray[np.float32]
    window_reference: NDArray[np.float32]
    window_threshold: NDArray[np.float32]
    seen_object: NDArray[np.float64]  # x, y in px, contrast; NaN before the first slice
    noise: Noise
    readout_us: NDArray[np.int64]  # (scans, width): time in the slice at which a column is read
    keys: NDArray[np.int64]  # as long as a slice may be, so nothing grows; memory is used only as far as it is written
    # Time until which a pixel is blind. Rows are empty without a refractory period that is longer than a scan.
    release_us: NDArray[np.float64]
    window_release_us: NDArray[np.float64]
    candidates: CandidatePixels
    candidate_runs: CandidateRuns
    middle_shift: NDArray[np.float32]  # see GelPixels
    window_middle_shift: NDArray[np.float32]
    shapes: DotShapes  # empty if dots are alike
    contact_edges: ContactEdges | None = None
    light: Light | None = None
    table_hot_pixels: HotPixels | None = None
    readout: Readout | None = None
    noise_filter: NoiseFilter | None = None
    slices: int = 0
    dropped: int = 0
    # The arrays above as plain tuples in the order of GelPixels and WindowPixels, as compiled code takes them:
    gel: tuple[Any, ...] = field(init=False, repr=False)
    window: tuple[Any, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Group the arrays once."""
        self.gel = (
            self.seen_dot_xy_px,
            tuple(self.profile),
            self.reference,
            self.threshold,
            self.release_us,
            tuple(self.candidates),
            self.middle_shift,
            tuple(self.shapes),
        )
        self.window = (
            *self.window_px[:2],
            self.seen_object,
            self.texture,
            self.window_reference,
            self.window_threshold,
            self.window_release_us,
            tuple(self.candidate_runs),
            self.window_middle_shift,
        )


def start(
    model: CameraModel,
    dot_xy_px: ArrayLike,
    window: Window | None,
    rng: np.random.Generator,
    camera_rng: np.random.Generator | None = None,
    contact_edges: ContactEdges | None = None,
    light_change: LightSettings | None = None,
    dots_differ: tuple[ArrayLike, ArrayLike] | None = None,
) -> CameraState:
    """Start the camera in front of dots (dots, 2); draw thresholds, hot pixels, and a phase for every pixel.

    A pixel's reference starts at its level plus a uniform phase in (-C_i, C_i); without the phase all pixels of a rim
    would fire at once.

    `window` is its corners, x0, y0, x1, y1, ends excluded, and the texture (sides powers of two, from `optics.texture`)
    that its pixels see; they see no dots. Their first level is that at the start of the first `step`, so an object that
    is already there causes no flash. If the texture is None they see nothing.

    `camera_rng` draws the camera's own values, thresholds and hot pixels; if None, `rng` draws them too.
    `contact_edges`, from `contact_edges.start` for this frame, are lines that are not dots; the camera owns them
    afterwards. `light_change` describes changing light. `dots_differ` are factors on the radius (dots,) and on the log
    contrast (dots,) of each dot, if they differ.

    ValueError for positions that are not finite.
    """
    width, height = model.frame_px
    dots = camera_input.positions("dot_xy_px", dot_xy_px)
    radius_px = model.dot_radius_px
    profile = optics.dot_profile(radius_px, model.edge_sigma_px, model.log_contrast)
    shapes = alike()
    if dots_differ is not None:
        radii, contrasts = (np.broadcast_to(np.asarray(factors, np.float64), len(dots)) for factors in dots_differ)
        shapes = dot_shapes(profile, radius_px * (radii - 1.0), contrasts)
        profile = profile._replace(inner_px=float(shapes.inner_px.min()), outer_px=float(shapes.outer_px.max()))
    (x0, y0, x1, y1), texture = ((0, 0, 0, 0), None) if window is None else window
    pattern = np.zeros((1, 1), np.float32) if texture is None else np.ascontiguousarray(texture, np.float32)
    assert 0 <= x0 <= x1 <= width and 0 <= y0 <= y1 <= height
    assert np.isfinite(pattern).all() and all(size >= 1 and not size & (size - 1) for size in pattern.shape)

    built = rng if camera_rng is None else camera_rng
    threshold, middle_shift = _thresholds(model, built)
    phase: NDArray[np.float32] = threshold * rng.uniform(-1.0, 1.0, (height, width)).astype(np.float32)
    window_threshold = threshold[y0:y1, x0:x1].copy()
    window_reference = phase[y0:y1, x0:x1].copy()
    threshold[y0:y1, x0:x1] = np.inf
    columns = np.arange(model.scans_per_ms * width).reshape(-1, width)
    light = None if light_change is None else Light(light_change, model.frame_px, y1 - y0)
    level = shaped_level(model.frame_px, dots, profile, shapes)
    assert contact_edges is None or contact_edges.frame_px == (width, height)
    blind = model.refractory_us > SLICE_US / model.scans_per_ms
    steady: NDArray[np.float32] = np.zeros(2, np.float32)
    return CameraState(
        model=model,
        profile=profile,
        reference=level + phase,
        threshold=threshold,
        seen_dot_xy_px=dots.copy(),
        window_px=(x0, y0, x1, y1),
        texture=pattern,
        window_reference=window_reference,
        window_threshold=window_threshold,
        seen_object=np.full(3, np.nan),
        noise=Noise(
            model.noise_rate_hz,
            built.choice(width * height, model.hot_pixels, replace=False),
            np.append(0.0, np.cumsum(hot_rates(model.hot_rate_hz, model.hot_pixels, built))),
            model.noise_on_share,
            model.timestamp_step_us,
        ),
        readout_us=columns * SLICE_US // columns.size,
        keys=np.empty(model.max_events, np.int64),
        release_us=np.zeros((height, width if blind else 0)),
        window_release_us=np.zeros((y1 - y0, x1 - x0 if blind else 0)),
        candidates=all_pixels(
            (height, width),
            len(dots),
            profile,
            steady if light is None else light.candidate_light,
            model.scans_per_ms,
        ),
        candidate_runs=all_runs(window_reference.shape, pattern),
        middle_shift=middle_shift,
        window_middle_shift=middle_shift[y0:y1, x0:x1].copy(),
        shapes=shapes,
        contact_edges=contact_edges,
        light=light,
        table_hot_pixels=None if model.hot_pixel_table is None else HotPixels(model.hot_pixel_table, rng.spawn(1)[0]),
        readout=None if model.events_per_s is None else Readout(model.events_per_s, model.frame_px),
        noise_filter=None if model.support_ms is None else NoiseFilter(model.support_ms, model.frame_px),
    )


def _thresholds(model: CameraModel, built: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Draw every pixel's threshold; if ON and OFF differ, the mean of both and half the difference (see GelPixels)."""
    width, height = model.frame_px

    def draw(threshold: float, rng: np.random.Generator) -> NDArray[np.float32]:
        each = threshold * (1.0 + model.mismatch * rng.standard_normal((height, width)))
        return np.maximum(each, LOWEST_THRESHOLD * threshold).astype(np.float32)

    on = draw(model.threshold, built)
    if model.threshold_off is None:
        return on, np.empty((0, 0), np.float32)
    off = draw(model.threshold_off, built.spawn(1)[0])
    half = np.float32(0.5)
    return half * (on + off), half * (on - off)


def step(state: CameraState, motion: SliceMotion, t0_us: int, rng: np.random.Generator) -> Events:
    """Return the events of one millisecond, sorted by time, t0_us <= t < t0_us + 1000.

    ValueError if values are not finite or further than 1e6 px; the state is then unchanged.
    """
    path, object_motion = camera_input.motions(len(state.seen_dot_xy_px), motion)
    lines = camera_input.line_motion(state.contact_edges, motion)

    t0_us = int(t0_us)
    model = state.model
    gel, window = state.gel, state.window
    times = (state.readout_us, float(t0_us), float(model.refractory_us))
    first_leaking_row = state.slices % leak.LEAK_SLICES if model.leak_hz > 0.0 else None
    if state.light is not None:
        state.light.forget_changed(path, gel, window, lines, first_leaking_row)
    line_events = 0
    if lines is not None:
        plain = (tuple(lines.start), tuple(lines.end), tuple(lines.outline), *lines[3:])
        event_count, line_events = scan_lines(plain, path, gel, tuple(object_motion), window, times, state.keys)
    elif len(state.shapes.inner_px) or not rests(path, gel[0], *object_motion, window[2], window[4]):
        event_count = _scan(path, gel, tuple(object_motion), window, times, state.keys)
    else:
        event_count = 0
    if state.contact_edges is not None:
        state.contact_edges.events = line_events
    if first_leaking_row is not None:
        drift = np.float32(leak.drift(model.leak_hz))
        event_count = _leak(first_leaking_row, drift, gel, window, times, state.keys, event_count)
    if state.light is not None:
        event_count = state.light.shine(gel, window, *times, state.keys, event_count)
    return _finish(state, t0_us, rng, event_count)


def step_still(state: CameraState, t0_us: int, rng: np.random.Generator) -> Events:
    """Return the events of one millisecond in which nothing moves or fades, as in the one before: leak and noise.

    They equal those of `step`, which would find that no pixel has to be compared. Not for a camera with changing light.
    """
    event_count = 0
    if state.contact_edges is not None:
        state.contact_edges.events = 0
    if state.model.leak_hz > 0.0:
        drift = np.float32(leak.drift(state.model.leak_hz))
        times = (state.readout_us, float(t0_us), float(state.model.refractory_us))
        event_count = _leak(
            state.slices % leak.LEAK_SLICES, drift, state.gel, state.window, times, state.keys, event_count
        )
    return _finish(state, t0_us, rng, event_count)


def _finish(state: CameraState, t0_us: int, rng: np.random.Generator, event_count: int) -> Events:
    """Add noise to the events of a slice, and count events that do not fit."""
    state.slices += 1
    event_count = noise_of_slice(state, t0_us, rng, event_count)
    stored = min(event_count, len(state.keys))
    state.dropped += event_count - stored
    columns = sorted_columns(state.keys[:stored], t0_us)
    if state.readout is not None:
        columns = state.readout.read(columns, t0_us)
    if state.noise_filter is not None:
        columns = state.noise_filter.keep(columns)
    return Events(*columns)


def noise_of_slice(state: CameraState, t0_us: int, rng: np.random.Generator, event_count: int) -> int:
    """Add the noise of a slice and the events of hot pixels; return the number of events so far."""
    model = state.model
    event_count = add_noise(state.noise, model.frame_px, t0_us, rng, state.keys, event_count)
    if state.table_hot_pixels is not None:
        event_count = state.table_hot_pixels.add(
            t0_us, model.frame_px[0], model.timestamp_step_us, state.keys, event_count
        )
    return event_count


# Python passes plain tuples, which get names here. With named tuples, each slice of a grasp took 4 to 6 us longer, of
# 43 us, because numba looks up the type of a named tuple at every call.


@njit(cache=True, _nrt=False)
def _scan(
    path: NDArray[np.float64],
    gel: tuple[Any, ...],
    motion: tuple[Any, ...],
    window: tuple[Any, ...],
    times: tuple[Any, ...],
    keys: NDArray[np.int64],
) -> int:
    """Scan dots and window; return the number of events."""
    scans = ScanTimes(times[0], times[1], times[2])
    dots, pixels = gel_pixels(gel), window_pixels(window)
    untouched = dots.candidates.flags[0]
    untouched[:] = 0
    event_count = scan_dots(path, dots, scans, ZERO, len(scans.readout_us), untouched, FALSE, keys, ZERO)
    if pixels.reference.size:
        object_motion = ObjectMotion(motion[0], motion[1], motion[2])
        line = dots.candidates.line
        event_count = scan_window(object_motion, pixels, scans, ZERO, len(scans.readout_us), line, keys, event_count)
    return int(event_count)


@njit(cache=True, _nrt=False)
def _leak(
    first_row: int,
    drift: np.float32,
    gel: tuple[Any, ...],
    window: tuple[Any, ...],
    times: tuple[Any, ...],
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Let leak lower the references of the rows that are due; return the number of events so far."""
    scans = ScanTimes(times[0], times[1], times[2])
    return int(leak.leak_in_scans(first_row, drift, gel_pixels(gel), window_pixels(window), scans, keys, event_count))
