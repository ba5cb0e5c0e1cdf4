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
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.common.rows import Extent, SolverSetting, collect, line, run_times
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.cost import camera as camera_cost
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.gel.contact import gap_profile, pad_nodes, pressure
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.scenes.true_slip import SLIP_PX, GroundTruthSlip
from evetac_cli.sim.setup.scene import Solver

PAD_M = (20e-3, 15e-3)
MM_PER_PX = 0.0329
AFTER_MS = 8
SLICE_S = 1e-3
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


def summary(rows: Rows) -> Row:
    """Return the number of rows."""
    return {"rows": len(rows)}


@dataclass(frozen=True)
class GelTrial:
    """A simulated trial: grid, material, object, contact, and a grip that falls evenly from `first_n` to `last_n`.

    The grip begins to fall at `begin_s`; the weight is handed over evenly until `hang_s`, or hangs from the start.
    """

    columns: int = 24
    rows: int = 18
    material: gel.GelMaterial = gel.GelMaterial()
    friction: gel.Friction = gel.Friction(0.8, 0.8)
    mass_kg: float = 0.1
    inertia_kg_m2: float = 4e-5
    centre_m: tuple[float, float] = (0.0, 0.0)
    radius_m: float = 0.06
    tilt_rad: float = 0.0
    indentation_m: float = 0.4e-3
    first_n: float = 2.0
    last_n: float = 0.2
    seconds: float = 0.2
    begin_s: float = 0.0
    hang_s: float = 0.0

    def start(self) -> gel.GelState:
        """Return the state of the pad and the object, at rest."""
        x, y = PAD_M
        nodes = pad_nodes(self.columns, self.rows, (-x / 2, x / 2), (-y / 2, y / 2))
        return gel.start(nodes, self.material, self.mass_kg, self.inertia_kg_m2, body_xy_m=self.centre_m)

    def shares(self, state: gel.GelState) -> Floats:
        """Return the share of the grip on each node, (rows, columns), with sum 1."""
        gap = gap_profile(state.node_xy_m, "cylinder", self.radius_m, self.tilt_rad)
        return np.asarray(pressure(self.indentation_m, gap, 1.0))

    def grip_n(self, time_s: float) -> float:
        """Return the normal force on one pad, in N, at a time in s."""
        fallen = (time_s - self.begin_s) / (self.seconds - self.begin_s)
        return self.first_n + (self.last_n - self.first_n) * min(max(fallen, 0.0), 1.0)

    def weight_n(self, time_s: float) -> tuple[float, float, float]:
        """Return the force and moment of gravity, along x through the centre of mass, as far as it is handed over."""
        share = min(time_s / self.hang_s, 1.0) if self.hang_s else 1.0
        return (share * self.mass_kg * GRAVITY_M_S2, 0.0, 0.0)


def draw_trial(seed: int) -> GelTrial:
    """Return the trial of a seed, which decides the tilt of the fingers and the distance from the object's centre."""
    rng = np.random.default_rng(seed)
    tilt_rad = rng.choice([-1, 1]) * rng.uniform(0.005, 0.015)
    centre_m = (rng.uniform(-2e-3, 2e-3), rng.choice([-1, 1]) * rng.uniform(1e-3, 2e-3))
    return GelTrial(tilt_rad=float(tilt_rad), centre_m=(float(centre_m[0]), float(centre_m[1])))


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


def unloadings() -> dict[str, Callable[[GelTrial], GelTrial]]:
    """Return the two ways to unload a trial, by name."""
    slow: dict[str, Any] = {"first_n": 1.1, "last_n": 0.58, "seconds": 0.36, "begin_s": 0.1, "hang_s": 0.08}
    return {"fast": lambda trial: trial, "slow": lambda trial: replace(trial, **slow)}


def frictions() -> dict[str, gel.Friction]:
    """Return constant friction, and two corners of the scenes' ranges: kinetic over static, Stribeck speed."""

    def falling(share: float, speed_mm_s: float) -> gel.Friction:
        return gel.Friction(STATIC, share * STATIC, 1e-3 * speed_mm_s)

    return {
        "constant friction": gel.Friction(STATIC, STATIC),
        "friction falls to 0.8 at 10 mm/s": falling(0.8, 10.0),
        "friction falls to 0.75 at 5 mm/s": falling(0.75, 5.0),
    }


def grid(trial: GelTrial, solver: Solver) -> GelTrial:
    """Return the trial on the nodes of a solver."""
    columns, rows = solver.nodes(PAD_M)
    return replace(trial, columns=columns, rows=rows)


def solve(trial: GelTrial, solver: Solver) -> Slide:
    """Solve a trial from start to end, on the nodes of the solver."""
    trial = grid(trial, solver)
    state, stepper = trial.start(), Stepper(solver, SLICE_S)
    shares = trial.shares(state)
    slip = GroundTruthSlip(state, MM_PER_PX, None)
    samples: list[tuple[Floats, float, float]] = []
    for slice_ in range(round(trial.seconds / SLICE_S)):
        ends_n = (trial.grip_n(slice_ * SLICE_S), trial.grip_n((slice_ + 1) * SLICE_S))
        weight_n = trial.weight_n((slice_ + 0.5) * SLICE_S)
        started = time.thread_time()
        stepper.advance(state, shares, ends_n, weight_n, trial.friction)
        took_us = (time.thread_time() - started) * 1e6
        slip.follow(state, shares, ends_n[1])
        samples.append((state.pose.copy(), slip.slid_px, took_us))
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


def _part_rows(part: str, cases: Sequence[GelTrial], full: bool) -> Iterator[Row]:
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
