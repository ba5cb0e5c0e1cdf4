"""The dot tracker with too many events, no events, extreme constants and adverse scenes.

Every case is run with every preset. Its rows are the largest distance of a dot from its true position and the 99th
percentile, over all slices. Dots that the tracker flags as lost in a slice do not count in it, because readers of the
tracks know not to trust them.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.common.rows import Extent
from evetac_cli.evaluate.cost.tracker import DOTS_PX, rim_events
from evetac_cli.evaluate.stability.cases import (
    P99_DOT,
    SAME_DOTS,
    SLIP_SOON,
    SLIPS,
    WORST_DOT,
    case_rows,
    in_nodes,
    merge,
    run_case,
)
from evetac_cli.events import FRAME_PX
from evetac_cli.jobs import Rows
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS, TrackerConstants
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.store.recordings import slip_grid
from evetac_cli.trials.record.simulated import play
from evetac_cli.trials.trial import SimulatedTrial

Columns = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]

GAINS = (0.003, 0.03, 0.3, 1.0, 10.0, 1e3)
WEIGHTS = (0.0, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6)
EVENTS_PER_PX = 300.0  # per dot and pixel of its motion, as simulated
DOT_RADIUS_PX = 15.0
SLICES = Extent(quick=200, full=1000)
OBJECT = 11  # number of the paper's object, in slips


@dataclass(frozen=True)
class TrackerCase:
    """Events slice by slice for dots whose shift from rest in px is `shift(k)` at the end of slice k.

    A dot's rim has events while it moves; `more` adds others. `changes` are constants that differ from the preset's.
    """

    name: str
    shift: Callable[[int], tuple[float, float]] = lambda _: (0.0, 0.0)
    more: Callable[[int, np.random.Generator], Columns | None] = lambda *_: None
    changes: dict[str, Any] = field(default_factory=dict)
    polarity: int | None = None  # of all events


def extreme_cases() -> list[TrackerCase]:
    """Return the extreme cases."""
    usual = partial(_circle, 3.0, 200.0)
    return [
        TrackerCase("no events"),
        TrackerCase("one event a slice", more=lambda k, rng: _anywhere(rng, 1)),
        TrackerCase("dots on a circle of 3 px", shift=usual),
        TrackerCase("all events brighter", shift=usual, polarity=1),
        TrackerCase("all events darker", shift=usual, polarity=0),
        TrackerCase("1e6 events a slice, for 3 slices", shift=usual, more=_burst),
        TrackerCase(
            "1e4 events a dot and slice", more=lambda k, rng: rim_events(rng, 10_000 * len(DOTS_PX)) if k < 5 else None
        ),
        TrackerCase("1e4 events on one side of one dot", more=_one_sided),
        TrackerCase("dots leave the frame at 5 px/ms", shift=lambda k: (-5.0 * k, 0.0)),
        TrackerCase("a hand passes over, 5,000 events a slice", shift=usual, more=partial(_bar, 5_000)),
        TrackerCase("a hand passes over, 20,000 events a slice", shift=usual, more=partial(_bar, 20_000)),
        TrackerCase("vibration of 1 px at 498 Hz", shift=lambda k: (math.sin(2 * math.pi * 0.498 * (k + 1)), 0.0)),
        *(TrackerCase(f"step size {gain:g}", shift=usual, changes={"step_size": gain}) for gain in GAINS),
        *(
            TrackerCase(f"regulariser {weight:g}", shift=usual, changes={"regulariser_weight": weight})
            for weight in WEIGHTS
        ),
    ]


def _circle(radius_px: float, slices: float, k: int) -> tuple[float, float]:
    turn = 2.0 * math.pi * (k + 1) / slices
    return radius_px * math.sin(turn), radius_px * (1.0 - math.cos(turn))


def _anywhere(rng: np.random.Generator, count: int) -> Columns:
    x, y = (rng.integers(0, size, count, dtype=np.uint16) for size in FRAME_PX)
    return x, y, rng.integers(0, 2, count, dtype=np.uint8)


def _burst(k: int, rng: np.random.Generator) -> Columns | None:
    return _anywhere(rng, 1_000_000) if 10 <= k < 13 else None


def _one_sided(k: int, rng: np.random.Generator) -> Columns | None:
    if k >= 20:
        return None
    place = DOTS_PX[0] + (16.0, 0.0) + rng.uniform(-1, 1, (10_000, 2))
    x, y = np.round(place).astype(np.uint16).T.copy()
    return x, y, np.zeros(len(x), np.uint8)


def _bar(count: int, k: int, rng: np.random.Generator) -> Columns | None:
    """Return the events of both rims of a bar that crosses the frame at 5 px/ms."""
    x = np.round(5.0 * k - 20.0 + 2.0 * rng.standard_normal(count) - 60.0 * rng.integers(0, 2, count))
    inside = (x >= 0) & (x < FRAME_PX[0])
    _, y, p = _anywhere(rng, int(inside.sum()))
    return x[inside].astype(np.uint16), y, p


def _moving_rims(before: NDArray[np.float64], after: NDArray[np.float64], rng: np.random.Generator) -> Columns:
    """Return events of dots (n, 2) moved within a slice: in proportion to distance, darker ahead, brighter behind."""
    shift = after - before
    length = np.linalg.norm(shift, axis=1)
    dot = np.repeat(np.arange(len(before)), rng.poisson(np.minimum(EVENTS_PER_PX * length, 2_000.0)))
    side = rng.choice([-1.0, 1.0], len(dot))
    sine = rng.uniform(-1.0, 1.0, len(dot))  # density as |cos| about the direction of motion
    front = shift[dot] / np.maximum(length[dot], 1e-12)[:, None]
    across = np.stack([-front[:, 1], front[:, 0]], axis=1)
    normal = (side * np.sqrt(1.0 - sine**2))[:, None] * front + sine[:, None] * across
    radius_px = DOT_RADIUS_PX + 0.7 * rng.standard_normal(len(dot))
    place = before[dot] + rng.random(len(dot))[:, None] * shift[dot] + radius_px[:, None] * normal
    pixel = np.round(place)
    inside = ((pixel >= 0) & (pixel < np.array(FRAME_PX))).all(axis=1)
    x, y = pixel[inside].astype(np.uint16).T.copy()
    return x, y, (side[inside] < 0).astype(np.uint8)


def track_rows(case: TrackerCase, preset: str, slices: int, seed: int = 0) -> Rows:
    """Track the events of a case with a preset, for some slices."""

    def run() -> Rows:
        rng = np.random.default_rng(seed)
        constants = replace(PRESETS[preset], **case.changes)
        return _followed(case.name, preset, constants, DOTS_PX, _played(case, slices, rng))

    return run_case(case.name, run, preset=preset)


def _played(case: TrackerCase, slices: int, rng: np.random.Generator) -> Iterator[tuple[Columns, Floats]]:
    """Yield the events of every slice, and the dots' positions at its end."""
    dots_px = DOTS_PX.copy()
    for k in range(slices):
        target = DOTS_PX + case.shift(k)
        parts = [_moving_rims(dots_px, target, rng)]
        more = case.more(k, rng)
        parts += [more] if more is not None else []
        x, y, p = (np.concatenate(column) for column in zip(*parts, strict=True))
        if case.polarity is not None:
            p = np.full_like(p, case.polarity)
        dots_px = target
        yield (x, y, p), dots_px


