"""A DVXplorer Mini through the maker's library dv-processing (firmware 10 only): an alternative to evetac's own driver.

The library finds and reads the camera and decodes its events; slices are cut as for evetac's driver (device_slices.py).
Its times are the camera's times plus the host's time of day at the start. The library does not report its own losses,
nor whether a camera without events still sends the time. So a second without an event is counted as such.
"""

import time
from collections import deque
from collections.abc import Mapping
from datetime import timedelta
from typing import Any

import numpy as np

from evetac_cli.devices.device_slices import DeviceSlices
from evetac_cli.devices.dvxplorer.protocol import DvxplorerSettings
from evetac_cli.errors import DeviceError, needs_extra
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource

POLL_S = 0.0005
QUIET_MS = 1000  # longest normal time without an event: even a sensor in the dark has noise
PATIENCE_US = 10_000  # on top of the flush time: two threads of the library, which does not report an empty camera


class DvCamera:
    """A running camera of dv-processing; an EventCamera.

    serial: which camera, None for the first; library: dv_processing, or a test's substitute. DeviceError with a message
    if the camera cannot be opened.
    """

    notes: tuple[str, ...] = ()
    time: TimeSource = HOST_TIME

    def __init__(
        self, serial: str | None = None, settings: DvxplorerSettings | None = None, library: Any = None
    ) -> None:
        self.settings = settings or DvxplorerSettings()
        self.where = f"--camera dv{':' + serial if serial else ''}"
        if library is None:
            with needs_extra("dv-processing is not installed", "camera", self.where):
                import dv_processing
            library = dv_processing
        self._camera: Any = None
        try:
            self._camera = library.io.camera.DVXplorerM(*([serial] if serial else []))
            self._set_up(library)
            name = str(self._camera.getCameraName())
        except (RuntimeError, IndexError, ValueError, OSError) as error:  # the library's bindings raise these
            self.close()
            raise DeviceError(
                "dv-processing could not open a camera",
                where=self.where,
                expected="a DVXplorer Mini with firmware 10 that no other program uses",
                found=str(error),
                hint="run `evetac doctor` to find the fault; --camera dvxplorer also supports older firmware",
            ) from error
        self.sensor: Mapping[str, Any] = {
            "sensor/frame_px": np.array(FRAME_PX, np.int32),
            "sensor/name": f"dv:{name}",
        }
        self._slices = DeviceSlices(self.settings.flush_us + SLICE_US + PATIENCE_US)
        self._slices.start(_now_us())
        self._first_us: int | None = None
        self._ready: deque[Events] = deque()
        self._quiet_ms = 0  # total of all silences that are over

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by reason; the library does not report its own."""
        slices = self._slices
        quiet_ms = slices.ms_without_time if slices.ms_without_time > QUIET_MS else 0
        return {
            "late_events": slices.late_events,
            "early_events": slices.early_events,
            "clock_restarts": slices.clock_restarts,
            "ms_without_events": self._quiet_ms + quiet_ms,
        }

    def read(self) -> Events | None:
        """Return the next slice once it is closed; None after close; DeviceError if the camera has gone."""
        while self._camera is not None and not self._ready:
            self._ready += self._slices.more()
            if self._ready:
                break
            begun_us = _now_us()
            batch = self._camera.getNextEventBatch()
            if batch is not None and batch.size():
                self._take(batch.numpy())
                continue
            if not self._camera.isRunning():
                raise DeviceError("is no longer on the bus", where=self.where, hint="plug it in again")
            self._ready += self._slices.close_until(self._slices.over(begun_us))
            if not self._ready:
                time.sleep(POLL_S)
        return self._ready.popleft() if self._camera is not None else None

    def host_us(self, device_us: float) -> float:
        """Return time.monotonic() in us at which the camera's clock showed this time of the recording."""
        return self._slices.host_us(device_us)

    def now_us(self) -> int:
        """Return the present time of the recording, by the camera's clock."""
        return int(self._slices.recording_us(_now_us()))

    def close(self) -> None:
        """Release the camera, which stops it; a second call does nothing."""
        self._camera = None

    def _take(self, rows: Any) -> None:
        """Cut one batch of the library, a structured array, into slices."""
        t_us = rows["timestamp"].astype(np.int64)
        columns = (
            rows[name].astype(kind) for name, kind in (("x", np.uint16), ("y", np.uint16), ("polarity", np.uint8))
        )
        events = Events(t_us, *columns)
        if self._first_us is None:
            self._first_us = int(t_us[0])
        if self._slices.ms_without_time > QUIET_MS:
            self._quiet_ms += self._slices.ms_without_time
        self._ready += self._slices.push(events, self._first_us, int(t_us[-1]), _now_us())

    def _set_up(self, library: Any) -> None:
        """Pass evetac's settings to the library, and request one batch per millisecond."""
        rate = self.settings.readout_rate.upper().replace("-", "_").replace("LOSSY", "CONSTANT_LOSSY")
        self._camera.setReadoutFPS(getattr(library.io.camera.DVXplorer.ReadoutFPS, rate))
        self._camera.setContrastThresholdOn(self.settings.threshold_on)
        self._camera.setContrastThresholdOff(self.settings.threshold_off)
        self._camera.setGlobalHold(self.settings.global_hold)
        self._camera.setMIPITimeoutValue(timedelta(microseconds=self.settings.flush_us))
        self._camera.setTimeInterval(timedelta(microseconds=SLICE_US))


def _now_us() -> float:
    return time.monotonic() * 1e6
