"""A camera that stays open between the recordings of a series: each recording gets its own slices and its own clock.

Reason: opening a camera takes a second or more, and a robot that starts a recording waits for it. Between recordings
the camera's slices are read and discarded, so the next recording begins with the present slice and not with old ones.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from evetac_cli.devices import EventCamera
from evetac_cli.devices.cameras import CameraSettings, NamedCamera, OpenedCamera
from evetac_cli.devices.plugin_devices import open_camera
from evetac_cli.errors import DeviceError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.names import Capability
from evetac_cli.realtime.shared_time import TimeSource


class CameraPart:
    """The slices of a camera from a given one onward, as a separate camera whose time begins there."""

    def __init__(self, camera: EventCamera, first: int) -> None:
        """first: number of slices that were read before."""
        self._camera = camera
        self._shift_us = first * SLICE_US
        self._lost_before = dict(camera.counted)
        self._open = True
        self.is_over = False  # the camera failed, or its stream ended
        self.slices = 0  # number of slices read
        # t_offset: time since the camera was opened
        self.sensor: Mapping[str, Any] = {**camera.sensor, "t_offset": np.int64(self._shift_us)}

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses since this part began."""
        return {why: max(0, count - self._lost_before.get(why, 0)) for why, count in self._camera.counted.items()}

    @property
    def notes(self) -> tuple[str, ...]:
        """The camera's notes, only on its first part."""
        return () if self._shift_us else self._camera.notes

    @property
    def time(self) -> TimeSource:
        """The time source of the camera."""
        return self._camera.time

    def now_us(self) -> int:
        """Return the device time in us since this part began."""
        return max(0, self._camera.now_us() - self._shift_us)

    def host_us(self, device_us: float) -> float:
        """Return the reading of `time`, in us, at this time of the part."""
        return self._camera.host_us(device_us + self._shift_us)

    def read(self) -> Events | None:
        """Return the next slice, with times since this part began; None after `close` or the end of the stream."""
        if not self._open:
            return None
        try:
            events = self._camera.read()
        except DeviceError:
            self.is_over = True
            raise
        if events is None:
            self.is_over = True
            return None
        self.slices += 1
        return events._replace(t=events.t - self._shift_us)

    def close(self) -> None:
        """End this part; the camera keeps running."""
        self._open = False


@dataclass
class _OpenState:
    """The open camera of a KeptCamera, its present part, and how many of its slices were read."""

    opened: OpenedCamera | None = None
    part: CameraPart | None = None
    read: int = 0

    def leave_part(self) -> bool:
        """Add the slices of the last part to the count; return whether the camera still delivers slices."""
        part, self.part = self.part, None
        if part is None:
            return True
        part.close()
        self.read += part.slices
        return not part.is_over

    def skip(self) -> bool:
        """Read and discard a slice; return whether there was one."""
        assert self.opened is not None
        if self.opened.camera.read() is None:
            return False
        self.read += 1
        return True


@dataclass(frozen=True)
class KeptCamera(NamedCamera):
    """A named camera that is opened once; each `open` returns its slices from that time onward.

    settings: the settings with which it is opened.
    """

    camera: NamedCamera
    settings: CameraSettings
    _state: "_OpenState" = field(default_factory=_OpenState, compare=False)

    @property
    def capabilities(self) -> frozenset[Capability]:
        """The capabilities of the camera."""
        return self.camera.capabilities

    @property
    def file_stem(self) -> str:
        """The file stem of the camera."""
        return self.camera.file_stem

    def __str__(self) -> str:
        return str(self.camera)

    def frame_px(self) -> tuple[int, int]:
        """Return the frame size of the camera."""
        return self.camera.frame_px()

    def known_sensor(self) -> dict[str, Any]:
        """Return the sensor datasets of the camera."""
        return self.camera.known_sensor()

    def open(self, settings: CameraSettings, world: Any, seeds: np.random.SeedSequence) -> OpenedCamera:
        """Return the part that begins now, opening the camera if necessary; DeviceError if that fails."""
        state = self._state
        if not self._is_current():
            self.close()
            state.opened, state.read = open_camera(self.camera, settings, world, seeds), 0
        assert state.opened is not None
        state.part = CameraPart(state.opened.camera, state.read)
        return OpenedCamera(state.part, state.opened.setup, state.opened.parents)

    def _is_current(self) -> bool:
        """Return whether the camera is open and delivers slices; slices that piled up unread are discarded."""
        state = self._state
        if state.opened is None or not state.leave_part():
            return False
        camera = state.opened.camera
        now_us = camera.time.now_s() * 1e6
        try:
            while camera.host_us((state.read + 1) * SLICE_US) < now_us:
                if not state.skip():
                    return False
        except DeviceError:
            return False
        return True

    def skip(self) -> None:
        """Read and discard a slice, which takes a millisecond. A camera that fails is closed until the next `open`.

        DeviceError if it failed now.
        """
        if self._state.opened is None:
            return
        try:
            over = not self._state.leave_part() or not self._state.skip()
        except DeviceError:
            self.close()
            raise
        if over:
            self.close()

    @property
    def is_open(self) -> bool:
        """Whether the camera is running."""
        return self._state.opened is not None

    def close(self) -> None:
        """Stop the camera, whether or not it still responds; a second call does nothing."""
        opened, self._state.opened = self._state.opened, None
        self._state.part = None
        if opened is not None:
            with suppress(DeviceError):
                opened.camera.close()
