"""What the cameras' errors cost: wrong times and lost events against run time, on small seeded workloads.

The reference visits every pixel that a dot comes near 100,000 times a second, takes its level from the closed form of
the edge instead of a table, and interpolates linearly between visits. It shares no code with the cameras, starts from
the same references and thresholds, and is the slow truth that both are measured by.
"""

import copy
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US, Events, concatenate
from evetac_cli.sim.camera.ideal import camera as ideal
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState

REFERENCE_STEPS_PER_MS = 100
SUBSTEPS = (1, 2, 4, 8, 16, 32)
TOLERANCE_US = 10.0
# Two events that are farther apart than this are not the same one.
FARTHEST_US = 1000.0
# An edge farther off than this changes a level by less than 1e-8.
EDGE_SIGMAS = 6.0
STILL = (0.0, 0.0)

# What all dots are displaced by over time: (times,) in ms -> (times, 2) in px.
Motion = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class FineEvents(NamedTuple):
    """Columns of events with times that need not be whole: t in us, x and y in px, p 0 or 1."""

    t: NDArray[np.float64]
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    p: NDArray[np.int64]


class Match(NamedTuple):
    """How well found events agree with a reference's.

    `count_share` is found / reference - 1, `f1` counts a pair within the tolerance as right, `error_us` are the
    absolute differences in time of all pairs within FARTHEST_US.
    """

    count_share: float
    f1: float
    error_us: NDArray[np.float64]


class Workload(NamedTuple):
    """Dots (dots, 2) in px that are all displaced by `motion` for some slices, before a camera `model`."""

    name: str
    model: CameraModel
    dot_xy_px: NDArray[np.float64]
    motion: Motion
    slices: int

    def path_px(self, steps_per_ms: int) -> NDArray[np.float64]:
        """Where the dots are at the ends of all steps, shape (slices * steps_per_ms + 1, dots, 2)."""
        times_ms = np.arange(self.slices * steps_per_ms + 1) / steps_per_ms
        return self.dot_xy_px[None] + self.motion(times_ms)[:, None]


def reference_events(state: CameraState, path_px: NDArray[np.float64], step_us: float) -> FineEvents:
    """Every crossing of every pixel near a path (steps + 1, dots, 2) of dots without window, sampled each `step_us`.

    `state` gives references and thresholds at the start and is left as it is. A level is the erf edge of the nearest
    dot, linear between samples. The events come pixel after pixel.
    """
    given = (
        path_px,
        float(step_us),
        state.reference,
        state.threshold,
        state.model.dot_radius_px,
        state.model.edge_sigma_px,
        state.model.log_contrast,
    )
    made = _reference(*given, *_columns(0))
    columns = _columns(made)
    _reference(*given, *columns)
    return FineEvents(*columns)


def _columns(size: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    return np.empty(size), np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)


@njit(cache=True)
def _reference(
    path: NDArray[np.float64],
    step_us: float,
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    radius: float,
    sigma: float,
    contrast: float,
    event_t: NDArray[np.float64],
    event_x: NDArray[np.int64],
    event_y: NDArray[np.int64],
    event_p: NDArray[np.int64],
) -> int:
    samples, dots, _ = path.shape
    height, width = reference.shape
    reach = radius + EDGE_SIGMAS * sigma
    near = np.empty(dots, np.int64)
    made = 0
    low = np.empty((dots, 2))
    high = np.empty((dots, 2))
    for dot in range(dots):
        for axis in range(2):
            low[dot, axis] = path[:, dot, axis].min() - reach
            high[dot, axis] = path[:, dot, axis].max() + reach
    for y in range(height):
        for x in range(width):
            count = 0
            for dot in range(dots):
                if low[dot, 0] <= x <= high[dot, 0] and low[dot, 1] <= y <= high[dot, 1]:
                    near[count] = dot
                    count += 1
            if count == 0:
                continue
            level = np.float64(reference[y, x])
            step = np.float64(threshold[y, x])
            before = _edge_level(x, y, path[0], near[:count], radius, sigma, contrast)
            for sample in range(1, samples):
                after = _edge_level(x, y, path[sample], near[:count], radius, sigma, contrast)
                while abs(after - level) >= step:
                    brighter = after > level
                    level += step if brighter else -step
                    if made < len(event_t):
                        event_t[made] = (sample - 1 + (level - before) / (after - before)) * step_us
                        event_x[made] = x
                        event_y[made] = y
                        event_p[made] = int(brighter)
                    made += 1
                before = after
    return made


