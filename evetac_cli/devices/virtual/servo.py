"""The logic of an RH-P12-RN(A): control table, instructions, errors and watchdog, without a port or its own clock.

Frames and the time go in; answers and their delays come out. So a test can drive it step by step. Simulated: it
moves a plant (servo_plant).

Where the maker's manual is unclear, this servo is strict. Goal Current starts at 0. A wrong CRC is answered with error
3. A tripped watchdog cuts the motor current, leaves Torque Enable as it is and accepts only 0. An overload switches
torque off until reboot. A factory reset is refused. Profiles, PWM, and the integral and derivative gains of position
are registers without effect.
"""

import struct
from collections import Counter
from collections.abc import Callable, Mapping
from typing import NamedTuple

from evetac_cli.devices.rh_p12_rn import control_table as table
from evetac_cli.devices.rh_p12_rn.control_table import BY_ADDRESS, REGISTERS, Register
from evetac_cli.devices.virtual.dynamixel_frames import (
    BROADCAST_ID,
    DynamixelFrame,
    Instruction,
    StatusError,
    fast_status,
    status,
)
from evetac_cli.devices.virtual.servo_plant import Goals, Plant

TICK_DEG = 0.088
_CLEAR = bytes([0x01, 0x44, 0x58, 0x4C, 0x22])
_NO_ID = 253  # Secondary ID from this value upward: none
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
        self._booted_s = self._heard_s = self._now_s = now_s
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
        self._registered: tuple[int, bytes] | None = None
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
        if self._watchdog_s and now_s - self._heard_s > self._watchdog_s:
            self.trip()
        self._motion = self._plant.advance(self._goals, now_s)

    def forgive(self, frozen_s: float) -> None:
        """Exclude a time (s) for which this process was stopped: the host was not silent then."""
        self._heard_s += frozen_s

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
        self._registered = None
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
        secondary = self._get("Secondary ID")
        if frame.id not in (own_id, BROADCAST_ID) and not frame.id == secondary < _NO_ID:
            return None
        quiet = frame.id != own_id
        if not frame.sound:
            return None if quiet or level < 2 else self._status(own_id, StatusError.CRC)
        self._heard_s = now_s
        self.instructions[frame.instruction] += 1
        try:
            listed = self._read_by_list(frame, own_id)
            if listed is not None:
                return listed if level >= 1 else None
            data = self._carry_out(frame, now_s)
            fault = StatusError.NONE
        except ServoRefused as refused:
            data, fault = b"", refused.fault
        if frame.instruction == Instruction.PING:
            return self._status(own_id, fault, data) if frame.id in (own_id, BROADCAST_ID) else None
        needed = 1 if frame.instruction == Instruction.READ else 2
        return None if quiet or level < needed or self._by_list(frame) else self._status(own_id, fault, data)

    def _status(self, own_id: int, fault: StatusError, data: bytes = b"") -> bytes:
        return status(own_id, fault, data, alert=self._get("Hardware Error Status") != 0)

    @staticmethod
    def _by_list(frame: DynamixelFrame) -> bool:
        return frame.instruction >= Instruction.SYNC_READ

    def _read_by_list(self, frame: DynamixelFrame, own_id: int) -> bytes | None:
        """Return the answer to a sync or bulk read that names this servo first, or None.

        A servo that is named later would wait for those before it.
        """
        sync = frame.instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ)
        bulk = frame.instruction in (Instruction.BULK_READ, Instruction.FAST_BULK_READ)
        if not (sync or bulk) or frame.id != BROADCAST_ID or len(frame.parameters) < 5:
            return None
        if sync:
            address, size, first = struct.unpack_from("<HHB", frame.parameters)
        else:
            first, address, size = struct.unpack_from("<BHH", frame.parameters)
        if first != own_id:
            return None
        fault, data = StatusError.NONE, bytes(size)
        try:
            data = self._read(address, size)
        except ServoRefused as refused:
            fault = refused.fault
        if frame.instruction in (Instruction.SYNC_READ, Instruction.BULK_READ):
            return self._status(own_id, fault, b"" if fault else data)
        # each of several devices would add its block, so this answers only if it is the only one listed
        alone = len(frame.parameters) == 5
        alert = 0x80 if self._get("Hardware Error Status") else 0
        return fast_status([(fault | alert, own_id, data)]) if alone else None

    def _carry_out(self, frame: DynamixelFrame, now_s: float) -> bytes:
        """Return the data of the answer; ServoRefused with the reason."""
        steps: dict[int, Callable[[bytes], bytes | None]] = {
            Instruction.PING: self._ping,
            Instruction.READ: self._read_one,
            Instruction.WRITE: self._write_one,
            Instruction.REG_WRITE: self._register,
            Instruction.ACTION: self._action,
            Instruction.FACTORY_RESET: self._factory_reset,
            Instruction.REBOOT: lambda _: self.restart(now_s),
            Instruction.CLEAR: self._clear,
            Instruction.SYNC_WRITE: self._sync_write,
            Instruction.BULK_WRITE: self._bulk_write,
        }
        step = steps.get(frame.instruction)
        if step is None:
            raise ServoRefused(StatusError.INSTRUCTION)
        return step(frame.parameters) or b""

    def _ping(self, _: bytes) -> bytes:
        return self._read(0, 2) + self._read(6, 1)

    def _read_one(self, parameters: bytes) -> bytes:
        if len(parameters) != 4:
            raise ServoRefused(StatusError.DATA_LENGTH)
        return self._read(*struct.unpack("<HH", parameters))

    def _write_one(self, parameters: bytes) -> None:
        self._write(*_target(parameters))

    def _register(self, parameters: bytes) -> None:
        address, data = _target(parameters)
        self._check(address, data)
        self._registered = address, data
        self._set("Registered Instruction", 1)

    def _action(self, _: bytes) -> None:
        if self._registered is None:
            raise ServoRefused(StatusError.INSTRUCTION)
        (address, data), self._registered = self._registered, None
        self._set("Registered Instruction", 0)
        self._write(address, data)

    def _factory_reset(self, _: bytes) -> None:
        raise ServoRefused(StatusError.RESULT)

    def _clear(self, parameters: bytes) -> None:
        if parameters != _CLEAR:
            raise ServoRefused(StatusError.DATA_RANGE)

    def _sync_write(self, parameters: bytes) -> None:
        if len(parameters) < 4:
            raise ServoRefused(StatusError.DATA_LENGTH)
        address, size = struct.unpack_from("<HH", parameters)
        for at in range(4, len(parameters), size + 1):
            if parameters[at] == self._get("ID"):
                self._write(address, parameters[at + 1 : at + 1 + size])
                return

    def _bulk_write(self, parameters: bytes) -> None:
        at = 0
        while at + 5 <= len(parameters):
            id_, address, size = struct.unpack_from("<BHH", parameters, at)
            if id_ == self._get("ID"):
                self._write(address, parameters[at + 5 : at + 5 + size])
                return
            at += 5 + size

    # Memory

    def _read(self, address: int, size: int) -> bytes:
        """Return bytes from an address that begins a register; holes after it read as 0."""
        if address not in BY_ADDRESS or address + size > table.TABLE_SIZE:
            raise ServoRefused(StatusError.ACCESS)
        self._measure()
        if address + size <= table.INDIRECT_DATA:
            return bytes(self._memory[address : address + size])
        return bytes(self._memory[self._mapped(at)] for at in range(address, address + size))

    def _mapped(self, address: int) -> int:
        """Return the true address of a byte: Indirect Data show the byte that their Indirect Address names."""
        if not table.INDIRECT_DATA <= address < table.INDIRECT_DATA + table.INDIRECT_COUNT:
            return address
        at = table.INDIRECT_ADDRESSES + 2 * (address - table.INDIRECT_DATA)
        return int.from_bytes(self._memory[at : at + 2], "little")

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
        bytes_at = {self._mapped(address + at): value for at, value in enumerate(data)}
        writes = []
        while bytes_at:
            register = BY_ADDRESS.get(next(iter(bytes_at)))
            if register is None or not register.writable or (register.eeprom and self._get("Torque Enable")):
                raise ServoRefused(StatusError.ACCESS)
            places = range(register.address, register.address + register.size)
            if not all(place in bytes_at for place in places):
                raise ServoRefused(StatusError.DATA_LENGTH)
            value = register.decode(bytes(bytes_at.pop(place) for place in places))
            self._check_value(register, value)
            writes.append((register, value))
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


def _target(parameters: bytes) -> tuple[int, bytes]:
    """Return address and data from the parameters of a write; ServoRefused if they are too short."""
    if len(parameters) < 2:
        raise ServoRefused(StatusError.DATA_LENGTH)
    return struct.unpack_from("<H", parameters)[0], parameters[2:]
