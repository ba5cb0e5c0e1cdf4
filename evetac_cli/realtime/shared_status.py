"""What the processes of a grasp know of each other, in shared memory.

The slip signal is written by the detector at 1000 Hz and read by the controller at 500 Hz. Beside it stand the times by
which the controller recognizes a detector that died and a camera that is silent, and knows how old the signal is.

Where a camera looks at each of two fingers, two detectors write, each a status of its own. The controller sees both,
and a signal that is made of both (kernels/grip/two_fingers.py).

A slice with slip that is new rings a bell, for a controller that sleeps until its next step (early_answer.py).

The other way the controller tells where the gripper is and what it was told, for a detector that is given both.

Recorder and controller leave a sign of life each, written by the loop that watches or commands, and by nothing else: a
thread that did so would hide that the loop hangs.
"""

import math
import multiprocessing
from typing import NamedTuple

from evetac_cli.kernels.grip import two_fingers
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime.bell import Bell
from evetac_cli.realtime.shared_row import SharedRow

REMEMBERED = 32  # slices with slip whose time is known
_SIZE = 1088
_STATUS_AT = (0, 384)  # of each finger
_STOP_AT, _RECORDER_AT, _CONTROLLER_AT, _OPEN_AT, _GRIPPER_AT = 768, 832, 896, 960, 1024


class DetectorStatus(NamedTuple):
    """What the detector has seen so far; times in us of the host's clock, or of a virtual world's (shared_time.py).

    second: what that of the second finger has seen, if there is one; it is published apart.
    """

    signal: SlipSignal
    slices: int  # that the detector has processed
    at_us: float  # when this was published
    heard_us: float  # when the camera last gave an event
    zero_us: float  # when the recording's time was 0
    slip_us: tuple[float, ...]  # first events of the latest slices with slip, oldest first; up to REMEMBERED
    second: "DetectorStatus | None" = None

    @property
    def fingers(self) -> tuple["DetectorStatus", ...]:
        """That of the first finger, and that of the second."""
        return (self,) if self.second is None else (self, self.second)

    @property
    def told(self) -> SlipSignal:
        """The signal that the law is told: of one finger, or made of those of both."""
        return self.signal if self.second is None else two_fingers.both(self.signal, self.second.signal)

    def slip_began_us(self, seen: int) -> float:
        """First event of the earliest slice with slip after the first `seen` ones, as far as remembered.

        NaN if there was none since.
        """
        new = min(self.signal.slips - seen, len(self.slip_us))
        return self.slip_us[-new] if new > 0 else float("nan")


class SharedStatus:
    """The shared memory; may be given to a process that is being spawned. fingers: how many have a detector."""

    def __init__(self, fingers: int = 1) -> None:
        self._fingers = fingers
        self._block = multiprocessing.get_context("spawn").RawArray("B", _SIZE)
        self.slip_bell = Bell()
        self._attach()

    def _attach(self) -> None:
        memory = memoryview(self._block).cast("B")
        self._rung_slips = 0
        form = f"q{len(SlipSignal._fields) - 1}dq3d{REMEMBERED}d"
        self._status = [SharedRow(memory, start, form) for start in _STATUS_AT[: self._fingers]]
        self._stop = SharedRow(memory, _STOP_AT, "q")
        self._recorder = SharedRow(memory, _RECORDER_AT, "d")
        self._controller = SharedRow(memory, _CONTROLLER_AT, "d")
        self._open = SharedRow(memory, _OPEN_AT, "q")
        self._gripper = SharedRow(memory, _GRIPPER_AT, "2d")

    def __getstate__(self) -> dict[str, object]:
        return {"_block": self._block, "slip_bell": self.slip_bell, "_fingers": self._fingers}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._attach()

    def publish(self, status: DetectorStatus, finger: int = 0) -> None:
        """For the detector of a finger: replace the status that the controller sees; new slip wakes it."""
        known = status.slip_us[-REMEMBERED:]
        unknown = (float("nan"),) * (REMEMBERED - len(known))
        self._status[finger].write(*status.signal, *status[1:5], *unknown, *known)
        if status.signal.slips > self._rung_slips:
            self._rung_slips = status.signal.slips
            self.slip_bell.ring()

    def latest(self) -> DetectorStatus | None:
        """For the controller: the latest status; None before the first, of both fingers where there are two."""
        first, *others = map(self._latest, self._status)
        if first is None or not others:
            return first
        return None if others[0] is None else first._replace(second=others[0])

    def _latest(self, written: SharedRow) -> DetectorStatus | None:
        row = written.read()
        if row is None:
            return None
        single = len(SlipSignal._fields) + 4
        slips, *felt, slices, at_us, heard_us, zero_us = row[1][:single]
        known = min(int(slips), REMEMBERED)
        slip_us = row[1][single + REMEMBERED - known :]
        return DetectorStatus(SlipSignal(int(slips), *felt), int(slices), at_us, heard_us, zero_us, slip_us)

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """For the controller: where the fingers were read, and the goal that they were given."""
        self._gripper.write(position_ticks, goal_ticks)

    @property
    def gripper(self) -> tuple[float, float] | None:
        """For the detector: position and goal of the gripper as last told; None before the first."""
        row = self._gripper.read()
        return None if row is None else (row[1][0], row[1][1])

    def stop(self) -> None:
        """For whoever started both: end, as soon as possible."""
        self._stop.write(1)

    @property
    def stopping(self) -> bool:
        """Whether `stop` was called."""
        return self._stop.read() is not None

    def open_gripper(self) -> None:
        """For the recorder: the emergency key was pressed; open the gripper, and end."""
        self._open.write(1)

    @property
    def opening(self) -> bool:
        """Whether `open_gripper` was called."""
        return self._open.read() is not None

    def recorder_lives(self, now_us: float) -> None:
        """For the loop of the recorder: it is alive."""
        self._recorder.write(now_us)

    @property
    def recorder_us(self) -> float:
        """When the recorder last gave a sign of life; -inf before the first."""
        row = self._recorder.read()
        return -math.inf if row is None else row[1][0]

    def controller_lives(self, now_us: float) -> None:
        """For the loop of the controller: it is alive."""
        self._controller.write(now_us)

    @property
    def controller_us(self) -> float:
        """When the controller last gave a sign of life; -inf before the first."""
        row = self._controller.read()
        return -math.inf if row is None else row[1][0]
