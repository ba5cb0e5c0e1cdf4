"""One camera of a trial: its file, and the thread that reads it if it is not the first camera."""

import math
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.devices import EventCamera, Rig
from evetac_cli.events import SLICE_US, Events
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.trials import session
from evetac_cli.trials.record.current_ramp import GripperLoop
from evetac_cli.trials.session import LateSlices, TimeSample

# Limits for a camera other than the first; beyond them its driver drops, and counts, events.
WAITING_EVENTS, WAITING_SLICES = 4_000_000, 60_000


class SliceThread:
    """Reads another camera of the same trial, so that no camera waits for the other.

    Slices are kept until they are taken, up to a limit, each with the time (s) of its arrival.
    """

    def __init__(self, camera: EventCamera) -> None:
        self._camera = camera
        self._slices: deque[tuple[Events, float]] = deque()
        self._waiting = 0  # waiting events
        self._lock = threading.Lock()
        self._running = True
        self._thread = threading.Thread(target=self._run, name="slices", daemon=True)
        self.error: Exception | None = None

    def start(self) -> None:
        """Start reading the camera."""
        self._thread.start()

    def take(self) -> list[tuple[Events, float]]:
        """Return the slices that arrived since the last call, oldest first."""
        with self._lock:
            taken = list(self._slices)
            self._slices.clear()
            self._waiting = 0
        return taken

    def stop(self) -> None:
        """Stop after the next slice; the camera is not read after this returns."""
        self._running = False
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        try:
            while self._running and (events := self._camera.read()) is not None:
                with self._lock:
                    self._slices.append((events, self._camera.time.now_s()))
                    self._waiting += events.size
                while self._running and (self._waiting > WAITING_EVENTS or len(self._slices) > WAITING_SLICES):
                    time.sleep(1e-3)
        except Exception as error:  # raised by the recording thread
            self.error = error


@dataclass
class CameraRecording:
    """One camera of a trial, its file, and the state of its recording."""

    output: Path
    rig: Rig
    recipe: Recipe
    writer: RecordingWriter
    slices: int = 0
    events: int = 0
    ended: str = ""
    saved: Path | None = None  # the file, or the folder left for repair
    error: Exception | None = None
    first_s: float = 0.0  # arrival time of the first and the last slice
    last_s: float = 0.0
    late_us: float = math.nan  # delay of the last slice, from its end to its arrival, if known
    delays: TimeSample = field(default_factory=TimeSample)
    late_slices: LateSlices = field(default_factory=lambda: LateSlices(1e6 * session.BEHIND_S))
    loop: GripperLoop | None = None  # commands the gripper, if there is one
    thread: SliceThread | None = None  # reads the camera, if it is not the first

    def append(self, events: Events, received_s: float) -> None:
        """Write one slice, and count it."""
        self.first_s = self.first_s or received_s
        self.last_s = received_s
        self.slices += 1
        self.events += events.size
        self.late_us = received_s * 1e6 - self.rig.camera.host_us(self.slices * SLICE_US)
        if not math.isnan(self.late_us):
            self.delays.add(self.late_us)
            self.late_slices.add(self.late_us, events.size)
        self.writer.append(events)

    def datasets(self, first: Rig) -> dict[str, Any]:
        """Return the datasets capture/...; for another camera, with the offset of its clock to the first camera's."""
        seconds = self.last_s - self.first_s
        rows: dict[str, Any] = {"capture/ended": self.ended}
        if seconds > 0:
            rows["capture/slices_per_s"] = np.float64((self.slices - 1) / seconds)
        rows |= session.lost_datasets(self.rig.counted())
        late_us = self.delays.spread()
        if late_us is not None:
            rows["capture/slice_late_us"] = late_us
        if self.loop is not None and self.loop.commands:
            if seconds > 0:
                rows["capture/commands_per_s"] = np.float64(self.loop.commands / seconds)
            rows["capture/command_misses"] = np.int64(self.loop.misses)
            command_us = self.loop.cycle_us.spread()
            if command_us is not None:
                rows["capture/command_us"] = command_us
        offset_us = self.rig.camera.host_us(0.0) - first.camera.host_us(0.0)
        if self.rig is not first and not math.isnan(offset_us):
            rows["capture/clock_offset_us"] = np.float64(offset_us)
        return rows
