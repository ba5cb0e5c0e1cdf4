"""The part `sim` of `evaluate stability`: the simulated gel, gripper and camera in extreme cases.

The gripper cases are drives without damping or mass, and stiff links; they check that a finger closes properly. Those
of the camera have extreme constants and motions: a slice must contain as many events as its case allows, in order,
within the slice and within the frame.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from evetac_cli.evaluate.common.gel_case import X_RANGE_M, Y_RANGE_M
from evetac_cli.evaluate.common.rows import Extent
from evetac_cli.evaluate.stability.cases import (
    EVENTS,
    FINITE,
    ORDER,
    SURPLUS,
    TURNS,
    case_rows,
    run_case,
)
from evetac_cli.evaluate.stability.gel import AREA_M2, gel_cases, gel_rows, onset_cases, random_case
from evetac_cli.events import SLICE_US
from evetac_cli.jobs import Rows
from evetac_cli.sim import gripper
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.gel.contact import ForceCurve, force_curve, gap_profile, pad_nodes

THETAS = Extent[tuple[float, ...]](quick=(0.51,), full=(0.51, 1.0, 0.5))
GEL_STEPS = Extent(quick=100, full=1000)
CAMERA_SLICES = 10
RANDOM_CASES = Extent(quick=10, full=200)
DOTS_PX = np.stack(np.meshgrid(61.0 + 62.3 * np.arange(8), 41.0 + 62.4 * np.arange(7)), axis=-1).reshape(-1, 2)
QUIET = camera.CameraModel(noise_rate_hz=0.0, hot_pixels=0)


def cases(seed: int, full: bool) -> list[Callable[[], Rows]]:
    """Return every case of gel, gripper and camera; `full` uses every theta, ten times the steps, more random cases."""
    of_gel = [*gel_cases(), *onset_cases(), *(random_case(seed, number) for number in range(RANDOM_CASES.pick(full)))]
    runs: list[Callable[[], Rows]] = []
    for theta in THETAS.pick(full):
        for case in of_gel:
            renamed = replace(case, name=f"{case.name}, theta {theta:g}") if full else case
            runs.append(partial(gel_rows, renamed, GEL_STEPS.pick(full), theta))
    runs += [partial(finger_rows, case) for case in finger_cases()]
    runs += [partial(camera_rows, case, CAMERA_SLICES, seed) for case in camera_cases()]
    return runs


@dataclass(frozen=True)
class FingerCase:
    """A finger that closes on a cylinder with 60 mA, and the stiffness of its links."""

    name: str
    drive: gripper.Drive
    finger_n_m: float = 1.8e3
    dt_s: float = 1e-2


def finger_cases() -> list[FingerCase]:
    """Return the extreme cases."""
    usual = gripper.Drive()
    free = gripper.Drive(damping_n_s_m=0.0, mass_kg=0.0)
    return [
        FingerCase("gripper without damping and mass", free),
        FingerCase("gripper without damping and mass, fingers of 2e8 N/m", free, finger_n_m=2e8),
        FingerCase("gripper with damping of 1e-6 N s/m, fingers of 2e8 N/m", replace(free, damping_n_s_m=1e-6), 2e8),
        FingerCase("gripper of 1e6 kg", gripper.Drive(mass_kg=1e6)),
        FingerCase("gripper, time step 1e-7 s", usual, dt_s=1e-7),
        FingerCase("gripper with 0.7 of its dry friction", replace(usual, friction_n=0.7 * usual.friction_n)),
        FingerCase("gripper with 1.3 of its dry friction", replace(usual, friction_n=1.3 * usual.friction_n)),
    ]


def finger_curve(finger_n_m: float) -> ForceCurve:
    """Return force over the fingers' position on a cylinder of 6 cm, with links of this stiffness."""
    gap = gap_profile(pad_nodes(12, 9, X_RANGE_M, Y_RANGE_M), "cylinder", 0.03)
    return force_curve(gap, 2e6 / 4e-3 * (AREA_M2 / 108), 4e-3, finger_n_m, gripper.metres_per_tick(0.06))


def finger_rows(case: FingerCase, steps: int = 200) -> Rows:
    """Close a finger and measure how often it turns back.

    If it comes to rest, also measure the force beyond its dry friction.
    """
    return run_case(case.name, lambda: _finger_rows(case, steps), part="gripper")


