"""The part `track`: distance of the dot tracker from the true dots against its run time, on seeded motions.

The workloads move a whole grid of dots: a sine of 3 px at 5 Hz, one of 0.3 px at 200 Hz, and a slow shift at the speed
of the paper's trials. Each is seen at 100 scans per ms without noise, and at 5 with the noise, hot pixels and
uneven thresholds of the sensor `evetac`. The dots' centres are known exactly. `standing still` is a tracker
that never moves dots; a tracker that is not better is useless. Run time is that of a step on events of the dots' rims
and depends on their number.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.common.rows import STILL, WARM_UP, Extent, collect, run_times, timed_us
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.cost.camera import Workload, oscillation, play
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS, TrackerConstants
from evetac_cli.sim.camera.scanning.camera import CameraModel

SLICES = Extent(quick=(400, 60, 200), full=(2000, 400, 2000))  # per workload
STEPS = Extent(quick=120, full=3000)  # number of timed steps
EVENT_COUNTS = (0, 50, 200, 1_000, 5_000, 20_000)
USUAL_COUNT = 1_000  # events per slice for `time_us_median` and `time_us_p99`
DISTINCT = 400_000  # events in slices timed in turn: with few, their pixels would always be in the cache
PATH_PIECES = 16  # per slice
# An edge of 1.5 px from 10 to 90 %; contrast and threshold as in the published simulators with these motions.
CAMERA = CameraModel(
    scans_per_ms=100,
    noise_rate_hz=0.0,
    hot_pixels=0,
    mismatch=0.0,
    edge_sigma_px=1.5 / 2.5631,
    log_contrast=1.07,
)
SCANNING = CameraModel(hot_pixels=6)  # noise as in the sensor `evetac`
DOTS_PX = np.stack(np.meshgrid(61.0 + 62.3 * np.arange(9), 41.0 + 62.4 * np.arange(7)), axis=-1).reshape(-1, 2)


class Scenario(NamedTuple):
    """Events slice by slice, and the dots' positions at the end of each, (slices, dots, 2) in px."""

    name: str
    slices: list[Events]
    truth_px: NDArray[np.float64]


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return rows of every setting on every workload; run times are measured once per setting.

    - error_px_*: distance from the true centre at the end of a slice, over all dots and slices;
    - still_px_rms: the same for dots that never move;
    - time_us_median, _p99: of a step at USUAL_COUNT events; time_us_N: median at N events.
    """
    scenarios = simulate_scenarios(params.seed, SLICES.pick(params.full))
    rows = (row for setting in settings() for row in _rows(*setting, scenarios, STEPS.pick(params.full), params.seed))
    still = (_still_row(scenario) for scenario in scenarios)
    return collect(chain(still, rows), (1 + len(list(settings()))) * len(scenarios), progress)


def summary(rows: Rows) -> dict[str, Any]:
    """Return the most accurate preset, and the presets' largest errors relative to a tracker that never moves."""
    worst: dict[str, float] = {}
    for row in rows:
        preset, _, events = row["setting"].partition(", ")
        if events == "all events":
            worst[preset] = max(worst.get(preset, 0.0), row["error_px_rms"] / row["still_px_rms"])
    return {
        "rows": len(rows),
        "most_accurate": min(worst, key=lambda preset: worst[preset]),
        **{f"{preset}_error_over_still_max": ratio for preset, ratio in worst.items()},
    }


def simulate_scenarios(seed: int, slices: tuple[int, int, int]) -> list[Scenario]:
    """Return the workloads with the given numbers of slices: seen in fine scans, then in noisy ones."""
    large, small, slow = slices
    loads = [
        Workload("3 px at 5 Hz", CAMERA, DOTS_PX, lambda t: oscillation(t, 3.0, 5.0), large),
        Workload("0.3 px at 200 Hz", CAMERA, DOTS_PX, lambda t: oscillation(t, 0.3, 200.0), small),
        Workload("slow shift at 0.005 px/ms", CAMERA, DOTS_PX, _slow_shift, slow),
    ]
    noisy = [load._replace(name=f"{load.name}, scanned and noisy", model=SCANNING) for load in loads]
    return [_simulate(load, (seed, number)) for number, load in enumerate(loads + noisy)]


