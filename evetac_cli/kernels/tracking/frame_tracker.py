"""Dots in frames, followed from each frame to the next by optical flow: the tracker of common RGB sensors.

Pyramidal Lucas-Kanade with the constants of GelSight's own software (gsrobotics, optical_flow_marker_tracking.py), with
which the paper tracks its RGB sensor. A dot that the flow loses stays where it was; so do, as there, the errors of all
steps before: they add up.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

WINDOW_PX = (15, 15)
LEVELS = 2  # of the pyramid, beside the frame itself
STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)


@dataclass
class FrameTracker:
    """The last frame, and where the dots are in it."""

    frame: NDArray[np.uint8]  # (height, width)
    dot_xy_px: NDArray[np.float32]  # (dots, 2)
    lost: NDArray[np.bool_]  # (dots,) not found in this frame


def start(frame: NDArray[np.uint8], dot_xy_px: ArrayLike) -> FrameTracker:
    """Begin with the first frame (height, width) and the places of the dots in it (dots, 2) in px.

    ValueError if the frame is not grey, or the places are none or not finite.
    """
    dots = np.array(dot_xy_px, np.float32)
    if dots.ndim != 2 or dots.shape[1] != 2 or not len(dots) or not np.isfinite(dots).all():
        raise ValueError(f"dot_xy_px: expected finite places (dots, 2), found shape {dots.shape}")
    if frame.ndim != 2 or frame.dtype != np.uint8:
        raise ValueError(f"frame: expected grey values (height, width) uint8, found {frame.dtype} {frame.shape}")
    return FrameTracker(frame, dots, np.zeros(len(dots), bool))


def step(state: FrameTracker, frame: NDArray[np.uint8]) -> None:
    """Follow the dots to the next frame; ValueError if it is of another size."""
    if frame.shape != state.frame.shape or frame.dtype != np.uint8:
        raise ValueError(f"frame: expected uint8 {state.frame.shape}, found {frame.dtype} {frame.shape}")
    places = state.dot_xy_px[:, None]
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        state.frame, frame, places, np.empty_like(places), winSize=WINDOW_PX, maxLevel=LEVELS, criteria=STOP
    )
    state.lost = status[:, 0] == 0
    state.dot_xy_px = np.where(state.lost[:, None], state.dot_xy_px, moved[:, 0])
    state.frame = frame
