"""The part `sim`: error against run time of the simulated gel and camera.

A cylinder of 100 g is held slightly tilted and off its centre of mass, and let go in two ways. `fast`: the weight drops
on at once and bounces; the grip falls from 2 to 0.2 N within 0.2 s. `slow`: the weight is handed over within 80 ms,
then the grip falls by 2 N/s, the slip scene's rate near onset. Each is run with constant friction and, as friction
falls with speed in every slip and lift scene, at two corners of the scenes' ranges. The memory length is the same
everywhere, so errors are due to the numerics, not to the friction law.

Lines: a fixed time step, a tolerance at which steps are halved, the node pitch. Steps and tolerances are compared with
a reference of much smaller steps on the same nodes; node pitches with a much finer grid at the same steps. So the
errors of one choice do not hide those of the other. Columns, over the trials:

- error_ms_gross_slip: onset of gross slip, half a pixel slid (sim.scenes.true_slip), interpolated between slices; root
  mean square.
- error_um_before: position of the object, sampled every ms up to the onset, root mean square.
- error_um_after: distance between the objects AFTER_MS after the onset, median: the effect of an error in time.
- time_us_*: run time per simulated ms as thread time, so that other programs do not count, averaged within a trial
  because few slices have shorter steps; over the trials.

The rows of the camera are those of camera.py.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.common.gel_case import X_RANGE_M, Y_RANGE_M, GelCase, solved_slices, under_cylinder
from evetac_cli.evaluate.common.rows import Extent, SolverSetting, collect, line, run_times
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.cost import camera as camera_cost
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.sim.gel import gel
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.scenes.true_slip import SLIP_PX
from evetac_cli.sim.setup.scene import Solver

AFTER_MS = 8
SLOW_S, HANG_S = 0.36, 0.08  # of the slow unloading: its duration, and that of handing over the weight
STATIC = 0.8

TRIALS = Extent(quick=3, full=8)
REFERENCE_STEP_MS = Extent(quick=0.02, full=0.01)
REFERENCE_PITCH_MM = Extent(quick=0.5, full=0.4)
STEPS_MS = Extent[tuple[float, ...]](quick=(1.0, 0.5, 0.25, 0.1), full=(1.0, 0.5, 0.25, 0.2, 0.1, 0.05))
TOLERANCES_UM = Extent[tuple[float, ...]](quick=(1.0, 0.2, 0.05), full=(5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02))
PITCHES_MM = Extent[tuple[float, ...]](quick=(1.67, 1.25, 0.833), full=(2.5, 1.67, 1.25, 1.0, 0.833, 0.625))
THETAS = Extent[tuple[float, ...]](quick=(), full=(1.0, 0.75, 0.5))
PITCH_STEP_MS = 0.25  # in the runs that compare node pitches
# Errors in the plot, for the rows that have them.
ERRORS = (
    "error_ms_gross_slip",
    "error_um_before",
    "error_um_after",
    "error_us_median",
    "error_us_p95",
    "error_share_count",
)


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return rows of the gel's mechanics and of the camera."""
    loads = camera_cost.workloads()
    rows = chain(mechanics_rows(params.seed, params.full, params.trials), camera_cost.camera_rows(params.seed, loads))
    of_mechanics = len(unloadings()) * len(frictions()) * len(choices(params.full))
    return collect(rows, of_mechanics + sum(len(load.settings) for load in loads), progress)


def falling(first_n: float, last_n: float, seconds: float, begin_s: float = 0.0) -> Callable[[float], float]:
    """Return a normal force over time that falls evenly from first_n at begin_s to last_n after so many seconds."""
    return lambda time_s: first_n + (last_n - first_n) * min(max((time_s - begin_s) / (seconds - begin_s), 0.0), 1.0)


def draw_trial(seed: int) -> GelCase:
    """Return the trial of a seed, which decides the tilt of the fingers and the distance from the object's centre."""
    rng = np.random.default_rng(seed)
    tilt_rad = rng.choice([-1, 1]) * rng.uniform(0.005, 0.015)
    centre_m = (rng.uniform(-2e-3, 2e-3), rng.choice([-1, 1]) * rng.uniform(1e-3, 2e-3))
    shares, seconds = under_cylinder(float(tilt_rad)), 0.2
    load = falling(2.0, 0.2, seconds)
    return GelCase(centre_m=(float(centre_m[0]), float(centre_m[1])), load=load, shares=shares, seconds=seconds)


class Slide(NamedTuple):
    """A solved trial, sampled after every ms.

    pose: (samples, 3). slid_px: (samples,), sliding of the object in gross slip. slice_us: (samples,), run time.
    """

    pose: Floats
    slid_px: Floats
    slice_us: Floats


def onset_ms(slid_px: Floats) -> float:
    """Return the time at which an object has slid by half a pixel, between samples of every ms; NaN if it never has."""
    beyond = np.flatnonzero(slid_px > SLIP_PX)
    if not len(beyond):
        return math.nan
    first = int(beyond[0])
    before_px = slid_px[first - 1] if first else 0.0
    return float(first + (SLIP_PX - before_px) / (slid_px[first] - before_px))


