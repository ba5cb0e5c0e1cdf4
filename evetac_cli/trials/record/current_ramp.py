"""What a gripper does in a recording from devices: it closes until contact, holds, and lets the current fall.

Or it follows the current that a scene names (gripper.current).

The law is a pure start/step state machine; the loop runs it at 500 Hz in a thread of its own, so that a gripper that
answers late does not hold up the camera. Whoever fetches its rows records, and shows by that that it is alive: where it
is not for FRESH of the watchdog's time (or RECORDER_MS), or the loop itself was stopped for longer than that time, the
gripper is let go of before it is commanded again. (paper, "Experimental Setup and Data Collection Procedure"; in a
simulated scene simulated.py commands in step with the scene's time instead.)
"""

import math
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.devices import Gripper, GripperReading, gripper_row
from evetac_cli.devices.rh_p12_rn.close_until_contact import Closing, ClosingSettings
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.realtime.emergency_key import EmergencyKey
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.sim.setup.held import GripperCurrent
from evetac_cli.trials.session import FRESH, OPENED, OVERLOADED, RECORDER_MS, TimeSample

COMMAND_MS = 2  # the gripper is commanded at 500 Hz
RAMP_MA = (-0.025, -0.0025)  # change of the target current a command (paper)
HANGS_S = 0.5  # a loop that gave no command for so long, or some times the watchdog's time, hangs
HANGS_WATCHDOGS = 4
OPENING_S = 2.0  # so much longer while it opens the gripper
END_S = 5.0  # for the command that is under way, at the end
OPENED_TICKS = 30  # an object is lost once the fingers are so far apart again: 4 mm


class RampPhase(IntEnum):
    """The three phases of a recording with a gripper, in their order."""

    CLOSING = 0
    HOLDING = 1
    FALLING = 2


@dataclass(frozen=True)
class Hold:
    """How an object is gripped and let go, in motor current; closing is positive.

    course: what the current follows instead, from the first command on; fall_factor: on how fast the current falls.
    """

    closing_ma: int
    holding_ma: float
    hold_s: float
    lowest_ma: float  # the recording ends where the target falls below
    course: GripperCurrent | None = None
    fall_factor: float = 1.0


@dataclass
class HoldState:
    """The state between two commands."""

    closing: Closing
    phase: RampPhase = RampPhase.CLOSING
    target_ma: float = math.nan
    touch_ticks: int = 0
    held: int = 0
    ended: str = ""  # why there is nothing left to do


def start(hold: Hold) -> HoldState:
    """The state before the first command."""
    return HoldState(Closing(ClosingSettings(current_ma=hold.closing_ma)))


def step(state: HoldState, hold: Hold, reading: GripperReading, rng: np.random.Generator) -> float:
    """One command: returns the target current in mA, and sets `state.ended` in words once there is nothing left to do.

    The target falls by fall_factor times U(-0.025, -0.0025) mA per command (paper, with a factor of 1); what is written
    to the gripper is its whole number. DeviceError if the fingers meet nothing.
    """
    if hold.course is not None:
        time_s = state.held * COMMAND_MS * 1e-3
        state.held += 1
        state.target_ma = hold.course.at(time_s)
        state.ended = "the gripper has followed its current to the end" if time_s >= hold.course.ends_s else ""
        return state.target_ma
    if state.phase is RampPhase.CLOSING:
        state.target_ma = hold.closing_ma
        if state.closing.step(reading.position_ticks):
            state.phase = RampPhase.HOLDING
    if state.phase is RampPhase.HOLDING:
        state.target_ma = hold.holding_ma
        state.touch_ticks = reading.position_ticks
        state.held += 1
        if state.held * COMMAND_MS > 1000 * hold.hold_s:
            state.phase = RampPhase.FALLING
    elif state.phase is RampPhase.FALLING:
        state.target_ma += hold.fall_factor * rng.uniform(*RAMP_MA)
        if state.target_ma <= hold.lowest_ma:
            state.ended = "the current reached its lower limit"
        elif reading.position_ticks <= state.touch_ticks - OPENED_TICKS:
            state.ended = "the gripper opened"
    return state.target_ma


class RecorderHangs(DeviceError):
    """Whoever records gives no sign of life; it cannot say so itself now."""


class GripperLoop:
    """A thread that reads and commands a gripper every 2 ms, and keeps a row of each command until it is fetched."""

    def __init__(
        self,
        gripper: Gripper,
        act: Callable[[GripperReading], tuple[float, str]],
        now_us: Callable[[], int],
        time: TimeSource = HOST_TIME,
        watchdog_ms: float = math.inf,
        key: EmergencyKey | None = None,
    ) -> None:
        """act: (target current in mA, why it is over or "") for a reading; now_us: device time of the recording.

        time: by which the loop goes; watchdog_ms: of the gripper; key: opens the gripper, and ends the loop.
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
        self._fetched_s = self._alive_s = math.inf  # when rows were last fetched, and when the loop last commanded
        self._error: Exception | None = None
        self.commands = 0
        self.misses = 0  # times at which no command was given, because the one before took too long
        self.cycle_us = TimeSample()  # time that reading and commanding took
        self.ended = ""

    def start(self) -> None:
        """Begin to command the gripper."""
        self._fetched_s = self._alive_s = self._time.now_s()
        self._thread.start()

    def stop(self) -> None:
        """End after the command that is under way; the gripper is not used after this returns."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(END_S)

    def rows(self) -> list[dict[str, Any]]:
        """The rows of the commands given since the last call, oldest first; shows that somebody records."""
        self._fetched_s = self._time.now_s()
        return [self._rows.popleft() for _ in range(len(self._rows))]

    @property
    def error(self) -> Exception | None:
        """What failed, that the loop hangs included; None if nothing did."""
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
        except Exception as error:  # raised by the thread that records
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
        """DeviceError where no command may be given: this loop was stopped, or nobody records."""
        now_s = self._time.now_s()
        if self.commands and now_s - self._alive_s > self._watchdog_s:  # the servo has let go, and must not grip again
            stopped_ms = (now_s - self._alive_s) * 1e3
            raise DeviceError(f"the program was stopped for {stopped_ms:.0f} ms", hint=OVERLOADED)
        if now_s - self._fetched_s > max(FRESH * self._watchdog_s, 1e-3 * RECORDER_MS):
            silent_ms = (now_s - self._fetched_s) * 1e3
            raise RecorderHangs(f"the recorder hangs: no sign of life for {silent_ms:.0f} ms", hint=OVERLOADED)

    def _open(self) -> None:
        """What the emergency key does."""
        self._alive_s += OPENING_S
        self._gripper.emergency_open()
        self.ended = OPENED

    def _let_go(self, error: Exception) -> None:
        """Torque off at once, whatever the thread that records is doing; then let that one know."""
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
