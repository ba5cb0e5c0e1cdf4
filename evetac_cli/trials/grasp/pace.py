"""The controller's timing: absolute deadlines, missed ones and their cause, and alignment with the detector."""

import time
from collections.abc import Callable

from evetac_cli.events import SLICE_US

FRESH_US = 150.0  # target age of a status when a step reads it; the detector's delay varies
FOLLOWING = 0.02  # share of a step's offset that is corrected at once
MOST_SHIFT_US = 4.0


class Pace:
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
    the controller sleeps and the bus is idle, when new slip is answered at once (early_answer.py). The steps therefore
    follow the slices by small corrections, because the camera's clock may run slightly faster or slower.
    """
    off_us = (FRESH_US - age_us + SLICE_US / 2) % SLICE_US - SLICE_US / 2
    return min(max(FOLLOWING * off_us, -MOST_SHIFT_US), MOST_SHIFT_US)
