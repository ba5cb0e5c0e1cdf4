"""What a gripper does in a recording from devices: phases, the paper's ramp, and a loop that keeps every command."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.devices import GripperReading
from evetac_cli.devices.virtual.servo_plant import Goals, Obstacle, OwnDynamics
from evetac_cli.errors import DeviceError
from evetac_cli.realtime.shared_time import WakeSignal
from evetac_cli.trials.record.current_ramp import (
    COMMAND_MS,
    LAST_TICK,
    MOST_CLOSING_COMMANDS,
    OPENED_TICKS,
    RAMP_MA,
    STILL_COMMANDS,
    GripperLoop,
    Hold,
    HoldState,
    RampPhase,
    step,
)
from evetac_cli.trials.session import OPENED
from tests.devices.stand_ins import StillGripper
from tests.patience import until

HOLD = Hold(closing_ma=10, holding_ma=40.0, hold_s=0.02, lowest_ma=-50.0)


def after_contact(hold: Hold = HOLD) -> tuple[HoldState, np.random.Generator]:
    """A state in which the current is about to fall."""
    state, rng = HoldState(), np.random.default_rng(0)
    while state.phase is not RampPhase.FALLING:
        step(state, hold, GripperReading(0.0, 400), rng)
    return state, rng


def test_phases() -> None:
    """Assert that it closes while it moves, holds for as long as was said from contact on, and only then lets go."""
    state, rng = HoldState(), np.random.default_rng(0)
    closing = [step(state, HOLD, GripperReading(10.0, 300 + k // 20), rng) for k in range(2000)]
    assert set(closing) == {10.0}
    assert state.phase is RampPhase.CLOSING
    targets = []
    while state.phase is not RampPhase.FALLING:
        targets.append(step(state, HOLD, GripperReading(10.0, 400), rng))
    assert targets.count(40.0) == 1000 * HOLD.hold_s / COMMAND_MS + 1
    assert STILL_COMMANDS - 1 <= targets.count(10.0) <= STILL_COMMANDS + 1
    assert step(state, HOLD, GripperReading(40.0, 400), rng) < 40.0


@given(st.integers(0, 2**32 - 1), st.floats(-50, 39))
@settings(max_examples=20, deadline=None)
def test_ramp_is_the_papers(seed: int, lowest_ma: float) -> None:
    """Assert that each command changes the target by U(-0.025, -0.0025) mA, until the lower limit, and says so."""
    hold = Hold(10, 40.0, 0.0, lowest_ma)
    state, _ = after_contact(hold)
    rng = np.random.default_rng(seed)
    targets = [40.0]
    while not state.ended:
        targets.append(step(state, hold, GripperReading(0.0, 400), rng))
    changes = np.diff(targets)
    assert (changes >= RAMP_MA[0] - 1e-12).all()
    assert (changes <= RAMP_MA[1] + 1e-12).all()
    assert targets[-1] <= lowest_ma < targets[-2]
    assert "lower limit" in state.ended
    if len(changes) > 200:
        assert abs(changes.mean() - np.mean(RAMP_MA)) < 5 * (RAMP_MA[1] - RAMP_MA[0]) / np.sqrt(12 * len(changes))


def test_a_factor_makes_the_ramp_faster() -> None:
    """Assert that each change of the target is the paper's times the factor."""
    targets = []
    for factor in (1.0, 4.0):
        hold = replace(HOLD, fall_factor=factor)
        state, _ = after_contact(hold)
        rng = np.random.default_rng(3)
        targets.append([step(state, hold, GripperReading(0.0, 400), rng) - 40.0 for _ in range(50)])
    assert np.allclose(4.0 * np.array(targets[0]), targets[1])


def test_open_gripper_ends_it() -> None:
    """Assert that fingers clearly further apart than at contact are the end, and a little further are not."""
    state, rng = after_contact()
    step(state, HOLD, GripperReading(0.0, 400 - OPENED_TICKS + 1), rng)
    assert not state.ended
    step(state, HOLD, GripperReading(0.0, 400 - OPENED_TICKS), rng)
    assert state.ended == "the gripper opened"


