"""Small pictures before a camera: dots on paths, and a texture in a window."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import Events
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState

Path = Callable[[float], NDArray[np.float64]]  # places of dots over time in ms

FRAME = (100, 80)
QUIET = CameraModel(frame_px=FRAME, noise_rate_hz=0.0, hot_pixels=0)
STILL = (0.0, 0.0)
STRIP = (70, 10, 100, 60)
TEXTURE = optics.texture(np.random.default_rng(3), (128, 128), 10.0, 0.3)


def start(
    dots: Any, model: CameraModel = QUIET, *, window: Any = None, texture: Any = None, seed: int = 0
) -> CameraState:
    """The state of a camera that is switched on before dots."""
    return camera.start(model, dots, None if window is None else (window, texture), np.random.default_rng(seed))


def play(state: CameraState, path: Path, slices: int, *, pieces: int = 1, seed: int = 1) -> list[Events]:
    """Slices of dots that follow a path, which is cut into so many straight pieces a slice."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(slices):
        cut = np.array([path(k + piece / pieces) for piece in range(pieces + 1)])
        parts.append(
            camera.step(
                state, SliceMotion(cut[0], cut[-1], STILL, STILL, 0.0, cut if pieces > 1 else None), 1000 * k, rng
            )
        )
    return parts


def slide(state: CameraState, velocity: Any, slices: int, contrast: float = 1.0) -> list[Events]:
    """Slices of an object that slides under still dots, velocity in px/ms."""
    xy = state.seen_dot_xy_px.copy()
    rng, v = np.random.default_rng(1), np.asarray(velocity)
    return [camera.step(state, SliceMotion(xy, xy, k * v, (k + 1) * v, contrast), 1000 * k, rng) for k in range(slices)]


def before_window(model: CameraModel = QUIET) -> CameraState:
    """The state of a camera before a dot and a textured window."""
    return start([[30.0, 30.0]], model, window=STRIP, texture=TEXTURE)


def line(xy: Any, velocity: Any) -> Path:
    """Dots on straight lines, velocity in px/ms."""
    return lambda t_ms: np.atleast_2d(xy) + np.asarray(velocity) * t_ms


def crowd(t_ms: float) -> NDArray[np.float64]:
    """Three dots that overlap: one shakes, one circles through it, one rests in the way."""
    turn = 2 * math.pi * t_ms / 12
    return np.array(
        [
            [40 + 4 * math.sin(2 * math.pi * t_ms / 7.3), 40.0 + 0.4 * t_ms],
            [50 + 9 * math.cos(turn), 40 + 9 * math.sin(turn)],
            [62.2, 47.7],
        ]
    )


def texture_level(
    texture: NDArray[np.float32], shape: tuple[int, int], first: tuple[int, int], at: Any, contrast: float = 1.0
) -> NDArray[np.float32]:
    """The texture of an object moved to `at`, in so many rows and columns of pixels from pixel (x, y) on."""
    level = np.empty(shape, np.float32)
    _sample(texture, *first, *at, contrast, level)
    return level


@njit
def _sample(texture: Any, first_x: int, first_y: int, x_px: float, y_px: float, contrast: float, level: Any) -> None:
    """Compiled as one function, as in the camera, so that both round alike."""
    place = optics.texture_place(texture, first_x, first_y, x_px, y_px, contrast)
    for row in range(level.shape[0]):
        optics.sample_texture_run(texture, place, row, 0, level.shape[1], level[row])


def total(slices: list[Events]) -> int:
    return sum(events.size for events in slices)


def as_set(slices: list[Events]) -> set[tuple[int, int, int, int]]:
    """All events, of which no two are the same."""
    result = [event for part in slices for event in zip(*(column.tolist() for column in part), strict=True)]
    assert len(result) == len(set(result))
    return set(result)


def waits_us(events: Events) -> NDArray[np.int64]:
    """Times between events of the same pixel."""
    t, x, y = (events[axis].astype(np.int64) for axis in range(3))
    order = np.lexsort((t, x, y))
    waits: NDArray[np.int64] = np.diff(t[order])[np.diff(y[order] * 1000 + x[order]) == 0]
    return waits
