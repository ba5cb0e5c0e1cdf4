"""Error against run time of the simulated cameras: timing errors and lost events, on small seeded workloads.

Both cameras are compared with the events of `reference`, which evaluates every pixel 100,000 times per second. The
reference has the thresholds of the compared camera and no noise, so noise events count as errors.
"""

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.evaluate.cost.camera_reference import FineEvents, fine, match, reference_events, window_events
from evetac_cli.evaluate.rows import run_times
from evetac_cli.events import SLICE_US, concatenate
from evetac_cli.jobs import Row
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.ideal import camera as ideal
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState

REFERENCE_STEPS_PER_MS = 100
SUBSTEPS = (1, 2, 4, 8, 16, 32)
FEW_SUBSTEPS = (1, 4, 16)  # for the workloads with noise, mismatch and window

# Displacement of all dots over time: (times,) in ms -> (times, 2) in px.
Motion = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class Workload(NamedTuple):
    """Dots (dots, 2) in px that are all displaced by `motion` for some slices, seen by a camera `model`.

    texture: that of an object moving with the dots, seen in `window_px` (x0, y0, x1, y1), ends excluded; no dots there.
    """

    name: str
    model: CameraModel
    dot_xy_px: NDArray[np.float64]
    motion: Motion
    slices: int
    substeps: tuple[int, ...] = SUBSTEPS
    part: str = "camera"
    texture: NDArray[np.float32] | None = None
    window_px: tuple[int, int, int, int] | None = None

    def path_px(self, steps_per_ms: int) -> NDArray[np.float64]:
        """Return the dots' positions at the ends of all steps, shape (slices * steps_per_ms + 1, dots, 2)."""
        times_ms = np.arange(self.slices * steps_per_ms + 1) / steps_per_ms
        return self.dot_xy_px[None] + self.motion(times_ms)[:, None]

    def object_px(self, steps_per_ms: int) -> NDArray[np.float64]:
        """Return the object's position at the ends of all steps, (slices * steps_per_ms + 1, 2), linear within a slice.

        Linear, because cameras and the reference receive the position of an object only at the ends of a slice.
        """
        ends_ms = np.arange(self.slices + 1.0)
        moved = self.motion(ends_ms) if self.texture is not None else np.zeros((len(ends_ms), 2))
        times_ms = np.arange(self.slices * steps_per_ms + 1) / steps_per_ms
        return np.stack([np.interp(times_ms, ends_ms, moved[:, axis]) for axis in range(2)], axis=1)


def play_ideal(state: CameraState, load: Workload, substeps: int) -> tuple[FineEvents, NDArray[np.float64]]:
    """Return the events of an ideal camera, starting from `state`, and the run time of every slice, in us.

    The dots' paths have `substeps` pieces per slice.
    """
    run = ideal.from_references(copy.deepcopy(state))
    path, moved = load.path_px(substeps), load.object_px(1)
    contrast = float(load.texture is not None)
    rng = np.random.default_rng(0)
    parts = []
    took_us = np.empty(load.slices)
    for k in range(load.slices):
        piece = path[k * substeps : (k + 1) * substeps + 1]
        begin = time.perf_counter()
        parts.append(
            ideal.step(
                run, SliceMotion(piece[0], piece[-1], moved[k], moved[k + 1], contrast, piece), k * SLICE_US, rng
            )
        )
        took_us[k] = (time.perf_counter() - begin) * 1e6
    return fine(concatenate(parts)), took_us


def play_scans(state: CameraState, load: Workload, substeps: int = 1) -> tuple[FineEvents, NDArray[np.float64]]:
    """Return the events of a scanning camera, starting from `state`, and the run time of every slice, in us."""
    run = copy.deepcopy(state)
    path, moved = load.path_px(substeps), load.object_px(1)
    contrast = float(load.texture is not None)
    rng = np.random.default_rng(0)
    parts = []
    took_us = np.empty(load.slices)
    for k in range(load.slices):
        piece = path[k * substeps : (k + 1) * substeps + 1]
        begin = time.perf_counter()
        parts.append(
            camera.step(
                run, SliceMotion(piece[0], piece[-1], moved[k], moved[k + 1], contrast, piece), k * SLICE_US, rng
            )
        )
        took_us[k] = (time.perf_counter() - begin) * 1e6
    return fine(concatenate(parts)), took_us


