"""A recording, handed out slice by slice as if it were a camera.

Events are read in packets of a fixed number and cut into slices by their time, as a driver does with USB packets.
Paced, a slice comes when as much time has passed since the first as in the recording: a stand-in for a device.
"""

import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from evetac_cli.events import SLICE_US, Events, Slicer
from evetac_cli.store.provenance import Header
from evetac_cli.store.read import open_recording

PACKET_EVENTS = 8192


class ReplayCamera:
    """A camera whose slices come from a recording; also its clock."""

    counted: Mapping[str, int] = MappingProxyType({})

    def __init__(self, path: Path, *, paced: bool = False) -> None:
        self._recording = open_recording(path)
        self.header: Header = self._recording.header
        self.sensor: Mapping[str, Any] = self._recording.sensor_datasets()
        self._slicer = Slicer()
        self._ready: deque[Events] = deque()
        self._read = 0
        self._handed_out = 0
        self._open = True
        self._paced = paced
        self._started_us = 0.0

    def read(self) -> Events | None:
        """The next slice, or None after the last one; paced, not before its time."""
        while self._open and not self._ready and self._handed_out < len(self._recording):
            if self._read < self._recording.event_count:
                stop = min(self._read + PACKET_EVENTS, self._recording.event_count)
                self._ready += self._slicer.push(self._recording.events(self._read, stop))
                self._read = stop
            else:
                self._ready += self._slicer.close_until(len(self._recording))
        if not self._open or not self._ready:
            return None
        if self._paced:
            self._started_us = self._started_us or _host_us()
            time.sleep(max(0.0, self.host_us((self._handed_out + 1) * SLICE_US) - _host_us()) * 1e-6)
        self._handed_out += 1
        return self._ready.popleft()

    def now_us(self) -> int:
        """End of the slice that was read last."""
        return self._handed_out * SLICE_US

    def host_us(self, device_us: float) -> float:
        """time.monotonic() in us at which a paced replay is at this time of the recording."""
        return self._started_us + device_us

    def close(self) -> None:
        """Close the file."""
        self._open = False
        self._recording.close()


def _host_us() -> float:
    return time.monotonic() * 1e6
