"""The gripper in a recording from devices: it closes until contact, holds, and then lowers the current.

Alternatively it follows the current that a scene names (gripper.current).

The law is a pure start/step state machine (paper, "Experimental Setup and Data Collection Procedure"). GripperLoop runs
it at 500 Hz in a thread of its own, so that a gripper that answers late does not delay the camera. The recording thread
fetches the loop's rows, which also shows that it is alive. The loop switches torque off before its next command if the
recording thread gave no sign of life for FRESH of the watchdog's time (or RECORDER_MS if longer). It does the same if
it was itself stopped for longer than the watchdog's time. In a simulated scene there is no loop; simulated.py
commands in step with the scene's time.
"""

import math
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.devices import Gripper, GripperReading, gripper_row
from evetac_cli.errors import DeviceError, EvetacError, InputError
from evetac_cli.realtime.emergency_key import EmergencyKey
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.sim.setup.held import GripperCurrent
from evetac_cli.trials.session import (
    FRESH,
    HANGS_S,
    HANGS_WATCHDOGS,
    OPENED,
    OPENING_S,
    OVERLOADED,
    RECORDER_MS,
    TimeSample,
)

COMMAND_MS = 2  # the gripper is commanded at 500 Hz
RAMP_MA = (-0.025, -0.0025)  # change of the target current per command (paper)
END_S = 5.0  # time for the command in progress, at the end
STILL_COMMANDS = 150  # commands without a new position that count as contact
MOST_CLOSING_COMMANDS = 10_000
LAST_TICK = 717  # the gap is 0 here (sim/gripper.py): the fingers touch each other
OPENED_TICKS = 30  # an object counts as lost once the fingers are this far apart again: 4 mm


class RampPhase(IntEnum):
    """The three phases of a recording with a gripper, in order."""

    CLOSING = 0
    HOLDING = 1
    FALLING = 2


@dataclass(frozen=True)
class Hold:
    """How an object is gripped and released, in motor current; closing is positive.

    course: a current to follow instead, starting at the first command; fall_factor: factor on the rate at which the
    current falls. InputError for a current that cannot fall.
    """

    closing_ma: int
    holding_ma: float | None  # None: a simulated scene draws it for each trial
    hold_s: float
    lowest_ma: float  # the recording ends when the target falls below this
    course: GripperCurrent | None = None
    fall_factor: float = 1.0

    def __post_init__(self) -> None:
        if self.course is None and self.holding_ma is not None and self.lowest_ma >= self.holding_ma:
            raise InputError(
                "the current would not fall",
                where="--lowest-ma",
                expected=f"less than the holding current, {self.holding_ma:g} mA (--holding-ma)",
                found=f"{self.lowest_ma:g} mA",
            )

    def of_trial(self, sampled_ma: float, fall_factor: float) -> "Hold":
        """Return the hold of one trial, whose scene draws both arguments; a current that was asked for stays."""
        holding_ma = sampled_ma if self.holding_ma is None else self.holding_ma
        return replace(self, holding_ma=holding_ma, fall_factor=fall_factor)

    def __str__(self) -> str:
        if self.course is not None:
            lowest, highest = min(self.course.ma), max(self.course.ma)
            return f"follows a current of {lowest:g} to {highest:g} mA for {self.course.ends_s:g} s"
        holding = "the current of its scene" if self.holding_ma is None else f"{self.holding_ma:g} mA"
        return (
            f"closes with {self.closing_ma:g} mA until contact, holds with {holding} for {self.hold_s:g} s,"
            f" lowers the current to {self.lowest_ma:g} mA"
        )


@dataclass
class HoldState:
    """The state between two commands."""

    phase: RampPhase = RampPhase.CLOSING
    closing_commands: int = 0
    still_commands: int = 0  # since the position was last a new one
    furthest_ticks: float = -math.inf
    target_ma: float = math.nan
    touch_ticks: int = 0
    held_commands: int = 0  # number of commands while holding; with a course, since its start
    ended: str = ""  # why the sequence is over; "" before


