"""A recording, returned slice by slice as if from a camera.

Events are read in packets of bounded size and cut into slices by their time, as a driver does with USB packets. An hour
without events is cut one second at a time. If paced, a slice is returned when as much time has passed since the first
as in the recording, as from a device.
"""

import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events, Slicer
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import open_recording

PACKET_EVENTS = 8192
BLOCK_SLICES = 1000  # slices that are cut at once


class ReplayCamera:
    """A camera whose slices come from a recording; also the clock of that recording."""

    counted: Mapping[str, int] = MappingProxyType({})
    notes: tuple[str, ...] = ()
    time: TimeSource = HOST_TIME

    def __init__(self, path: Path, *, paced: bool = False) -> None:
        self._recording = open_recording(path)
        self.header: Header = self._recording.header
        self.sensor: Mapping[str, Any] = self._recording.sensor_datasets()
        self._slicer = Slicer()
        self._ready: deque[Events] = deque()
        self._read = 0  # events read
        self._cut = 0  # slices cut
        self._handed_out = 0
        self._open = True
        self._paced = paced
        self._started_us = 0.0

    def read(self) -> Events | None:
        """Return the next slice, or None after the last one; if paced, not before its time."""
        while self._open and not self._ready and self._handed_out < len(self._recording):
            end = min(self._cut + BLOCK_SLICES, len(self._recording))
            last = int(self._recording.starts[end])
            if self._read < last:
                self._ready += self._slices_of(min(self._read + PACKET_EVENTS, last))
            if self._read == last:
                self._ready += self._slicer.close_until(end)
                self._cut = end
        if not self._open or not self._ready:
            return None
        if self._paced:
            now_us = self.time.now_s() * 1e6
            self._started_us = self._started_us or now_us
            self.time.sleep(max(0.0, self.host_us((self._handed_out + 1) * SLICE_US) - now_us) * 1e-6)
        self._handed_out += 1
        return self._ready.popleft()

    def _slices_of(self, stop: int) -> list[Events]:
        """Return the slices that the events up to `stop` complete; InputError for wrong slices or decreasing times."""
        packet = self._recording.events(self._read, stop)
        self._read = stop
        try:
            return self._slicer.push(packet)
        except ValueError as error:
            raise InputError(
                "the events are not in order of time",
                where=str(self._recording.path),
                found=str(error),
                hint="evetac validate reports what is wrong with the file",
            ) from None

    def now_us(self) -> int:
        """Return the end of the slice that was read last."""
        return self._handed_out * SLICE_US

    def host_us(self, device_us: float) -> float:
        """Return the host time in us at which a paced replay reaches this time of the recording."""
        return self._started_us + device_us if self._paced else math.nan

    def close(self) -> None:
        """Close the file."""
        self._open = False
        self._recording.close()