def _slow_shift(times_ms: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([0.003 * times_ms, -0.004 * times_ms], axis=1)


def _simulate(load: Workload, seeds: Sequence[int]) -> Scenario:
    events, _ = play(load, seeds, PATH_PIECES)
    edges = np.searchsorted(events.t, np.arange(load.slices + 1) * SLICE_US)
    slices = [events.part(first, last) for first, last in zip(edges, edges[1:], strict=False)]
    return Scenario(load.name, slices, load.path_px(1)[1:])


def settings() -> Iterator[tuple[str, TrackerConstants, float]]:
    """Yield name, tracker constants, and the share of events used, for every setting."""
    for name, constants in PRESETS.items():
        yield f"{name}, all events", constants, 1.0
    stable = PRESETS["stable"]
    for sweeps in (1, 2, 4, 16, 32):
        yield f"stable by sweeps, {sweeps} sweeps", replace(stable, sweeps=sweeps), 1.0
    for preset in ("paper", "stable"):
        for share in (0.5, 0.25, 0.1):
            yield f"{preset} with fewer events, {share:g} of them", PRESETS[preset], share


def _rows(
    setting: str, constants: TrackerConstants, share: float, scenarios: Sequence[Scenario], steps: int, seed: int
) -> Iterator[Row]:
    """Yield the rows of a setting, one per workload."""
    times_us = {count: _time_steps(constants, int(count * share), steps, seed) for count in EVENT_COUNTS}
    for scenario in scenarios:
        yield {
            "part": f"tracker, {scenario.name}",
            "setting": setting,
            **_errors(scenario, constants, share, seed),
            **run_times(times_us[USUAL_COUNT]),
            **{f"time_us_{count}": float(np.median(took_us)) for count, took_us in times_us.items()},
        }


def _still_row(scenario: Scenario) -> Row:
    """Return the row of a tracker that never moves dots and takes no time."""
    still_px = np.linalg.norm(DOTS_PX - scenario.truth_px, axis=2)
    return {
        "part": f"tracker, {scenario.name}",
        "setting": STILL,
        **_figures(still_px, still_px, 0, 0),
        **run_times(np.empty(0)),
        **{f"time_us_{count}": None for count in EVENT_COUNTS},
    }


def _errors(scenario: Scenario, constants: TrackerConstants, share: float, seed: int) -> Row:
    rng = np.random.default_rng(seed)
    state = tracker.start(DOTS_PX, constants)
    error_px = np.empty(scenario.truth_px.shape[:2])
    events = 0
    for k, slice_ in enumerate(scenario.slices):
        sample = rng.random(slice_.size) < share
        tracker.step(state, slice_.x[sample], slice_.y[sample], slice_.p[sample])
        error_px[k] = np.linalg.norm(state.dot_xy_px - scenario.truth_px[k], axis=1)
        events += int(sample.sum())
    still_px = np.linalg.norm(DOTS_PX - scenario.truth_px, axis=2)
    return _figures(error_px, still_px, int(state.lost.sum()), events)


def _figures(error_px: Floats, still_px: Floats, lost: int, events: int) -> Row:
    return {
        "error_px_rms": math.sqrt(np.mean(error_px**2)),
        "error_px_worst": float(error_px.max()),
        "still_px_rms": math.sqrt(np.mean(still_px**2)),
        "dots_lost": lost,
        "events_per_dot": events / error_px.size,
    }


def _time_steps(constants: TrackerConstants, count: int, steps: int, seed: int) -> Floats:
    """Return run times of steps in us, on slices of events of the dots' rims in turn, without the first few."""
    rng = np.random.default_rng((seed, count))
    state = tracker.start(DOTS_PX, constants)
    distinct = min(steps, max(WARM_UP, DISTINCT // max(count, 1)))
    slices = cycle([rim_events(rng, count) for _ in range(distinct)])
    return timed_us(lambda: tracker.step(state, *next(slices)), steps - WARM_UP)


def rim_events(
    rng: np.random.Generator, count: int
) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Return events on the rims of DOTS_PX at rest, blurred by 0.7 px: columns x, y in px, p."""
    which, angle = rng.integers(0, len(DOTS_PX), count), rng.uniform(0.0, 2.0 * np.pi, count)
    radius_px = 15.0 + 0.7 * rng.standard_normal(count)
    rim = DOTS_PX[which] + radius_px[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    x, y = np.clip(np.round(rim), 0, np.array(FRAME_PX) - 1).astype(np.uint16).T.copy()
    return x, y, rng.integers(0, 2, count, dtype=np.uint8)
