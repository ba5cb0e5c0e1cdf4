"""The third process of a grasp in real time: starts detector and controller, and records what they send.

It never keeps them waiting, and they never wait for it; but a grasp goes on only while it is alive. It is the parent of
the others, so one sign of life stands for both, and the loop that records is the only one that gives it. It knows why
the grasp ended: because it was over, because of Ctrl-C or the emergency key, or because something failed; the file says
so in any case. Where the controller died or hangs, it ends the controller, switches torque off and reads it back.
"""

import contextlib
import math
import multiprocessing
import select
import time
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.interrupts import signals_held
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.realtime.emergency_key import EmergencyKey
from evetac_cli.realtime.last_words import LastWords, exit_words, telling
from evetac_cli.realtime.message_pipe import MessageReader
from evetac_cli.realtime.processes import start_shielded
from evetac_cli.realtime.shared_status import SharedStatus
from evetac_cli.sim import grasp_outcome
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials.grasp import controller_process, detector_process
from evetac_cli.trials.grasp.controller_process import DETECTOR, OVER, ControllerEnded, ControllerSettings, GripperReady
from evetac_cli.trials.grasp.detector_process import CameraReady, DetectorEnded, DetectorSettings, SliceBatch
from evetac_cli.trials.live_view import LiveView
from evetac_cli.trials.session import (
    INTERRUPTED,
    LET_GO,
    OPENED,
    LateSlices,
    lost_datasets,
    spread,
)

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

HANGS_S = 0.5  # a controller without a sign of life for so long, or some times the watchdog's time, is ended
HANGS_WATCHDOGS = 4
OPENING_S = 2.0  # so much longer while it opens the gripper
LOAD_S = 120.0  # in which both must be ready, compiling included
OPEN_S = 30.0  # in which the camera must run
LAST_S = 0.5  # for the one to end by itself, once the other has ended
END_S = 3.0
POLL_S = 0.05
ALIVE_S = 0.005  # the loop that records gives a sign of life as often as this
FELL = "the object fell"
_T = TypeVar("_T")


class GraspProcesses:
    """Detector and controller, each in a process of its own; closing them switches torque off."""

    def __init__(
        self, detector: DetectorSettings, controller: ControllerSettings, world: "VirtualWorld | None"
    ) -> None:
        """Start both; they load, and wait for `begin`."""
        context = multiprocessing.get_context("spawn")
        self.status = SharedStatus()
        self._settings = controller
        self.now_s = controller.time.now_s
        self._hangs_us = 1e6 * max(HANGS_S, HANGS_WATCHDOGS * 1e-3 * controller.watchdog_ms)
        self._began_us = math.inf
        self._orders = []  # to the detector and to the controller
        theirs = []
        for _ in range(2):
            order, ours = context.Pipe(duplex=False)
            self._orders.append(ours)
            theirs.append(order)
        slices, slices_end = context.Pipe(duplex=False)
        steps, steps_end = context.Pipe(duplex=False)
        detector_end, alive = context.Pipe(duplex=False)  # nothing is sent: it ends when the detector does
        self.slices, self.steps = MessageReader(slices), MessageReader(steps)
        self._words = LastWords(), LastWords()
        self.detector = context.Process(
            target=telling,
            args=(
                *(self._words[0], detector_process.run_detector),
                *(detector, self.status, world, theirs[0], slices_end, alive),
            ),
            name="evetac-detector",
        )
        self.controller = context.Process(
            target=telling,
            args=(
                *(self._words[1], controller_process.run_controller),
                *(controller, self.status, theirs[1], steps_end, detector_end),
            ),
            name="evetac-controller",
        )
        for process in (self.detector, self.controller):
            process.daemon = True
            start_shielded(process)
        # Our copies of their ends; else a pipe would not end with the process at its other end.
        for end in (*theirs, slices_end, steps_end, detector_end, alive):
            end.close()

    def begin(self, signals: list[int]) -> tuple[CameraReady, GripperReady]:
        """Open the gripper once the detector has loaded, then the camera; what they are. EvetacError if one fails.

        Nothing moves before `go`. signals: grows when Ctrl-C is pressed.
        """
        self._wait_for(str, self.slices, self.detector, LOAD_S, signals)
        self._order(1, "begin")
        gripper = self._wait_for(GripperReady, self.steps, self.controller, LOAD_S, signals)
        self._order(0, "begin")
        return self._wait_for(CameraReady, self.slices, self.detector, OPEN_S, signals), gripper

    def go(self) -> None:
        """Let the detector begin, upon which the controller moves the gripper; from now on it needs signs of life."""
        self.give_sign_of_life()
        self._began_us = self.now_s() * 1e6
        self._order(0, "go")

    def _order(self, whom: int, order: str) -> None:
        with contextlib.suppress(OSError):  # it has died, which whoever waits for its answer finds out
            self._orders[whom].send(order)

    def give_sign_of_life(self) -> None:
        """For the loop that records: it is alive."""
        self.status.recorder_lives(self.now_s() * 1e6)

    def end_hanging_controller(self) -> str:
        """End a controller that gives no sign of life; for how long it did not, in words, "" if it does."""
        patience_us = self._hangs_us + 1e6 * OPENING_S * self.status.opening
        silent_us = self.now_s() * 1e6 - max(self.status.controller_us, self._began_us)
        if not silent_us > patience_us:
            return ""
        self.controller.kill()
        return f"the controller hangs: no sign of life for {silent_us * 1e-6:.1f} s"

    def switch_off(self) -> str:
        """Torque off, once the controller has ended without saying what torque is; in words, what was read back.

        The port is free once the process has ended.
        """
        self.controller.kill()
        self.controller.join(END_S)
        return self._settings.gripper.release(self._settings.port, self._settings.driver)

    def _wait_for(self, kind: type[_T], inbox: MessageReader, process: Any, most_s: float, signals: list[int]) -> _T:
        """The first message of a kind; what went wrong before it comes is raised."""
        until_s = time.monotonic() + most_s
        while time.monotonic() < until_s and not signals:
            select.select([inbox], [], [], POLL_S)
            for message in inbox.take():
                if isinstance(message, kind):
                    return message
                if isinstance(message, (DetectorEnded, ControllerEnded)) and message.error is not None:
                    raise message.error
            if inbox.ended:
                torque = f"; {self.switch_off()}" if process is self.controller else ""
                raise DeviceError(f"{process.name} died while it started{torque}", found=self.exit_words(process))
        if signals:
            raise KeyboardInterrupt("interrupted: nothing was recorded")
        raise DeviceError(f"{process.name} did not come up", expected=f"within {most_s:g} s")

    def exit_words(self, process: Any) -> str:
        """How one of the two ended, in words; "" if it has not within a second."""
        return exit_words(process, self._words[process is self.controller])

    def close(self) -> None:
        """End both; torque is off afterwards, or the servo's watchdog sees to it. Signals wait until then."""
        with signals_held():
            self._close()

    def _close(self) -> None:
        self.status.stop()
        for orders in self._orders:
            orders.close()
        for process in (self.controller, self.detector):
            process.join(END_S)
            if process.is_alive():
                process.kill()
                process.join()

    def last_words(self) -> str:
        """What torque is once both were closed; for whoever broke off recording."""
        ended = [message for message in self.steps.take() if isinstance(message, ControllerEnded)]
        return ended[-1].torque if ended else self.switch_off()


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
        first = 0
        for k, count in enumerate(batch.counts):
            if self.world_over and self.slices >= self.truths:
                break
            events = batch.events.part(first, first + count)
            writer.append(events, {"control/probability": batch.probability[k]})
            if view is not None:
                view.add_slice(events, batch.late_us[k], batch.probability[k])
            first += count
            self.first_us = batch.at_us[k] if not self.slices else self.first_us
            self.last_us = batch.at_us[k]
            self.slice_late_us.append(batch.late_us[k])
            self.late_slices.add(batch.late_us[k], count)
            self.slices += 1
        self.events += first
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
        opened = controller is not None and self.ended == OPENED == controller.ended
        if opened or (controller is not None and self.ended in (INTERRUPTED, LET_GO, FELL)):
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


