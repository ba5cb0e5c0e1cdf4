"""A new slip is answered as it comes to be known, not with the controller's next step.

The detector knows of a slip after any slice, a step of the controller comes after every second one. Until that step the
bus is idle. So the controller sleeps beside a bell, which the detector rings (shared_status.py), and on new slip it
writes at once what the step to come would command: the law's step on a copy of its state, with the position that was
last read, which is at most a step old.

Why a copy: laws count steps. The paper's opens and closes by so much a step of 2 ms, and knows the end of slip from one
step to the next. So its state goes on from step to step of the grid alone, and so do the rows of the recording: the law
over them gives their goals, as if nothing had been written between. A row says beside that what was written ahead of it
and on which slices, which the law gives again from the row before. The step itself then reads the fingers, and commands
by where they are.

Why once per step: to the law slip is a flag, which one slice raises or several; and a bus of 2 ms has room for a read
(0.35 ms) and two writes (0.2 ms each), but must be free when the next read is due. What is not safe to decide here is
left to the step: whatever ends a grasp, the change of phases, and any command after this process was stopped, when the
servo may have let go.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from evetac_cli.devices import Gripper
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.grip.control import Control
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.realtime.bell import Bell
from evetac_cli.realtime.shared_status import SharedStatus
from evetac_cli.trials.grasp.loop import Timing

ROOM_S = 2e-4  # beside the time on the wire: computing, and the pause after it; with less left, the step is as fast


class EarlyCommand(NamedTuple):
    """What was written ahead of a step, on which slices, and when: begun in us of the recording, done in s."""

    goal_ticks: int
    slices: tuple[int, ...]  # of each finger
    t_us: float
    done_s: float


NOTHING = EarlyCommand(-1, (0, 0), math.nan, math.nan)


class EarlyAnswer:
    """Sleeps for the controller, and answers slip in its sleep."""

    def __init__(
        self,
        gripper: Gripper,
        shared: SharedStatus,
        timing: Timing,
        wire_s: float,
        clock: Callable[[], float],
        sleep: Callable[[float, Bell | None], bool],
        may_write: Callable[[], bool],
    ) -> None:
        """wire_s: that a command is on the wire; clock and sleep: in s, as of a TimeSource.

        may_write: False once an order or a signal has come.
        """
        self._gripper, self._shared, self._timing = gripper, shared, timing
        self._room_s = wire_s + ROOM_S
        self._clock, self._sleep, self._may_write = clock, sleep, may_write
        self._ahead: Control | None = None  # as the law is after the last step; None: nothing more before the next
        self._phase, self._position, self._slips = GraspPhase.CONTACT, 0, 0
        self._written = NOTHING

    def after_step(self, control: Control, phase: GraspPhase, position_ticks: int, slips: int) -> None:
        """A step was made: in this phase, with fingers here, and so many slices with slip known."""
        # In contact no law reacts to slip.
        self._ahead = None if phase is GraspPhase.CONTACT else control.copy()
        self._phase, self._position, self._slips = phase, position_ticks, slips
        self._written = NOTHING

    @property
    def written(self) -> EarlyCommand:
        """What was written since the last step."""
        return self._written

    def sleep(self, seconds: float) -> None:
        """Sleep for so long; DeviceError where a command fails on the way, EvetacError where a law does."""
        due_s = self._clock() + seconds
        while (left_s := due_s - self._clock()) > 0:
            if self._sleep(left_s, self._shared.slip_bell):
                self._answer(due_s)

    def _answer(self, due_s: float) -> None:
        """Command what the next step would, if there is slip that the last one did not know, and time."""
        status = self._shared.latest()
        ahead, began_s = self._ahead, self._clock()
        if ahead is None or status is None or status.told.slips <= self._slips or began_s + self._room_s > due_s:
            return
        t_us = began_s * 1e6 - status.zero_us
        slice_ = max(int(t_us) // SLICE_US, 0)
        is_last = slice_ + self._timing.every_ms >= self._timing.end_ms  # no step would record it
        if is_last or self._timing.phase(slice_) is not self._phase or not self._may_write():
            return
        self._ahead = None
        goal = ahead.step(self._phase, status.told, self._position)
        self._gripper.write_position(goal)
        self._written = EarlyCommand(goal, tuple(each.slices for each in status.fingers), t_us, self._clock())


def columns(written: EarlyCommand, fingers: int = 1) -> dict[str, Any]:
    """What a row of the recording says of it; fingers: how many have a detector."""
    row = {
        "control/early_goal_ticks": written.goal_ticks,
        "control/early_slices_processed": written.slices[0],
        "control/early_t_us": written.t_us,
    }
    if fingers > 1:
        row["control/early_second_slices_processed"] = written.slices[1]
    return row