def unloadings() -> dict[str, Callable[[GelCase], GelCase]]:
    """Return the two ways to unload a trial, by name."""

    def slow(trial: GelCase) -> GelCase:
        def handed_over(time_s: float) -> tuple[float, float, float]:
            return (min(time_s / HANG_S, 1.0) * trial.mass_kg * GRAVITY_M_S2, 0.0, 0.0)

        return replace(trial, load=falling(1.1, 0.58, SLOW_S, begin_s=0.1), force=handed_over, seconds=SLOW_S)

    return {"fast": lambda trial: trial, "slow": slow}


def frictions() -> dict[str, gel.Friction]:
    """Return constant friction, and two corners of the scenes' ranges: kinetic over static, Stribeck speed."""

    def falling(share: float, speed_mm_s: float) -> gel.Friction:
        return gel.Friction(STATIC, share * STATIC, 1e-3 * speed_mm_s)

    return {
        "constant friction": gel.Friction(STATIC, STATIC),
        "friction falls to 0.8 at 10 mm/s": falling(0.8, 10.0),
        "friction falls to 0.75 at 5 mm/s": falling(0.75, 5.0),
    }


def solve(trial: GelCase, solver: Solver) -> Slide:
    """Solve a trial from start to end, on the nodes of the solver."""
    columns, rows = solver.nodes((X_RANGE_M[1] - X_RANGE_M[0], Y_RANGE_M[1] - Y_RANGE_M[0]))
    solved = solved_slices(replace(trial, columns=columns, rows=rows), solver)
    samples = [(state.pose.copy(), slip.slid_px, took_us) for state, slip, took_us in solved]
    return Slide(*(np.array(column) for column in zip(*samples, strict=True)))


def choices(full: bool) -> list[SolverSetting]:
    """Return the settings to compare."""
    return [
        *line("fixed step", "step_ms", STEPS_MS.pick(full), "ms"),
        *line("tolerance", "tolerance_um", TOLERANCES_UM.pick(full), "um"),
        *line("theta", "theta", THETAS.pick(full)),
        *line("node pitch", "node_pitch_mm", PITCHES_MM.pick(full), "mm", step_ms=PITCH_STEP_MS),
    ]


def mechanics_rows(seed: int, full: bool, trials: int | None = None) -> Iterator[Row]:
    """Yield the rows of every way of unloading and friction."""
    random_trials = [draw_trial(seed + number) for number in range(trials or TRIALS.pick(full))]
    solve(replace(random_trials[0], seconds=0.01), Solver())  # compiles
    for unloading, unload in unloadings().items():
        for law, friction in frictions().items():
            part = f"mechanics, {unloading} unloading, {law}"
            cases = [replace(unload(trial), friction=friction) for trial in random_trials]
            yield from _part_rows(part, cases, full)


def _part_rows(part: str, cases: Sequence[GelCase], full: bool) -> Iterator[Row]:
    """Yield the rows of one panel: trials of one unloading and friction."""
    finest = Solver(step_ms=REFERENCE_STEP_MS.pick(full), theta=0.51, residual=1e-8)
    in_time = [solve(trial, finest) for trial in cases]
    finer_grid = Solver(step_ms=PITCH_STEP_MS, node_pitch_mm=REFERENCE_PITCH_MM.pick(full))
    in_space = [solve(trial, finer_grid) for trial in cases]
    for setting in choices(full):
        options: dict[str, Any] = dict(setting.solver)
        solved = [solve(trial, Solver(**options)) for trial in cases]
        yield _row(part, setting, solved, in_space if "node_pitch_mm" in options else in_time)


def _row(part: str, setting: SolverSetting, solved: Sequence[Slide], references: Sequence[Slide]) -> Row:
    """Return the row of a setting over all trials of a panel."""
    errors = [_errors(one, reference) for one, reference in zip(solved, references, strict=True)]
    onset, before, after = (np.array(column) for column in zip(*errors, strict=True))
    return {
        "part": part,
        "setting": setting.name,
        "flags": setting.flags,
        "trials": len(solved),
        "error_ms_gross_slip": _rms(onset),
        "error_um_before": _rms(before),
        "error_um_after": float(np.median(after[np.isfinite(after)])) if np.isfinite(after).any() else None,
        **run_times(np.array([one.slice_us.mean() for one in solved])),
    }


def _errors(one: Slide, reference: Slide) -> tuple[float, float, float]:
    """Return the error of the onset in ms, and those of the object before and after it in um."""
    true_ms = onset_ms(reference.slid_px)
    stop = len(reference.pose) if math.isnan(true_ms) else max(int(true_ms), 1)
    apart = ((one.pose - reference.pose)[:, :2] ** 2).sum(axis=-1)
    later = stop + AFTER_MS
    after = 1e6 * math.sqrt(apart[later]) if later < len(apart) else math.nan
    return onset_ms(one.slid_px) - true_ms, 1e6 * math.sqrt(apart[:stop].mean()), after


def _rms(values: Floats) -> float | None:
    """Return the root mean square of finite values; None if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt((finite**2).mean())) if len(finite) else None
