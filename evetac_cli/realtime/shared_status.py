"""The status that the processes of a grasp exchange through shared memory.

The detector writes the slip signal at 1000 Hz, and the controller reads it at 500 Hz. Time stamps next to it allow the
controller to recognize a dead detector or a silent camera, and the age of the signal.

If each of two fingers has a camera, two detectors write, each its own status. The controller reads both, and a signal
combined from both (kernels/grip/control.py).

A new slice with slip wakes a controller that sleeps until its next step (trials/grasp/deadlines.py).

In the other direction, the controller publishes the gripper's position and its goal, for a detector that uses them.

Recorder and controller each write a sign of life. Only the loop that watches or commands writes it: a separate thread
would hide that the loop hangs.
"""

import math
import multiprocessing
from typing import NamedTuple

from evetac_cli.kernels.grip import control
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime.shared_row import SharedRow
from evetac_cli.realtime.shared_time import WakeSignal

REMEMBERED = 32  # latest slices with slip whose times are stored
_SIZE = 1088
_STATUS_AT = (0, 384)  # offset of each finger's status
_STOP_AT, _RECORDER_AT, _CONTROLLER_AT, _OPEN_AT, _GRIPPER_AT = 768, 832, 896, 960, 1024


class DetectorStatus(NamedTuple):
    """The state of the detector; times in us on the host's clock, or a virtual world's (shared_time.py).

    second: the state of the second finger's detector, if there is one; it is published separately.
    """

    signal: SlipSignal
    slices: int  # processed by the detector
    at_us: float  # time of publication
    last_event_us: float  # time of the camera's last event
    zero_us: float  # time at which the recording's time was 0
    slip_us: tuple[float, ...]  # first events of the latest slices with slip, oldest first; up to REMEMBERED
    second: "DetectorStatus | None" = None

    @property
    def fingers(self) -> tuple["DetectorStatus", ...]:
        """The status of the first finger, and of the second, if there is one."""
        return (self,) if self.second is None else (self, self.second)

    @property
    def control_signal(self) -> SlipSignal:
        """The input signal of the control law: that of one finger, or the combination of both."""
        return self.signal if self.second is None else control.both_fingers(self.signal, self.second.signal)

    def slip_began_us(self, seen: int) -> float:
        """Return the first event of the earliest remembered slice with slip after the first `seen` ones.

        NaN if there was none since.
        """
        new = min(self.signal.slips - seen, len(self.slip_us))
        return self.slip_us[-new] if new > 0 else float("nan")


class SharedStatus:
    """The shared memory; may be passed to a process when it is spawned. fingers: number of fingers with a detector."""

    def __init__(self, fingers: int = 1) -> None:
        self._fingers = fingers
        self._block = multiprocessing.get_context("spawn").RawArray("B", _SIZE)
        self.slip_wake = WakeSignal()
        self._attach()

    def _attach(self) -> None:
        memory = memoryview(self._block).cast("B")
        self._sent_slips = 0
        form = f"q{len(SlipSignal._fields) - 1}dq3d{REMEMBERED}d"
        self._status = [SharedRow(memory, start, form) for start in _STATUS_AT[: self._fingers]]
        self._stop = SharedRow(memory, _STOP_AT, "q")
        self._recorder = SharedRow(memory, _RECORDER_AT, "d")
        self._controller = SharedRow(memory, _CONTROLLER_AT, "d")
        self._open = SharedRow(memory, _OPEN_AT, "q")
        self._gripper = SharedRow(memory, _GRIPPER_AT, "2d")

    def __getstate__(self) -> dict[str, object]:
        return {"_block": self._block, "slip_wake": self.slip_wake, "_fingers": self._fingers}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._attach()

    def publish(self, status: DetectorStatus, finger: int = 0) -> None:
        """For the detector of a finger: replace the status that the controller reads; new slip wakes it."""
        slip_us = status.slip_us[-REMEMBERED:]
        padding = (float("nan"),) * (REMEMBERED - len(slip_us))
        self._status[finger].write(*status.signal, *status[1:5], *padding, *slip_us)
        if status.signal.slips > self._sent_slips:
            self._sent_slips = status.signal.slips
            self.slip_wake.send()

    def latest(self) -> DetectorStatus | None:
        """For the controller: return the latest status; None before the first (of both fingers, if there are two)."""
        first, *others = map(self._latest, self._status)
        if first is None or not others:
            return first
        return None if others[0] is None else first._replace(second=others[0])

    def _latest(self, written: SharedRow) -> DetectorStatus | None:
        row = written.read()
        if row is None:
            return None
        single = len(SlipSignal._fields) + 4
        slips, *felt, slices, at_us, last_event_us, zero_us = row[1][:single]
        remembered_slips = min(int(slips), REMEMBERED)
        slip_us = row[1][single + REMEMBERED - remembered_slips :]
        return DetectorStatus(SlipSignal(int(slips), *felt), int(slices), at_us, last_event_us, zero_us, slip_us)

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """For the controller: publish the measured position of the fingers and their goal."""
        self._gripper.write(position_ticks, goal_ticks)

    @property
    def gripper(self) -> tuple[float, float] | None:
        """For the detector: the last published position and goal of the gripper; None before the first."""
        row = self._gripper.read()
        return None if row is None else (row[1][0], row[1][1])

    def stop(self) -> None:
        """For the parent process: request that both end as soon as possible."""
        self._stop.write(1)

    @property
    def stopping(self) -> bool:
        """Whether `stop` was called."""
        return self._stop.read() is not None

    def open_gripper(self) -> None:
        """For the recorder: the emergency key was pressed; request to open the gripper and end."""
        self._open.write(1)

    @property
    def opening(self) -> bool:
        """Whether `open_gripper` was called."""
        return self._open.read() is not None

    def recorder_lives(self, now_us: float) -> None:
        """For the loop of the recorder: give a sign of life."""
        self._recorder.write(now_us)

    @property
    def recorder_us(self) -> float:
        """Time of the recorder's last sign of life; -inf before the first."""
        row = self._recorder.read()
        return -math.inf if row is None else row[1][0]

    def controller_lives(self, now_us: float) -> None:
        """For the loop of the controller: give a sign of life."""
        self._controller.write(now_us)

    @property
    def controller_us(self) -> float:
        """Time of the controller's last sign of life; -inf before the first."""
        row = self._controller.read()
        return -math.inf if row is None else row[1][0]
