"""The controller between its steps: absolute deadlines, missed ones and their cause, and answers to new slip.

Deadlines are aligned with the detector. New slip is answered at once, before the controller's next step.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from evetac_cli.devices import Gripper
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.grip.control import Control
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.realtime.shared_status import SharedStatus
from evetac_cli.realtime.shared_time import TimeSource
from evetac_cli.trials.grasp.loop import Timing

FRESH_US = 150.0  # target age of a status when a step reads it; the detector's delay varies
FOLLOWING = 0.02  # share of a step's offset that is corrected at once
MOST_SHIFT_US = 4.0


class Deadlines:
    """Absolute deadlines at equal intervals, on a clock that tests can replace."""

    def __init__(
        self, period_s: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._period_s = period_s
        self._clock, self._sleep = clock, sleep
        self._began_s = clock()
        self._next = 0
        self.missed = 0
        # missed deadlines that a gripper answer as fast as its fastest would have kept
        self.missed_by_gripper = 0

    def shift(self, later_us: float) -> None:
        """Move all further deadlines by this time, which may be negative."""
        self._began_s += later_us * 1e-6

    def wait(self, waited_s: float = 0.0) -> float:
        """Sleep until the next deadline; return the delay after it, in us.

        A step must be done by the next deadline. Deadlines that pass before that are counted as missed. The next step
        then begins at once, and replaces all deadlines that passed. waited_s: how much longer than necessary the step
        waited for the gripper.
        """
        if self._next:
            now_s = self._clock()
            passed = self._passed(now_s)
            self.missed += passed
            self.missed_by_gripper += passed - self._passed(now_s - waited_s)
            self._next += max(passed - 1, 0)
        due_s = self._began_s + self._next * self._period_s
        self._next += 1
        early_s = due_s - self._clock()
        if early_s > 0:
            self._sleep(early_s)
        return max(self._clock() - due_s, 0.0) * 1e6

    def _passed(self, now_s: float) -> int:
        """Return how many deadlines have passed by then since the one of this step."""
        return max(int((now_s - self._began_s) / self._period_s) - (self._next - 1), 0)


def shift_us(age_us: float) -> float:
    """Return how much later deadlines should be, given the age of the status that a step read.

    There is a new status every millisecond. One should arrive just before a step reads it. The next then arrives while
    the controller sleeps and the bus is idle, when new slip is answered at once (EarlyAnswer). The steps therefore
    follow the slices by small corrections, because the camera's clock may run slightly faster or slower.
    """
    off_us = (FRESH_US - age_us + SLICE_US / 2) % SLICE_US - SLICE_US / 2
    return min(max(FOLLOWING * off_us, -MOST_SHIFT_US), MOST_SHIFT_US)


# margin on top of the time on the wire: computing and the pause after it; with less left, the step is as fast
ROOM_S = 2e-4


class EarlyCommand(NamedTuple):
    """A command written ahead of a step, its slices, and its times: begin in us of the recording, end in s."""

    goal_ticks: int
    slices: tuple[int, ...]  # slice count of each finger
    t_us: float
    done_s: float


NOTHING = EarlyCommand(-1, (0, 0), math.nan, math.nan)


class EarlyAnswer:
    """Sleeps for the controller, and answers slip while it sleeps.

    The detector may find slip after any slice, and the controller makes a step after every second one. Until that step
    the bus is idle. So the controller sleeps until the step, or until the detector wakes it (shared_status.py). On
    new slip it immediately writes the command that the next step would give: the law's step on a copy of its state,
    with the last position read, which is at most one step old.

    Why a copy: laws count steps. The paper's law opens and closes by a fixed amount per step of 2 ms, and recognises
    the end of slip from one step to the next. So the law's own state only advances with the regular steps, and the rows
    of the recording do too. The law reproduces its goals from these rows as if nothing had been written in between.
    Each row also stores what was written ahead of it and on which slices, which the law reproduces from the row before.
    The step itself then reads the fingers, and commands from their true position.

    Why once per step: to the law, slip is a flag, raised by one slice or several. A bus period of 2 ms has room for a
    read (0.35 ms) and two writes (0.2 ms each), but the bus must be free when the next read is due. Decisions that are
    not safe here are left to the step. These are everything that ends a grasp, the change of phases, and any command
    after this process was stopped, because the servo may have released the object.
    """

    def __init__(
        self,
        gripper: Gripper,
        shared: SharedStatus,
        timing: Timing,
        wire_s: float,
        time: TimeSource,
        may_write: Callable[[], bool],
    ) -> None:
        """wire_s: time of a command on the wire; may_write: returns False once an order or a signal was received."""
        self._gripper, self._shared, self._timing = gripper, shared, timing
        self._room_s = wire_s + ROOM_S
        self._time, self._may_write = time, may_write
        # the law's state after the last step; None: no further early answer before the next step
        self._ahead: Control | None = None
        self._phase, self._position, self._slips = GraspPhase.CONTACT, 0, 0
        self.written = NOTHING  # the command since the last step

    def after_step(self, control: Control, phase: GraspPhase, position_ticks: int, slips: int) -> None:
        """Record a step: its phase, the position of the fingers, and the number of known slices with slip."""
        # During contact no law reacts to slip.
        self._ahead = None if phase is GraspPhase.CONTACT else control.copy()
        self._phase, self._position, self._slips = phase, position_ticks, slips
        self.written = NOTHING

    def sleep(self, seconds: float) -> None:
        """Sleep for this time; DeviceError if a command fails meanwhile, EvetacError if a law does."""
        due_s = self._time.now_s() + seconds
        while (left_s := due_s - self._time.now_s()) > 0:
            if self._time.sleep(left_s, self._shared.slip_wake):
                self._answer(due_s)

    def _answer(self, due_s: float) -> None:
        """Send the command of the next step now, if there is slip that the last step did not know, and enough time."""
        status = self._shared.latest()
        ahead, began_s = self._ahead, self._time.now_s()
        if (
            ahead is None
            or status is None
            or status.control_signal.slips <= self._slips
            or began_s + self._room_s > due_s
        ):
            return
        t_us = began_s * 1e6 - status.zero_us
        slice_ = max(int(t_us) // SLICE_US, 0)
        is_last = slice_ + self._timing.every_ms >= self._timing.end_ms  # no later step would record it
        if is_last or self._timing.phase(slice_) is not self._phase or not self._may_write():
            return
        self._ahead = None
        goal = ahead.step(self._phase, status.control_signal, self._position)
        self._gripper.write_position(goal)
        self.written = EarlyCommand(goal, tuple(each.slices for each in status.fingers), t_us, self._time.now_s())


def early_columns(written: EarlyCommand, fingers: int = 1) -> dict[str, Any]:
    """Return the columns of a recording's row for an early command; fingers: number of fingers with a detector."""
    row = {
        "control/early_goal_ticks": written.goal_ticks,
        "control/early_slices_processed": written.slices[0],
        "control/early_t_us": written.t_us,
    }
    if fingers > 1:
        row["control/early_second_slices_processed"] = written.slices[1]
    return row
