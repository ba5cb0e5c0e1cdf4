"""What the dot tracker's choices cost: distance from the true dots, and run time, on seeded motions.

The workloads shake a whole grid of dots, (a) 3 px at 5 Hz and (b) 0.3 px at 200 Hz, and creep it at the pace of the
paper's trials; the ideal camera sees them without noise, and the dots' centres are known exactly. Run time is that of
a step on events of the dots' rims, whose number is what it depends on.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.tracker import PRESETS, TrackerConstants
from evetac_cli.numerics.simulator import camera_cost
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel

LOADS = (0, 50, 200, 1_000, 5_000, 20_000)
LOADED = 1_000  # events a slice of `time_us_*`
WARM = 20  # steps that are left out of the run times
DISTINCT = 400_000  # events in slices that are timed in turn: with few, the same pixels again and again would be hot
PATH_PIECES = 16  # of a slice, for the ideal camera
# An edge of 1.5 px from 10 to 90 %, contrast and threshold as for the published simulators these motions were made for.
CAMERA = CameraModel(noise_rate_hz=0.0, hot_pixels=0, mismatch=0.0, edge_sigma_px=1.5 / 2.5631, log_contrast=1.07)
DOTS_PX = np.stack(np.meshgrid(61.0 + 62.3 * np.arange(9), 41.0 + 62.4 * np.arange(7)), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Extent:
    """How long each workload lasts, in slices, and how often a step is timed."""

    slices: tuple[int, int, int]
    steps: int


USUAL = Extent((400, 60, 200), 120)
FULL = Extent((2000, 400, 2000), 3000)


class Scenario(NamedTuple):
    """Events, slice by slice, and where the dots are at the end of each, (slices, dots, 2) in px."""

    name: str
    slices: list[Events]
    truth_px: NDArray[np.float64]


def scenarios(seed: int, extent: Extent) -> list[Scenario]:
    """The workloads, seen by the ideal camera."""
    shear, tone, creep = extent.slices
    loads = [
        camera_cost.Workload("3 px at 5 Hz", CAMERA, DOTS_PX, lambda t: _shaken(t, 3.0, 5.0), shear),
        camera_cost.Workload("0.3 px at 200 Hz", CAMERA, DOTS_PX, lambda t: _shaken(t, 0.3, 200.0), tone),
        camera_cost.Workload("creep at 0.005 px/ms", CAMERA, DOTS_PX, _creep, creep),
    ]
    return [_seen(load, np.random.default_rng((seed, number))) for number, load in enumerate(loads)]


def _shaken(times_ms: NDArray[np.float64], amplitude_px: float, frequency_hz: float) -> NDArray[np.float64]:
    way = amplitude_px * np.sin(2.0 * np.pi * 1e-3 * frequency_hz * times_ms)
    return np.stack([0.8 * way, 0.6 * way], axis=1)


def _creep(times_ms: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([0.003 * times_ms, -0.004 * times_ms], axis=1)


def _seen(load: camera_cost.Workload, rng: np.random.Generator) -> Scenario:
    state = camera.start(load.model, load.path_px(1)[0], None, None, None, rng)
    found, _ = camera_cost.play_ideal(state, load, PATH_PIECES)
    edges = np.searchsorted(found.t, np.arange(load.slices + 1) * float(SLICE_US))
    columns = (
        found.t.astype(np.int64),
        found.x.astype(np.uint16),
        found.y.astype(np.uint16),
        found.p.astype(np.uint8),
    )
    events = Events(*columns)
    slices = [events.part(first, last) for first, last in zip(edges, edges[1:], strict=False)]
    return Scenario(load.name, slices, load.path_px(1)[1:])


def settings() -> Iterator[tuple[str, TrackerConstants, float]]:
    """What is compared: name, constants, and which share of the events is used."""
    for name, constants in PRESETS.items():
        yield f"{name}, all events", constants, 1.0
    stable = PRESETS["stable"]
    for sweeps in (1, 2, 4, 16, 32):
        yield f"stable by sweeps, {sweeps} sweeps", replace(stable, sweeps=sweeps), 1.0
    for preset in ("paper", "stable"):
        for share in (0.5, 0.25, 0.1):
            yield f"{preset} with fewer events, {share:g} of them", PRESETS[preset], share


def tracker_cost(seed: int, extent: Extent) -> Iterator[dict[str, Any]]:
    """Rows of error and run time: every setting on every workload, run times once a setting.

    error_px_*: distance from the true centre at the end of a slice, over all dots and slices; still_px_rms is that of
    a tracker that never moves. time_us_median, _p99: of a step at LOADED events; time_us_N: median at N events.
    """
    played = scenarios(seed, extent)
    for setting, constants, share in settings():
        times = {count: _timed(constants, int(count * share), extent.steps, seed) for count in LOADS}
        for scenario in played:
            yield {
                "part": f"tracker, {scenario.name}",
                "setting": setting,
                **_errors(scenario, constants, share, seed),
                "time_us_median": float(np.median(times[LOADED])),
                "time_us_p99": float(np.percentile(times[LOADED], 99)),
                **{f"time_us_{count}": float(np.median(took)) for count, took in times.items()},
            }


def rows(extent: Extent) -> int:
    """How many rows `tracker_cost` gives."""
    return len(list(settings())) * len(extent.slices)


def _errors(scenario: Scenario, constants: TrackerConstants, share: float, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    state = tracker.start(DOTS_PX, constants)
    error_px = np.empty(scenario.truth_px.shape[:2])
    events = 0
    for k, every in enumerate(scenario.slices):
        kept = rng.random(every.size) < share
        piece = Events(every.t[kept], every.x[kept], every.y[kept], every.p[kept])
        tracker.step(state, piece.x, piece.y, piece.p)
        error_px[k] = np.linalg.norm(state.dot_xy_px - scenario.truth_px[k], axis=1)
        events += piece.size
    still_px = np.linalg.norm(DOTS_PX - scenario.truth_px, axis=2)
    return {
        "error_px_rms": math.sqrt(np.mean(error_px**2)),
        "error_px_worst": float(error_px.max()),
        "still_px_rms": math.sqrt(np.mean(still_px**2)),
        "dots_lost": int(state.lost.sum()),
        "events_per_dot": events / error_px.size,
    }


def _timed(constants: TrackerConstants, count: int, steps: int, seed: int) -> NDArray[np.float64]:
    """Run times of steps, in us, on different slices of events of the dots' rims in turn, the first few left out."""
    rng = np.random.default_rng((seed, count))
    state = tracker.start(DOTS_PX, constants)
    slices = [rim_events(rng, count) for _ in range(min(steps, max(WARM, DISTINCT // max(count, 1))))]
    took_us = np.empty(steps)
    for k in range(steps):
        x, y, p = slices[k % len(slices)]
        begin = time.perf_counter()
        tracker.step(state, x, y, p)
        took_us[k] = (time.perf_counter() - begin) * 1e6
    return took_us[WARM:]


def rim_events(
    rng: np.random.Generator, count: int
) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Events on the rims of DOTS_PX at rest, 0.7 px blurred: columns x, y in px, p."""
    which, angle = rng.integers(0, len(DOTS_PX), count), rng.uniform(0.0, 2.0 * np.pi, count)
    radius_px = 15.0 + 0.7 * rng.standard_normal(count)
    rim = DOTS_PX[which] + radius_px[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    x, y = np.clip(np.round(rim), 0, np.array(FRAME_PX) - 1).astype(np.uint16).T.copy()
    return x, y, rng.integers(0, 2, count, dtype=np.uint8)
