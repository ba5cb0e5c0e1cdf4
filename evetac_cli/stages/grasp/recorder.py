"""The third process of a grasp in real time: starts detector and controller, and writes down what they say.

It never keeps them waiting, and they never wait for it. It knows why the grasp ended: because it was over, because
somebody pressed Ctrl-C, or because something failed; the file says so in any case.
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

from evetac_cli.errors import DeviceError
from evetac_cli.kernels.grip.paper import Phase
from evetac_cli.realtime.message_pipe import MessageReader
from evetac_cli.realtime.processes import start_shielded
from evetac_cli.realtime.shared_status import SharedStatus
from evetac_cli.sim import grasp_outcome
from evetac_cli.stages.grasp import controller_process, detector_process
from evetac_cli.stages.grasp.controller_process import OVER, Commanding, CommandingEnded, Ready
from evetac_cli.stages.grasp.detector_process import Feeling, FeelingEnded, Piece, Seen
from evetac_cli.stages.grasp.loop import TrialBuffer
from evetac_cli.stages.record.capture import INTERRUPTED, LOST, spread
from evetac_cli.store.segments import RecordingWriter

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

LOAD_S = 120.0  # in which both must be ready, compiling included
OPEN_S = 30.0  # in which the camera must run
LAST_S = 0.5  # that one of both has, once the other has ended, to end by itself
END_S = 3.0
LOOK_S = 0.05
ALIVE = "it is still there"
FELL = "the object fell"
_T = TypeVar("_T")


class Loops:
    """Detector and controller, each in a process of its own; closing them switches torque off."""

    def __init__(self, feeling: Feeling, commanding: Commanding, world: "VirtualWorld | None") -> None:
        """Start both; they load, and wait for `begin`."""
        context = multiprocessing.get_context("spawn")
        self.board = SharedStatus()
        self._orders = []  # to the detector and to the controller
        theirs = []
        for _ in range(2):
            heard, ours = context.Pipe(duplex=False)
            self._orders.append(ours)
            theirs.append(heard)
        seen, seeing = context.Pipe(duplex=False)
        done, doing = context.Pipe(duplex=False)
        detector, alive = context.Pipe(duplex=False)  # nothing is sent: it ends when the detector does
        self.seen, self.done = MessageReader(seen), MessageReader(done)
        self.detector = context.Process(
            target=detector_process.live,
            args=(feeling, self.board, world, theirs[0], seeing, alive),
            name="evetac-detector",
        )
        self.controller = context.Process(
            target=controller_process.live,
            args=(commanding, self.board, theirs[1], doing, detector),
            name="evetac-controller",
        )
        for process in (self.detector, self.controller):
            process.daemon = True
            start_shielded(process)
        for end in (
            *theirs,
            seeing,
            doing,
            detector,
            alive,
        ):  # ours; else a pipe would not end with the process at its other end
            end.close()

    def begin(self, came: list[int]) -> tuple[Seen, Ready]:
        """Open the gripper once the detector has loaded, then the camera; what they are. EvetacError if one fails.

        Nothing moves before `go`.
        """
        self._wait_for(str, self.seen, self.detector, LOAD_S, came)
        self._orders[1].send("begin")
        ready = self._wait_for(Ready, self.done, self.controller, LOAD_S, came)
        self._orders[0].send("begin")
        return self._wait_for(Seen, self.seen, self.detector, OPEN_S, came), ready

    def go(self) -> None:
        """Let the detector feel, upon which the controller moves the gripper."""
        with contextlib.suppress(OSError):  # it has died, which is told to who records
            self._orders[0].send("go")

    @staticmethod
    def _wait_for(kind: type[_T], inbox: MessageReader, process: Any, most_s: float, came: list[int]) -> _T:
        until_s = time.monotonic() + most_s
        while time.monotonic() < until_s and not came:
            select.select([inbox], [], [], LOOK_S)
            for message in inbox.take():
                if isinstance(message, kind):
                    return message
                if isinstance(message, (FeelingEnded, CommandingEnded)) and message.error is not None:
                    raise message.error
            if inbox.ended:
                raise DeviceError(f"{process.name} died while it started", found=exit_of(process))
        if came:
            raise KeyboardInterrupt("interrupted: nothing was recorded")
        raise DeviceError(f"{process.name} did not come up", expected=f"within {most_s:g} s")

    def close(self) -> None:
        """End both; torque is off afterwards, or the servo's watchdog sees to it."""
        self.board.stop()
        for orders in self._orders:
            orders.close()
        for process in (self.controller, self.detector):
            process.join(END_S)
            if process.is_alive():
                process.kill()
                process.join()