def workloads() -> list[Workload]:
    """Return workloads of eight dots for 20 ms: slow shear, a turning slip, a tone; and the slip in harder conditions.

    Without noise every error is due to the method.
    """
    model = CameraModel(frame_px=(320, 180), noise_rate_hz=0.0, hot_pixels=0)
    column, row = np.meshgrid(np.arange(4), np.arange(2))
    xy = np.stack([40.3 + 62.5 * column.ravel(), 45.6 + 62.5 * row.ravel()], axis=1)
    noisy = replace(model, noise_rate_hz=1.0, hot_pixels=10)
    uneven = replace(model, mismatch=0.3)
    bare = optics.texture(np.random.default_rng(0), (256, 256), 12.0, 0.06)
    harder = "camera with noise, mismatch and window"
    few = FEW_SUBSTEPS
    return [
        Workload("shear 3 px at 5 Hz", model, xy, lambda t: oscillation(t, 3.0, 5.0), 20),
        Workload("slip from 0.2 to 1 px/ms", model, xy, _slip, 20),
        Workload("tone 0.3 px at 200 Hz", model, xy, lambda t: oscillation(t, 0.3, 200.0), 20),
        Workload("slip, noise of 1 Hz a pixel and 10 hot pixels", noisy, xy, _slip, 20, few, harder),
        Workload("slip, thresholds 30 % apart", uneven, xy, _slip, 20, few, harder),
        Workload("slip, texture in a window", model, xy[:3], _slip, 20, few, harder, bare, (240, 0, 320, 180)),
    ]


def oscillation(times_ms: NDArray[np.float64], amplitude_px: float, frequency_hz: float) -> NDArray[np.float64]:
    """Return displacements (times, 2) in px of a sine along (0.8, 0.6), for times in ms."""
    shift_px = amplitude_px * np.sin(2.0 * np.pi * 1e-3 * frequency_hz * times_ms)
    return np.stack([0.8 * shift_px, 0.6 * shift_px], axis=1)


def _slip(times_ms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a motion that doubles its speed in about 8.6 ms and turns by a quarter in 20 ms."""
    distance_px = 0.2 * times_ms + 0.02 * times_ms**2
    turn = times_ms * np.pi / 40.0
    return np.stack([distance_px * np.cos(turn), distance_px * np.sin(turn)], axis=1)


def row_count(loads: Sequence[Workload]) -> int:
    """Return the number of rows of `camera_rows`."""
    return sum(len(load.substeps) + 1 for load in loads)


def camera_rows(seed: int, loads: Sequence[Workload]) -> Iterator[Row]:
    """Yield rows of error and run time for the ideal camera with SUBSTEPS pieces per slice and for the scanning camera.

    `error_us_*` is the time error of events within 1 ms of a reference event. Of this, 0.25 us in the median are due to
    the ideal camera's whole microseconds. `error_share_count` is |events / reference - 1|. Run times are those of one
    slice, compiled.
    """
    for number, load in enumerate(loads):
        rng = np.random.default_rng((seed, number))
        window = None if load.window_px is None else (load.window_px, load.texture)
        state = camera.start(load.model, load.path_px(1)[0], None, window, rng)
        truth = true_events(state, load)
        play_ideal(state, load, 1)  # compiles
        play_scans(state, load)
        for substeps in load.substeps:
            yield _row(load, f"ideal, {load.name}, {substeps} sub-steps", truth, *play_ideal(state, load, substeps))
        setting = f"dvxplorer, {load.name}, {load.model.scans_per_ms} scans"
        yield _row(load, setting, truth, *play_scans(state, load))


def true_events(state: CameraState, load: Workload) -> FineEvents:
    """Return the events of a workload from the reference, starting from `state`: those of dots, then of the window."""
    step_us = SLICE_US / REFERENCE_STEPS_PER_MS
    parts = [reference_events(state, load.path_px(REFERENCE_STEPS_PER_MS), step_us)]
    if load.texture is not None:
        parts.append(window_events(state, load.object_px(REFERENCE_STEPS_PER_MS), step_us))
    return FineEvents(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _row(load: Workload, setting: str, truth: FineEvents, events: FineEvents, took_us: NDArray[np.float64]) -> Row:
    agreement = match(events, truth)
    error_us = agreement.error_us if agreement.error_us.size else np.array([math.inf])
    return {
        "part": load.part,
        "setting": setting,
        "error_us_median": float(np.median(error_us)),
        "error_us_p95": float(np.percentile(error_us, 95)),
        "error_share_count": abs(float(agreement.count_share)),
        "f1_10us": float(agreement.f1),
        **run_times(took_us),
    }
