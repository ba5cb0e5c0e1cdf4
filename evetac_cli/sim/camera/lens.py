"""Lens distortion, radial about the middle of the frame: straight lines appear curved.

A point at distance r from the middle is seen at r (1 + k1 r^2 + k2 r^4); the frame's corners are at r = 1. Negative
coefficients give barrel distortion, positive ones pincushion distortion. Dots, the cut edge and the middle of an
outline are moved to their distorted positions. Not simulated: dots and outlines keep their shape, and a texture moves
like the middle of its window.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.setup.sensor import Sensor

FARTHEST = 1.1  # distances must grow up to here, as a multiple of a corner's distance


@dataclass(frozen=True)
class Lens:
    """A lens in front of a frame of (width, height); ValueError if it would show a point twice."""

    frame_px: tuple[int, int]
    k1: float
    k2: float

    def __post_init__(self) -> None:
        r2 = np.linspace(0.0, FARTHEST, 200) ** 2
        if not (1.0 + 3.0 * self.k1 * r2 + 5.0 * self.k2 * r2**2 > 0.0).all():
            raise ValueError(f"distortion: expected seen distances that grow with distance, found {self.k1}, {self.k2}")

    @classmethod
    def of_sensor(cls, sensor: Sensor) -> "Lens | None":
        """Return the lens of a sensor; None without distortion."""
        k1, k2 = sensor.distortion
        return cls(sensor.frame_px, k1, k2) if k1 or k2 else None

    def seen(self, xy_px: ArrayLike) -> Floats:
        """Return the positions at which points (..., 2) are seen."""
        points = np.ascontiguousarray(xy_px, np.float64)
        width, height = self.frame_px
        seen: Floats = _seen(points.reshape(-1, 2), 0.5 * width, 0.5 * height, self.k1, self.k2)
        return seen.reshape(points.shape)

    def seen_line(self, x_px: Floats) -> Floats:
        """Return the positions (height,) in every row at which a line at x_px (height,) is seen."""
        height = len(x_px)
        beyond = height // 4
        rows = np.arange(-beyond, height + beyond, dtype=np.float64)
        points = self.seen(np.stack([np.pad(x_px, beyond, mode="edge"), rows], axis=1))
        return np.interp(np.arange(height, dtype=np.float64), points[:, 1], points[:, 0])


@njit(cache=True)
def _seen(xy_px: Floats, middle_x: float, middle_y: float, k1: float, k2: float) -> Floats:
    seen = np.empty_like(xy_px)
    corner2 = middle_x * middle_x + middle_y * middle_y
    for point in range(len(xy_px)):
        across = xy_px[point, 0] - middle_x
        down = xy_px[point, 1] - middle_y
        r2 = min((across * across + down * down) / corner2, FARTHEST * FARTHEST)
        factor = 1.0 + r2 * (k1 + r2 * k2)
        seen[point, 0] = middle_x + across * factor
        seen[point, 1] = middle_y + down * factor
    return seen