def exit_of(process: Any) -> str:
    """How a process ended."""
    process.join(1.0)
    code = process.exitcode
    return ALIVE if code is None else f"signal {-code}" if code < 0 else f"exit code {code}"


@dataclass
class Recorded:
    """What a grasp in real time amounts to."""

    end_ms: int  # when it is to be over
    slices: int = 0
    events: int = 0
    ended: str = ""
    error: Exception | None = None
    began_us: float = math.nan  # when the first and the last slice were felt
    last_us: float = math.nan
    slice_late_us: "array[float]" = field(default_factory=lambda: array("d"))
    step_late_us: "array[float]" = field(default_factory=lambda: array("d"))
    latency_us: "array[float]" = field(default_factory=lambda: array("d"))
    steps: TrialBuffer = field(default_factory=TrialBuffer)  # of the controller: what tells what became of it
    truth: TrialBuffer = field(default_factory=TrialBuffer)  # of a virtual world
    truths: int = 0  # slices whose truth is known
    world_over: bool = False
    died: bool = False  # the detector
    feeling: FeelingEnded | None = None
    commanding: CommandingEnded | None = None

    def figures(self) -> dict[str, Any]:
        """The datasets capture/... that tell how well time was kept."""
        rows: dict[str, Any] = {"capture/ended": self.ended}
        passed_us = self.last_us - self.began_us
        if passed_us > 0:
            rows["capture/slices_per_s"] = np.float64((self.slices - 1) / passed_us * 1e6)
        for name in ("slice_late_us", "step_late_us", "latency_us"):
            if len(getattr(self, name)):
                rows[f"capture/{name}"] = spread(getattr(self, name))
        done = self.commanding
        if done is not None and done.steps:
            rows["capture/command_misses"] = np.int64(done.missed)
            rows["capture/command_us"] = spread(done.cycle_us)
            if done.seconds > 0:
                rows["capture/commands_per_s"] = np.float64((done.steps - 1) / done.seconds)
            if self.error is not None and not math.isnan(done.released_us - done.alive_us):
                rows["capture/released_us"] = np.float64(done.released_us - done.alive_us)
        for name, ended in (("camera", self.feeling), ("gripper", self.commanding)):
            if ended is not None:
                rows |= {f"{LOST}{name}.{why}": np.int64(count) for why, count in ended.counted.items()}
        return rows

    def take_steps(self, rows: list[dict[str, Any]], writer: RecordingWriter) -> None:
        """Steps of the controller, which are written."""
        for row in rows:
            writer.append_rows(row)
            self.steps.append_rows({name: row[name] for name in grasp_outcome.NEEDED if name in row})
            self.step_late_us.append(row["control/late_us"])
            if row["control/phase"] != Phase.CONTACT and not math.isnan(row["control/latency_us"]):
                self.latency_us.append(row["control/latency_us"])  # in contact nobody listens for slip

    def take_slices(self, piece: Piece, writer: RecordingWriter) -> None:
        """Slices of the camera, which are written, but for those after the end of a virtual world."""
        first = 0
        for k, count in enumerate(piece.counts):
            if self.world_over and self.slices >= self.truths:
                break
            writer.append(piece.events.part(first, first + count), {"control/probability": piece.probability[k]})
            first += count
            self.began_us = piece.at_us[k] if not self.slices else self.began_us
            self.last_us = piece.at_us[k]
            self.slice_late_us.append(piece.late_us[k])
            self.slices += 1
        self.events += first

    def take_truth(self, rows: Mapping[str, NDArray[Any]] | None) -> None:
        """Truth of some slices of a virtual world; None once it is over, which it is too when the object has fallen."""
        if rows is None:
            self.world_over = True
            return
        for name, values in rows.items():
            self.truth.rows.setdefault(name, []).extend(values)
        self.truths += len(next(iter(rows.values())))

    def is_to_stop(self) -> bool:
        """Whether something has come up for which the other processes have to end now."""
        if self.world_over and self.truths < self.end_ms and not self.ended:
            self.ended = FELL
        if self.commanding is not None and self.commanding.ended != OVER:
            return True
        if self.died or (self.feeling is not None and self.feeling.error is not None):
            return True
        return bool(self.ended)

    def conclude(self, loops: Loops) -> None:
        """Why it ended, from what both said, or from that they said nothing."""
        feeling, commanding = self.feeling, self.commanding
        if commanding is None:
            died = f"the controller died ({exit_of(loops.controller)}); the servo's own watchdog switches torque off"
            self.error = DeviceError(died)
        elif feeling is None and (exit_ := exit_of(loops.detector)) != ALIVE:
            self.error = DeviceError(f"the detector died ({exit_}); torque is off")
        else:
            self.error = (feeling and feeling.error) or commanding.error
        if self.ended in (INTERRUPTED, FELL):
            self.error = None
        else:
            self.ended = str(self.error).splitlines()[0] if self.error or commanding is None else commanding.ended

    def what_became(self, mm_per_px: float) -> dict[str, Any] | None:
        """Success of each phase and so on, as in simulation; None where there is no truth, or too little of it."""
        steps, truth = self.steps.row_arrays(), self.truth_arrays()
        if not truth or not steps or not (steps["control/phase"] == Phase.CONTACT).any():
            return None
        return grasp_outcome.outcome({**steps, **truth}, mm_per_px, self.end_ms)

    def truth_arrays(self) -> dict[str, Any]:
        """Truth of the slices that were recorded; nothing if some have none."""
        if not self.slices or self.truths < self.slices:
            return {}
        return {name: rows[: self.slices] for name, rows in self.truth.row_arrays().items()}


