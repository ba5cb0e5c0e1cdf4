"""A controller on a clock that only tests move, with a detector and a gripper of theirs."""

import math
import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from evetac_cli.devices import GripperReading
from evetac_cli.devices.grippers import Serial
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.errors import DeviceError
from evetac_cli.kernels.grip.control import Control, SlipSignal
from evetac_cli.kernels.grip.paper import PAPER, GraspPhase
from evetac_cli.realtime.message_pipe import MessageReader, MessageWriter
from evetac_cli.realtime.shared_status import DetectorStatus, SharedStatus
from evetac_cli.realtime.shared_time import WakeSignal
from evetac_cli.trials.grasp.controller_process import ControllerEnded, ControllerSettings, command_grasp
from evetac_cli.trials.grasp.loop import Timing
from tests.devices.stand_ins import StillGripper
from tests.devices.stepped import StepClock

PERIOD_S = 0.002
READ_S, WRITE_S = 400e-6, 100e-6
FELT_S = 600e-6  # from the end of a slice until it is in shared memory
MOST_S = 1e-9  # of rounding


class Clock(StepClock):
    """Time that passes only in a sleep, or when a test moves it."""

    def __init__(self) -> None:
        super().__init__()
        self.passing: Callable[[], None] = lambda: None
        self.next_s: Callable[[], float] = lambda: math.inf  # when something happens next that may ring

    def sleep(self, seconds: float, wake: WakeSignal | None = None) -> bool:
        assert seconds >= 0
        until_s = self.s + seconds
        while wake is not None and not (rang := wake.wait(0.0)) and self.next_s() < until_s:
            self.s = self.next_s()
            self.passing()
        if wake is not None and rang:
            return True
        self.s = until_s
        self.passing()
        return False


class Hand(StillGripper):
    """A gripper whose finger is where it was commanded to be, and which takes its time; fails at a step."""

    def __init__(self, clock: Clock) -> None:
        self.counted: dict[str, int] = {"answers_lost": 0}
        self.goals: list[int] = []
        self.position = 400
        self.closed_s: float | None = None
        self.opened_s: float | None = None
        self.release_words = "torque is on"
        self.fails_at = 10**9
        self.frozen_at = 10**9
        self.frozen_s = 0.1
        self.is_held = False  # an object keeps the finger where it is
        self._clock = clock

    def read(self) -> GripperReading:
        assert self.closed_s is None
        if len(self.goals) == self.fails_at:
            raise DeviceError("no answer", where="gripper")
        self._clock.sleep(READ_S if len(self.goals) != self.frozen_at else self.frozen_s)
        return GripperReading(5.0, self.position)

    def write_current(self, current_ma: int) -> None:
        raise AssertionError("positions are commanded")

    def write_position(self, goal_ticks: int) -> None:
        assert self.closed_s is None
        self._clock.sleep(WRITE_S)
        self.goals.append(goal_ticks)
        if not self.is_held:
            self.position += (goal_ticks > self.position) - (goal_ticks < self.position)

    def emergency_open(self) -> None:
        assert self.closed_s is None
        self.opened_s = self._clock.s
        self.close()

    def close(self) -> None:
        self.closed_s = self.closed_s or self._clock.s
        self.release_words = "torque is off (read back)"


