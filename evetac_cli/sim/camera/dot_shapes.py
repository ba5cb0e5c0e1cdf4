"""Dots that are not all alike: each with a radius and a contrast of its own, the softness of their rims in common."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera.optics import DotProfile, draw_dots, gel_level, profile_level, profile_position


class DotShapes(NamedTuple):
    """Of each dot the `inner_px`, `outer_px` (dots,) and `level` (dots, entries) of DotProfile.

    `visited_px` (dots, 4) is scratch of the scanning camera. All are empty where dots are alike.
    """

    inner_px: NDArray[np.float64]
    outer_px: NDArray[np.float64]
    level: NDArray[np.float32]
    visited_px: NDArray[np.float64]


def dot_shapes(profile: DotProfile, larger_px: NDArray[np.float64], contrast: NDArray[np.float64]) -> DotShapes:
    """Dots larger than a profile by `larger_px` (dots,), and of `contrast` (dots,) times its levels.

    ValueError unless contrasts are positive.
    """
    if not (np.isfinite(larger_px).all() and (contrast > 0.0).all()):
        raise ValueError("dot_shapes: expected finite sizes and positive contrasts")
    return DotShapes(
        profile.inner_px + larger_px,
        profile.outer_px + larger_px,
        (contrast[:, None] * profile.level).astype(np.float32),
        np.full((len(larger_px), 4), np.nan),
    )


def alike() -> DotShapes:
    """The shapes of dots that are all alike: none of their own."""
    return DotShapes(np.empty(0), np.empty(0), np.empty((0, 1), np.float32), np.empty((0, 4)))


def shaped_level(
    frame_px: tuple[int, int], dot_xy_px: NDArray[np.float64], profile: DotProfile, shapes: DotShapes
) -> NDArray[np.float32]:
    """Log brightness of the frame, shape (height, width), for dots (dots, 2); of dots not alike the darkest counts."""
    if not len(shapes.inner_px):
        return gel_level(frame_px, dot_xy_px, profile)
    picture = np.zeros(frame_px[::-1], np.float32)
    for dot in range(len(dot_xy_px)):
        inner, outer, level = shapes.inner_px[dot], shapes.outer_px[dot], shapes.level[dot]
        draw_dots(picture, dot_xy_px[dot : dot + 1], inner, outer, profile.steps_per_px, level)
    return picture


@njit(cache=True, _nrt=False)
def differing_row(
    dot_xy_px: NDArray[np.float64],
    inner: NDArray[np.float64],
    outer: NDArray[np.float64],
    steps_per_px: float,
    level: NDArray[np.float32],
    y: int,
    first: int,
    end: int,
    line: NDArray[np.float32],
) -> None:
    """As `dot_row`, of dots that each have a shape of their own; the darkest counts."""
    line[: end - first] = 0.0
    for dot in range(len(dot_xy_px)):
        down = y - dot_xy_px[dot, 1]
        if abs(down) > outer[dot]:
            continue
        dot_x = dot_xy_px[dot, 0]
        half = math.sqrt(outer[dot] * outer[dot] - down * down)
        down2 = np.float32(down) * np.float32(down)
        for x in range(max(first, math.ceil(dot_x - half)), min(end, math.floor(dot_x + half) + 1)):
            across = np.float32(x - dot_x)
            position = profile_position(across * across + down2, np.float32(inner[dot]), np.float32(steps_per_px))
            line[x - first] = min(line[x - first], profile_level(position, level[dot]))
