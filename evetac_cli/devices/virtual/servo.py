"""The logic of an RH-P12-RN(A): control table, instructions, errors and watchdog, without a port or its own clock.

Frames and the time go in; answers and their delays come out. So a test can drive it step by step. Simulated: it
moves a plant (servo_plant).

Where the maker's manual is unclear, this servo is strict. Goal Current starts at 0. A wrong CRC is answered with error
3. A tripped watchdog cuts the motor current, leaves Torque Enable as it is and accepts only 0. An overload switches
torque off until reboot. It knows the instructions that the driver and the maker's library use for one gripper: ping,
read, write, sync write and reboot. Profiles, PWM, and the integral and derivative gains of position are registers
without effect.
"""

import struct
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from evetac_cli.devices.rh_p12_rn import control_table as table
from evetac_cli.devices.rh_p12_rn.control_table import BY_ADDRESS, REGISTERS, Register
from evetac_cli.devices.virtual.dynamixel_frames import (
    BROADCAST_ID,
    DynamixelFrame,
    Instruction,
    StatusError,
    status,
)
from evetac_cli.devices.virtual.servo_plant import Goals, Plant

TICK_DEG = 0.088
_TICK_MS = 32768  # Realtime Tick wraps at this value
_OVERLOAD = 1 << table.HARDWARE_ERRORS.index("overload")
_LIMITED_BY = {"Goal PWM": "PWM Limit", "Goal Current": "Current Limit", "Goal Velocity": "Velocity Limit"}
_GOALS = (*_LIMITED_BY, "Goal Position")


class Answer(NamedTuple):
    """Bytes for the wire, and the time in s from the receipt of the frame until the last byte has left the servo."""

    data: bytes
    after_s: float


class ServoRefused(Exception):
    """An instruction was not carried out; `fault` is the error of its answer."""

    def __init__(self, fault: StatusError) -> None:
        self.fault = fault


