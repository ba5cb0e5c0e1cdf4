"""Driver of the ROBOTIS RH-P12-RN(A) gripper: one answered transaction per cycle, and no current left on afterwards.

In current mode the goal is a motor current. In position mode (the maker's current-based position mode) it is a
position, reached with P gain and a maximum current. Closing is positive in both. Limits are read from the device; a
command beyond them is clamped to them and counted. One cycle is a read of current, speed and position, and a command
without an answer. Every 100th command is answered, which proves that commands arrive. Two others of each hundred are
followed by a check: one of torque, one of supply and temperature (measurements.py). A second command in a cycle, for
example when slip is answered between two steps of a loop, is only sent: it requests no answer that would delay the next
read.

However the driver ends (close, an error, Ctrl-C, the end of the program, SIGTERM, a lost terminal), it sets current 0
and torque off, and `release_words` report what was read back. Events that no program can handle (SIGKILL, a pulled
plug) are left to the servo's Bus Watchdog, which stops the motor. After 100 ms of silence a program loses the gripper
and gets an error that explains it. Setting up leaves torque off, and the first command switches it on, watchdog first
(torque.py). So a program may take its time before that command. Only commands reset the watchdog: no thread, no timer.

EEPROM is written only if a needed value differs (operating mode, return delay), with torque off, and is listed in
`described`. Nothing is ever reset to factory values. Sources: hardware notes on the control table; the set-up order and
P gain 50 are from a driver by Evetac's authors.
"""

import atexit
import contextlib
import operator
import os
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from evetac_cli import console
from evetac_cli.devices import GripperReading
from evetac_cli.devices.rh_p12_rn.control_table import (
    CURRENT_MODE,
    LAST_ID,
    POSITION_MODE,
    RETURN_DELAY_US,
    WATCHDOG_MS,
    WATCHDOG_TRIPPED,
    baud_code,
    check_model,
)
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import ANSWER_MS, RANGE_FAULT, Bus, InstructionRefused
from evetac_cli.devices.rh_p12_rn.measurements import Measurements
from evetac_cli.devices.rh_p12_rn.torque import SETTLE_S, Torque
from evetac_cli.errors import DeviceError, EvetacError, check_range, check_whole
from evetac_cli.interrupts import end_in_order

Mode = Literal["current", "position"]
CHECK_EVERY = 100  # commands between two that are answered
# positions of the checks within these, each after a different command, so that no cycle takes too long
TORQUE_AT, SUPPLY_AT = 33, 66
SET_UP_TRIES = 5
OPENING_STEP_S = 0.005  # between two commands while opening
LONGEST_OPENING_S = 10.0
_GOAL = {"current": "Goal Current", "position": "Goal Position"}
_T = TypeVar("_T")


@dataclass(frozen=True)
class RhP12RnSettings:
    """Settings of a gripper; None for max_current_ma is the device's own limit."""

    id: int = 1
    p_gain: int = 50  # register Position P Gain (paper: K_p)
    max_current_ma: int | None = None
    first_tick: int = 0  # open
    last_tick: int = 740  # closed, with the maker's fingers; wider ones touch each other earlier
    watchdog_ms: int = 100
    return_delay_us: int | None = 0  # None keeps the device's value
    answer_ms: float = ANSWER_MS

    def __post_init__(self) -> None:
        check_range("id", self.id, 0, LAST_ID)
        check_range("p_gain", self.p_gain, 0, 32767)
        check_range("last_tick", self.last_tick, self.first_tick, above=True)
        check_range("answer_ms", self.answer_ms, above=True)
        if self.max_current_ma is not None:
            check_range("max_current_ma", self.max_current_ma, above=True)
        if self.return_delay_us is not None:
            check_whole("return_delay_us", self.return_delay_us, 0, 254 * RETURN_DELAY_US, step=RETURN_DELAY_US)
        check_whole("watchdog_ms", self.watchdog_ms, WATCHDOG_MS, 127 * WATCHDOG_MS, step=WATCHDOG_MS)


