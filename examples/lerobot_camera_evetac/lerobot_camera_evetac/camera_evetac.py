"""LeRobot's camera interface for the event frames."""

from typing import Any

import numpy as np
from lerobot.cameras import Camera
from numpy.typing import NDArray

from evetac_cli.devices.cameras import CameraSettings, parse
from evetac_cli.names import Capability

from .configuration_evetac import EvetacCameraConfig
from .event_frames import EventFrames

SEED = 0  # for prepared event words
WARM_UP_S = 5.0
READ_S = 5.0  # how long `read` waits, in s; LeRobot specifies no limit


class EvetacCamera(Camera):
    """A camera whose pictures (height, width, 3) show the last event frames; raises DeviceError and InputError.

    opened: an evetac camera that is already open, used instead of the one named in `config`.
    """

    def __init__(self, config: EvetacCameraConfig, opened: Any = None) -> None:
        super().__init__(config)
        self.config = config
        self._opened = opened
        self._frames: EventFrames | None = None

    def __str__(self) -> str:
        return f"EvetacCamera({self.config.camera})"

    @property
    def is_connected(self) -> bool:
        """Whether the camera is connected."""
        return self._frames is not None

    @property
    def frames_lost(self) -> int:
        """The number of event frames that `read` missed because 10 s of frames were already waiting."""
        return self._of().frames_lost

    @property
    def counted(self) -> dict[str, int]:
        """The events that the event camera itself lost, by kind of loss."""
        return dict(self._of().camera.counted)

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Return the event cameras on USB."""
        from evetac_cli.devices.dvxplorer.camera import find_cameras

        return [{"type": "evetac", "name": "DVXplorer", "id": f"dvxplorer:{one.serial}"} for one in find_cameras()]

    def connect(self, warmup: bool = True) -> None:
        """Open the camera; with `warmup`, wait for its first frame."""
        if self.is_connected:
            raise ConnectionError(f"{self} is already connected")
        named = parse(self.config.camera)
        frame_px = named.frame_px()
        camera = self._opened
        if camera is None:
            if not named.has(Capability.DEVICE):
                raise ValueError(f"camera: expected a real or virtual camera, or a replay, found {self.config.camera}")
            camera = named.open(CameraSettings(), None, np.random.SeedSequence(SEED)).camera
        side = round(self.config.event_frames**0.5)
        size_px = (self.config.width or 0) // side, (self.config.height or 0) // side
        self._frames = EventFrames(camera, frame_px, size_px, float(self.config.fps or 0), self.config.event_frames)
        if warmup:
            self._frames.newest(WARM_UP_S)

    def read(self) -> NDArray[Any]:
        """Return the next event frame, each exactly once; with several frames in a picture, one up to the newest."""
        frames = self._of()
        return _coloured(frames.next(READ_S).grey if self.config.event_frames == 1 else frames.newest(READ_S))

    def async_read(self, timeout_ms: float = 200) -> NDArray[Any]:
        """Return a picture up to the newest event frame; wait for a frame not yet returned, or raise TimeoutError."""
        return _coloured(self._of().newest(1e-3 * timeout_ms))

    def read_latest(self, max_age_ms: int = 500) -> NDArray[Any]:
        """Return a picture up to the newest event frame at once; TimeoutError if the frame is older than max_age_ms."""
        picture, age_s = self._of().latest()
        if 1e3 * age_s > max_age_ms:
            raise TimeoutError(
                f"{self}: the newest event frame is {1e3 * age_s:.0f} ms old, expected at most {max_age_ms} ms"
            )
        return _coloured(picture)

    def disconnect(self) -> None:
        """Close the camera."""
        frames, self._frames = self._of(), None
        frames.close()

    def _of(self) -> EventFrames:
        if self._frames is None:
            raise ConnectionError(f"{self} is not connected")
        return self._frames


def _coloured(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.repeat(grey[:, :, None], 3, axis=2)
