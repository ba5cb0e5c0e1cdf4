"""The third process of a real-time grasp: it supervises detector and controller, and records what they send.

It never delays them, and they never wait for it, but a grasp only continues while the recorder is alive. It is the
parent of the others, so one sign of life covers both. It knows why the grasp ended: it was over, Ctrl-C or the
emergency key ended it, or something failed. The file states the reason in every case.

The loop here supervises and is fast; a thread with lower priority than all others writes. Data may
wait in several places, so that a recorder without core or disk time loses nothing. There is room for 192 MB of events
in this process, 1 MB in the pipe, and 64 MB in the detector's process, which then ends the grasp. At a million events
per second this lasts 20 s.
"""

import contextlib
import math
import os
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from evetac_cli.realtime.emergency_key import EmergencyKey
from evetac_cli.realtime.processes import raised_priority, set_niceness
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.trials.grasp.detector_process import SliceBatch
from evetac_cli.trials.grasp.grasp_processes import END_S, POLL_S, GraspProcesses
from evetac_cli.trials.grasp.recorded_grasp import RecordedFinger, RecordedGrasp
from evetac_cli.trials.live_view import LiveView
from evetac_cli.trials.session import INTERRUPTED, LET_GO, OPENED

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld
    from evetac_cli.trials.listen.trial_requests import TrialRequests

PRIORITY = 20  # priority of the supervising loop, below servo and controller: it uses some hundredths of a core
LAST_S = 0.5  # time for one process to end by itself after the other has ended
ALIVE_S = 0.005  # interval between signs of life of the supervising loop
STOP_S = 0.05  # how long a robot's `stop` waits for the current slice: torque must not wait for a slow disk
SWITCH_S = 5e-4  # after this time the writing thread yields to the loop
MOST_BYTES = 192 << 20  # limit of waiting data: at 13 bytes per event, 15 s at a million events per s
WAIT_S = 0.1  # interval at which to check whether the main thread was interrupted


@dataclass(eq=False)
class GraspRecorder:
    """What the recorder's process knows of a grasp while the other processes run.

    writers: one per finger's file; signals: grows when Ctrl-C is pressed; key: opens the gripper.

    view: shows the first finger of the grasp, and its button releases the gripper; niceness: of the writing thread.

    requests: for a robot's program, which may mark and end the grasp.
    """

    processes: GraspProcesses
    world: "VirtualWorld | None"
    writers: Sequence[RecordingWriter]
    end_ms: int
    signals: list[int]
    key: EmergencyKey
    progress: Callable[[int], None]
    view: LiveView | None = None
    niceness: int = 0
    requests: "TrialRequests | None" = None
    _received: int = field(default=0, init=False)  # slices of the first finger, some of which may wait to be written
    _heard_s: float = field(default=-math.inf, init=False)  # time of the last message: who still sends is waited for

    def record(self) -> RecordedGrasp:
        """Write until all processes have ended; the result contains their failures. A failure in writing is raised."""
        second = RecordedFinger() if len(self.writers) > 1 else None
        self._recorded = RecordedGrasp(end_ms=self.end_ms, second=second)
        interval_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            with WritingThread(self._write, self.niceness) as self._writing, raised_priority(PRIORITY):
                self._watch()
        finally:
            sys.setswitchinterval(interval_s)
        self._write_marks(last=True)
        self._take_last_truths()
        self._recorded.conclude(self.processes, self.world)
        return self._recorded

    def _write(self, message: Any) -> None:
        if not isinstance(message, SliceBatch):
            self._recorded.take_steps(message, self.writers[0], self.view)
        elif message.finger:
            self._recorded.take_second(message, self.writers[1], self.processes.now_s())
        else:
            self._recorded.take_slices(message, self.writers[0], self.processes.now_s(), self.view)
            self._write_marks()

    def _write_marks(self, *, last: bool = False) -> None:
        for row in () if self.requests is None else self.requests.marked(last=last):
            self.writers[0].append_rows(row)

    def _watch(self) -> None:
        """Take incoming messages, and end processes that must end, until all have ended."""
        processes, recorded = self.processes, self._recorded
        first_end_s = stopped_s = math.inf
        while not (all(inbox.ended for inbox in processes.slices) and processes.steps.ended):
            now_s = self._take_messages()
            if now_s > max(stopped_s, self._heard_s) + END_S:  # nothing is waiting now, even if this loop is late
                break
            self._writing.check()
            if recorded.slices:
                self.progress(recorded.slices)
            if processes.steps.ended or any(inbox.ended for inbox in processes.slices):
                first_end_s = min(first_end_s, now_s)
            for inbox, finger in zip(processes.slices, recorded.fingers, strict=True):
                finger.detector_died = inbox.ended and finger.detector is None
            self._end_on_request()
            if recorded.controller is None and not recorded.torque:
                if not processes.steps.ended:
                    recorded.controller_hung = processes.end_hanging_controller()
                if processes.steps.ended or recorded.controller_hung:
                    recorded.torque = processes.switch_off()
            if stopped_s == math.inf and (recorded.must_stop() or now_s > first_end_s + LAST_S):
                processes.status.stop()
                stopped_s = now_s

    def _take_messages(self) -> float:
        """Wait for messages for ALIVE_S at most, give a sign of life, and take them; return the time of the sign."""
        processes, recorded, writing = self.processes, self._recorded, self._writing
        truths = None if self.world is None else self.world.truths
        slices = () if writing.is_full else processes.slices  # then slices wait in the detectors
        inboxes = [inbox for inbox in (*slices, processes.steps, truths) if inbox is not None and not inbox.ended]
        readable = select.select(inboxes, [], [], ALIVE_S)[0]
        processes.give_sign_of_life()
        now_s = time.monotonic()
        if writing.is_full or any(inbox is not truths for inbox in readable):
            self._heard_s = now_s
        for message in truths.take() if truths is not None else ():
            recorded.take_truth(message)
        for inbox, finger in zip(slices, recorded.fingers, strict=False):
            for message in inbox.take():
                if not isinstance(message, SliceBatch):
                    finger.detector = message
                    continue
                self._received += len(message.counts) if finger is recorded else 0
                writing.put(message, message.size)
        for message in processes.steps.take():
            if isinstance(message, list):
                writing.put(message)
            else:
                recorded.controller = message
        return now_s

    def _end_on_request(self) -> None:
        """Let the grasp end if a robot's program, Ctrl-C, the live view or the emergency key asks for it."""
        recorded, view = self._recorded, self.view
        if self.requests is not None and not recorded.ended:
            recorded.ended = self._asked_to_end(self.requests)
        if self.signals and not recorded.ended:
            recorded.ended = INTERRUPTED
        if view is not None and view.is_asked_to_let_go and not recorded.ended:
            recorded.ended = LET_GO
        if self.key.pressed and not recorded.ended:
            recorded.ended = OPENED
            self.processes.status.open_gripper()

    def _asked_to_end(self, requests: "TrialRequests") -> str:
        """Return why a robot's program ends the grasp, "" if it does not."""
        if not self._recorded.slices:
            return requests.end_reason
        return requests.recorded(self._received, self.processes.now_s, self._recorded.zero_us, patience_s=STOP_S)

    def _take_last_truths(self) -> None:
        """Take the ground truth of the last slices, which may arrive after them."""
        truths = None if self.world is None else self.world.truths
        until_s = time.monotonic() + END_S
        while (
            truths is not None
            and not truths.ended
            and self._recorded.truths < self._recorded.slices
            and time.monotonic() < until_s  # a world that still sends is waited for
        ):
            select.select([truths], [], [], POLL_S)
            for message in truths.take():
                self._recorded.take_truth(message)
                until_s = time.monotonic() + END_S


