"""The controller's beat and its watchdog, on a clock that only these tests move."""

import math
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from evetac_cli.devices import GripperReading
from evetac_cli.devices.grippers import Serial
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.errors import DeviceError
from evetac_cli.kernels.grip.control import Control, SlipSignal
from evetac_cli.kernels.grip.paper import PAPER, GraspPhase
from evetac_cli.realtime.message_pipe import MessageReader, MessageWriter
from evetac_cli.realtime.shared_status import DetectorStatus, SharedStatus
from evetac_cli.trials.grasp.controller_process import (
    COMMAND_BYTES,
    FRESH_US,
    MOST_SHIFT_US,
    OVER,
    STOPPED,
    TOO_LONG,
    ControllerEnded,
    ControllerSettings,
    Pace,
    Watch,
    command_grasp,
    shift_us,
)
from evetac_cli.trials.grasp.loop import Timing
from evetac_cli.trials.session import OPENED, RECORDER_LATE_MS
from tests.devices.stand_ins import StillGripper

PERIOD_S = 0.002
READ_S, WRITE_S = 400e-6, 100e-6
FELT_S = 600e-6  # from the end of a slice until it is in shared memory
MOST_S = 1e-9  # of rounding


class Clock:
    """Time that passes only in a sleep, or when a test moves it."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.passing: Callable[[], None] = lambda: None

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now_s += seconds
        self.passing()


@given(took=st.lists(st.floats(0.0, 0.02), min_size=1, max_size=50))
def test_deadlines_are_absolute_and_none_is_hidden(took: list[float]) -> None:
    """Assert that steps begin on the grid, or less than a period late, and that every deadline that passed counts."""
    clock = Clock()
    pace = Pace(PERIOD_S, clock, clock.sleep)
    began_s = clock.now_s
    passed = 0
    for seconds in took:
        late_us = pace.wait()
        assert 0.0 <= late_us < (PERIOD_S + MOST_S) * 1e6
        due_s = clock.now_s - late_us * 1e-6
        steps = (due_s - began_s) / PERIOD_S
        assert steps == pytest.approx(round(steps), abs=1e-5)
        clock.now_s += seconds
        periods = (clock.now_s - due_s) / PERIOD_S
        assume(not 0 < abs(periods - round(periods)) < 1e-6)  # whether it is in time is then a matter of rounding
        passed += math.floor(periods)
    pace.wait()
    assert pace.missed == passed


def test_one_long_step() -> None:
    """Assert that a step of three and a half periods costs three deadlines; the next begins half a one late."""
    clock = Clock()
    pace = Pace(PERIOD_S, clock, clock.sleep)
    assert pace.wait() == 0.0
    clock.now_s += 3.5 * PERIOD_S
    assert pace.wait() == pytest.approx(0.5e6 * PERIOD_S)
    assert pace.missed == 3
    clock.now_s += 0.1 * PERIOD_S
    assert pace.wait() == pytest.approx(0.0, abs=1e-3)
    assert pace.missed == 3


@given(age_us=st.floats(0.0, 5000.0))
def test_steps_follow_the_status(age_us: float) -> None:
    """Assert that a shift is small, repeats with the slices, and brings the age of the status to what is wanted."""
    shift = shift_us(age_us)
    assert abs(shift) <= MOST_SHIFT_US
    assert shift_us(age_us + 1000.0) == pytest.approx(shift, abs=1e-6)
    for _ in range(1000):
        age_us = (age_us + shift_us(age_us)) % 1000.0
    assert age_us == pytest.approx(FRESH_US, abs=1.0)


def test_watch() -> None:
    """Assert that silence of detector, camera and recorder are told apart, within the watchdog's time or 75 ms."""
    watch = Watch(60)
    status = DetectorStatus(SlipSignal(), 10, at_us=1e6, heard_us=1e6, zero_us=0.0, slip_us=())
    assert watch.fault(status, 1e6, 1.044e6)[0] == ""
    reason, alive_us = watch.fault(status, 1.04e6, 1.046e6)
    assert ("detector" in reason, alive_us) == (True, 1e6)
    reason, alive_us = watch.fault(status._replace(at_us=1.04e6), 1.04e6, 1.046e6)
    assert ("camera" in reason, alive_us) == (True, 1e6)
    later = status._replace(at_us=1.07e6, heard_us=1.07e6)
    assert watch.fault(later, 1e6, 1.074e6)[0] == ""
    reason, alive_us = watch.fault(later, 1e6, 1.076e6)
    assert ("recorder" in reason, alive_us) == (True, 1e6)
    assert Watch(200).fault(later._replace(at_us=1.14e6, heard_us=1.14e6), 1e6, 1.149e6)[0] == ""
    assert "recorder" in watch.fault(status, -math.inf, 1.001e6)[0]  # it never gave a sign of life


