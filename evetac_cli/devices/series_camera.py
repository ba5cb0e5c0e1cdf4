"""A camera that stays open between the recordings of a series: each recording gets its own slices and its own clock.

Reason: opening a camera takes a second or more, and a robot that starts a recording waits for it. Between recordings
the camera's slices are read and discarded, so the next recording begins with the present slice and not with old ones.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from evetac_cli.devices.cameras import CameraSettings, NamedCamera, OpenedCamera
from evetac_cli.devices.plugin_devices import open_camera
from evetac_cli.errors import DeviceError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.names import Capability
from evetac_cli.realtime.shared_time import TimeSource


class _Running:
    """The open camera of a SeriesCamera: how many of its slices were read, and whether it still delivers any."""

    def __init__(self, opened: OpenedCamera) -> None:
        self.opened = opened
        self.camera = opened.camera
        self.slices = 0
        self.is_over = False  # the camera failed, or its stream ended

    def read(self) -> Events | None:
        """Return the next slice; None after the last; DeviceError if the camera failed."""
        try:
            events = self.camera.read()
        except DeviceError:
            self.is_over = True
            raise
        self.is_over = events is None
        self.slices += events is not None
        return events


class CameraPart:
    """The slices of a camera from the present one onward, as a separate camera whose time begins there."""

    def __init__(self, running: _Running) -> None:
        self._running, self._camera = running, running.camera
        self._shift_us = running.slices * SLICE_US
        self._lost_before = dict(self._camera.counted)
        self._open = True
        # t_offset: time since the camera was opened
        self.sensor: Mapping[str, Any] = {**self._camera.sensor, "t_offset": np.int64(self._shift_us)}
        self.notes = () if self._shift_us else self._camera.notes  # only on its first part
        self.time: TimeSource = self._camera.time

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses since this part began."""
        return {why: max(0, count - self._lost_before.get(why, 0)) for why, count in self._camera.counted.items()}

    def now_us(self) -> int:
        """Return the device time in us since this part began."""
        return max(0, self._camera.now_us() - self._shift_us)

    def host_us(self, device_us: float) -> float:
        """Return the reading of `time`, in us, at this time of the part."""
        return self._camera.host_us(device_us + self._shift_us)

    def read(self) -> Events | None:
        """Return the next slice, with times since this part began; None after `close` or the end of the stream."""
        events = self._running.read() if self._open else None
        return None if events is None else events._replace(t=events.t - self._shift_us)

    def close(self) -> None:
        """End this part; the camera keeps running."""
        self._open = False


@dataclass(frozen=True)
class SeriesCamera(NamedCamera):
    """A named camera that is opened once; each `open` returns its slices from that time onward.

    settings: the settings with which it is opened.
    """

    camera: NamedCamera
    settings: CameraSettings
    _running: list[_Running] = field(default_factory=list, compare=False)  # empty, or the one open camera

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
        self._discard_waiting()
        if not self.is_open:
            self._running.append(_Running(open_camera(self.camera, settings, world, seeds)))
        (running,) = self._running
        return running.opened._replace(camera=CameraPart(running))

    def _discard_waiting(self) -> None:
        """Discard slices that piled up unread; close a camera that does not deliver any more."""
        for running in self._running:
            now_us = running.camera.time.now_s() * 1e6
            with suppress(DeviceError):
                while not running.is_over and running.camera.host_us((running.slices + 1) * SLICE_US) < now_us:
                    running.read()
        self._close_if_over()

    def skip(self) -> None:
        """Read and discard a slice, which takes a millisecond. A camera that fails is closed until the next `open`.

        DeviceError if it failed now.
        """
        try:
            for running in self._running:
                if not running.is_over:
                    running.read()
        finally:
            self._close_if_over()

    def _close_if_over(self) -> None:
        if any(running.is_over for running in self._running):
            self.close()

    @property
    def is_open(self) -> bool:
        """Whether the camera is running."""
        return bool(self._running)

    def close(self) -> None:
        """Stop the camera, whether or not it still responds; a second call does nothing."""
        while self._running:
            with suppress(DeviceError):
                self._running.pop().camera.close()
