"""What is known of a grasp in real time while it is recorded, and why it ended.

The recorder's two threads share it: the one that watches (recorder.py) learns how the others ended, the one that writes
(writing_thread.py) takes slices and steps.
"""

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim import grasp_outcome
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials.grasp.controller_process import DETECTOR, OVER, ControllerEnded
from evetac_cli.trials.grasp.detector_process import DetectorEnded, SliceBatch
from evetac_cli.trials.grasp.grasp_processes import GraspProcesses
from evetac_cli.trials.live_view import LiveView
from evetac_cli.trials.session import (
    ABORTED,
    INTERRUPTED,
    LET_GO,
    OPENED,
    OVERLOADED,
    STOPPED,
    LateSlices,
    lost_datasets,
    spread,
)

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

FELL = "the object fell"


@dataclass
class RecordedGrasp:
    """What was recorded of a grasp in real time, and why it ended."""

    end_ms: int  # when it is to be over
    slices: int = 0
    events: int = 0
    ended: str = ""
    error: Exception | None = None
    first_us: float = math.nan  # when the first and the last slice were evaluated
    last_us: float = math.nan
    slice_late_us: "array[float]" = field(default_factory=lambda: array("d"))
    step_late_us: "array[float]" = field(default_factory=lambda: array("d"))
    latency_us: "array[float]" = field(default_factory=lambda: array("d"))
    late_slices: LateSlices = field(default_factory=LateSlices)
    zero_us: float = math.nan  # when the recording began, by the time of the grasp
    behind_s: float = 0.0  # that slices waited for the recorder, at most
    steps: TrialBuffer = field(default_factory=TrialBuffer)  # of the controller, as far as the outcome needs them
    truth: TrialBuffer = field(default_factory=TrialBuffer)  # of a virtual world
    truths: int = 0  # slices whose truth is known
    world_over: bool = False
    detector_died: bool = False
    detector: DetectorEnded | None = None  # what each said at its end
    controller: ControllerEnded | None = None
    controller_hung: str = ""  # in words
    torque: str = ""  # what it was at the end, in words
    cores_used: str = ""  # by whom, in words: from beginning to end, and in the second before something ended it
    cores_at_end: str = ""

    @property
    def has_steps(self) -> bool:
        """Whether so much was recorded that a file can be made of it."""
        return bool(self.slices and self.steps.rows)

    def datasets(self) -> dict[str, Any]:
        """The datasets capture/...: why it ended, what was lost, how well time was kept."""
        rows: dict[str, Any] = {"capture/ended": self.ended}
        passed_us = self.last_us - self.first_us
        if passed_us > 0:
            rows["capture/slices_per_s"] = np.float64((self.slices - 1) / passed_us * 1e6)
        for name in ("slice_late_us", "step_late_us", "latency_us"):
            if len(getattr(self, name)):
                rows[f"capture/{name}"] = spread(getattr(self, name))
        controller = self.controller
        if controller is not None and controller.steps:
            rows["capture/command_misses"] = np.int64(controller.missed)
            rows["capture/command_misses_by_gripper"] = np.int64(controller.missed_by_gripper)
            rows["capture/command_us"] = spread(controller.cycle_us)
            if controller.seconds > 0:
                rows["capture/commands_per_s"] = np.float64((controller.steps - 1) / controller.seconds)
            released_us = controller.released_us - controller.alive_us
            if self.error is not None and not math.isnan(released_us):
                rows["capture/released_us"] = np.float64(released_us)
        for name, ended in (("camera", self.detector), ("gripper", self.controller)):
            if ended is not None:
                rows |= lost_datasets({f"{name}.{why}": count for why, count in ended.counted.items()})
        return rows

    def take_steps(self, rows: list[dict[str, Any]], writer: RecordingWriter, view: LiveView | None = None) -> None:
        """Write steps of the controller, and remember what of them says how the grasp went."""
        for row in rows:
            writer.append_rows(row)
            if view is not None:
                view.add_command(row)
            self.steps.append_rows({name: row[name] for name in grasp_outcome.NEEDED if name in row})
            self.step_late_us.append(row["control/late_us"])
            if row["control/phase"] != GraspPhase.CONTACT and not math.isnan(row["control/latency_us"]):
                self.latency_us.append(row["control/latency_us"])  # in contact the law does not react to slip

    def take_slices(
        self, batch: SliceBatch, writer: RecordingWriter, now_s: float = -math.inf, view: LiveView | None = None
    ) -> None:
        """Write slices of the camera, but for those after the end of a virtual world. now_s: when they came here."""
        self.behind_s = max([self.behind_s, *(now_s - at_us * 1e-6 for at_us in batch.at_us[-1:])])
        wanted = len(batch.counts)
        if self.world_over:
            wanted = min(max(self.truths - self.slices, 0), wanted)
        if wanted:
            counts = batch.counts[:wanted]
            events = batch.events.part(0, sum(counts))
            writer.append_slices(events, counts, {"control/probability": batch.probability[:wanted]})
            first = 0
            for count, late_us, probability in zip(counts, batch.late_us, batch.probability, strict=False):
                self.late_slices.add(late_us, count)
                if view is not None:
                    view.add_slice(events.part(first, first + count), late_us, probability)
                first += count
            if not self.slices:
                self.first_us = batch.at_us[0]
            self.last_us = batch.at_us[wanted - 1]
            self.slice_late_us.extend(batch.late_us[:wanted])
            self.slices += wanted
            zero_us = self.last_us - batch.late_us[wanted - 1] - self.slices * SLICE_US
            self.zero_us = self.zero_us if math.isnan(zero_us) else zero_us
            self.events += events.size
        if view is not None and batch.counted is not None:
            view.lost({f"camera.{why}": count for why, count in batch.counted.items()})

    def take_truth(self, rows: Mapping[str, NDArray[Any]] | None) -> None:
        """Truth of some slices of a virtual world; None once it is over, which it is too when the object has fallen."""
        if rows is None:
            self.world_over = True
            return
        for name, values in rows.items():
            self.truth.rows.setdefault(name, []).extend(values)
        self.truths += len(next(iter(rows.values())))

    def must_stop(self) -> bool:
        """Whether something has come up for which the other processes have to end now."""
        if self.world_over and self.truths < self.end_ms and not self.ended:
            self.ended = FELL
        if self.controller is not None and self.controller.ended != OVER:
            return True
        if self.detector_died or (self.detector is not None and self.detector.error is not None):
            return True
        return bool(self.ended) and self.ended != OPENED  # then the controller ends by itself

    def conclude(self, processes: GraspProcesses, world: "VirtualWorld | None" = None) -> None:
        """Find out why it ended, from what both said at their end, or from that they said nothing.

        world: the virtual one, if there is one: the detector sees that it is gone, and does not know why.
        """
        detector, controller = self.detector, self.controller
        if controller is not None:
            self.torque = controller.torque
        if controller is None:
            exit_ = processes.exit_words(processes.controller)
            died = f"the controller died ({exit_})" if exit_ else "the controller does not end"
            self.torque = self.torque or processes.switch_off()
            self.error = DeviceError(f"{self.controller_hung or died}; {self.torque}")
        elif (
            detector is None
            and (controller.error is None or DETECTOR in controller.ended)  # else the controller failed before
            and (exit_ := processes.exit_words(processes.detector))
        ):
            self.error = DeviceError(f"the detector died ({exit_}); {self.torque}")
        else:
            self.error = (detector and detector.error) or controller.error
            if world is not None and world.has_died:
                self.error = world.died()
            if isinstance(self.error, EvetacError) and "torque" not in str(self.error):
                self.error.message += f"; {self.torque}"
            if isinstance(self.error, EvetacError) and self.error.hint == OVERLOADED:
                self.error.found = "; ".join(words for words in (self.error.found, self.cores_at_end) if words)
        opened = controller is not None and self.ended == OPENED == controller.ended
        if opened or (controller is not None and self.ended in (INTERRUPTED, LET_GO, STOPPED, ABORTED, FELL)):
            self.error = None
        else:
            self.ended = str(self.error).splitlines()[0] if self.error or controller is None else controller.ended

    def outcome(self, mm_per_px: float) -> dict[str, Any] | None:
        """Success of each phase and so on, as in simulation; None where there is no truth, or too little of it."""
        steps, truth = self.steps.row_arrays(), self.truth_arrays()
        if not truth or not steps or not (steps["control/phase"] == GraspPhase.CONTACT).any():
            return None
        return grasp_outcome.outcome({**steps, **truth}, mm_per_px, self.end_ms)

    def truth_arrays(self) -> dict[str, Any]:
        """Truth of the slices that were recorded; nothing if some have none."""
        if not self.slices or self.truths < self.slices:
            return {}
        return {name: rows[: self.slices] for name, rows in self.truth.row_arrays().items()}