def _finger_rows(case: FingerCase, steps: int) -> Rows:
    drive, current_ma = case.drive, 60.0
    curve = finger_curve(case.finger_n_m)
    state = gripper.start(drive, curve, gripper.ticks_at_gap(0.06))
    wrong, turns, sign = 0, 0, 0.0
    for _ in range(steps):
        gripper.step(state, drive, curve, "current", current_ma, case.dt_s)
        wrong += sum(isinstance(value, float) and not math.isfinite(value) for value in vars(state).values())
        turns += sign * state.speed_m_s < 0
        sign = state.speed_m_s or sign
    rests = state.speed_m_s == 0.0
    outcome = f"rests at {state.force_n:.3g} N" if rests else f"still closing at {state.force_n:.3g} N"
    measured = [(FINITE, float(wrong)), (TURNS, float(turns))]
    if rests:
        pushed_n = abs(drive.force_per_current_n_ma * current_ma - state.force_n)
        band_n = drive.friction_n + drive.friction_share * state.force_n
        measured.append((SURPLUS, max(pushed_n - band_n, 0.0) / band_n))
    return case_rows(case.name, outcome, measured, part="gripper")


@dataclass(frozen=True)
class CameraCase:
    """A camera, and the shifts of dots and object in px from their start at each whole millisecond."""

    name: str
    model: camera.CameraModel
    dots: Callable[[int], tuple[float, float]] = lambda _: (0.0, 0.0)
    object: Callable[[int], tuple[float, float]] = lambda _: (0.0, 0.0)
    window_px: tuple[int, int, int, int] = (540, 0, 640, 480)
    events: tuple[int, int] = (0, 1_000_000)  # allowed number per slice, ends included


def camera_cases() -> list[CameraCase]:
    """Return the extreme cases."""
    usual, most = camera.CameraModel(), 1_000_000
    return [
        CameraCase("camera: nothing moves, no noise", QUIET, events=(0, 0)),
        CameraCase("camera: noise of 1e4 Hz a pixel", replace(QUIET, noise_rate_hz=1e4), events=(most, most)),
        CameraCase(
            "camera: 1e5 hot pixels of 1e4 Hz",
            replace(QUIET, hot_pixels=100_000, hot_rate_hz=(1e4, 1e4)),
            events=(900_000, most),
        ),
        CameraCase(
            "camera: texture over the whole frame at 50 px/ms, threshold 0.01",
            replace(QUIET, threshold=0.01),
            object=lambda k: (0.0, 50.0 * k),
            window_px=(0, 0, 640, 480),
            events=(most, most),
        ),
        CameraCase("camera: all dots jump by 50 px and back", usual, dots=lambda k: (50.0 * (k % 2), 0.0)),
        CameraCase("camera: all dots at 50 px/ms, out of the frame", usual, dots=lambda k: (-50.0 * k, 0.0)),
        CameraCase(
            "camera: dots and object at 1e5 px/ms",
            usual,
            dots=lambda k: (1e5 * (k % 9), 0.0),
            object=lambda k: (0.0, 1e5 * (k % 9)),
        ),
        CameraCase("camera: dots tremble by 1e-9 px", QUIET, dots=lambda k: (1e-9 * (k % 2), 0.0), events=(0, 0)),
        CameraCase("camera: threshold of 100", replace(QUIET, threshold=100.0), dots=lambda k: (3.0 * k, 0.0)),
    ]


def camera_rows(case: CameraCase, slices: int = 10, seed: int = 0) -> Rows:
    """Run a camera for some slices and count surplus or missing events and invalid ones."""
    return run_case(case.name, lambda: _camera_rows(case, slices, np.random.default_rng(seed)), part="camera")


def _camera_rows(case: CameraCase, slices: int, rng: np.random.Generator) -> Rows:
    state = _camera(case.model, case.window_px, rng)
    counts, astray, wrong = [], 0, 0
    for k in range(slices):
        moved, object_px = (np.array([path(k), path(k + 1)]) for path in (case.dots, case.object))
        start, end = DOTS_PX + moved[0], DOTS_PX + moved[1]
        events = camera.step(state, SliceMotion(start, end, object_px[0], object_px[1], 1.0), SLICE_US * k, rng)
        counts.append(len(events.t))
        least, most = case.events
        astray += max(least - counts[-1], counts[-1] - most, 0)
        off_slice = (events.t < SLICE_US * k) | (events.t >= SLICE_US * (k + 1))
        off_frame = (events.x >= case.model.frame_px[0]) | (events.y >= case.model.frame_px[1])
        wrong += int((off_slice | off_frame).sum() + (np.diff(events.t) < 0).sum())
    not_finite = sum(int((~np.isfinite(array)).sum()) for array in (state.reference, state.window_reference))
    outcome = f"{min(counts):,} to {max(counts):,} events per slice"
    outcome += f", {state.dropped:,} dropped beyond the limit of a slice" if state.dropped else ""
    measured = [(FINITE, float(not_finite)), (EVENTS, float(astray)), (ORDER, float(wrong))]
    return case_rows(case.name, outcome, measured, part="camera")


def _camera(
    model: camera.CameraModel, window_px: tuple[int, int, int, int], rng: np.random.Generator
) -> camera.CameraState:
    return camera.start(model, DOTS_PX, (window_px, optics.texture(rng, (256, 256), 4.0, 0.5)), rng)
