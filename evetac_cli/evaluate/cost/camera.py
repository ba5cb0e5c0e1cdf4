"""Error against run time of the simulated camera: timing errors and lost events, on small seeded workloads.

Each setting is compared with the same camera at REFERENCE_SCANS scans per ms. The reference itself is late by 1 to 2 us
in the median, and by less than 11 us for 95 % of the events.

tests/evaluate/cost/test_camera.py compares it with every pixel followed in closed form.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.evaluate.common.rows import run_times
from evetac_cli.events import SLICE_US, Events, concatenate
from evetac_cli.jobs import Row
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel

REFERENCE_SCANS, REFERENCE_SUBSTEPS = 1000, 50
# Pieces of a dot's path per slice, and scans per ms.
SETTINGS = tuple((substeps, scans) for substeps in (1, 16) for scans in (1, 2, 5, 10, 20, 50, 100, 200))
TOLERANCE_US = 10.0
FARTHEST_US = 1000.0  # two events farther apart than this are not the same event

# Displacement of all dots over time: (times,) in ms -> (times, 2) in px.
Motion = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class Workload(NamedTuple):
    """Dots (dots, 2) in px that are all displaced by `motion` for some slices, seen by a camera `model`."""

    name: str
    model: CameraModel
    dot_xy_px: NDArray[np.float64]
    motion: Motion
    slices: int
    settings: tuple[tuple[int, int], ...] = SETTINGS

    def path_px(self, steps_per_ms: int) -> NDArray[np.float64]:
        """Return the dots' positions at the ends of all steps, shape (slices * steps_per_ms + 1, dots, 2)."""
        times_ms = np.arange(self.slices * steps_per_ms + 1) / steps_per_ms
        return self.dot_xy_px[None] + self.motion(times_ms)[:, None]


def play(load: Workload, seed: Sequence[int], substeps: int = 1) -> tuple[Events, NDArray[np.float64]]:
    """Return the events of a workload, and the run time of every slice in us; paths have `substeps` pieces per slice.

    Equal seeds give equal thresholds and first references; scans and noise of the model do not matter.
    """
    path = load.path_px(substeps)
    state = camera.start(load.model, path[0], None, np.random.default_rng(seed))
    rng = np.random.default_rng(0)
    parts = []
    took_us = np.empty(load.slices)
    for k in range(load.slices):
        piece = path[k * substeps : (k + 1) * substeps + 1]
        motion = SliceMotion(piece[0], piece[-1], (0.0, 0.0), (0.0, 0.0), 0.0, piece)
        begin = time.perf_counter()
        parts.append(camera.step(state, motion, k * SLICE_US, rng))
        took_us[k] = (time.perf_counter() - begin) * 1e6
    return concatenate(parts), took_us


def workloads() -> list[Workload]:
    """Return workloads of eight dots for 20 ms: slow shear, a turning slip, a tone.

    Without noise every error is due to the method.
    """
    model = CameraModel(frame_px=(320, 180), noise_rate_hz=0.0, hot_pixels=0)
    column, row = np.meshgrid(np.arange(4), np.arange(2))
    xy = np.stack([40.3 + 62.5 * column.ravel(), 45.6 + 62.5 * row.ravel()], axis=1)
    return [
        Workload("shear 3 px at 5 Hz", model, xy, lambda t: oscillation(t, 3.0, 5.0), 20),
        Workload("slip from 0.2 to 1 px/ms", model, xy, _slip, 20),
        Workload("tone 0.3 px at 200 Hz", model, xy, lambda t: oscillation(t, 0.3, 200.0), 20),
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


def camera_rows(seed: int, loads: Sequence[Workload]) -> Iterator[Row]:
    """Yield rows of error and run time for the settings of each workload.

    `error_us_*` is the time error of events within 1 ms of a reference event. `error_share_count` is
    |events / reference - 1|. Run times are those of one slice, compiled.
    """
    for number, load in enumerate(loads):
        seeds = (seed, number)
        truth = reference_events(load, seeds)  # compiles too
        for substeps, scans in load.settings:
            model = replace(load.model, scans_per_ms=scans)
            events, took_us = play(load._replace(model=model), seeds, substeps)
            yield _row(load, f"{load.name}, {substeps} sub-steps, {scans} scans", truth, events, took_us)


def reference_events(load: Workload, seeds: Sequence[int]) -> Events:
    """Return the events of a workload in fine scans, without noise."""
    model = replace(load.model, scans_per_ms=REFERENCE_SCANS, noise_rate_hz=0.0, hot_pixels=0)
    return play(load._replace(model=model), seeds, REFERENCE_SUBSTEPS)[0]


def _row(load: Workload, setting: str, truth: Events, events: Events, took_us: NDArray[np.float64]) -> Row:
    agreement = match(events, truth)
    error_us = agreement.error_us if agreement.error_us.size else np.array([math.inf])
    return {
        "part": "camera",
        "setting": setting,
        "error_us_median": float(np.median(error_us)),
        "error_us_p95": float(np.percentile(error_us, 95)),
        "error_share_count": abs(float(agreement.count_share)),
        "f1_10us": float(agreement.f1),
        **run_times(took_us),
    }


class Match(NamedTuple):
    """Agreement of a camera's events with a reference's.

    `count_share` is events / reference - 1. `f1` counts pairs within the tolerance as correct. `error_us` are the
    absolute time differences of all pairs within FARTHEST_US.
    """

    count_share: float
    f1: float
    error_us: NDArray[np.float64]


def match(events: Events, reference: Events, tolerance_us: float = TOLERANCE_US) -> Match:
    """Pair the events of each pixel and polarity in order of time, each at most once.

    F1 = 2 pairs / (events + reference) for pairs within `tolerance_us`. Two empty streams agree.
    """
    both = events.t.size + reference.t.size
    if both == 0:
        return Match(0.0, 1.0, np.empty(0))
    sides = [_sorted_by_pixel(events), _sorted_by_pixel(reference)]
    pairs = _pair(*sides[0], *sides[1], tolerance_us)
    share = events.t.size / reference.t.size - 1.0 if reference.t.size else math.inf
    return Match(share, 2.0 * len(pairs) / both, _pair(*sides[0], *sides[1], FARTHEST_US))


def _sorted_by_pixel(events: Events) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pixel and polarity as one number, and times, sorted by both."""
    x, y, p = (column.astype(np.int64) for column in events[1:])
    group = (y * 65536 + x) * 2 + p
    order = np.lexsort((events.t, group))
    return group[order], events.t[order]


@njit(cache=True)
def _pair(
    group_a: NDArray[np.int64],
    time_a: NDArray[np.int64],
    group_b: NDArray[np.int64],
    time_b: NDArray[np.int64],
    tolerance_us: float,
) -> NDArray[np.float64]:
    """Return absolute time differences of the pairs within the tolerance."""
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