@njit(cache=True)
def _edge_level(
    x: int,
    y: int,
    dot_xy: NDArray[np.float64],
    near: NDArray[np.int64],
    radius: float,
    sigma: float,
    contrast: float,
) -> float:
    least2 = np.inf
    for dot in near:
        least2 = min(least2, (x - dot_xy[dot, 0]) ** 2 + (y - dot_xy[dot, 1]) ** 2)
    sigmas = (math.sqrt(least2) - radius) / sigma
    if sigmas > EDGE_SIGMAS:
        return 0.0
    if sigmas < -EDGE_SIGMAS:
        return -contrast
    ink = math.exp(-contrast)
    return math.log(ink + (1.0 - ink) * 0.5 * math.erfc(-sigmas / math.sqrt(2.0)))


def match(found: FineEvents, reference: FineEvents, tolerance_us: float = TOLERANCE_US) -> Match:
    """Pair the events of each pixel and polarity, each at most once, first come first paired.

    F1 = 2 pairs / (found + reference) for pairs within `tolerance_us`. Two empty streams agree.
    """
    both = found.t.size + reference.t.size
    if both == 0:
        return Match(0.0, 1.0, np.empty(0))
    sides = [_sorted_by_pixel(found), _sorted_by_pixel(reference)]
    right = _pair(*sides[0], *sides[1], tolerance_us)
    share = found.t.size / reference.t.size - 1.0 if reference.t.size else math.inf
    return Match(share, 2.0 * len(right) / both, _pair(*sides[0], *sides[1], FARTHEST_US))


def _sorted_by_pixel(events: FineEvents) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Pixel and polarity as one number, and times, sorted by both."""
    group = (events.y * 65536 + events.x) * 2 + events.p
    order = np.lexsort((events.t, group))
    return group[order], events.t[order]


@njit(cache=True)
def _pair(
    group_a: NDArray[np.int64],
    time_a: NDArray[np.float64],
    group_b: NDArray[np.int64],
    time_b: NDArray[np.float64],
    tolerance_us: float,
) -> NDArray[np.float64]:
    """Absolute time differences of the pairs within the tolerance."""
    apart = np.empty(min(len(group_a), len(group_b)))
    pairs = 0
    a = 0
    b = 0
    while a < len(group_a) and b < len(group_b):
        same = group_a[a] == group_b[b]
        if same and abs(time_a[a] - time_b[b]) <= tolerance_us:
            apart[pairs] = abs(time_a[a] - time_b[b])
            pairs += 1
            a += 1
            b += 1
        elif group_a[a] < group_b[b] or (same and time_a[a] < time_b[b]):
            a += 1
        else:
            b += 1
    return apart[:pairs]


def fine(events: Events) -> FineEvents:
    """Events of a camera, whose times are rounded down, at the middle of their microsecond."""
    x, y, p = (column.astype(np.int64) for column in events[1:])
    return FineEvents(events.t.astype(np.float64) + 0.5, x, y, p)


def play_ideal(state: CameraState, load: Workload, substeps: int) -> tuple[FineEvents, NDArray[np.float64]]:
    """Events of an ideal camera that starts as `state`, whose dots' paths have `substeps` pieces a slice.

    Also the run time of every slice, in us.
    """
    run = ideal.from_references(copy.deepcopy(state))
    path = load.path_px(substeps)
    rng = np.random.default_rng(0)
    parts = []
    took_us = np.empty(load.slices)
    for k in range(load.slices):
        piece = path[k * substeps : (k + 1) * substeps + 1]
        begin = time.perf_counter()
        parts.append(ideal.step(run, piece[0], piece[-1], STILL, STILL, 0.0, k * SLICE_US, rng, piece))
        took_us[k] = (time.perf_counter() - begin) * 1e6
    return fine(concatenate(parts)), took_us


def play_scans(state: CameraState, load: Workload) -> tuple[FineEvents, NDArray[np.float64]]:
    """Events of a scanning camera that starts as `state`, and the run time of every slice, in us."""
    run = copy.deepcopy(state)
    path = load.path_px(1)
    rng = np.random.default_rng(0)
    parts = []
    took_us = np.empty(load.slices)
    for k in range(load.slices):
        begin = time.perf_counter()
        parts.append(camera.step(run, path[k], path[k + 1], STILL, STILL, 0.0, k * SLICE_US, rng))
        took_us[k] = (time.perf_counter() - begin) * 1e6
    return fine(concatenate(parts)), took_us


def workloads() -> list[Workload]:
    """Eight dots for 20 ms: a slow shear, a turning slip, a tone. Without noise every error is the method's."""
    model = CameraModel(frame_px=(320, 180), noise_rate_hz=0.0, hot_pixels=0)
    column, row = np.meshgrid(np.arange(4), np.arange(2))
    xy = np.stack([40.3 + 62.5 * column.ravel(), 45.6 + 62.5 * row.ravel()], axis=1)
    return [
        Workload("shear 3 px at 5 Hz", model, xy, lambda t: _shaken(t, 3.0, 5.0), 20),
        Workload("slip from 0.2 to 1 px/ms", model, xy, _slip, 20),
        Workload("tone 0.3 px at 200 Hz", model, xy, lambda t: _shaken(t, 0.3, 200.0), 20),
    ]


