"""The simulated camera with extreme or invalid constants and motions.

A slice must contain as many events as its case allows, in order, within the slice and within the frame.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from evetac_cli.evaluate.stability.bounds import EVENTS, FINITE, ORDER, case_rows, run_case
from evetac_cli.events import SLICE_US
from evetac_cli.jobs import Rows
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera

DOTS_PX = np.stack(np.meshgrid(61.0 + 62.3 * np.arange(8), 41.0 + 62.4 * np.arange(7)), axis=-1).reshape(-1, 2)
QUIET = camera.CameraModel(noise_rate_hz=0.0, hot_pixels=0)


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
    return camera.start(model, DOTS_PX, None, (window_px, optics.texture(rng, (256, 256), 4.0, 0.5)), rng)


def wrong_models(value: float) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield calls that create a camera with this value for a constant, by name."""
    for name in ("threshold", "mismatch", "noise_rate_hz", "edge_sigma_px", "log_contrast", "dot_radius_px"):
        yield f"camera, {name} {value:g}", partial(replace, camera.CameraModel(), **{name: value})


def wrong_slices(value: float) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield calls that create a slice in which a position or the contrast is this value, by name."""
    yield f"camera, a dot at {value:g} px", partial(_wrong_slice, dot_px=value)
    yield f"camera, the object at {value:g} px", partial(_wrong_slice, object_px=value)
    yield f"camera, contrast {value:g}", partial(_wrong_slice, contrast=value)


def _wrong_slice(dot_px: float = 0.0, object_px: float = 0.0, contrast: float = 1.0) -> object:
    rng = np.random.default_rng(0)
    state = _camera(camera.CameraModel(frame_px=(64, 48)), (32, 0, 64, 48), rng)
    dots = DOTS_PX.copy()
    dots[5, 1] += dot_px
    return camera.step(state, SliceMotion(DOTS_PX, dots, (0.0, 0.0), (0.0, object_px), contrast), 0, rng)