class VirtualServo:
    """One servo: `handle` takes a frame and returns the answers; `tick` lets time pass."""

    def __init__(self, plant: Plant, registers: Mapping[str, int], now_s: float) -> None:
        """registers: values that differ from the factory values; ValueError for an unknown name or a wrong size."""
        self._plant = plant
        self._booted_s = self._last_byte_s = self._now_s = now_s
        self.instructions: Counter[int] = Counter()  # how often each instruction was received
        self.false_readings: Mapping[str, int] = {}  # values that registers show instead of the measured ones
        self._memory = bytearray(table.TABLE_SIZE)
        for register in table.TABLE:
            self._set(register.name, register.default)
        for name, value in registers.items():
            if name not in REGISTERS:
                raise ValueError(f"{name} is not a register of the gripper")
            self._set(name, value)
        self._ram = bytes(self._memory[table.RAM_START :])  # RAM as after a restart
        self._supply = {name: self._get(name) for name in ("Present Input Voltage", "Present Temperature")}
        self._motion = self._plant.advance(Goals(), now_s)
        self._set("Goal Position", self._motion.position_ticks)
        self._apply_registers()

    def value(self, name: str) -> int:
        """Return a register's value, with measurements up to date."""
        self._measure()
        return self._get(name)

    @property
    def baud(self) -> int:
        """The baud rate of the servo."""
        return table.BAUD_RATES[self._get("Baud Rate")]

    @property
    def torque(self) -> bool:
        """Whether torque is on."""
        return bool(self._get("Torque Enable"))

    def _get(self, name: str) -> int:
        register = REGISTERS[name]
        return register.decode(self._memory[register.address : register.address + register.size])

    def _set(self, name: str, value: int) -> None:
        register = REGISTERS[name]
        self._memory[register.address : register.address + register.size] = register.encode(value)

    # Events

    def tick(self, now_s: float) -> None:
        """Let the plant move until now, and trip the watchdog if the host was silent."""
        self._now_s = now_s
        if self._watchdog_s and now_s - self._last_byte_s > self._watchdog_s:
            self.trip()
        self._motion = self._plant.advance(self._goals, now_s)

    def forgive(self, frozen_s: float) -> None:
        """Exclude a time (s) for which this process was stopped: the host was not silent then."""
        self._last_byte_s += frozen_s

    def trip(self) -> None:
        """Trip the Bus Watchdog: no current, and goals are refused until 0 is written to it."""
        self._set("Bus Watchdog", table.WATCHDOG_TRIPPED)
        self._apply_registers()

    def overload(self) -> None:
        """Raise an overload error; torque goes off if Shutdown includes it."""
        self._set("Hardware Error Status", self._get("Hardware Error Status") | _OVERLOAD)
        if self._get("Shutdown") & _OVERLOAD:
            self._set("Torque Enable", 0)
        self._apply_registers()

    def restart(self, now_s: float) -> None:
        """Restart, as after a short power cut or a reboot: no torque, no watchdog, no error, clock at 0."""
        self._memory[table.RAM_START :] = self._ram
        self._booted_s = now_s
        self._set("Goal Position", self._plant.advance(Goals(), now_s).position_ticks)
        self._apply_registers()

    def _apply_registers(self) -> None:
        """Apply the written registers: the plant's goals, and the watchdog time (s, 0 without watchdog or torque)."""
        watchdog = self._get("Bus Watchdog")
        self._watchdog_s = max(watchdog, 0) * table.WATCHDOG_MS * 1e-3 if self.torque else 0.0  # e-Manual, 546
        self._goals = Goals(
            torque=self.torque and watchdog != table.WATCHDOG_TRIPPED,
            mode=self._get("Operating Mode"),
            goal_current_ma=self._get("Goal Current"),
            current_limit_ma=self._get("Current Limit"),
            goal_ticks=self._get("Goal Position"),
            p_gain=self._get("Position P Gain"),
        )

    def _measure(self) -> None:
        """Write the measurements of the last tick to the registers."""
        velocity = round(self._motion.velocity_ticks_s * TICK_DEG / 360.0 * 60.0 / table.RPM)
        self._set("Realtime Tick", int((self._now_s - self._booted_s) * 1000.0) % _TICK_MS)
        self._set("Moving", int(abs(velocity) > self._get("Moving Threshold")))
        self._set("Present Current", round(self._motion.current_ma))
        self._set("Present Velocity", velocity)
        self._set("Present Position", self._motion.position_ticks)
        self._set("Position Trajectory", self._get("Goal Position"))
        for name, value in {**self._supply, **self.false_readings}.items():
            self._set(name, value)

    # Instructions

    def handle(self, frame: DynamixelFrame, now_s: float) -> list[Answer]:
        """Execute an instruction; return its answers (none or one)."""
        answer_level = self._get("Status Return Level")
        delay_s = self._get("Return Delay Time") * table.RETURN_DELAY_US * 1e-6
        byte_s = 10.0 / self.baud
        self.tick(now_s)
        answer = self._answer(frame, now_s, answer_level)
        if frame.instruction not in (Instruction.PING, Instruction.READ):
            self._apply_registers()
            self.tick(now_s)  # passes the goals on at once
        if answer is None:
            return []
        return [Answer(answer, (frame.size + len(answer)) * byte_s + delay_s)]

    def _answer(self, frame: DynamixelFrame, now_s: float, level: int) -> bytes | None:
        own_id = self._get("ID")
        if frame.id not in (own_id, BROADCAST_ID):
            return None
        fault, data = StatusError.CRC, b""
        if frame.sound:
            self._last_byte_s = now_s
            self.instructions[frame.instruction] += 1
            try:
                fault, data = StatusError.NONE, self._carry_out(frame, now_s)
            except ServoRefused as refused:
                fault = refused.fault
            if frame.instruction == Instruction.PING:
                return self._status(own_id, fault, data)
        needed = 1 if frame.sound and frame.instruction == Instruction.READ else 2
        is_quiet = frame.id == BROADCAST_ID or level < needed or frame.instruction == Instruction.SYNC_WRITE
        return None if is_quiet else self._status(own_id, fault, data)

    def _status(self, own_id: int, fault: StatusError, data: bytes = b"") -> bytes:
        return status(own_id, fault, data, alert=self._get("Hardware Error Status") != 0)

    def _carry_out(self, frame: DynamixelFrame, now_s: float) -> bytes:
        """Return the data of the answer; ServoRefused with the reason."""
        parameters = frame.parameters
        match frame.instruction:
            case Instruction.PING:
                return self._read(0, 2) + self._read(6, 1)
            case Instruction.READ:
                if len(parameters) != 4:
                    raise ServoRefused(StatusError.DATA_LENGTH)
                return self._read(*struct.unpack("<HH", parameters))
            case Instruction.WRITE:
                if len(parameters) < 2:
                    raise ServoRefused(StatusError.DATA_LENGTH)
                self._write(struct.unpack_from("<H", parameters)[0], parameters[2:])
            case Instruction.SYNC_WRITE:
                self._sync_write(parameters)
            case Instruction.REBOOT:
                self.restart(now_s)
            case _:
                raise ServoRefused(StatusError.INSTRUCTION)
        return b""

    def _sync_write(self, parameters: bytes) -> None:
        if len(parameters) < 4:
            raise ServoRefused(StatusError.DATA_LENGTH)
        address, size = struct.unpack_from("<HH", parameters)
        for at in range(4, len(parameters), size + 1):
            if parameters[at] == self._get("ID"):
                self._write(address, parameters[at + 1 : at + 1 + size])
                return

    # Memory

    def _read(self, address: int, size: int) -> bytes:
        """Return bytes from an address that begins a register; holes after it read as 0."""
        if address not in BY_ADDRESS or address + size > table.TABLE_SIZE:
            raise ServoRefused(StatusError.ACCESS)
        self._measure()
        return bytes(self._memory[address : address + size])

    def _write(self, address: int, data: bytes) -> None:
        for register, value in self._check(address, data):
            if register.name == "Torque Enable" and value and self._get("Hardware Error Status"):
                raise ServoRefused(StatusError.RESULT)
            self._set(register.name, value)

    def _check(self, address: int, data: bytes) -> list[tuple[Register, int]]:
        """Return registers and values of a write; ServoRefused if any of them may not be written."""
        if not data:
            raise ServoRefused(StatusError.DATA_LENGTH)
        if address + len(data) > table.TABLE_SIZE:
            raise ServoRefused(StatusError.ACCESS)
        writes = []
        while data:
            register = BY_ADDRESS.get(address)
            if register is None or not register.writable or (register.eeprom and self._get("Torque Enable")):
                raise ServoRefused(StatusError.ACCESS)
            if len(data) < register.size:
                raise ServoRefused(StatusError.DATA_LENGTH)
            value = register.decode(data[: register.size])
            self._check_value(register, value)
            writes.append((register, value))
            address, data = address + register.size, data[register.size :]
        return writes

    def _check_value(self, register: Register, value: int) -> None:
        if not register.accepts(value):
            raise ServoRefused(StatusError.DATA_RANGE)
        tripped = self._get("Bus Watchdog") == table.WATCHDOG_TRIPPED
        if tripped and (register.name in _GOALS or (register.name == "Bus Watchdog" and value)):
            raise ServoRefused(StatusError.DATA_RANGE)
        if register.name not in _GOALS:
            return
        limit = _LIMITED_BY.get(register.name)
        if limit is not None:
            within = abs(value) <= self._get(limit)
        else:
            within = self._get("Min Position Limit") <= value <= self._get("Max Position Limit")
        if not within:
            raise ServoRefused(StatusError.DATA_LIMIT)