def _shaken(times_ms: NDArray[np.float64], amplitude_px: float, frequency_hz: float) -> NDArray[np.float64]:
    way = amplitude_px * np.sin(2.0 * np.pi * 1e-3 * frequency_hz * times_ms)
    return np.stack([0.8 * way, 0.6 * way], axis=1)


def _slip(times_ms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice as fast each 8.6 ms, while the direction turns by a quarter in 20 ms."""
    way = 0.2 * times_ms + 0.02 * times_ms**2
    turn = times_ms * np.pi / 40.0
    return np.stack([way * np.cos(turn), way * np.sin(turn)], axis=1)


def camera_cost(seed: int = 0, loads: list[Workload] | None = None) -> list[dict[str, Any]]:
    """Rows of error and run time for the ideal camera with SUBSTEPS pieces a slice, and for the scanning camera.

    `error_us_*` is the time error of events found within 1 ms of their reference, of which the ideal camera's whole
    microseconds make 0.25 us in the median; `error_count_share` is |found / reference - 1|; run times are those of
    one slice, compiled. Without `loads` those of `workloads`.
    """
    rows = []
    for number, load in enumerate(workloads() if loads is None else loads):
        rng = np.random.default_rng((seed, number))
        state = camera.start(load.model, load.path_px(1)[0], None, None, None, rng)
        truth = reference_events(state, load.path_px(REFERENCE_STEPS_PER_MS), SLICE_US / REFERENCE_STEPS_PER_MS)
        if number == 0:  # compile
            play_ideal(state, load, 1)
            play_scans(state, load)
        rows += [
            _row(f"ideal, {load.name}, {substeps} sub-steps", truth, *play_ideal(state, load, substeps))
            for substeps in SUBSTEPS
        ]
        scans = f"dvxplorer, {load.name}, {load.model.scans_per_ms} scans"
        rows.append(_row(scans, truth, *play_scans(state, load)))
    return rows


def _row(setting: str, truth: FineEvents, found: FineEvents, took_us: NDArray[np.float64]) -> dict[str, Any]:
    agreement = match(found, truth)
    late = agreement.error_us if agreement.error_us.size else np.array([math.inf])
    return {
        "part": "camera",
        "setting": setting,
        "error_us_median": float(np.median(late)),
        "error_us_p95": float(np.percentile(late, 95)),
        "error_count_share": abs(float(agreement.count_share)),
        "f1_10us": float(agreement.f1),
        "time_us_median": float(np.median(took_us)),
        "time_us_p99": float(np.percentile(took_us, 99)),
    }