def _touches(state: HoldState, position_ticks: int) -> bool:
    """Return whether the closing fingers have stopped at something.

    DeviceError if they closed fully, or still move after MOST_CLOSING_COMMANDS. In the simulated drive, 10 mA is just
    more than the gear's friction, and a tick takes 0.09 s. A driver by Evetac's authors closes at the same current.
    """
    state.closing_commands += 1
    state.still_commands += 1
    if position_ticks > state.furthest_ticks:
        state.still_commands = int(math.isinf(state.furthest_ticks))  # the first reading is no motion
        state.furthest_ticks = position_ticks
    if position_ticks >= LAST_TICK:
        expected, hint = f"contact before {LAST_TICK} ticks", "put an object between the fingers"
        found = f"{position_ticks} ticks"
        raise DeviceError("the gripper closed without contact", expected=expected, found=found, hint=hint)
    if state.still_commands >= STILL_COMMANDS:
        return True
    if state.closing_commands >= MOST_CLOSING_COMMANDS:
        expected = f"contact within {MOST_CLOSING_COMMANDS} commands"
        hint = "open it less beforehand, or close with more current"
        raise DeviceError("the gripper is still closing", expected=expected, hint=hint)
    return False


def step(state: HoldState, hold: Hold, reading: GripperReading, rng: np.random.Generator) -> float:
    """Return the target current of one command in mA, and set `state.ended` to the reason once the sequence is over.

    The target falls by fall_factor times U(-0.025, -0.0025) mA per command (paper, with a factor of 1). The integer
    nearest to it is written to the gripper. DeviceError if the fingers close without contact.
    """
    if hold.course is not None:
        time_s = state.held_commands * COMMAND_MS * 1e-3
        state.held_commands += 1
        state.target_ma = hold.course.at(time_s)
        state.ended = "the gripper has followed its current to the end" if time_s >= hold.course.ends_s else ""
        return state.target_ma
    if state.phase is RampPhase.CLOSING:
        state.target_ma = hold.closing_ma
        if _touches(state, reading.position_ticks):
            state.phase = RampPhase.HOLDING
    if state.phase is RampPhase.HOLDING:
        assert hold.holding_ma is not None  # of_trial has asked the scene
        state.target_ma = hold.holding_ma
        state.touch_ticks = reading.position_ticks
        state.held_commands += 1
        if state.held_commands * COMMAND_MS > 1000 * hold.hold_s:
            state.phase = RampPhase.FALLING
    elif state.phase is RampPhase.FALLING:
        state.target_ma += hold.fall_factor * rng.uniform(*RAMP_MA)
        if state.target_ma <= hold.lowest_ma:
            state.ended = "the current reached its lower limit"
        elif reading.position_ticks <= state.touch_ticks - OPENED_TICKS:
            state.ended = "the gripper opened"
    return state.target_ma


class RecorderHangs(DeviceError):
    """The recording thread gives no sign of life; it cannot report that itself now."""


