"""LeRobot's interface of a camera, in front of the event frames."""

from typing import Any

import numpy as np
from lerobot.cameras import Camera
from numpy.typing import NDArray

from evetac_cli.devices.cameras import CameraSettings, parse
from evetac_cli.names import Capability

from .configuration_evetac import EvetacCameraConfig
from .event_frames import EventFrames

SEED = 0  # of prepared words
WARM_UP_S = 5.0
READ_S = 5.0  # how long `read` waits; LeRobot says nothing of it


class EvetacCamera(Camera):
    """Pictures (height, width, 3) of the last event frames; evetac's DeviceError and InputError say what is wrong.

    opened: a camera of evetac that is open already, which is taken in place of the one that is named.
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
        """Whether its frames come."""
        return self._frames is not None

    @property
    def frames_lost(self) -> int:
        """Event frames that `read` can give no more, because 10 s of them waited."""
        return self._of().frames_lost

    @property
    def counted(self) -> dict[str, int]:
        """What the event camera lost itself, by plain name."""
        return dict(self._of().camera.counted)

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The event cameras on USB."""
        from evetac_cli.devices.dvxplorer.camera import find_cameras

        return [{"type": "evetac", "name": "DVXplorer", "id": f"dvxplorer:{one.serial}"} for one in find_cameras()]

    def connect(self, warmup: bool = True) -> None:
        """Open the camera; with `warmup`, wait for its first frame."""
        if self.is_connected:
            raise ConnectionError(f"{self} is connected already")
        named = parse(self.config.camera)
        frame_px = named.frame_px()
        camera = self._opened
        if camera is None:
            if not named.has(Capability.DEVICE):
                raise ValueError(f"camera: expected a camera that runs by itself, found {self.config.camera}")
            camera = named.open(CameraSettings(), None, np.random.SeedSequence(SEED)).camera
        side = round(self.config.event_frames**0.5)
        size_px = (self.config.width or 0) // side, (self.config.height or 0) // side
        self._frames = EventFrames(camera, frame_px, size_px, float(self.config.fps or 0), self.config.event_frames)
        if warmup:
            self._frames.newest(WARM_UP_S)

    def read(self) -> NDArray[Any]:
        """The next event frame, each once and none left out; where a picture shows several, those up to the newest."""
        frames = self._of()
        return _coloured(frames.next(READ_S).grey if self.config.event_frames == 1 else frames.newest(READ_S))

    def async_read(self, timeout_ms: float = 200) -> NDArray[Any]:
        """A picture up to the newest event frame, once there is one that was not given yet; TimeoutError."""
        return _coloured(self._of().newest(1e-3 * timeout_ms))

    def read_latest(self, max_age_ms: int = 500) -> NDArray[Any]:
        """A picture up to the newest event frame at once; TimeoutError if that is older than max_age_ms."""
        picture, age_s = self._of().latest()
        if 1e3 * age_s > max_age_ms:
            raise TimeoutError(
                f"{self}: the newest event frame is {1e3 * age_s:.0f} ms old, of {max_age_ms} ms at most"
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
