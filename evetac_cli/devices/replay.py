"""A recording, handed out slice by slice as if it were a camera.

Events are read in packets of a fixed number and cut into slices by their time, as a driver does with USB packets.
"""

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evetac_cli.events import SLICE_US, Events, Slicer
from evetac_cli.store.read import open_recording

PACKET_EVENTS = 8192


class ReplayCamera:
    """A camera whose slices come from a recording; also its clock."""

    def __init__(self, path: Path) -> None:
        self._recording = open_recording(path)
        self.sensor: Mapping[str, Any] = {
            name: self._recording.read(name) for name in self._recording.contents() if name.startswith("sensor/")
        }
        self._slicer = Slicer()
        self._ready: deque[Events] = deque()
        self._read = 0
        self._handed_out = 0
        self._open = True

    def read(self) -> Events | None:
        """The next slice, or None after the last one."""
        while self._open and not self._ready and self._handed_out < len(self._recording):
            if self._read < self._recording.event_count:
                stop = min(self._read + PACKET_EVENTS, self._recording.event_count)
                self._ready += self._slicer.push(self._recording.events(self._read, stop))
                self._read = stop
            else:
                self._ready += self._slicer.close_until(len(self._recording))
        if not self._open or not self._ready:
            return None
        self._handed_out += 1
        return self._ready.popleft()

    def now_us(self) -> int:
        """End of the slice that was read last."""
        return self._handed_out * SLICE_US

    def close(self) -> None:
        """Close the file."""
        self._open = False
        self._recording.close()
