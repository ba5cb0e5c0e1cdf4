"""The controller's beat: absolute deadlines, those missed and by whom, and how they follow the detector's slices."""

import time
from collections.abc import Callable

from evetac_cli.events import SLICE_US

FRESH_US = 150.0  # age that a status should have when a step reads it: the detector is not always as fast
FOLLOWING = 0.02  # of what a step is off, so much is corrected at a time
MOST_SHIFT_US = 4.0


class Pace:
    """Absolute deadlines at equal distances, on a clock that may be another one in tests."""

    def __init__(
        self, period_s: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._period_s = period_s
        self._clock, self._sleep = clock, sleep
        self._began_s = clock()
        self._next = 0
        self.missed = 0
        self.missed_by_gripper = 0  # of these, those that an answer as fast as its fastest would have met

    def shift(self, later_us: float) -> None:
        """Move all further deadlines by this time, which may be negative."""
        self._began_s += later_us * 1e-6

    def wait(self, waited_s: float = 0.0) -> float:
        """Sleep until the next deadline; how much later than that it is then, in us.

        A step has until the next deadline to be done. Deadlines that passed before it was are counted as missed; the
        next step then begins at once, and where several passed, it stands for all of them. waited_s: how much longer
        than need be the step waited for the gripper.
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
        """How many deadlines have passed by then since the one of this step."""
        return max(int((now_s - self._began_s) / self._period_s) - (self._next - 1), 0)


def shift_us(age_us: float) -> float:
    """How much later deadlines should be, given how old the status was that a step read.

    There is a new one every millisecond. One should come just before a step reads it; the next then comes while the
    controller sleeps beside an idle bus, where new slip is answered at once (early_answer.py). So the steps follow, by
    little at a time: the camera's clock may run a little otherwise.
    """
    off_us = (FRESH_US - age_us + SLICE_US / 2) % SLICE_US - SLICE_US / 2
    return min(max(FOLLOWING * off_us, -MOST_SHIFT_US), MOST_SHIFT_US)
