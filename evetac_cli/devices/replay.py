"""A recording, returned slice by slice as if from a camera.

If paced, a slice is returned when as much time has passed since the first as in the recording, as from a device.
"""

import math
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

from evetac_cli.events import SLICE_US, Events
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import open_recording

BLOCK_SLICES = 20  # slices that are read at once: a paced replay must not wait for a large block


class ReplayCamera:
    """A camera whose slices come from a recording; also the clock of that recording."""

    counted: Mapping[str, int] = MappingProxyType({})
    notes: tuple[str, ...] = ()
    time: TimeSource = HOST_TIME

    def __init__(self, path: Path, *, paced: bool = False) -> None:
        self._recording = open_recording(path)
        self.header: Header = self._recording.header
        self.sensor: Mapping[str, Any] = self._recording.sensor_datasets()
        blocks = self._recording.blocks(BLOCK_SLICES)
        self._slices = chain.from_iterable(block.slices() for block in blocks)
        self._handed_out = 0
        self._open = True
        self._paced = paced
        self._started_us = 0.0

    def read(self) -> Events | None:
        """Return the next slice, or None after the last one; if paced, not before its time.

        SchemaError if events are not in their slices.
        """
        events = next(self._slices, None) if self._open else None
        if events is None:
            return None
        if self._paced:
            now_us = self.time.now_s() * 1e6
            self._started_us = self._started_us or now_us
            self.time.sleep(max(0.0, self.host_us((self._handed_out + 1) * SLICE_US) - now_us) * 1e-6)
        self._handed_out += 1
        return events

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
