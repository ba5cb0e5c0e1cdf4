"""Build and parse frames of Dynamixel Protocol 2.0 for the virtual servo.

    FF FF FD 00 | ID | LEN (2) | instruction, parameters ... | CRC (2)

LEN counts the bytes after it. Within instruction and parameters, an FD is stuffed after each FF FF FD; LEN and CRC are
those of the stuffed form. A status has the instruction 55 and an error byte before its parameters. Source: ROBOTIS
e-Manual, protocol 2.0.

The reader relies on LEN and never searches for a header inside a frame, because the Python SDK sends its frames without
stuffing.
"""

import struct
from enum import IntEnum
from typing import NamedTuple

HEADER = b"\xff\xff\xfd\x00"
BROADCAST_ID = 254
LONGEST = 1024  # a larger LEN is damage
_AROUND = 7  # bytes of a frame that LEN does not count
_ALERT = 0x80


class Instruction(IntEnum):
    """The instructions that the virtual servo knows; STATUS is the answer."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_WRITE = 0x83


class StatusError(IntEnum):
    """Error number of a status: why an instruction was not carried out."""

    NONE = 0
    RESULT = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class DynamixelFrame(NamedTuple):
    """A parsed frame: parameters without stuffing; `sound`: whether the CRC was right; size as on the wire."""

    id: int
    instruction: int
    parameters: bytes
    sound: bool
    size: int


def _crc_table() -> tuple[int, ...]:
    entries = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
        entries.append(crc)
    return tuple(entries)


_CRC = _crc_table()


def crc16(data: bytes) -> int:
    """Return the CRC-16 of Protocol 2.0: polynomial 8005, start 0, not reflected (CRC-16/UMTS)."""
    crc = 0
    for byte in data:
        crc = (crc << 8 ^ _CRC[crc >> 8 ^ byte]) & 0xFFFF
    return crc


def stuffed(body: bytes) -> bytes:
    """Return instruction and parameters with an FD after each FF FF FD."""
    return body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")


def unstuffed(body: bytes) -> bytes:
    """Return instruction and parameters as they were before `stuffed`."""
    return body.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")


def frame(id_: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of the frame in which a host sends an instruction to the device `id_`."""
    body = stuffed(bytes([instruction]) + parameters)
    before = HEADER + bytes([id_]) + struct.pack("<H", len(body) + 2) + body
    return before + struct.pack("<H", crc16(before))


def status(id_: int, fault: int = StatusError.NONE, parameters: bytes = b"", *, alert: bool = False) -> bytes:
    """Return the bytes of an answer; alert: whether Hardware Error Status is not zero."""
    return frame(id_, Instruction.STATUS, bytes([fault | (_ALERT if alert else 0)]) + parameters)


class FrameReader:
    """Extracts frames from a stream of bytes in pieces of any size, and resynchronizes after damage."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    @property
    def partial(self) -> bool:
        """Whether the beginning of a frame is waiting for its remainder."""
        return bool(self._waiting)

    def forget(self) -> None:
        """Drop a partial frame whose remainder did not arrive."""
        self._waiting.clear()

    def push(self, data: bytes) -> list[DynamixelFrame]:
        """Take the next bytes; return the frames that they complete, including those with a wrong CRC."""
        self._waiting += data
        frames = []
        while (frame := self._next()) is not None:
            frames.append(frame)
        return frames

    def _next(self) -> DynamixelFrame | None:
        waiting = self._waiting
        while True:
            start = waiting.find(HEADER)
            if start < 0:
                del waiting[: max(len(waiting) - len(HEADER) + 1, 0)]  # a header may have begun
                return None
            del waiting[:start]
            if len(waiting) < _AROUND:
                return None
            length = struct.unpack_from("<H", waiting, 5)[0]
            if 3 <= length <= LONGEST:
                break
            del waiting[: len(HEADER)]
        size = length + _AROUND
        if len(waiting) < size:
            return None
        whole = bytes(waiting[:size])
        sound = crc16(whole[:-2]) == struct.unpack("<H", whole[-2:])[0]
        # after damage LEN may be wrong too, and a good frame may begin inside
        del waiting[: size if sound else len(HEADER)]
        body = unstuffed(whole[_AROUND:-2])
        return DynamixelFrame(whole[4], body[0], body[1:], sound, size)