def test_fingers_that_meet_or_never_stop() -> None:
    """Assert that nothing between the fingers is an error, and so is motion without an end."""
    rng, state = np.random.default_rng(0), HoldState()
    with pytest.raises(DeviceError, match="without contact"):
        step(state, HOLD, GripperReading(0.0, LAST_TICK), rng)
    state = HoldState()
    with pytest.raises(DeviceError, match="still closing"):
        for k in range(MOST_CLOSING_COMMANDS):
            step(state, HOLD, GripperReading(0.0, 300 + k // 100), rng)


@pytest.mark.parametrize("falls_back", [0, 1])
def test_contact_is_a_position_that_stays(falls_back: int) -> None:
    """Assert that contact is so many readings without a further position; an encoder that flickers rests."""
    state, rng = HoldState(), np.random.default_rng(0)
    positions = [-3, -2, *(-2 - falls_back * (k % 2) for k in range(STILL_COMMANDS))]
    phases = [(step(state, HOLD, GripperReading(0.0, each), rng), state.phase)[1] for each in positions]
    assert phases.count(RampPhase.CLOSING) == STILL_COMMANDS + 1


def test_closing_on_the_simulated_drive() -> None:
    """Assert that at the default current the simulated finger stops at the obstacle, and is found there."""
    plant = OwnDynamics(Obstacle(at_ticks=404.0), position_ticks=400.0)
    goals = Goals(torque=True, mode=0, goal_current_ma=10, current_limit_ma=661)
    state, rng, now_s = HoldState(), np.random.default_rng(0), 0.0
    while state.phase is RampPhase.CLOSING:
        now_s += COMMAND_MS * 1e-3
        step(state, HOLD, GripperReading(0.0, plant.advance(goals, now_s).position_ticks), rng)
    assert state.touch_ticks == 404


class LoggingGripper(StillGripper):
    """A gripper that answers after a time, and remembers its commands."""

    def __init__(self, read_s: float = 0.0, fails_at: int = 10**9) -> None:
        self.counted: dict[str, int] = {}
        self.written: list[int] = []
        self._read_s = read_s
        self._fails_at = fails_at

    def read(self) -> GripperReading:
        if len(self.written) >= self._fails_at:
            raise DeviceError("no answer")
        time.sleep(self._read_s)
        return GripperReading(1.5, 300 + len(self.written))

    def write_current(self, current_ma: int) -> None:
        self.written.append(current_ma)

    def write_position(self, goal_ticks: int) -> None:
        raise AssertionError("the current is commanded, not the position")

    def close(self) -> None:
        pass


def run_loop(gripper: LoggingGripper, commands: int) -> tuple[GripperLoop, list[dict[str, float]]]:
    """Run until so many commands, or an error; rows are fetched while it runs and at the end."""
    given: list[float] = []

    def act(reading: GripperReading) -> tuple[float, str]:
        given.append(20.0 - 0.3 * len(given))
        return given[-1], "enough" if len(given) == commands else ""

    loop = GripperLoop(gripper, act, lambda: 1000 * len(given))
    loop.start()
    rows = []
    while not loop.ended and loop.error is None:
        rows += loop.rows()
        time.sleep(0.001)
    loop.stop()
    return loop, rows + loop.rows()


def test_every_command_has_its_row() -> None:
    """Assert that rows are the commands one by one, in order, with the target as a float and what was written whole."""
    gripper = LoggingGripper()
    loop, rows = run_loop(gripper, 60)
    assert [row["gripper/current_written_ma"] for row in rows] == gripper.written
    assert len(rows) == loop.commands == 60
    targets = [row["gripper/current_target_ma"] for row in rows]
    np.testing.assert_allclose(targets, 20.0 - 0.3 * np.arange(60))
    assert gripper.written == [round(target) for target in targets]
    assert [row["gripper/position_ticks"] for row in rows] == list(range(300, 360))
    assert [row["gripper/t_us"] for row in rows] == list(range(1000, 61000, 1000))


def test_late_commands_are_counted() -> None:
    """Assert that a gripper that takes three cycles is commanded less often, and each command left out is a miss."""
    loop, rows = run_loop(LoggingGripper(read_s=3 * COMMAND_MS * 1e-3), 20)
    assert loop.misses >= 19
    assert min(loop.cycle_us._values) >= 3000 * COMMAND_MS


def test_failure_is_kept_for_the_recorder() -> None:
    """Assert that an error ends the loop, can be read from it, and the rows until then too."""
    gripper = LoggingGripper(fails_at=7)
    loop, rows = run_loop(gripper, 60)
    assert isinstance(loop.error, DeviceError)
    assert len(rows) == 7


class Clock:
    """Time that passes only in the sleeps of the loop; what a test puts in `passing` happens in each."""

    def __init__(self) -> None:
        self.s = 100.0
        self.passing: Callable[[], None] = lambda: None

    def now_s(self) -> float:
        return self.s

    def sleep(self, seconds: float, wake: WakeSignal | None = None) -> bool:
        time.sleep(0)
        self.s += max(seconds, 1e-6)
        self.passing()
        return False

    def slices_read_until(self, now_s: float) -> None:
        pass


class WatchedGripper(LoggingGripper):
    """A gripper that says when it was let go of or opened, by a test's clock; nothing may be written after."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self.closed_s = self.opened_s = math.nan
        self.release_words = "torque is on"
        self.stops_at, self.stopped_s = 10**9, 0.0

    def read(self) -> GripperReading:
        if len(self.written) == self.stops_at:
            self._clock.s += self.stopped_s
        return super().read()

    def write_current(self, current_ma: int) -> None:
        assert math.isnan(self.closed_s)
        super().write_current(current_ma)

    def emergency_open(self) -> None:
        self.opened_s = self._clock.s
        self.close()

    def close(self) -> None:
        if math.isnan(self.closed_s):
            self.closed_s = self._clock.s
        self.release_words = "torque is off (read back)"


def run_watched(gripper: WatchedGripper, clock: Clock, **more: Any) -> GripperLoop:
    """Run a loop on a test's clock until it ends by itself."""
    loop = GripperLoop(gripper, lambda reading: (20.0, ""), lambda: 0, clock, 100.0, **more)
    loop.start()
    assert until(lambda: loop.ended or loop.error is not None, every_s=0.001)
    loop.stop()
    return loop


def test_a_recorder_that_hangs_ends_with_torque_off() -> None:
    """Assert that nobody fetching rows for three quarters of the watchdog's time is torque off, in words."""
    clock = Clock()
    gripper = WatchedGripper(clock)
    loop = run_watched(gripper, clock)
    assert str(loop.error).startswith("the recorder hangs: no sign of life for ")
    assert "; torque is off (read back)" in str(loop.error)
    assert gripper.closed_s == pytest.approx(100.075, abs=0.003)


def test_rows_that_are_fetched_are_a_sign_of_life() -> None:
    """Assert that the loop goes on for as long as rows are fetched, and not much longer."""
    clock = Clock()
    gripper = WatchedGripper(clock)
    loops: list[GripperLoop] = []
    clock.passing = lambda: loops[0].rows() and None if loops and clock.s < 101.0 else None
    loop = GripperLoop(gripper, lambda reading: (20.0, ""), lambda: 0, clock, 100.0)
    loops.append(loop)
    loop.start()
    assert until(lambda: loop.error is not None, every_s=0.001)
    assert gripper.closed_s == pytest.approx(101.075, abs=0.005)


@pytest.mark.parametrize("stopped_s", [0.11, 1.0, 60.0])
def test_a_loop_that_was_stopped_does_not_grip_again(stopped_s: float) -> None:
    """Assert that a program stopped for longer than the watchdog's time lets go before it commands anything."""
    clock = Clock()
    gripper = WatchedGripper(clock)
    gripper.stops_at, gripper.stopped_s = 5, stopped_s
    loop = run_watched(gripper, clock)
    assert str(loop.error).startswith("the program was stopped for ")
    assert "; torque is off (read back)" in str(loop.error)
    assert len(gripper.written) == 5


class Key:
    """An emergency key that is pressed at a time."""

    def __init__(self, clock: Clock, at_s: float) -> None:
        self._clock, self._at_s = clock, at_s

    @property
    def pressed(self) -> bool:
        return self._clock.s >= self._at_s


def test_the_emergency_key_opens() -> None:
    """Assert that it opens at the next command and ends the loop with its own word, and no error."""
    clock = Clock()
    gripper = WatchedGripper(clock)
    loop = run_watched(gripper, clock, key=Key(clock, 100.03))
    assert (loop.ended, loop.error) == (OPENED, None)
    assert gripper.opened_s == pytest.approx(100.03, abs=0.003)
    assert gripper.release_words == "torque is off (read back)"