def test_a_recorder_that_waits_for_a_core_is_late_for_seconds() -> None:
    """Assert that a silent recorder ends the grasp at once if it was stopped, and if it was not, after its 5 s."""
    stopped = False
    watch = Watch(60, recorder_stopped=lambda: stopped)

    def fault(silent_ms: float) -> str:
        now_us = 10e6
        status = DetectorStatus(SlipSignal(), 10, at_us=now_us, heard_us=now_us, zero_us=0.0, slip_us=())
        return watch.fault(status, now_us - 1e3 * silent_ms, now_us)[0]

    assert [fault(ms) for ms in (74, 76, 1000, RECORDER_LATE_MS - 1)] == [""] * 4
    assert fault(RECORDER_LATE_MS + 1) == "the recorder hangs: no sign of life for 5001 ms"
    stopped = True
    assert fault(74) == ""
    assert fault(76) == "the recorder hangs: no sign of life for 76 ms"


def test_watch_counts_only_while_it_runs_but_not_for_ever() -> None:
    """Assert that who was stopped with the controller has time to go on, but no more than that time."""
    watch = Watch(60)
    status = DetectorStatus(SlipSignal(), 10, at_us=1e6, heard_us=1e6, zero_us=0.0, slip_us=())
    watch.slept_until(1.04e6)
    assert watch.fault(status, 1e6, 1.084e6)[0] == ""
    assert "detector" in watch.fault(status, 1e6, 1.086e6)[0]
    watch.slept_until(1.09e6)
    assert "detector" in watch.fault(status, 1e6, 1.091e6)[0]


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
        self.position += (goal_ticks > self.position) - (goal_ticks < self.position)

    def emergency_open(self) -> None:
        assert self.closed_s is None
        self.opened_s = self._clock.now_s
        self.close()

    def close(self) -> None:
        self.closed_s = self.closed_s or self._clock.now_s
        self.release_words = "torque is off (read back)"


class Bench:
    """A controller, and a detector of these tests that publishes its status."""

    def __init__(self, timing: Timing, slips: Callable[[int], bool] = lambda k: False) -> None:
        self.clock = Clock()
        self.shared, self.hand = SharedStatus(), Hand(self.clock)
        self.zero_s = self.clock.now_s
        self.dies_at = self.silent_at = self.stops_at = self.recorder_dies_at = self.key_at = 10**9
        self._slips, self._slices, self._known, self._events_us = slips, 0, list[float](), 0.0
        self.clock.passing = self._publish
        self._reading, self._writing = multiprocessing.Pipe(duplex=False)
        self.settings = ControllerSettings(Serial("nowhere"), "nowhere", RhP12RnSettings(), PAPER, timing, 60, 100.0)

    def _publish(self) -> None:
        while self.clock.now_s >= self.zero_s + (self._slices + 1) * 1e-3 + FELT_S and self._slices < self.dies_at:
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
            if slice_ < self.recorder_dies_at:
                self.shared.recorder_lives(at_us)
            if slice_ == self.stops_at:
                self.shared.stop()
            if slice_ == self.key_at:
                self.shared.open_gripper()

    def run(self, ending: Sequence[int] = (), **changed: Any) -> tuple[ControllerEnded, list[dict[str, Any]]]:
        settings = replace(self.settings, **changed)
        outbox = MessageWriter(self._writing)
        ended = command_grasp(self.hand, self.shared, settings, outbox, self.clock, self.clock.sleep, ending=ending)
        assert outbox.flush(1.0)
        return ended, [row for rows in MessageReader(self._reading).take() for row in rows]

    def close(self) -> None:
        self._reading.close()
        self._writing.close()


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def make(**more: Any) -> Bench:
        made.append(Bench(Timing(100, 200, 100), **more))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_a_grasp_that_is_over(bench: Callable[..., Bench]) -> None:
    """Assert that it steps 500 times a second without a miss, decides as the law does, and ends with torque off."""
    at = bench(slips=lambda k: 150 <= k < 160 or 320 <= k < 330)
    ended, rows = at.run()
    assert (ended.ended, ended.error, ended.missed) == (OVER, None, 0)
    assert at.hand.closed_s is not None
    assert ended.steps == len(at.hand.goals)
    assert ended.steps / ended.seconds == pytest.approx(500.0, rel=0.01)
    phases = [row["control/phase"] for row in rows]
    assert sorted(phases) == phases
    assert set(phases) == set(GraspPhase)
    law, position = Control(PAPER), 400
    slips = [sum(150 <= k < 160 or 320 <= k < 330 for k in range(row["control/slices_processed"])) for row in rows]
    for row, count, goal in zip(rows, slips, at.hand.goals, strict=False):
        assert row["gripper/position_ticks"] == position
        assert row["control/goal_ticks"] == goal == law.step(row["control/phase"], SlipSignal(count), position)
        position += (goal > position) - (goal < position)
    assert sum(row["control/slip"] for row in rows) == pytest.approx(10, abs=2)
    times = [row["control/t_us"] for row in rows]
    assert all(earlier < later for earlier, later in pairwise(times))


