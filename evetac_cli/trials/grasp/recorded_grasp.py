"""The record of a real-time grasp while it runs, why it ended, and its row of figures.

The recorder's two threads share it. The supervising thread (recorder.py) learns how the other processes ended; the
writing thread takes slices and steps. A second finger, if it has a camera, only has its own slices;
everything else belongs to the grasp.
"""

import math
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices import of_finger
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.events import SLICE_US
from evetac_cli.jobs import Outcome, outcome
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim import grasp_outcome
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials import session
from evetac_cli.trials.grasp.controller_process import DETECTOR, OF_FINGER, OVER, ControllerEnded
from evetac_cli.trials.grasp.detector_process import DetectorEnded, SliceBatch
from evetac_cli.trials.grasp.grasp_processes import GraspProcesses
from evetac_cli.trials.grasp.settings import DeviceGrasp
from evetac_cli.trials.live_view import LiveView
from evetac_cli.trials.session import (
    ABORTED,
    INTERRUPTED,
    LET_GO,
    MEDIAN,
    OPENED,
    P99,
    STOPPED,
    LateSlices,
    figure,
    lost_columns,
    lost_datasets,
    spread,
)

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

FELL = "the object fell"
WHERE_FINGER = " (first finger)", " (second finger)"


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


@dataclass
class RecordedGrasp(RecordedFinger):
    """The recorded data of a real-time grasp, including its first finger, and why it ended."""

    end_ms: int  # planned end
    second: RecordedFinger | None = None
    ended: str = ""
    error: Exception | None = None
    step_late_us: "array[float]" = field(default_factory=lambda: array("d"))
    latency_us: "array[float]" = field(default_factory=lambda: array("d"))
    steps: TrialBuffer = field(default_factory=TrialBuffer)  # columns of the controller's steps that the outcome needs
    truth: TrialBuffer = field(default_factory=TrialBuffer)  # ground truth of a virtual world
    truths: int = 0  # number of slices with known ground truth
    world_over: bool = False
    controller: ControllerEnded | None = None  # its final message
    controller_hung: str = ""  # sentence, if it hung
    torque: str = ""  # sentence on its state at the end

    @property
    def fingers(self) -> tuple[RecordedFinger, ...]:
        """The first finger, and the second if it has a camera."""
        return (self,) if self.second is None else (self, self.second)

    @property
    def has_steps(self) -> bool:
        """Whether enough was recorded to write a file."""
        return bool(self.slices and self.steps.rows)

    def datasets(self) -> dict[str, Any]:
        """Return the datasets capture/...: why it ended, losses and timing."""
        rows: dict[str, Any] = {"capture/ended": self.ended, **self.camera_datasets()}
        for name in ("step_late_us", "latency_us"):
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
        if controller is not None:
            rows |= lost_datasets({f"gripper.{why}": count for why, count in controller.counted.items()})
        if self.second is not None:
            rows["control/second_probability"] = self._second_probability(self.second)
        return rows

    def second_datasets(self) -> dict[str, Any]:
        """Return the datasets of the second finger's file, with the offset of its camera's clock."""
        assert self.second is not None
        rows: dict[str, Any] = {"capture/ended": self.ended, **self.second.camera_datasets()}
        if not math.isnan(self.clock_offset_us):
            rows["capture/clock_offset_us"] = np.float64(self.clock_offset_us)
        return rows

    @property
    def clock_offset_us(self) -> float:
        """Time from time 0 of the first camera to that of the second; NaN if unknown."""
        return math.nan if self.second is None else self.second.zero_us - self.zero_us

    def _second_probability(self, second: RecordedFinger) -> NDArray[np.float32]:
        """Return the second detector's probabilities, one per slice of the first finger.

        Each is that of the second finger's last slice that had ended by the end of the first finger's slice.
        """
        offset_ms = 0.0 if math.isnan(self.clock_offset_us) else self.clock_offset_us / SLICE_US
        last = np.floor(np.arange(1, self.slices + 1) - offset_ms).astype(np.int64) - 1
        probabilities = np.append(np.frombuffer(second.probability, np.float32), np.float32(math.nan))
        last[last >= len(probabilities) - 1] = len(probabilities) - 2
        row: NDArray[np.float32] = probabilities[np.maximum(last, -1)]
        return row

    def take_steps(self, rows: list[dict[str, Any]], writer: RecordingWriter, view: LiveView | None = None) -> None:
        """Write steps of the controller, and keep the columns that the outcome needs."""
        for row in rows:
            writer.append_rows(row)
            if view is not None:
                view.add_command(row)
            self.steps.append_rows({name: row[name] for name in grasp_outcome.NEEDED if name in row})
            self.step_late_us.append(row["control/late_us"])
            if row["control/phase"] != GraspPhase.CONTACT and not math.isnan(row["control/latency_us"]):
                self.latency_us.append(row["control/latency_us"])  # during contact the law does not react to slip

    def take_slices(
        self, batch: SliceBatch, writer: RecordingWriter, now_s: float = -math.inf, view: LiveView | None = None
    ) -> None:
        """Write slices of the camera, except those after the end of a virtual world. now_s: time of arrival."""
        most = self.truths if self.world_over else None
        wanted = self.take(batch, writer, most, now_s, {"control/probability": batch.probability})
        if view is None:
            return
        events, first = batch.events, 0
        for count, late_us, probability in zip(batch.counts[:wanted], batch.late_us, batch.probability, strict=False):
            view.add_slice(events.part(first, first + count), late_us, probability)
            first += count
        if batch.counted is not None:
            view.lost({f"camera.{why}": count for why, count in batch.counted.items()})

    def take_second(self, batch: SliceBatch, writer: RecordingWriter, now_s: float) -> None:
        """Write slices of the second finger's camera, except those after the end of the grasp."""
        assert self.second is not None
        offset_ms = 0.0 if math.isnan(self.clock_offset_us) else self.clock_offset_us / SLICE_US
        most = self.end_ms - round(offset_ms)
        if self.world_over:
            most = min(most, self.truths)
        wanted = self.second.take(batch, writer, most, now_s, {})
        self.second.probability.extend(batch.probability[:wanted])

    def take_truth(self, rows: Mapping[str, NDArray[Any]] | None) -> None:
        """Store the ground truth of some slices of a virtual world; None at its end, also if the object has fallen."""
        if rows is None:
            self.world_over = True
            return
        for name, values in rows.items():
            self.truth.rows.setdefault(name, []).extend(values)
        self.truths += len(next(iter(rows.values())))

    def must_stop(self) -> bool:
        """Return whether something happened that must end the other processes now."""
        if self.world_over and self.truths < self.end_ms and not self.ended:
            self.ended = FELL
        if self.controller is not None and self.controller.ended != OVER:
            return True
        for each in self.fingers:
            if each.detector_died or (each.detector is not None and each.detector.error is not None):
                return True
        if self.second is not None and self.controller is not None and self.detector is not None:
            return True  # the second detector runs until it is stopped
        return bool(self.ended) and self.ended != OPENED  # in that case the controller ends by itself

    def conclude(self, processes: GraspProcesses, world: "VirtualWorld | None" = None) -> None:
        """Determine why the grasp ended, from the final messages of detector and controller, or from their absence.

        world: the virtual world, if any: the detector notices that it has gone, but does not know why.
        """
        controller = self.controller
        if controller is not None:
            self.torque = controller.torque
        if controller is None:
            exit_ = processes.exit_words(processes.controller)
            died = f"the controller died ({exit_})" if exit_ else "the controller did not end"
            self.torque = self.torque or processes.switch_off()
            self.error = DeviceError(f"{self.controller_hung or died}; {self.torque}")
        elif (
            controller.error is None or DETECTOR in controller.ended  # otherwise the controller failed first
        ) and (died := self._detector_deaths(processes)):
            self.error = DeviceError(f"{died}; {self.torque}")
        else:
            self.error = next(filter(None, self._detector_errors()), controller.error)
            if world is not None and world.has_died:
                self.error = world.died()
            if isinstance(self.error, EvetacError) and "torque" not in str(self.error):
                self.error.message += f"; {self.torque}"
        opened = controller is not None and self.ended == OPENED == controller.ended
        if opened or (controller is not None and self.ended in (INTERRUPTED, LET_GO, STOPPED, ABORTED, FELL)):
            self.error = None
        else:
            self.ended = str(self.error).splitlines()[0] if self.error or controller is None else controller.ended

    def _detector_deaths(self, processes: GraspProcesses) -> str:
        """Return a sentence on a detector that died without a final message; "" if none did."""
        for finger, (each, process) in enumerate(zip(self.fingers, processes.detectors, strict=True)):
            if each.detector is None and (exit_ := processes.exit_words(process)):
                return f"{DETECTOR}{'' if self.second is None else OF_FINGER[finger]} died ({exit_})"
        return ""

    def _detector_errors(self) -> list[Exception | None]:
        """Return the errors of the detectors; with two, each names its finger."""
        errors = [None if each.detector is None else each.detector.error for each in self.fingers]
        for finger, error in enumerate(errors):
            if self.second is not None and isinstance(error, EvetacError):
                error.message = f"{error.message}{WHERE_FINGER[finger]}"
        return errors

    def outcome(self, mm_per_px: float) -> dict[str, Any] | None:
        """Return the success of each phase and other figures, as in simulation; None without enough ground truth."""
        steps, (truth, *others) = self.steps.row_arrays(), self.truth_arrays()
        if not truth or not steps or not (steps["control/phase"] == GraspPhase.CONTACT).any():
            return None
        second_slip_share = others[0].get("truth/visible_slip_share") if others else None
        rows = {**steps, **truth}
        return grasp_outcome.outcome(rows, mm_per_px, self.end_ms, second_slip_share=second_slip_share)

    def truth_arrays(self) -> tuple[dict[str, Any], ...]:
        """Return the ground truth of the recorded slices of each finger.

        Empty for a finger if some slices have none.
        """
        arrays: list[dict[str, Any]] = []
        for finger, each in enumerate(self.fingers):
            if not each.slices or self.truths < each.slices:
                arrays.append({})
                continue
            buffer = TrialBuffer(rows=of_finger(self.truth.rows, finger))
            arrays.append({name: rows[: each.slices] for name, rows in buffer.row_arrays().items()})
        return tuple(arrays)