def scene_rows(name: str, preset: str, seed: int) -> Rows:
    """Track a simulated slip with a preset; the simulation is cached for the next preset."""

    def run() -> Rows:
        slip = _simulated(name, seed)
        constants = PRESETS[preset].for_dots(slip.dot_radius_px, slip.contrast_over_threshold)
        rows = _followed(f"slip, {name}", preset, constants, slip.dots_px, slip.slices)
        return [{**row, "outcome": f"{row['outcome']}{in_nodes(slip.half_wavelength_nodes)}"} for row in rows]

    return run_case(f"slip, {name}", run, preset=preset)


@dataclass(frozen=True)
class SimulatedSlip:
    """A slip: the dots that the tracker is given, their radius and contrast over threshold, and the slices.

    half_wavelength_nodes: see slip_grid.
    """

    dots_px: Floats
    dot_radius_px: float
    contrast_over_threshold: float
    slices: list[tuple[Columns, Floats]]
    half_wavelength_nodes: float | None


@lru_cache(maxsize=1)
def _simulated(name: str, seed: int) -> SimulatedSlip:
    """Simulate a slip with this extreme part."""
    plan = merge(first_plan("slip", str(OBJECT)), SLIP_SOON, SLIPS[name])
    trial = SimulatedTrial((), Path("slip.recording.h5"), 0, seed, plan)
    devices, slices = play(trial)
    played, nodes = [], []
    try:
        sensor = devices.camera.sensor
        for events, rows in slices:
            played.append(((events.x, events.y, events.p), rows["truth/dot_xy_px"]))
            nodes.append(rows[slip_grid.NODES])
    finally:
        devices.close()
    radius_px, contrast = (float(sensor[f"sensor/{name}"]) for name in ("dot_radius_px", "contrast_over_threshold"))
    dots_px = np.asarray(sensor["sensor/dot_xy_px"].reshape(-1, 2))
    return SimulatedSlip(dots_px, radius_px, contrast, played, slip_grid.fewest_nodes(nodes))


