"""Dots that differ: each has its own radius and contrast; the softness of their rims is the same."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera.optics import DotProfile, draw_dots, gel_level, profile_level, profile_position


class DotShapes(NamedTuple):
    """For each dot, the `inner_px`, `outer_px` (dots,) and `level` (dots, entries) of DotProfile.

    `visited_px` (dots, 4) is scratch of the scanning camera. All are empty if dots are alike.
    """

    inner_px: NDArray[np.float64]
    outer_px: NDArray[np.float64]
    level: NDArray[np.float32]
    visited_px: NDArray[np.float64]


def dot_shapes(profile: DotProfile, larger_px: NDArray[np.float64], contrast: NDArray[np.float64]) -> DotShapes:
    """Return dots that are larger than a profile by `larger_px` (dots,), with `contrast` (dots,) times its levels."""
    assert np.isfinite(larger_px).all() and (contrast > 0.0).all()
    return DotShapes(
        profile.inner_px + larger_px,
        profile.outer_px + larger_px,
        (contrast[:, None] * profile.level).astype(np.float32),
        np.full((len(larger_px), 4), np.nan),
    )


def alike() -> DotShapes:
    """Return the shapes for dots that are all alike: empty arrays."""
    return DotShapes(np.empty(0), np.empty(0), np.empty((0, 1), np.float32), np.empty((0, 4)))


def shaped_level(
    frame_px: tuple[int, int], dot_xy_px: NDArray[np.float64], profile: DotProfile, shapes: DotShapes
) -> NDArray[np.float32]:
    """Return the log brightness of the frame, (height, width), for dots (dots, 2); of differing dots the darkest."""
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
    """Fill a line like `dot_row`, for dots that each have their own shape; the darkest counts."""
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
