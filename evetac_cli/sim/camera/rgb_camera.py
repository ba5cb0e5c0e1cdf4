"""The same gel as an RGB sensor sees it: frames at 25 Hz, dark dots on bright gel, with blur and noise.

For comparison with the event camera (paper, "Dot-based Shear Force Reconstruction", whose RGB sensor is a GelSight
Mini). Frames have half the event camera's resolution in each direction, 320 x 240, the size on which the software of
that sensor works. They are grey, as its tracker of dots turns them grey first. Each is taken in an instant: a longer
exposure would smear moving dots. The frame's sizes and the camera's noise are estimates.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.sim.camera.optics import dot_profile, gel_level


@dataclass(frozen=True)
class RgbCamera:
    """A camera of frames that looks at the gel; lengths in px of its own frames, brightness in grey values of 255."""

    frame_px: tuple[int, int] = (320, 240)
    frame_ms: int = 40
    blur_px: float = 1.0  # sigma of a dot's rim
    log_contrast: float = 1.61  # gel against dot
    gel_grey: float = 180.0
    noise_grey: float = 2.0  # sd, of every pixel in every frame

    def __post_init__(self) -> None:
        if not 0.0 <= self.noise_grey < np.inf or not 0.0 < self.gel_grey <= 255.0 or self.frame_ms < 1:
            raise ValueError(f"expected noise >= 0, 0 < gel_grey <= 255 and frame_ms >= 1, found {self}")


def frame(camera: RgbCamera, dot_xy_px: ArrayLike, radius_px: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A frame (height, width) of dots (dots, 2) of one radius, both in px of this camera's frames.

    ValueError on a radius that is not positive or dots that are nowhere.
    """
    dots = np.ascontiguousarray(dot_xy_px, np.float64)
    if dots.ndim != 2 or dots.shape[1] != 2 or not np.isfinite(dots).all():
        raise ValueError(f"dot_xy_px: expected finite places (dots, 2), found shape {dots.shape}")
    profile = dot_profile(radius_px, camera.blur_px, camera.log_contrast)
    bright = np.exp(gel_level(camera.frame_px, dots, profile))
    noise = rng.standard_normal(bright.shape, np.float32) * np.float32(camera.noise_grey)
    grey: NDArray[np.uint8] = np.clip(np.rint(bright * np.float32(camera.gel_grey) + noise), 0, 255).astype(np.uint8)
    return grey