class GripperLoop:
    """A thread that reads and commands a gripper every 2 ms, and keeps a row per command until it is fetched."""

    def __init__(
        self,
        gripper: Gripper,
        act: Callable[[GripperReading], tuple[float, str]],
        now_us: Callable[[], int],
        time: TimeSource = HOST_TIME,
        watchdog_ms: float = math.inf,
        key: EmergencyKey | None = None,
    ) -> None:
        """act: returns (target current in mA, reason for the end or "") for a reading.

        now_us: device time of the recording; time: time source of the loop; watchdog_ms: of the gripper; key: opens the
        gripper, and ends the loop.
        """
        self._gripper = gripper
        self._act = act
        self._now_us = now_us
        self._time = time
        self._watchdog_s = 1e-3 * watchdog_ms
        self._key = key
        self._rows: deque[dict[str, Any]] = deque()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gripper", daemon=True)
        self._fetched_s = self._alive_s = math.inf  # time of the last fetch of rows, and of the loop's last command
        self._error: Exception | None = None
        self.commands = 0
        self.misses = 0  # missed commands, because the one before took too long
        self.cycle_us = TimeSample()  # duration of reading and commanding
        self.ended = ""

    def start(self) -> None:
        """Start commanding the gripper."""
        self._fetched_s = self._alive_s = self._time.now_s()
        self._thread.start()

    def stop(self) -> None:
        """End after the command in progress; the gripper is not used after this returns."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(END_S)

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of commands since the last call, oldest first; the call shows that the recording is alive."""
        self._fetched_s = self._time.now_s()
        return [self._rows.popleft() for _ in range(len(self._rows))]

    @property
    def error(self) -> Exception | None:
        """The failure of the loop, including a hang; None without one."""
        silent_s = self._time.now_s() - self._alive_s
        if (
            self._error is None
            and self._thread.is_alive()
            and silent_s > max(HANGS_S, HANGS_WATCHDOGS * self._watchdog_s)
        ):
            return DeviceError(f"the loop that commands the gripper hangs: no command for {silent_s:.1f} s")
        return self._error

    def _run(self) -> None:
        try:
            due = self._time.now_s()
            while not (self._stop.is_set() or self.ended):
                started = self._time.now_s()
                if self._key is not None and self._key.pressed:
                    self._open()
                    return
                self._command()
                now = self._time.now_s()
                self.cycle_us.add((now - started) * 1e6)
                due += COMMAND_MS * 1e-3
                if now > due + COMMAND_MS * 1e-3:
                    missed = int((now - due) / (COMMAND_MS * 1e-3))
                    self.misses += missed
                    due += missed * COMMAND_MS * 1e-3
                self._time.sleep(max(0.0, due - now))
        except Exception as error:  # raised by the recording thread
            self._let_go(error)

    def _command(self) -> None:
        reading = self._gripper.read()
        target_ma, self.ended = self._act(reading)
        now_us = self._now_us()
        written_ma = round(target_ma)
        self._check_that_all_live()
        self._gripper.write_current(written_ma)
        self._alive_s = self._time.now_s()
        self._rows.append(gripper_row(now_us, reading, target_ma=target_ma, written_ma=written_ma))
        self.commands += 1

    def _check_that_all_live(self) -> None:
        """Raise DeviceError if no command may be sent: this loop was stopped, or the recording thread hangs."""
        now_s = self._time.now_s()
        # the servo's watchdog has stopped the motor, which must not grip again
        if self.commands and now_s - self._alive_s > self._watchdog_s:
            stopped_ms = (now_s - self._alive_s) * 1e3
            raise DeviceError(f"the program was stopped for {stopped_ms:.0f} ms", hint=OVERLOADED)
        if now_s - self._fetched_s > max(FRESH * self._watchdog_s, 1e-3 * RECORDER_MS):
            silent_ms = (now_s - self._fetched_s) * 1e3
            raise RecorderHangs(f"the recorder hangs: no sign of life for {silent_ms:.0f} ms", hint=OVERLOADED)

    def _open(self) -> None:
        """Open the gripper: the action of the emergency key."""
        self._alive_s += OPENING_S
        self._gripper.emergency_open()
        self.ended = OPENED

    def _let_go(self, error: Exception) -> None:
        """Switch torque off at once, without waiting for the recording thread; then store the error for it."""
        try:
            self._gripper.close()
        except DeviceError as failed:
            error = failed if not isinstance(error, DeviceError) else error
        torque = self._gripper.release_words
        if isinstance(error, EvetacError) and torque not in str(error):
            error.message += f"; {torque}"
        self._error = error
        if isinstance(error, RecorderHangs):
            with suppress(OSError):  # there may be no terminal any more
                console.say(f"error: {error}")