def result_of(
    trial: DeviceGrasp,
    recipe: Recipe,
    recorded: RecordedGrasp,
    datasets: Mapping[str, Any],
    grasp_outcome: Mapping[str, Any],
    saved: Path | None,
    say: Callable[[str], None],
    *,
    interrupted: bool,
) -> Outcome:
    """Return the row of a grasp; an error or Ctrl-C is raised again here with the saved files."""
    result = None
    if recorded.has_steps:
        result = _row(trial, recipe, recorded, datasets, grasp_outcome)
        if result.rows[0]["too_slow"] is not None:
            say(result.rows[0]["too_slow"])
    words = f"{recorded.slices:,} slices in {session.place(saved)}" if saved else "nothing was recorded"
    session.raise_end(recorded.error, recorded.ended, words, result, recorded.torque, interrupted=interrupted)
    if result is None and recorded.ended == STOPPED:
        return Outcome([], recipe.simulated, made=False)
    if result is None:
        raise DeviceError("the grasp ended before its first step", found=recorded.ended)
    return result


def _row(
    trial: DeviceGrasp,
    recipe: Recipe,
    recorded: RecordedGrasp,
    datasets: Mapping[str, Any],
    grasp_outcome: Mapping[str, Any],
) -> Outcome:
    """Return the figures of a grasp that has a file."""
    late, commands = recorded.late_slices, len(recorded.step_late_us)
    too_slow = session.too_slow(datasets, recorded.slices, late, commands, recorded.behind_s)
    return outcome(
        trial,
        made=True,
        simulated=recipe.simulated,
        slices=recorded.slices,
        ended=recorded.ended,
        latency_us_median=figure(datasets, "latency_us", MEDIAN),
        latency_us_p99=figure(datasets, "latency_us", P99),
        step_late_us_p99=figure(datasets, "step_late_us", P99),
        command_us_median=figure(datasets, "command_us", MEDIAN),
        slices_per_s=figure(datasets, "slices_per_s"),
        commands_per_s=figure(datasets, "commands_per_s"),
        **_of_second(trial, recorded),
        commands=commands,
        command_misses=_whole(datasets.get("capture/command_misses")),
        command_misses_by_gripper=_whole(datasets.get("capture/command_misses_by_gripper")),
        latencies=len(recorded.latency_us),
        late_slices=late.count,
        recorder_behind_s=recorded.behind_s,
        too_slow=too_slow,
        detector_core_share=None if recorded.detector is None else recorded.detector.core_share,
        scheduling=datasets["capture/scheduling"],
        **lost_columns(datasets),
        **grasp_outcome,
    )


def _of_second(trial: DeviceGrasp, recorded: RecordedGrasp) -> dict[str, Any]:
    """Return the figures of the second finger, if it has a camera."""
    if recorded.second is None:
        return {}
    datasets, second = recorded.second_datasets(), recorded.second
    return {
        "second_output": str(trial.outputs[1]) if second.slices else None,
        "second_slices": second.slices,
        "second_slices_per_s": float(datasets.get("capture/slices_per_s", math.nan)),
        "second_slice_late_us_p99": figure(datasets, "slice_late_us", P99),
        "second_late_slices": second.late_slices.count,
        "second_detector_core_share": None if second.detector is None else second.detector.core_share,
        **{f"second_{name}": value for name, value in lost_columns(datasets).items()},
        "clock_offset_us": recorded.clock_offset_us,
    }


def _whole(value: Any) -> int | None:
    return None if value is None else int(value)