class WritingThread(threading.Thread):
    """Passes messages, in order, to a function that may be slow, at lowest priority; used as a context manager.

    A grasp must not end because a disk or a core is waited for, and code that can be so late must not be responsible
    for Ctrl-C and the emergency key. So messages wait here, in memory of bounded size, and are written as time permits.

    The two threads share an interpreter. HDF5 holds it while it packs, not while the disk takes the bytes, and a thread
    that loses its core keeps the interpreter. This was measured on two cores with 18 processes that wanted one. With a
    continuously writing thread at normal niceness, a loop of 5 ms at real-time priority came up to 50 ms late (21 to
    29 ms at p99). With niceness 15, which is for virtual devices, it came 0.7 s late. So a late sign of life alone ends
    no grasp (controller_process.py).
    """

    def __init__(self, write: Callable[[Any], None], niceness: int, most_bytes: int = MOST_BYTES) -> None:
        """niceness: of this thread only, where permitted; most_bytes: above this, no more should be put."""
        super().__init__(name="writes the recording", daemon=True)
        self._write = write
        self._niceness = niceness
        self._most_bytes = most_bytes
        self._waiting: deque[tuple[Any, int]] = deque()
        self._changed = threading.Condition()
        self._ends = False
        self._error: BaseException | None = None
        self.waiting_bytes = 0

    def __enter__(self) -> "WritingThread":
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait until everything is written, or after a failure in the block until the current write is done."""
        try:
            self._end(drop=kind is not None)
        except BaseException:  # a second Ctrl-C: waiting messages are dropped
            self._end(drop=True)
            raise
        if kind is None:
            self.check()

    @property
    def is_full(self) -> bool:
        """Whether the limit of waiting data is reached; new data should then wait at their source."""
        return self.waiting_bytes >= self._most_bytes

    def put(self, message: Any, size: int = 0) -> None:
        """Queue a message with this number of bytes."""
        with self._changed:
            self._waiting.append((message, size))
            self.waiting_bytes += size
            self._changed.notify()

    def check(self) -> None:
        """Raise the error that writing failed with, for example a full disk."""
        if self._error is not None:
            raise self._error

    def _end(self, *, drop: bool) -> None:
        with self._changed:
            self._ends = True
            if drop:
                self._waiting.clear()
            self._changed.notify()
        while self.is_alive():
            self.join(WAIT_S)

    def run(self) -> None:
        """Write until the block is over, or writing fails."""
        if (
            sys.platform == "linux"
        ):  # on Linux both settings apply to this thread only; it may have inherited another priority
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            set_niceness(self._niceness)
        try:
            while (message := self._next()) is not None:
                self._write(message)
        except BaseException as error:  # raised in the thread that puts messages
            self._error = error

    def _next(self) -> Any:
        """Return the next message; None at the end."""
        with self._changed:
            while not self._waiting and not self._ends:
                self._changed.wait()
            if not self._waiting:
                return None
            message, size = self._waiting.popleft()
            self.waiting_bytes -= size
            return message