def _followed(
    case: str,
    preset: str,
    constants: TrackerConstants,
    dots_px: Floats,
    slices: Iterable[tuple[Columns, Floats]],
) -> Rows:
    """Measure the tracker's distance from the true dots, over all slices and all dots that it does not flag as lost."""
    state = tracker.start(dots_px, constants)
    reported, events_max, flagged = [], 0, 0
    off_px = np.zeros(len(dots_px))
    for (x, y, p), true_px in slices:
        tracker.step(state, x, y, p)
        off_px = np.linalg.norm(state.dot_xy_px - true_px, axis=1)
        reported.append(off_px[~state.lost])
        flagged += int(state.lost.sum())
        events_max = max(events_max, len(x))
    distances_px = np.concatenate(reported) if any(map(len, reported)) else np.zeros(1)
    silent = int((off_px[~state.lost] > WORST_DOT.most).sum())
    outcome = f"{int(state.lost.sum())} of {len(dots_px)} dots flagged lost, {silent} others off by more than"
    outcome += f" {WORST_DOT.most:g} px at the end; {flagged / max(len(reported), 1):.3g} flagged per slice"
    outcome += f" on average, up to {events_max:,} events per slice"
    measured = [(WORST_DOT, float(distances_px.max())), (P99_DOT, float(np.percentile(distances_px, 99)))]
    return case_rows(case, outcome, measured, preset=preset)


def duplicated_rows(preset: str, slices: int = 50, seed: int = 0) -> Rows:
    """Track the events of slices, each event given twice, in two different orders, for dots that do not move."""
    case = "every event twice"

    def run() -> Rows:
        rng = np.random.default_rng(seed)
        states = [tracker.start(DOTS_PX, PRESETS[preset]) for _ in range(2)]
        for _ in range(slices):
            x, y, p = (np.tile(column, 2) for column in rim_events(rng, 500))
            for state, order in zip(states, (np.arange(len(x)), rng.permutation(len(x))), strict=True):
                tracker.step(state, x[order], y[order], p[order])
        moved = (states[0].dot_xy_px != states[1].dot_xy_px).any(axis=1)
        off_px = np.linalg.norm(states[0].dot_xy_px - DOTS_PX, axis=1)
        measured = [(SAME_DOTS, float(moved.sum())), (WORST_DOT, float(off_px.max()))]
        return case_rows(case, f"{int(states[0].lost.sum())} dots flagged lost", measured, preset=preset)

    return run_case(case, run, preset=preset)


def cases(seed: int, full: bool) -> list[Callable[[], Rows]]:
    """Return all cases with all presets; `full` runs those without a scene five times as long."""
    runs: list[Callable[[], Rows]] = []
    for preset in PRESETS:
        runs += [partial(track_rows, case, preset, SLICES.pick(full), seed) for case in extreme_cases()]
        runs.append(partial(duplicated_rows, preset, seed=seed))
    runs += [partial(scene_rows, name, preset, seed) for name in SLIPS for preset in PRESETS]
    return runs