class Bench:
    """A controller, and a detector of these tests that publishes its status.

    second: whether a slice of the second finger has slip; None: there is one finger. Its slices end with those of the
    first, and are known with them.
    """

    def __init__(
        self,
        timing: Timing,
        slips: Callable[[int], bool] = lambda k: False,
        second: Callable[[int], bool] | None = None,
    ) -> None:
        self.clock = Clock()
        self.shared, self.hand = SharedStatus(1 if second is None else 2), Hand(self.clock)
        self.second_dies_at = self.second_silent_at = 10**9
        self._second, self._second_known, self._second_events_us = second, list[float](), 0.0
        self.zero_s = self.clock.s
        self.dies_at = self.silent_at = self.stops_at = self.recorder_dies_at = self.key_at = 10**9
        self._slips, self._slices, self._known, self._events_us = slips, 0, list[float](), 0.0
        self.clock.passing, self.clock.next_s = self._publish, self._next_s
        self._reading, self._writing = multiprocessing.Pipe(duplex=False)
        self.settings = ControllerSettings(
            Serial("nowhere"), "nowhere", RhP12RnSettings(), PAPER, timing, 60, 100.0, self.clock
        )

    def _next_s(self) -> float:
        """When the next status is published."""
        return self.zero_s + (self._slices + 1) * 1e-3 + FELT_S if self._slices < self.dies_at else math.inf

    def _publish(self) -> None:
        while self.clock.s >= self._next_s():
            slice_ = self._slices
            self._slices += 1
            at_us = (self.zero_s + self._slices * 1e-3 + FELT_S) * 1e6
            self._events_us = at_us if slice_ < self.silent_at else self._events_us
            if self._slips(slice_):
                self._known.append((self.zero_s + slice_ * 1e-3) * 1e6 + 50.0)
            signal = SlipSignal(len(self._known), 0.5, 0.0, 0.0)
            self.shared.publish(
                DetectorStatus(
                    signal, self._slices, at_us, self._events_us, self.zero_s * 1e6, tuple(self._known[-20:])
                )
            )
            if self._second is not None and slice_ < self.second_dies_at:
                self._publish_second(self._second, slice_, at_us)
            if slice_ < self.recorder_dies_at:
                self.shared.recorder_lives(at_us)
            if slice_ == self.stops_at:
                self.shared.stop()
            if slice_ == self.key_at:
                self.shared.open_gripper()

    def _publish_second(self, slips: Callable[[int], bool], slice_: int, at_us: float) -> None:
        known = self._second_known
        if slips(slice_):
            known.append((self.zero_s + slice_ * 1e-3) * 1e6 + 50.0)
        if slice_ < self.second_silent_at:
            self._second_events_us = at_us
        signal = SlipSignal(len(known), 0.5, 0.0, 0.0)
        times = (at_us, self._second_events_us, self.zero_s * 1e6)
        self.shared.publish(DetectorStatus(signal, self._slices, *times, tuple(known[-20:])), 1)

    def run(self, ending: Sequence[int] = (), **changed: Any) -> tuple[ControllerEnded, list[dict[str, Any]]]:
        settings = replace(self.settings, **changed)
        outbox = MessageWriter(self._writing)
        ended = command_grasp(self.hand, self.shared, settings, outbox, ending=ending)
        assert outbox.flush(1.0)
        return ended, [row for rows in MessageReader(self._reading).take() for row in rows]

    def close(self) -> None:
        self._reading.close()
        self._writing.close()


def goals_by_law(
    rows: Sequence[dict[str, Any]], slips: Callable[[int], bool], second: Callable[[int], bool] = lambda k: False
) -> list[int]:
    """All goals that the paper's law gives over the recorded steps, those ahead of a step among them, in order.

    slips, second: whether a slice of the first and of the second finger has slip.
    """
    law, goals = Control(PAPER), list[int]()

    def signal(row: dict[str, Any], early: str) -> SlipSignal:
        counted = sum(map(slips, range(row[f"control/{early}slices_processed"])))
        name = f"control/{early}second_slices_processed"
        return SlipSignal(counted + (sum(map(second, range(row[name]))) if name in row else 0))

    before: dict[str, Any] = {}
    for row in rows:
        if row["control/early_goal_ticks"] != -1:
            phase, ticks = GraspPhase(before["control/phase"]), before["gripper/position_ticks"]
            goals.append(law.copy().step(phase, signal(row, "early_"), ticks))
            assert row["control/early_goal_ticks"] == goals[-1]
        goals.append(law.step(GraspPhase(row["control/phase"]), signal(row, ""), row["gripper/position_ticks"]))
        assert (row["control/goal_ticks"], row["control/slip"]) == (goals[-1], law.slip)
        before = row
    return goals
