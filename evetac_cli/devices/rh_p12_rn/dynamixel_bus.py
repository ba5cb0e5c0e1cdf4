"""One Dynamixel device on a serial port, through the maker's dynamixel-sdk: registers by name, losses counted.

This is the only module that imports dynamixel_sdk. A lost or damaged answer is counted and requested once more; a
second loss is an error. A bus belongs to one thread.

Reason: the behaviour of the SDK's port is changed. It sleeps while it waits for an answer, where the SDK's port would
occupy a core. It gives up after `answer_ms`, where the SDK's takes 34 ms. It is locked, so that two programs cannot
talk at once. It leaves the servo a pause after an instruction without an answer. If a transaction is aborted,
the port is free for the next one.
"""

import os
import select
import termios
import time
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

import serial
from dynamixel_sdk import (
    COMM_RX_CORRUPT,
    COMM_SUCCESS,
    INST_PING,
    INST_READ,
    INST_WRITE,
    PortHandler,
    Protocol2PacketHandler,
)

from evetac_cli.devices.rh_p12_rn.control_table import REGISTERS, SDK_RATES, hardware_errors
from evetac_cli.errors import DeviceError, DeviceTimeout

ANSWER_MS = 20.0  # on top of the time on the wire; a serial adapter at its default latency timer answers after 16 ms
WRITE_S = 1.0  # a port that accepts no bytes for this long is broken
WARY_S = 2.0  # how long stray answers are watched for after a lost answer
FOLLOWS_S = 1e-3  # an answer follows its question within this, plus the time on the wire
LONGEST_ANSWER = 40  # bytes, including its question
PAUSE_S = 100e-6  # servos miss an instruction that follows too closely on one without an answer
VIRTUAL_PORTS = "/dev/pts/"  # a virtual servo answers at a pseudo terminal, once the computer runs its process
VIRTUAL_IS_LATE = "the virtual gripper's process got no core: is the computer overloaded?"
_FAULTS = {
    1: "could not carry it out",
    2: "does not know the instruction",
    3: "received a wrong checksum",
    4: "refuses the value as out of range",
    5: "refuses the length of the data",
    6: "refuses the value as beyond a limit",
    7: "does not allow access to the register now",
}
CRC_FAULT, RANGE_FAULT = 3, 4
_BROKEN = (OSError, termios.error)  # raised by a port that has gone; serial.SerialException is an OSError
_SYSFS = Path("/sys/bus/usb-serial/devices")


class InstructionRefused(DeviceError):
    """The servo answered that it did not carry out the instruction; `fault` is its error number."""

    fault = 0


class HardwareAlert(DeviceError):
    """The servo has a hardware error, for example an overload; its registers identify it."""


class PortGone(DeviceError):
    """The serial port disappeared while it was open: unplugged, or its adapter was reset."""


class _Port(PortHandler):  # type: ignore[misc]
    """The SDK's port with changed behaviour; the methods' names are the SDK's."""

    is_open: bool
    packet_timeout: float

    def __init__(self, name: str, answer_ms: float) -> None:
        super().__init__(name)
        self._answer_ms = answer_ms
        self._pause_until_s = 0.0
        self._last_byte_s = 0.0
        self._wary_until_s = 0.0
        self.least_ms = 0.0  # minimum time for answers, if the SDK allows less
        self.strays = 0  # answers that arrived when none was expected

    def setupPort(self, cflag_baud: int) -> bool:
        if self.is_open:
            self.closePort()
        self.ser = serial.Serial(self.port_name, self.baudrate, timeout=0, exclusive=True)
        self.is_open = True
        self.ser.reset_input_buffer()
        self.tx_time_per_byte = 10_000.0 / self.baudrate
        return True

    def getCurrentTime(self) -> float:
        return time.monotonic() * 1000.0

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + self._answer_ms)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        super().setPacketTimeoutMillis(max(msec, self.least_ms))

    def be_wary(self) -> None:
        """Watch for a while whether another answer follows the accepted one, because a lost answer may still arrive.

        Otherwise the next question would get the answer to this one, and so on as long as questions follow closely.
        """
        self._wary_until_s = time.monotonic() + WARY_S

    def clearPort(self) -> None:
        if time.monotonic() < self._wary_until_s:
            left_s = self._last_byte_s + FOLLOWS_S + LONGEST_ANSWER * self.tx_time_per_byte * 1e-3 - time.monotonic()
            time.sleep(max(left_s, 0.0))
        if self.ser.in_waiting:
            self.strays += 1
        super().clearPort()

    def writePort(self, packet: list[int]) -> int:
        early_s = self._pause_until_s - time.monotonic()
        if early_s > 0:
            time.sleep(early_s)
        # pyserial's own write with a timeout reports a failure after a success if the program stood still meanwhile
        if not select.select([], [self.ser.fileno()], [], WRITE_S)[1]:
            raise serial.SerialTimeoutException("the port accepts no bytes")
        return os.write(self.ser.fileno(), bytes(packet))

    def readPort(self, length: int) -> bytes:
        if length <= 0:
            return b""
        if not self.ser.in_waiting:
            left_ms = self.packet_timeout - self.getTimeSinceStart()
            select.select([self.ser.fileno()], [], [], max(left_ms, 0.0) * 1e-3 + PAUSE_S)
        data = bytes(self.ser.read(length))
        if data:
            self._last_byte_s = time.monotonic()
        return data

    def pause_after(self, size: int) -> None:
        """Send nothing until this many bytes are on the wire and the servo has had time to process them."""
        self._pause_until_s = time.monotonic() + size * self.tx_time_per_byte * 1e-3 + PAUSE_S


