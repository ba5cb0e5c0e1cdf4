"""An RGB sensor for comparison with the event camera: frames of the same gel at 25 Hz, and its own dot tracker.

The RGB sensor of the paper is a GelSight Mini (paper, "Dot-based Shear Force Reconstruction"). Frames show dark dots on
bright gel, with blur and noise. They have half the event camera's resolution in each direction, 320 x 240, the size on
which that sensor's software works. They are grey, because its tracker first converts them to grey. Each frame is taken
at one instant: a longer exposure would smear moving dots. The frame size and the camera's noise are estimates.

Dots are followed from frame to frame by optical flow, pyramidal Lucas-Kanade with the constants of GelSight's software
(gsrobotics, optical_flow_marker_tracking.py). A dot that the flow loses stays where it was. As in that software, the
errors of all steps add up.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

WINDOW_PX = (15, 15)  # window of the optical flow
LEVELS = 2  # levels of the pyramid, in addition to the frame itself
MOST_ROUNDS, CLOSE_ENOUGH_PX = 10, 0.03  # limits of the search for a dot: iterations, step size


@dataclass(frozen=True)
class RgbCamera:
    """A frame camera that views the gel; lengths in px of its own frames, brightness in grey values of 255."""

    frame_px: tuple[int, int] = (320, 240)
    frame_ms: int = 40
    blur_px: float = 1.0  # standard deviation of the blur of a dot's rim
    log_contrast: float = 1.61  # contrast between gel and dot, log units
    gel_grey: float = 180.0
    noise_grey: float = 2.0  # standard deviation of every pixel in every frame


def frame(camera: RgbCamera, dot_xy_px: ArrayLike, radius_px: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a frame (height, width) of dots (dots, 2) of the same radius, both in px of this camera's frames.

    ValueError if the radius is not positive.
    """
    from evetac_cli.sim.camera.optics import dot_profile, gel_level  # here, because a recipe needs only the camera

    dots = np.ascontiguousarray(dot_xy_px, np.float64)
    assert dots.ndim == 2 and dots.shape[1] == 2 and np.isfinite(dots).all()
    profile = dot_profile(radius_px, camera.blur_px, camera.log_contrast)
    bright = np.exp(gel_level(camera.frame_px, dots, profile))
    noise = rng.standard_normal(bright.shape, np.float32) * np.float32(camera.noise_grey)
    grey: NDArray[np.uint8] = np.clip(np.rint(bright * np.float32(camera.gel_grey) + noise), 0, 255).astype(np.uint8)
    return grey


@dataclass
class FrameTracker:
    """The last frame, and the positions of the dots in it."""

    frame: NDArray[np.uint8]  # (height, width)
    dot_xy_px: NDArray[np.float32]  # (dots, 2)
    lost: NDArray[np.bool_]  # (dots,) not found in this frame


def start_tracker(frame: NDArray[np.uint8], dot_xy_px: ArrayLike) -> FrameTracker:
    """Start with the first frame (height, width) and the positions of the dots in it (dots, 2) in px."""
    dots = np.array(dot_xy_px, np.float32)
    assert dots.ndim == 2 and dots.shape[1] == 2 and len(dots) and np.isfinite(dots).all()
    assert frame.ndim == 2 and frame.dtype == np.uint8
    return FrameTracker(frame, dots, np.zeros(len(dots), bool))


def track(state: FrameTracker, frame: NDArray[np.uint8]) -> None:
    """Follow the dots to the next frame, which has the same size."""
    import cv2

    assert frame.shape == state.frame.shape and frame.dtype == np.uint8
    places = state.dot_xy_px[:, None]
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, MOST_ROUNDS, CLOSE_ENOUGH_PX)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        state.frame, frame, places, np.empty_like(places), winSize=WINDOW_PX, maxLevel=LEVELS, criteria=stop
    )
    state.lost = status[:, 0] == 0
    state.dot_xy_px = np.where(state.lost[:, None], state.dot_xy_px, moved[:, 0])
    state.frame = frame
