"""The settings of the camera, for LeRobot's command line or Python."""

import math
from dataclasses import dataclass

from lerobot.cameras import CameraConfig

RATE_HZ = 200
EVENT_FRAME_PX = (160, 120)  # width and height of one event frame, unless those of the picture are given


@CameraConfig.register_subclass("evetac")
@dataclass(kw_only=True)
class EvetacCameraConfig(CameraConfig):
    """The camera's settings; ValueError if they contradict each other.

    camera: as for `evetac record --camera`. event_frames: how many of the last event frames a picture shows, a square
    number. fps: event frames per second. width, height: size of the picture in px.
    """

    camera: str = "dvxplorer"
    event_frames: int = 1

    def __post_init__(self) -> None:
        side = math.isqrt(max(self.event_frames, 0))
        if side < 1 or side**2 != self.event_frames:
            raise ValueError(f"event_frames: expected 1, 4, 9, 16, ..., found {self.event_frames}")
        self.fps = RATE_HZ if self.fps is None else self.fps
        self.width = side * EVENT_FRAME_PX[0] if self.width is None else self.width
        self.height = side * EVENT_FRAME_PX[1] if self.height is None else self.height
        if self.width % side or self.height % side:
            found = f"{self.width} x {self.height}"
            raise ValueError(
                f"width, height: expected multiples of {side} for {self.event_frames} frames, found {found}"
            )