class Bus(AbstractContextManager["Bus"]):
    """A device with an id, on a port, at a rate; registers by the names of the control table."""

    def __init__(self, port: str, baud: int, id_: int = 1, *, answer_ms: float = ANSWER_MS) -> None:
        """Open the port; DeviceError if it is missing, not permitted, in use, or cannot be set to the rate."""
        self.port, self.baud, self.id = port, baud, id_
        self.tolerant = False  # continue despite a hardware error of the device
        # how long to wait after a lost answer, so that it is not taken for the answer to the next question
        self.settle_s = 0.0
        self._counted = {"answers_lost": 0, "answers_damaged": 0}
        self._packets = Protocol2PacketHandler()
        self._port = _Port(port, answer_ms)
        where = f"gripper at {port}"
        try:
            opened = self._port.setBaudRate(baud)
        except (*_BROKEN, ValueError) as error:
            raise _not_opened(where, error) from error
        if not opened:
            rates = ", ".join(map(str, SDK_RATES))
            raise DeviceError("no such baud rate", where=where, expected=f"one of {rates}", found=str(baud))

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far: answers_lost, answers_damaged, and answers_stray, which arrived too late and were not used."""
        return {**self._counted, "answers_stray": self._port.strays}

    def ping(self) -> int:
        """Check that the device answers, and return its model number."""
        return int.from_bytes(self._transact(INST_PING, b"", 3, "ping")[:2], "little")

    def read(self, name: str) -> int:
        """Return the value of a register, by its name in the control table."""
        register = REGISTERS[name]
        return register.decode(self.read_bytes(register.address, register.size))

    def read_bytes(self, address: int, size: int) -> bytes:
        """Return the bytes of consecutive registers, read in one transaction."""
        request = address.to_bytes(2, "little") + size.to_bytes(2, "little")
        return self._transact(INST_READ, request, size, f"read {size} bytes at {address}")

    def write(self, name: str, value: int) -> None:
        """Set a register and wait for the answer; DeviceError if it is refused or lost."""
        register = REGISTERS[name]
        data = register.address.to_bytes(2, "little") + register.encode(value)
        self._transact(INST_WRITE, data, 0, f"write {value} to {name}")

    def send(self, name: str, value: int) -> None:
        """Set a register without an answer, by a sync write to this device only: half the traffic."""
        register = REGISTERS[name]
        row = [self.id, *register.encode(value)]
        try:
            result = self._packets.syncWriteTxOnly(self._port, register.address, register.size, row, len(row))
        except _BROKEN as error:
            raise self._gone(error) from error
        finally:
            self._port.is_using = False
        self._port.pause_after(len(row) + 14)
        if result != COMM_SUCCESS:
            raise DeviceError(f"the port did not accept the write of {value} to {name}", where=self._where)

    def devices(self, least_ms: float = 0.0) -> dict[int, tuple[int, int]]:
        """Return model number and firmware of every device on the bus, by id.

        Uses a broadcast ping (0.8 s, or least_ms).
        """
        self._port.least_ms = least_ms
        try:
            answers, _ = self._packets.broadcastPing(self._port)
        except _BROKEN as error:
            raise self._gone(error) from error
        finally:
            self._port.is_using = False
            self._port.least_ms = 0.0
        return {id_: (model, firmware) for id_, (model, firmware) in answers.items()}

    def close(self) -> None:
        """Close the port; a second call does nothing."""
        if self._port.is_open:
            try:
                self._port.closePort()
            except _BROKEN:
                self._port.is_open = False

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _where(self) -> str:
        return f"gripper {self.id} at {self.port}, {self.baud} baud"

    def _transact(self, instruction: int, parameters: bytes, size: int, what: str) -> bytes:
        """Return the data, `size` bytes, of the answer to an instruction; at most two attempts."""
        lost = "answers_lost"
        for _ in range(2):
            packet, result, error = self._once(instruction, parameters)
            # an answer of another length belongs to an earlier question
            if result == COMM_SUCCESS and packet[5] | packet[6] << 8 == size + 4 and error & 0x7F != CRC_FAULT:
                self._raise_for_error(error, what)
                return bytes(packet[9 : 9 + size])
            if result == COMM_SUCCESS and error & 0x7F not in (0, CRC_FAULT):
                self._raise_for_error(error, what)
            lost = "answers_damaged" if result in (COMM_SUCCESS, COMM_RX_CORRUPT) else "answers_lost"
            self._counted[lost] += 1
            self._port.be_wary()
            time.sleep(self.settle_s)
        if lost == "answers_damaged":
            raise DeviceError(f"damaged answers to: {what}", where=self._where, hint="check the cable and its length")
        cause = VIRTUAL_IS_LATE if self.port.startswith(VIRTUAL_PORTS) else "is the 24 V supply on?"
        raise DeviceTimeout(
            f"no answer to: {what}",
            where=self._where,
            expected="an answer at the first or second try",
            hint=f"{cause} evetac doctor --gripper {self.port} reports which id and rate answer",
        )

    def _once(self, instruction: int, parameters: bytes) -> tuple[list[int], int, int]:
        length = len(parameters) + 3
        packet = [0, 0, 0, 0, self.id, length & 0xFF, length >> 8, instruction, *parameters, 0, 0]
        try:
            answer, result, error = self._packets.txRxPacket(self._port, packet)
        except _BROKEN as broken:
            raise self._gone(broken) from broken
        finally:
            self._port.is_using = False
        return answer or [], result, error

    def _raise_for_error(self, error: int, what: str) -> None:
        fault = error & 0x7F
        if fault:
            refused = InstructionRefused(
                f"the gripper {_FAULTS.get(fault, f'reports error {fault}')}: {what}", where=self._where
            )
            refused.fault = fault
            raise refused
        if error & 0x80 and not self.tolerant:
            self.tolerant = True
            try:
                errors = hardware_errors(self.read("Hardware Error Status"))
            finally:
                self.tolerant = False
            raise HardwareAlert(
                f"hardware error: {', '.join(errors) or 'unnamed'}",
                where=self._where,
                hint="remove the cause; switching 24 V off and on clears it",
            )

    def _gone(self, error: BaseException) -> PortGone:
        return PortGone(
            "the port is gone: unplugged?",
            where=self._where,
            found=str(error) or type(error).__name__,
            hint=f"plug it in again, then run evetac doctor --gripper {self.port}",
        )


def _not_opened(where: str, error: BaseException) -> DeviceError:
    """Return the DeviceError for a port that cannot be opened: missing, not permitted, or in use."""
    number = getattr(error, "errno", None)
    if number == 2 or "No such file" in str(error):
        return DeviceError("there is no such port", where=where, hint="evetac doctor lists the serial ports")
    if number == 13:
        hint = "sudo usermod -aG dialout $USER, then log in again; or evetac doctor udev"
        return DeviceError("no permission to open the port", where=where, hint=hint)
    if number in (11, 16) or "exclusively lock" in str(error):
        return DeviceError("the port is in use by another program", where=where, hint="end that program")
    return DeviceError("the port cannot be opened", where=where, found=str(error))


class BusDevice(NamedTuple):
    """A device that answered a ping: its rate, id and model number."""

    baud: int
    id: int
    model: int


def scan(
    port: str, bauds: Iterable[int] = SDK_RATES, ids: Iterable[int] = (1,), *, answer_ms: float = ANSWER_MS
) -> list[BusDevice]:
    """Ping every id at every rate, and return the devices that answer; reads only.

    DeviceError if the port cannot be opened.
    """
    all_ids = list(ids)
    devices = []
    for baud in bauds:
        for id_ in all_ids:
            with Bus(port, baud, id_, answer_ms=answer_ms) as bus:
                try:
                    bus.tolerant = True
                    devices.append(BusDevice(baud, id_, bus.ping()))
                except PortGone:
                    raise
                except DeviceError:
                    continue
    return devices


def latency_timer_ms(port: str, sysfs: Path = _SYSFS) -> int | None:
    """Return how long the USB adapter of a port holds back an answer, in ms; None if it has no such timer.

    The default is 16 ms; evetac needs 1 ms.
    """
    file = sysfs / Path(port).resolve().name / "latency_timer"
    try:
        return int(file.read_text())
    except (OSError, ValueError):
        return None