class RhP12Rn(AbstractContextManager["RhP12Rn"]):
    """A gripper with torque on from the first command to `close`; also a context manager."""

    def __init__(
        self,
        port: str,
        baud: int = 2_000_000,
        mode: Mode = "current",
        settings: RhP12RnSettings = RhP12RnSettings(),  # frozen: may be shared
    ) -> None:
        """Open the port and set the gripper up, with torque off.

        DeviceError or DeviceTimeout if it is missing, of another model, or has a hardware error.
        """
        if mode not in _GOAL:
            raise ValueError(f"mode must be current or position, found {mode!r}")
        self._mode, self._settings = mode, settings
        self._closed = False
        self._is_ours = False  # whether it is the model that this driver is for
        self._clamped = self._commands = 0  # commands: only the first in each cycle are counted
        self._in_cycle = 0  # commands since the last reading, up to the next counted one
        self._alone = threading.RLock()  # at the end of a program another thread may be in the middle of a command
        self._process = os.getpid()  # a child process that inherits this object must not touch the gripper
        self._spoken_s = time.monotonic()
        self._silent_ms = 0.0  # the longest silence since an answered command
        self._bus = Bus(port, baud, settings.id, answer_ms=settings.answer_ms)
        self._torque = Torque(self._bus, settings.watchdog_ms)
        self._measured = Measurements(self._bus, self._torque)
        _close_at_exit(self)
        try:
            self._bus.settle_s = SETTLE_S
            self.described: Mapping[str, Any] = self._set_up_soundly()
            self._bus.settle_s = 0.0
        except DeviceError as error:
            raise self._given_up(error) from error
        except BaseException:
            if self._is_ours:
                self._torque.switch_off()
            self._end()
            raise

    @property
    def release_words(self) -> str:
        """The known state of torque.

        After `close`, the state that was read back, or why that failed and what happens then.
        """
        return self._torque.words

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far: answers_lost, answers_damaged, answers_stray, commands_clamped and readings_impossible."""
        return {
            **self._bus.counted,
            "commands_clamped": self._clamped,
            "readings_impossible": self._measured.impossible,
        }

    def read(self) -> GripperReading:
        """Return present current (mA) and position (ticks), read in one transaction.

        DeviceError if they are impossible.
        """
        self._in_cycle = 0
        return self._attempt(self._measured.read)

    def write_current(self, current_ma: int) -> None:
        """Set the goal current in mA, clamped to the limit; only in current mode."""
        self._command("current", current_ma, -self._limit_ma, self._limit_ma)

    def write_position(self, goal_ticks: int) -> None:
        """Set the goal position in ticks, clamped to the range; only in position mode."""
        self._command("position", goal_ticks, *self._range_ticks)

    def close(self) -> None:
        """Set current 0 and torque off, and close the port; a second call does nothing.

        DeviceError unless torque was read back as off.
        """
        if os.getpid() != self._process:
            return
        with self._alone:
            if self._closed:
                return
            try:
                released = self._torque.switch_off()
            finally:
                self._end()
        if not released:
            raise DeviceError(self.release_words, where=self._where, hint="switch 24 V off if the fingers still press")

    def emergency_open(self, current_ma: int = 100, seconds: float = 0.5) -> None:
        """Open with at most this current for this time, then switch torque off and close.

        This is the action of an emergency key. Commands of other threads wait, and then find the driver closed.
        DeviceError for the same reasons as a command and `close`; ValueError for a current below 1 mA, or a time that
        is not above 0 and at most 10 s.
        """
        if operator.index(current_ma) < 1 or not 0 < seconds <= LONGEST_OPENING_S:
            raise ValueError(f"expected 1 mA or more and 0 to {LONGEST_OPENING_S:g} s, found {current_ma}, {seconds}")
        most_ma = min(current_ma, self._limit_ma)
        goals = {"Goal Current": most_ma, "Goal Position": self._range_ticks[0]}
        if self._mode == "current":
            goals = {"Goal Current": -most_ma}
        with self._alone:
            try:
                until_s = time.monotonic() + seconds
                while time.monotonic() < until_s:
                    self._attempt(lambda: self._put(goals))
                    self._attempt(self._measured.require_torque)
                    time.sleep(OPENING_STEP_S)
            finally:
                self.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def port(self) -> str:
        """The serial port, as it was named."""
        return self._bus.port

    @property
    def _where(self) -> str:
        return f"gripper at {self.port}"

    # Setting up

    def _set_up_soundly(self) -> dict[str, Any]:
        """Repeat the set-up until no answer is lost: a late answer may have been taken for that to another question."""
        written: dict[str, list[int]] = {}
        for _ in range(SET_UP_TRIES):
            before = sum(self._bus.counted.values())
            described = self._set_up(written)
            if sum(self._bus.counted.values()) == before:
                return described
            time.sleep(SETTLE_S)
        raise DeviceError(
            "answers keep getting lost",
            where=self._where,
            expected=f"a set-up without lost answers within {SET_UP_TRIES} tries",
            found=", ".join(f"{name} {count}" for name, count in self._bus.counted.items()),
            hint="check cable, power and ground",
        )

    def _set_up(self, written: dict[str, list[int]]) -> dict[str, Any]:
        bus, settings = self._bus, self._settings
        bus.tolerant = True  # a hardware error is handled below; first check the model
        check_model(bus.ping(), self._where)
        bus.tolerant, self._is_ours = False, True
        bus.send("Status Return Level", 2)  # otherwise it may not answer the next instructions
        self._torque.clear()
        needed = {"Operating Mode": CURRENT_MODE if self._mode == "current" else POSITION_MODE}
        if settings.return_delay_us is not None:
            needed["Return Delay Time"] = settings.return_delay_us // RETURN_DELAY_US
        for name, value in needed.items():
            if (before := bus.read(name)) != value:
                bus.write(name, value)
                written[name] = [before, value]
        limit_ma = bus.read("Current Limit")
        self._limit_ma = min(limit_ma, settings.max_current_ma or limit_ma)
        self._measured.set_up()
        lowest, highest = self._measured.limits_ticks
        self._range_ticks = max(lowest, settings.first_tick), min(highest, settings.last_tick)
        if self._range_ticks[0] >= self._range_ticks[1]:
            raise DeviceError(
                "the gripper's position limits leave no range of motion",
                where=self._where,
                expected=f"limits that overlap {settings.first_tick} to {settings.last_tick} ticks",
                found=f"{lowest} to {highest}",
            )
        return {
            "model": "RH-P12-RN(A)",
            "firmware": bus.read("Firmware Version"),
            "id": settings.id,
            "baud": bus.baud,
            "mode": self._mode,
            "p_gain": settings.p_gain if self._mode == "position" else bus.read("Position P Gain"),
            "current_limit_ma": self._limit_ma,
            "range_ticks": list(self._range_ticks),
            "watchdog_ms": settings.watchdog_ms,
            "return_delay_us": bus.read("Return Delay Time") * RETURN_DELAY_US,
            "eeprom_written": written,
        }

    # Commands

    def _command(self, mode: Mode, value: int, low: int, high: int) -> None:
        if mode != self._mode:
            raise DeviceError(f"a {mode} command to a gripper opened in {self._mode} mode", where=self._where)
        goal = min(max(operator.index(value), low), high)
        self._clamped += goal != value
        self._in_cycle += 1
        # without a reading, the third and later commands count, so that a program that never reads is checked too
        between = self._in_cycle == 2
        self._attempt(lambda: self._command_once(goal, between=between))
        self._commands += not between

    def _command_once(self, goal: int, *, between: bool) -> None:
        """Send one command.

        It is answered every CHECK_EVERY commands, and after a silence that may have tripped the watchdog.

        between: whether it is the second command in a cycle.
        """
        name = _GOAL[self._mode]
        spoke = self._silent_ms < 0.5 * self._settings.watchdog_ms
        if not self._torque.is_on:
            self._put({name: goal} if self._mode == "current" else {name: goal, "Goal Current": self._limit_ma})
        elif (between or self._commands % CHECK_EVERY) and spoke:
            self._bus.send(name, goal)
        else:
            self._put({name: goal})
        place = 0 if between else self._commands % CHECK_EVERY
        if place == TORQUE_AT:
            self._measured.require_torque()
        elif place == SUPPLY_AT:
            self._measured.require_supply()

    def _put(self, goals: Mapping[str, int]) -> None:
        """Write goals with an answer, with torque on; in position mode the current limit follows the position."""
        if not self._torque.is_on:
            if self._mode == "position":  # now, not during set-up: it may have restarted since
                self._bus.write("Position P Gain", self._settings.p_gain)
            self._torque.switch_on(self._here_ticks() if self._mode == "position" else None)
        try:
            for name, goal in goals.items():
                self._bus.write(name, goal)
        except InstructionRefused as refused:
            if refused.fault == RANGE_FAULT and self._bus.read("Bus Watchdog") == WATCHDOG_TRIPPED:
                raise DeviceError(
                    "the gripper's bus watchdog has tripped and stopped it",
                    where=self._where,
                    expected=f"a command at least every {self._settings.watchdog_ms} ms",
                    found=f"longest silence {self._silent_ms:.0f} ms, by this program's clock",
                    hint="is the computer overloaded?",
                ) from refused
            raise
        self._silent_ms = 0.0

    def _here_ticks(self) -> int:
        """Return the present position of the fingers, within the gripper's own limits."""
        lowest, highest = self._measured.limits_ticks
        return min(max(self._measured.read().position_ticks, lowest), highest)

    def _attempt(self, action: Callable[[], _T]) -> _T:
        """Run a transaction; on any failure switch torque off and add the read-back state to the error."""
        with self._alone:
            if self._closed:
                raise DeviceError("the gripper is closed", where=self._where)
            self._silent_ms = max(self._silent_ms, (time.monotonic() - self._spoken_s) * 1e3)
            try:
                result = action()
            except DeviceError as error:
                raise self._given_up(error) from error
            self._spoken_s = time.monotonic()
            return result

    def _given_up(self, error: DeviceError) -> DeviceError:
        """End the driver, and return the error with the state of torque added; nothing is written to another model."""
        if self._is_ours:
            self._torque.switch_off()
        self._end()
        if not self._is_ours:
            return error
        return type(error)(f"{error}\n  then:     {self.release_words}")

    def _end(self) -> None:
        self._bus.close()
        self._closed = True
        if self in _OPEN:
            _OPEN.remove(self)


