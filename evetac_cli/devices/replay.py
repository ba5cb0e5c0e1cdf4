"""A recording, handed out slice by slice as if it were a camera."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evetac_cli.events import SLICE_US, Events
from evetac_cli.store.read import open_recording


class ReplayCamera:
    """A camera whose slices come from a recording; also its clock."""

    def __init__(self, path: Path) -> None:
        self._recording = open_recording(path)
        self._next = 0
        self._open = True

    @property
    def sensor(self) -> Mapping[str, Any]:
        """The datasets `sensor/...` of the recording."""
        return {name: self._recording.read(name) for name in self._recording.contents() if name.startswith("sensor/")}

    def read(self) -> Events | None:
        """The next slice, or None after the last one."""
        if not self._open or self._next >= len(self._recording):
            return None
        self._next += 1
        return self._recording[self._next - 1]

    def now_us(self) -> int:
        """End of the slice that was read last."""
        return self._next * SLICE_US

    def close(self) -> None:
        """Close the file."""
        self._open = False
        self._recording.close()
