"""Frames of Protocol 2.0: known bytes in both directions, stuffing, and a reader that survives damage."""

import struct

import pytest
from dynamixel_sdk import Protocol2PacketHandler
from hypothesis import assume, given
from hypothesis import strategies as st

from evetac_cli.devices.virtual.dynamixel_frames import (
    BROADCAST_ID,
    HEADER,
    DynamixelFrame,
    FrameReader,
    Instruction,
    crc16,
    frame,
    stuffed,
    unstuffed,
)


def le(form: str, *values: int) -> bytes:
    return struct.pack("<" + form, *values)


OK = b"\0"
# id, instruction, parameters, bytes: of the hardware notes, cross-checked with the e-Manual's examples and the SDK
VECTORS = {
    "ping": (1, Instruction.PING, b"", "ff ff fd 00 01 03 00 01 19 4e"),
    "ping answered": (1, Instruction.STATUS, OK + le("HB", 35074, 14), "ff ff fd 00 01 07 00 55 00 02 89 0e cc f3"),
    "read 4 at 580": (1, Instruction.READ, le("HH", 580, 4), "ff ff fd 00 01 07 00 02 44 02 04 00 14 95"),
    "position 300": (1, Instruction.STATUS, OK + le("i", 300), "ff ff fd 00 01 08 00 55 00 2c 01 00 00 a4 48"),
    "read 10 at 574": (1, Instruction.READ, le("HH", 574, 10), "ff ff fd 00 01 07 00 02 3e 02 0a 00 00 f9"),
    "current -100, speed 0, position 300": (
        1,
        Instruction.STATUS,
        OK + le("hii", -100, 0, 300),
        "ff ff fd 00 01 0e 00 55 00 9c ff 00 00 00 00 2c 01 00 00 a3 29",
    ),
    "torque on": (1, Instruction.WRITE, le("HB", 512, 1), "ff ff fd 00 01 06 00 03 00 02 01 db 6f"),
    "mode 0": (1, Instruction.WRITE, le("HB", 11, 0), "ff ff fd 00 01 06 00 03 0b 00 00 42 e3"),
    "P gain 50": (1, Instruction.WRITE, le("HH", 532, 50), "ff ff fd 00 01 07 00 03 14 02 32 00 74 61"),
    "goal current -100": (1, Instruction.WRITE, le("Hh", 550, -100), "ff ff fd 00 01 07 00 03 26 02 9c ff 76 6f"),
    "goal position 400": (
        1,
        Instruction.WRITE,
        le("Hi", 564, 400),
        "ff ff fd 00 01 09 00 03 34 02 90 01 00 00 7b 49",
    ),
    "sync write of goal position 400": (
        BROADCAST_ID,
        Instruction.SYNC_WRITE,
        le("HHBi", 564, 4, 1, 400),
        "ff ff fd 00 fe 0c 00 83 34 02 04 00 01 90 01 00 00 f8 5b",
    ),
    "status ok": (1, Instruction.STATUS, OK, "ff ff fd 00 01 04 00 55 00 a1 0c"),
    "status data limit": (1, Instruction.STATUS, b"\6", "ff ff fd 00 01 04 00 55 06 b5 0c"),
    "status data limit, alert": (1, Instruction.STATUS, b"\x86", "ff ff fd 00 01 04 00 55 86 b6 8f"),
    "reboot": (1, Instruction.REBOOT, b"", "ff ff fd 00 01 03 00 08 2f 4e"),
    "write of a header, stuffed": (
        1,
        Instruction.WRITE,
        le("H", 634) + b"\xff\xff\xfd\0",
        "ff ff fd 00 01 0a 00 03 7a 02 ff ff fd fd 00 c1 19",
    ),
    "read 4 at 132": (1, Instruction.READ, le("HH", 132, 4), "ff ff fd 00 01 07 00 02 84 00 04 00 1d 15"),
}


@pytest.mark.parametrize("name", VECTORS)
def test_known_bytes(name: str) -> None:
    """Assert that a frame is built as these bytes, and that these bytes are taken apart as that frame."""
    id_, instruction, parameters, text = VECTORS[name]
    known = bytes.fromhex(text)
    assert frame(id_, instruction, parameters) == known
    assert FrameReader().push(known) == [DynamixelFrame(id_, instruction, parameters, True, len(known))]


@given(st.binary(max_size=64))
def test_crc_is_the_sdks(data: bytes) -> None:
    """Assert that any bytes have the checksum that the maker's library gives them."""
    assert crc16(data) == Protocol2PacketHandler().updateCRC(0, data, len(data))


# bytes that make headers likely
NEAR_HEADERS = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x01, 0x55]), max_size=40).map(bytes)


@given(NEAR_HEADERS)
def test_stuffing_hides_headers(body: bytes) -> None:
    """Assert that no header is left inside a stuffed body, and that unstuffing gives it back."""
    assert b"\xff\xff\xfd\x00" not in stuffed(body)
    assert unstuffed(stuffed(body)) == body


FRAMES = st.tuples(st.integers(0, 254), st.sampled_from(list(Instruction)), NEAR_HEADERS)


@given(st.lists(FRAMES, max_size=5), st.data())
def test_frames_survive_any_cut(sent: list[tuple[int, Instruction, bytes]], data: st.DataObject) -> None:
    """Assert that frames come out whole and in order however the stream is cut."""
    stream = b"".join(frame(*one) for one in sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    reader = FrameReader()
    frames = []
    for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        frames += reader.push(stream[start:stop])
    assert [(one.id, one.instruction, one.parameters) for one in frames] == sent
    assert all(one.sound for one in frames)
    assert not reader.partial


@given(NEAR_HEADERS, FRAMES)
def test_noise_before_a_frame_is_skipped(noise: bytes, sent: tuple[int, Instruction, bytes]) -> None:
    """Assert that a frame is found behind noise that holds no header itself."""
    known = frame(*sent)
    assume((noise + known).find(HEADER) == len(noise))
    assert FrameReader().push(noise + known) == [DynamixelFrame(*sent, True, len(known))]


def test_a_damaged_frame_does_not_take_the_next_one_along() -> None:
    """Assert that a frame with a wrong checksum is reported as such, and that a good one behind or within is found."""
    bad = bytearray(frame(1, Instruction.PING))
    bad[-1] ^= 1
    good = frame(1, Instruction.READ, le("HH", 580, 4))
    assert [one.sound for one in FrameReader().push(bytes(bad) + good)] == [False, True]
    long = bytearray(frame(1, Instruction.PING))
    long[5] += len(good)  # LEN was damaged and now reaches into the next frame
    frames = FrameReader().push(bytes(long) + good + good)
    assert [one.instruction for one in frames if one.sound] == [Instruction.READ, Instruction.READ]


def test_a_frame_cut_off_is_forgotten() -> None:
    """Assert that the rest of a frame is waited for until it is given up."""
    reader = FrameReader()
    reader.push(frame(1, Instruction.PING)[:6])
    assert reader.partial
    reader.forget()
    assert [one.sound for one in reader.push(frame(1, Instruction.PING))] == [True]


def test_the_sdk_sends_without_stuffing() -> None:
    """Assert that a frame whose parameters hold a header in the open is read by its length."""
    body = bytes([Instruction.WRITE]) + le("H", 634) + b"\xff\xff\xfd\x00"
    before = b"\xff\xff\xfd\x00\x01" + le("H", len(body) + 2) + body
    (frames,) = FrameReader().push(before + le("H", crc16(before)))
    assert (frames.sound, frames.parameters[2:]) == (True, b"\xff\xff\xfd\x00")