def change_baud(port: str, baud: int, new_baud: int, *, id_: int = 1, answer_ms: float = ANSWER_MS) -> None:
    """Set the gripper's baud rate in its EEPROM with torque off, and find it again; an equal rate is not written.

    A held object may fall. DeviceError if the gripper does not answer at the new rate; ValueError if there is no such
    rate.
    """
    code = baud_code(new_baud)
    with Bus(port, baud, id_, answer_ms=answer_ms) as bus:
        bus.settle_s, bus.tolerant = SETTLE_S, True
        check_model(bus.ping(), f"gripper at {port}")
        bus.write("Torque Enable", 0)
        if bus.read("Baud Rate") != code:
            try:
                bus.write("Baud Rate", code)
            except InstructionRefused:
                raise
            except DeviceError:
                pass  # the answer may already have arrived at the new rate: the ping below decides
    with Bus(port, new_baud, id_, answer_ms=answer_ms) as bus:
        bus.tolerant = True
        bus.ping()


# Grippers that are released when the program ends. At SIGTERM and SIGHUP Python ends at once, unless a handler is set.
_OPEN: list[RhP12Rn] = []


def _close_at_exit(gripper: RhP12Rn) -> None:
    """Close the gripper when the program ends; signals that would end it at once now end it in order."""
    if not _OPEN:
        atexit.unregister(_close_all)
        atexit.register(_close_all)
    _OPEN.append(gripper)
    end_in_order()


def _close_all() -> None:
    """Close grippers that the program left open, and print what was read back, if output is still possible."""
    for gripper in _OPEN.copy():
        with contextlib.suppress(EvetacError):
            gripper.close()
        with contextlib.suppress(OSError, ValueError, AttributeError):
            console.say(f"gripper at {gripper.port}: {gripper.release_words}")
