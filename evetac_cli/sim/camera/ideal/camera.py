"""An ideal event camera: every pixel fires at the very moment its log brightness has changed by its threshold.

The counterpart of the scanning camera in camera.py, which shares its optics, individuals, noise and interface. Here a
pixel fires as often as its level passes a threshold, several times a slice if need be, and an event's time is that of
the crossing, rounded down to a microsecond. Use it to tell what a scanning camera loses, or as a camera without scans.

Crossings are solved, not stepped through: those of the gel in ideal_dots, of the window in ideal_window, of pixels
under moving lines in ideal_lines. Leak is that of camera.py: an event comes late by up to the 40 ms between two visits.

Left out: bandwidth (a low pass has no closed form for the crossing), and what camera.py leaves out.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.events import Events
from evetac_cli.sim.camera import camera_input, leak, optics
from evetac_cli.sim.camera.contact_edges import ContactEdges, Place
from evetac_cli.sim.camera.event_keys import sorted_columns
from evetac_cli.sim.camera.ideal.dots import find_all_radii, solve_dots
from evetac_cli.sim.camera.ideal.lines import LINE_STEP_PX, line_steps, solve_line_pixels
from evetac_cli.sim.camera.ideal.window import NO_LINES, solve_window
from evetac_cli.sim.camera.noise import add_noise
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState


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
    window_release_us: NDArray[np.float64]
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
    camera_rng: np.random.Generator | None = None,
    contact_edges: ContactEdges | None = None,
    line_step_px: float = LINE_STEP_PX,
) -> IdealState:
    """Switch the camera on; arguments, draws and errors are those of `camera.start`.

    Equal generators give both cameras the same thresholds, phases and hot pixels.
    """
    shared = camera.start(model, dot_xy_px, dot_radius_px, window_px, texture, rng, camera_rng, contact_edges)
    return from_references(shared, line_step_px)


def from_references(shared: CameraState, line_step_px: float = LINE_STEP_PX) -> IdealState:
    """An ideal camera that goes on from the references in `shared`, which it owns from now on; ValueError on NaN."""
    if np.isnan(shared.reference).any() or np.isnan(shared.window_reference).any():
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
        window_release_us=np.zeros(shared.window_reference.shape if blind else (0, 0)),
        line_step_px=float(line_step_px),
    )
    inner, _, steps_per_px, profile = shared.profile
    table = (inner, steps_per_px, profile, state.level_index)
    find_all_radii(shared.reference, shared.threshold, *table, state.lower2_px2, state.upper2_px2)
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
    contact_edges_start: Place | None = None,
    contact_edges_end: Place | None = None,
) -> Events:
    """The events of one millisecond, sorted by time, t0_us <= t < t0_us + 1000.

    Dots (dots, 2) and the object's displacement (2,) move on straight lines from start to end, in px, the contrast
    holds for the whole slice. Dots on curved paths come with `dot_path_px` (k + 1, dots, 2): where they are at k + 1
    equally spaced times, from their start to their end. A camera with rims needs `contact_edges_start` and
    `contact_edges_end`, between which they move and fade evenly. What lies elsewhere than at the end of the last slice, or has
    another contrast, has jumped there at t0_us. ValueError on values that are not finite, farther than 1e6 px, of
    another shape than at `start`, or a path with other ends; the state is then as before.
    """
    shared = state.shared
    path, object_start, object_end = camera_input.moves(
        len(shared.seen_dot_xy_px),
        dot_xy_px_start,
        dot_xy_px_end,
        dot_path_px,
        object_xy_px_start,
        object_xy_px_end,
    )
    camera_input.check_range("texture_contrast", texture_contrast, 0.0, 1e3)
    lines = camera_input.line_places(shared.contact_edges, contact_edges_start, contact_edges_end)

    t0_us = int(t0_us)
    refractory_us = shared.model.refractory_us

    state.slices += 1
    made = 0
    when = (refractory_us, state.window_release_us, t0_us, shared.keys)
    window = (
        object_start,
        object_end,
        float(texture_contrast),
        shared.seen_object,
        shared.texture,
        shared.window_px[0],
        shared.window_px[1],
        shared.window_level,
        shared.window_reference,
        shared.window_threshold,
    )
    gel = (*shared.profile, state.level_index, shared.reference, shared.threshold, state.lower2_px2, state.upper2_px2)
    solved = (state.solved_in, state.slices, refractory_us, state.release_us, t0_us, shared.keys)
    if shared.contact_edges is not None and lines is not None:
        made = _solve_lines(state, shared.contact_edges, *lines, path, window, when, gel, solved)
    elif shared.window_level.size:
        made = solve_window(*window, NO_LINES, *when, made)
    if shared.contact_edges is not None and lines is None:
        shared.contact_edges.events = 0
    made = solve_dots(path, shared.seen_dot_xy_px, *gel, *solved, made)
    if shared.model.leak_hz > 0.0:
        made = _leak(state, t0_us, made)
    hot = (shared.hot_pixel, shared.hot_cumulative_hz)
    made = add_noise(shared.model.noise_rate_hz, *hot, shared.model.frame_px, rng, shared.keys, made)
    kept = min(made, len(shared.keys))
    shared.dropped += made - kept
    return Events(*sorted_columns(shared.keys[:kept], t0_us))


def _solve_lines(
    state: IdealState,
    contact_edges: ContactEdges,
    start: Place,
    end: Place,
    path: NDArray[np.float64],
    window: tuple[Any, ...],
    when: tuple[Any, ...],
    gel: tuple[Any, ...],
    solved: tuple[Any, ...],
) -> int:
    """Crossings of the pixels that moving lines may touch, in the window and on the gel; returns the number of events.

    `window` and `when`, `gel` and `solved` are arguments of `solve_window` and `solve_dots`.
    """
    steps = line_steps(contact_edges, start, end, path, state.line_step_px)
    edge = (contact_edges.cut_contrast, contact_edges.cut_half_px)
    made = 0
    if state.shared.window_level.size:
        lines = (
            steps,
            contact_edges.outline,
            *edge,
            start,
            end,
            contact_edges.seen_level,
            contact_edges.seen_cut_level,
        )
        made = solve_window(*window, lines, *when, made)
    seen = (contact_edges.seen_corner, contact_edges.seen_cut_x, contact_edges.seen_level, contact_edges.seen_cut_level)
    given = (steps, contact_edges.outline, *edge, start, end, seen, path, gel, solved)
    total, contact_edges.events = solve_line_pixels(*given, made)
    return int(total)


def _leak(state: IdealState, t0_us: int, made: int) -> int:
    """Let leak lower the references of the rows whose turn it is, and tell who fires by it."""
    shared = state.shared
    drift = leak.drift(shared.model.leak_hz)
    first_row = state.slices % leak.LEAK_SLICES
    refractory_us = shared.model.refractory_us
    level = np.empty(shared.reference.shape, np.float32)
    inner, outer, steps_per_px, profile = shared.profile
    table = (outer, steps_per_px, profile)
    leak.draw_leaking_rows(shared.seen_dot_xy_px, inner, *table, first_row, level)
    state.lower2_px2[first_row :: leak.LEAK_SLICES] = np.inf
    when = (refractory_us, float(t0_us), shared.keys)
    made = leak.leak_in_rows(
        level, first_row, 0, 0, drift, shared.reference, shared.threshold, state.release_us, *when, made
    )
    first_x, first_y = shared.window_px[:2]
    strip = (shared.window_reference, shared.window_threshold, state.window_release_us)
    own_first = (first_row - first_y) % leak.LEAK_SLICES
    return int(leak.leak_in_rows(shared.window_level, own_first, first_x, first_y, drift, *strip, *when, made))