def record(
    processes: GraspProcesses,
    world: "VirtualWorld | None",
    writer: RecordingWriter,
    end_ms: int,
    signals: list[int],
    key: EmergencyKey,
    progress: Callable[[int], None],
    view: LiveView | None = None,
) -> RecordedGrasp:
    """Write until both have ended; what failed is in the result.

    signals: grows when Ctrl-C is pressed; key: opens the gripper; view: shows the grasp, and its button lets go.
    """
    recorded = RecordedGrasp(end_ms)
    truths = None if world is None else world.truths
    first_end_s = stopped_s = math.inf
    heard_s = -math.inf  # when a message last came: who sends goes on being waited for, also where writing is slow
    while not (processes.slices.ended and processes.steps.ended) and time.monotonic() < max(stopped_s, heard_s) + END_S:
        inboxes = [
            inbox for inbox in (processes.slices, processes.steps, truths) if inbox is not None and not inbox.ended
        ]
        select.select(inboxes, [], [], ALIVE_S)
        processes.give_sign_of_life()
        for message in truths.take() if truths is not None else ():
            recorded.take_truth(message)
        for message in processes.slices.take():
            if isinstance(message, SliceBatch):
                recorded.take_slices(message, writer, processes.now_s(), view)
                progress(recorded.slices)
            else:
                recorded.detector = message
            heard_s = time.monotonic()
        processes.give_sign_of_life()  # a segment may have been written, which takes a while
        for message in processes.steps.take():
            if isinstance(message, list):
                recorded.take_steps(message, writer, view)
            else:
                recorded.controller = message
            heard_s = time.monotonic()
        now_s = time.monotonic()
        if processes.slices.ended or processes.steps.ended:
            first_end_s = min(first_end_s, now_s)
        recorded.detector_died = processes.slices.ended and recorded.detector is None
        if signals and not recorded.ended:
            recorded.ended = INTERRUPTED
        if view is not None and view.is_asked_to_let_go and not recorded.ended:
            recorded.ended = LET_GO
        if key.pressed and not recorded.ended:
            recorded.ended = OPENED
            processes.status.open_gripper()
        if recorded.controller is None and not recorded.torque:
            if not processes.steps.ended:
                recorded.controller_hung = processes.end_hanging_controller()
            if processes.steps.ended or recorded.controller_hung:
                recorded.torque = processes.switch_off()
        if stopped_s == math.inf and (recorded.must_stop() or now_s > first_end_s + LAST_S):
            processes.status.stop()
            stopped_s = now_s
    until_s = time.monotonic() + END_S
    while (
        truths is not None
        and not truths.ended
        and recorded.truths < recorded.slices
        and time.monotonic() < until_s  # a world that sends goes on being waited for
    ):
        select.select([truths], [], [], POLL_S)
        for message in truths.take():
            recorded.take_truth(message)
            until_s = time.monotonic() + END_S
    recorded.conclude(processes, world)
    return recorded
