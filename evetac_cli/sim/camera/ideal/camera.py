"""An ideal event camera: every pixel fires at the exact time at which its log brightness has changed by its threshold.

It has two uses. `--readout ideal` selects this camera, whose times are correct to the microsecond. `evaluate cost
camera` uses it to measure the loss from the scans of the other camera. Here a pixel fires each time its level crosses a
threshold, several times per slice if necessary. An event's time is that of the crossing, rounded down to a microsecond.

Shared with the scanning camera (scanning/camera.py): `CameraModel`, `CameraState` with the values that `start` draws,
the noise and the noise filter. Shared modules one level up: motion in a slice (camera_input), optics, rings of dots,
contact edges, event keys, and the drift of leak. Different: no scan compares pixels here; the crossings are solved,
those of the gel in dots, of the window in window, and of pixels under moving lines in lines. Leak also visits each row
once in 40 ms, so a leak event is late by up to that time.

Not simulated: bandwidth (a low pass has no closed form for the crossing), changing light, a limit of the readout,
separate thresholds of ON and OFF, and dots that differ. Everything that the scanning camera leaves out is also missing.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.checks import check_range
from evetac_cli.events import Events
from evetac_cli.sim.camera import camera_input, leak, optics
from evetac_cli.sim.camera.camera_input import SliceMotion, Window
from evetac_cli.sim.camera.contact_edges import ContactEdges
from evetac_cli.sim.camera.event_keys import sorted_columns
from evetac_cli.sim.camera.ideal.dots import find_all_radii, solve_dots
from evetac_cli.sim.camera.ideal.lines import LINE_STEP_PX, line_steps, solve_line_pixels
from evetac_cli.sim.camera.ideal.pixels import IdealGelPixels, IdealWindowPixels, SliceTimes
from evetac_cli.sim.camera.ideal.window import NO_LINES, solve_window
from evetac_cli.sim.camera.scanning import camera as scanning
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState


@dataclass
class IdealState:
    """State of an ideal camera from slice to slice; `step` changes it in place.

    `shared` is the state that both cameras have; references, also those of the window, are NaN while a pixel is
    refractory. `lower2_px2` and `upper2_px2` are the squares of a pixel's two radii, -1 and infinity if there is none;
    single precision resolves a radius to 1e-6 px. A pixel whose reference was changed by a line has infinity as the
    first: its radii are computed again when a dot comes near. `level_index` speeds up that computation.

    `solved_in` is the last slice in which a pixel near several dots or under a line was solved, so that it is solved
    only once. `*release_us` is the time at which a refractory pixel sees again; without a refractory period both are
    empty. `line_step_px` is the motion of lines per sub-step.
    """

    shared: CameraState
    level_index: NDArray[np.int16]
    lower2_px2: NDArray[np.float32]
    upper2_px2: NDArray[np.float32]
    solved_in: NDArray[np.int64]
    release_us: NDArray[np.float64]
    window_release_us: NDArray[np.float64]
    line_step_px: float
    slices: int = 0

    @property
    def dropped(self) -> int:
        """Return the number of events lost so far because a slice was full."""
        return self.shared.dropped


def start(
    model: CameraModel,
    dot_xy_px: ArrayLike,
    dot_radius_px: float | None,
    window: Window | None,
    rng: np.random.Generator,
    camera_rng: np.random.Generator | None = None,
    contact_edges: ContactEdges | None = None,
    line_step_px: float = LINE_STEP_PX,
) -> IdealState:
    """Start the camera; arguments, random draws and errors are those of the scanning camera's `start`.

    Equal generators give both cameras the same thresholds, phases and hot pixels.
    """
    shared = scanning.start(model, dot_xy_px, dot_radius_px, window, rng, camera_rng, contact_edges)
    return from_references(shared, line_step_px)


def from_references(shared: CameraState, line_step_px: float = LINE_STEP_PX) -> IdealState:
    """Return an ideal camera that continues from the references in `shared`, which it owns afterwards.

    ValueError for NaN references, and for features of the scanning camera only: separate thresholds of ON and OFF, a
    limit of the readout, dots that differ.
    """
    if len(shared.shapes.inner_px):
        raise ValueError("dots that differ: expected none with an ideal camera, found some")
    if shared.readout is not None:
        raise ValueError("readout.events_per_s: expected none with an ideal camera, found one")
    if shared.middle_shift.size:
        raise ValueError("threshold_off: expected none with an ideal camera, found one")
    if np.isnan(shared.reference).any() or np.isnan(shared.window_reference).any():
        raise ValueError("reference: expected finite levels, found those of refractory pixels")
    check_range("line_step_px", line_step_px, 1e-3, 10.0)
    shape = shared.reference.shape
    blind = shared.model.refractory_us > 0.0
    state = IdealState(
        shared=shared,
        level_index=optics.level_index(shared.profile),
        lower2_px2=np.empty(shape, np.float32),
        upper2_px2=np.empty(shape, np.float32),
        solved_in=np.zeros(shape, np.int64),
        release_us=np.zeros(shape if blind else (0, 0)),
        window_release_us=np.zeros(shared.window_reference.shape if blind else (0, 0)),
        line_step_px=float(line_step_px),
    )
    inner, _, steps_per_px, profile = shared.profile
    table = (inner, steps_per_px, profile, state.level_index)
    find_all_radii(shared.reference, shared.threshold, *table, state.lower2_px2, state.upper2_px2)
    return state


def step(state: IdealState, motion: SliceMotion, t0_us: int, rng: np.random.Generator) -> Events:
    """Return the events of one millisecond, sorted by time, t0_us <= t < t0_us + 1000.

    Anything that is not where the last slice ended, or has another contrast, has jumped at t0_us. ValueError if values
    are not finite, further than 1e6 px, or of another shape than at `start`, or if a path has other ends; the state is
    then unchanged.
    """
    shared = state.shared
    path, object_motion = camera_input.motions(len(shared.seen_dot_xy_px), motion)
    lines = camera_input.line_motion(shared.contact_edges, motion)

    t0_us = int(t0_us)
    state.slices += 1
    times = SliceTimes(state.slices, t0_us, float(shared.model.refractory_us))
    gel = IdealGelPixels(
        shared.seen_dot_xy_px,
        shared.profile,
        state.level_index,
        shared.reference,
        shared.threshold,
        state.lower2_px2,
        state.upper2_px2,
        state.solved_in,
        state.release_us,
    )
    steps = 0 if lines is None else line_steps(lines, path, state.line_step_px)
    event_count = 0
    if shared.window_level.size:
        pixels = IdealWindowPixels(
            *shared.window_px[:2],
            shared.seen_object,
            shared.texture,
            shared.window_level,
            shared.window_reference,
            shared.window_threshold,
            state.window_release_us,
        )
        event_count = solve_window(
            object_motion, pixels, NO_LINES if lines is None else lines, steps, times, shared.keys, event_count
        )
    if shared.contact_edges is not None:
        shared.contact_edges.events = 0
        if lines is not None:
            event_count, events = solve_line_pixels(lines, steps, path, gel, times, shared.keys, event_count)
            shared.contact_edges.events = events
    event_count = solve_dots(path, gel, times, shared.keys, event_count)
    if shared.model.leak_hz > 0.0:
        event_count = _leak(state, times, event_count)
    event_count = scanning.noise_of_slice(shared, t0_us, rng, event_count)
    stored = min(event_count, len(shared.keys))
    shared.dropped += event_count - stored
    columns = sorted_columns(shared.keys[:stored], t0_us)
    return Events(*(columns if shared.noise_filter is None else shared.noise_filter.keep(columns)))


def _leak(state: IdealState, times: SliceTimes, event_count: int) -> int:
    """Let leak lower the references of the rows that are due; return the number of events so far."""
    shared = state.shared
    drift = leak.drift(shared.model.leak_hz)
    first_row = state.slices % leak.LEAK_SLICES
    level = np.empty(shared.reference.shape, np.float32)
    leak.draw_leaking_rows(shared.seen_dot_xy_px, *shared.profile, first_row, level)
    state.lower2_px2[first_row :: leak.LEAK_SLICES] = np.inf
    gel = (shared.reference, shared.threshold, state.release_us)
    event_count = leak.leak_in_rows(level, first_row, (0, 0), drift, gel, times, shared.keys, event_count)
    corner_px = shared.window_px[:2]
    window = (shared.window_reference, shared.window_threshold, state.window_release_us)
    own_first = (first_row - corner_px[1]) % leak.LEAK_SLICES
    return int(
        leak.leak_in_rows(shared.window_level, own_first, corner_px, drift, window, times, shared.keys, event_count)
    )
