"""Run `evetac` with an additional camera, `--camera clock`: evetac's driver with a virtual DVXplorer that shows time.

    python scripts/studies/realtime/clock_camera.py record --camera clock --gripper none --listen -o data

The pixel of each event encodes its number, and thus the time, by the computer's clock, at which it was made. A
recording therefore contains the true time of each slice. The camera writes its start time (s, by time.monotonic) to the
file named by the variable EVETAC_CLOCK_BEGAN. listen_trials.py uses this camera. Simulated.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from evetac_cli.devices import cameras
from evetac_cli.devices.cameras import CameraSettings, NamedCamera, OpenedCamera
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.names import Capability
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource

BEGAN = "EVETAC_CLOCK_BEGAN"
EVENT_US = 200  # between two events
EVENTS = SLICE_US // EVENT_US  # per slice
PIXELS = FRAME_PX[0] * FRAME_PX[1]


class ClockWords:
    """Event words of a camera that shows the time; a source for a virtual DVXplorer."""

    time: TimeSource = HOST_TIME

    def __init__(self) -> None:
        self._began_s: float | None = None
        self._sent = 0  # slices

    def run(self, on: bool) -> None:
        """Start the clock and write its start time to a file."""
        if on and self._began_s is None:
            self._began_s = time.monotonic()
            if BEGAN in os.environ:
                Path(os.environ[BEGAN]).write_text(repr(self._began_s))

    def take(self, most: int, timeout_s: float) -> bytes:
        """Return the words of all completed slices, waiting for the end of one."""
        from evetac_cli.devices.dvxplorer.event_words import encode, timestamp

        if self._began_s is None:
            time.sleep(max(timeout_s, 0.0))
            return b""
        left_s = self._began_s + (self._sent + 1) * 1e-3 - time.monotonic()
        if left_s > timeout_s:
            time.sleep(max(timeout_s, 0.0))
            return b""
        time.sleep(max(left_s, 0.0))
        over = min(int((time.monotonic() - self._began_s) * 1e3), self._sent + most // 256)
        words = [] if self._sent else [timestamp(1)]
        for slice_ in range(self._sent, over):
            number = np.arange(slice_ * EVENTS, (slice_ + 1) * EVENTS)
            x, y = number % FRAME_PX[0], number // FRAME_PX[0] % FRAME_PX[1]
            events = Events(number * EVENT_US, x.astype(np.uint16), y.astype(np.uint16), np.ones(EVENTS, np.uint8))
            words += [encode(events, 1, EVENT_US)[1:], timestamp(slice_ + 2)]
        self._sent = max(over, self._sent)
        return b"".join(part.astype("<u4").tobytes() for part in words)


@dataclass(frozen=True)
class Clock(NamedCamera):
    """The camera `clock`: evetac's driver with a virtual camera that shows the time."""

    name = "clock"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Accept no options."""
        return cls()

    @property
    def capabilities(self) -> frozenset[Capability]:
        """Return the capabilities of a device whose events are simulated."""
        return frozenset({Capability.DEVICE, Capability.SIMULATED})

    def open(self, settings: CameraSettings, world: Any, seeds: np.random.SeedSequence) -> OpenedCamera:
        """Start the driver."""
        from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
        from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer

        return OpenedCamera(DvxplorerCamera(backend=VirtualDvxplorer(ClockWords())), {"name": self.name})


if __name__ == "__main__":
    from evetac_cli.__main__ import main

    cameras.KINDS[Clock.name] = Clock
    main()
