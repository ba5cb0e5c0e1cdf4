"""The record of one finger's camera and detector while a real-time grasp is recorded."""

import math
from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from evetac_cli.events import SLICE_US
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.trials.grasp.detector_process import DetectorEnded, SliceBatch
from evetac_cli.trials.session import LateSlices, lost_datasets, spread


@dataclass(kw_only=True)
class RecordedFinger:
    """The recorded data of one finger, and how its detector ended."""

    slices: int = 0
    events: int = 0
    first_us: float = math.nan  # time at which the first and the last slice were evaluated
    last_us: float = math.nan
    zero_us: float = math.nan  # latest estimate of when the camera's recording began, on the host's clock
    slice_late_us: "array[float]" = field(default_factory=lambda: array("d"))
    late_slices: LateSlices = field(default_factory=LateSlices)
    behind_s: float = 0.0  # longest time that slices waited for the recorder
    detector_died: bool = False
    detector: DetectorEnded | None = None  # its final message
    probability: "array[float]" = field(default_factory=lambda: array("f"))  # of each slice, only for a second finger

    def take(
        self, batch: SliceBatch, writer: RecordingWriter, most: int | None, now_s: float, rows: dict[str, Any]
    ) -> int:
        """Write the slices of a batch, at most up to `most` in total; return how many were written.

        rows: columns written with the events.
        """
        self.behind_s = max([self.behind_s, *(now_s - at_us * 1e-6 for at_us in batch.at_us[-1:])])
        wanted = len(batch.counts)
        if most is not None:
            wanted = min(max(most - self.slices, 0), wanted)
        if not wanted:
            return 0
        counts = batch.counts[:wanted]
        events = batch.events.part(0, sum(counts))
        writer.append_slices(events, counts, {name: values[:wanted] for name, values in rows.items()})
        for count, late_us in zip(counts, batch.late_us, strict=False):
            self.late_slices.add(late_us, count)
        if not self.slices:
            self.first_us = batch.at_us[0]
        self.last_us = batch.at_us[wanted - 1]
        self.slice_late_us.extend(batch.late_us[:wanted])
        self.slices += wanted
        self.events += events.size
        zero_us = self.last_us - batch.late_us[wanted - 1] - self.slices * SLICE_US
        self.zero_us = self.zero_us if math.isnan(zero_us) else zero_us
        return wanted

    def camera_datasets(self) -> dict[str, Any]:
        """Return the datasets capture/... of the camera: losses and timing."""
        rows: dict[str, Any] = {}
        passed_us = self.last_us - self.first_us
        if passed_us > 0:
            rows["capture/slices_per_s"] = np.float64((self.slices - 1) / passed_us * 1e6)
        if len(self.slice_late_us):
            rows["capture/slice_late_us"] = spread(self.slice_late_us)
        if self.detector is not None:
            rows |= lost_datasets({f"camera.{why}": count for why, count in self.detector.counted.items()})
        return rows