def record(
    loops: Loops,
    world: "VirtualWorld | None",
    writer: RecordingWriter,
    end_ms: int,
    came: list[int],
    progress: Callable[[int], None],
) -> Recorded:
    """Write until both have ended; what failed is in the result."""
    recorded = Recorded(end_ms)
    truths = None if world is None else world.truths
    first_end_s = stopped_s = math.inf
    while not (loops.seen.ended and loops.done.ended) and time.monotonic() < stopped_s + END_S:
        inboxes = [inbox for inbox in (loops.seen, loops.done, truths) if inbox is not None and not inbox.ended]
        select.select(inboxes, [], [], LOOK_S)
        for message in truths.take() if truths is not None else ():
            recorded.take_truth(message)
        for message in loops.seen.take():
            if isinstance(message, Piece):
                recorded.take_slices(message, writer)
                progress(recorded.slices)
            else:
                recorded.feeling = message
        for message in loops.done.take():
            if isinstance(message, list):
                recorded.take_steps(message, writer)
            else:
                recorded.commanding = message
        now_s = time.monotonic()
        if loops.seen.ended or loops.done.ended:
            first_end_s = min(first_end_s, now_s)
        recorded.died = loops.seen.ended and recorded.feeling is None
        if came and not recorded.ended:
            recorded.ended = INTERRUPTED
        if stopped_s == math.inf and (recorded.is_to_stop() or now_s > first_end_s + LAST_S):
            loops.board.stop()
            stopped_s = now_s
    until_s = time.monotonic() + LAST_S
    while truths is not None and recorded.truths < recorded.slices and time.monotonic() < until_s:
        select.select([truths], [], [], LOOK_S)
        for message in truths.take():
            recorded.take_truth(message)
    recorded.conclude(loops)
    return recorded