def test_latency_is_from_the_event_to_the_last_byte(bench: Callable[..., Bench]) -> None:
    """Assert that latency counts slice, detector, waiting, command and wire, and exists only after a new slip."""
    at = bench(slips=lambda k: k % 50 == 7)
    _, rows = at.run()
    wire_us = COMMAND_BYTES * 10 / 2.0
    least_us = 1000.0 - 50.0 + FELT_S * 1e6 + WRITE_S * 1e6 + wire_us
    latency = np.array([row["control/latency_us"] for row in rows])
    new = np.array([row["control/slip"] for row in rows], bool)
    assert new.any()
    assert (np.isfinite(latency) == new).all()
    assert (latency[new] >= least_us - 0.01).all()
    assert (latency[new] <= least_us + PERIOD_S * 1e6 + 0.01).all()


@pytest.mark.parametrize(
    ("silent", "what", "after_ms"),
    [("dies_at", "detector", 45), ("silent_at", "camera", 45), ("recorder_dies_at", "recorder", 75)],
)
def test_silence_ends_with_torque_off(bench: Callable[..., Bench], silent: str, what: str, after_ms: int) -> None:
    """Assert that a hanging detector or recorder, or a silent camera, ends the grasp within the watchdog's time."""
    at = bench()
    setattr(at, silent, 250)
    if silent == "dies_at":  # the clock of this bench is the detector's; the recorder lives on
        passing = at.clock.passing
        at.clock.passing = lambda: (passing(), at.shared.recorder_lives(at.clock.now_s * 1e6))[0]
    ended, _ = at.run()
    assert what in ended.ended
    assert isinstance(ended.error, DeviceError)
    assert "; torque is off (read back)" in str(ended.error)
    assert ended.torque == "torque is off (read back)"
    assert 0.0 < ended.released_us - ended.alive_us - 1e3 * after_ms < 3_000.0
    assert at.hand.closed_s == pytest.approx(ended.released_us * 1e-6)


def test_a_bus_that_fails(bench: Callable[..., Bench]) -> None:
    """Assert that the driver's error ends the grasp and is handed on; when torque was off is not known."""
    at = bench()
    at.hand.fails_at = 60
    ended, rows = at.run()
    assert ended.ended.endswith("no answer")
    assert isinstance(ended.error, DeviceError)
    assert math.isnan(ended.released_us)
    assert at.hand.closed_s is not None
    assert len(rows) == ended.steps == 60


def test_a_computer_that_stops_everything(bench: Callable[..., Bench]) -> None:
    """Assert that 0.05 s in which no process ran is no death of the detector, and that its deadlines are counted."""
    at = bench()
    at.hand.frozen_at, at.hand.frozen_s = 60, 0.05
    ended, rows = at.run()
    assert ended.ended == OVER
    assert ended.missed == pytest.approx(25, abs=1)
    assert sum(row["control/missed"] for row in rows) == ended.missed


@pytest.mark.parametrize("frozen_s", [0.065, 0.1, 10.0])
def test_a_controller_that_was_stopped_does_not_grip_again(bench: Callable[..., Bench], frozen_s: float) -> None:
    """Assert that a stop longer than the watchdog's time ends with torque off, before another goal is written."""
    at = bench()
    at.hand.frozen_at, at.hand.frozen_s = 60, frozen_s
    ended, _ = at.run(most_s=1e3, timing=Timing(100, 200, 100_000))
    assert "the controller was stopped for" in ended.ended
    assert "; torque is off (read back)" in str(ended.error)
    assert len(at.hand.goals) == 60
    assert at.hand.closed_s is not None


def test_the_emergency_key_opens(bench: Callable[..., Bench]) -> None:
    """Assert that it opens within a step, ends with its own word and no error, and commands nothing afterwards."""
    at = bench()
    at.key_at = 120
    ended, _ = at.run()
    assert (ended.ended, ended.error) == (OPENED, None)
    assert at.hand.opened_s == pytest.approx(at.zero_s + 0.121 + FELT_S, abs=2 * PERIOD_S)
    assert ended.torque == "torque is off (read back)"


def test_a_signal_to_the_controller_ends_in_words(bench: Callable[..., Bench]) -> None:
    """Assert that a signal ends it at the next step, torque off, and is named; before the first slice too."""
    at = bench()
    came: list[int] = []
    passing = at.clock.passing
    at.clock.passing = lambda: (passing(), came.append(signal.SIGTERM) if at.clock.now_s > at.zero_s + 0.1 else None)[0]
    ended, _ = at.run(ending=came)
    assert str(ended.error) == "the controller was ended by SIGTERM; torque is off (read back)"
    at = bench()
    at.clock.passing = lambda: None
    ended, rows = at.run(ending=[signal.SIGUSR1])
    assert ended.ended == "the controller was ended by SIGUSR1"
    assert not at.hand.goals


def test_stop_and_too_long(bench: Callable[..., Bench]) -> None:
    """Assert that an order to stop and the longest time end a grasp, with torque off and no error."""
    at = bench()
    at.stops_at = 120
    ended, _ = at.run()
    assert (ended.ended, ended.error) == (STOPPED, None)
    assert at.hand.closed_s is not None
    at = bench()
    ended, _ = at.run(most_s=0.1)
    assert (ended.ended, ended.error) == (TOO_LONG, None)
    assert ended.steps == pytest.approx(50, abs=2)
    assert at.hand.closed_s is not None
