"""AEDAT 3.1 of cAER: packets by the published layout, packed here by hand, and as tonic reads them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.aedat import read_aedat3
from evetac_cli.formats.read.source import NOT_RECORDED
from tests.importing import assert_equal, drawn, event_rows, refusal, tonic_io

FRAME = (240, 180)
HEAD = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS240C\r\n#Start-Time: 2026-01-01 10:00:00 (TZ+0000)\r\n"
END = b"#!END-HEADER\r\n"
EVENTS = drawn(3000, FRAME)


def packet(kind: int, events: list[bytes], source: int = 1, overflows: int = 0, size: int = 8) -> bytes:
    count = len(events)
    return struct.pack("<hhiiiiii", kind, source, size, 4, overflows, count, count, count) + b"".join(events)


def polarity(t: int, x: int, y: int, p: int, valid: int = 1) -> bytes:
    return struct.pack("<Ii", x << 17 | y << 2 | p << 1 | valid, t)


def packets_of(events: Events, at_once: int = 700) -> bytes:
    """The events of one source, some a packet, their clock of 31 bits with its overflows."""
    parts = []
    for first in range(0, events.size, at_once):
        rows = list(zip(*(column.tolist() for column in events.part(first, first + at_once)), strict=True))
        for overflows in sorted({t >> 31 for t, *_ in rows}):
            inside = [polarity(t & 0x7FFFFFFF, x, y, p) for t, x, y, p in rows if t >> 31 == overflows]
            parts.append(packet(1, inside, overflows=overflows))
    return b"".join(parts)


def write(path: Path, content: bytes, head: bytes = HEAD) -> Path:
    path.write_bytes(head + END + content)
    return path


def test_events_frame_and_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that events come out of packets of any length, in blocks of any size, with the frame of the chip."""
    path = write(tmp_path / "a.aedat", packets_of(EVENTS))
    imported = read_events(path)
    assert_equal(imported, EVENTS)
    assert (imported.format, imported.frame_px, imported.left_out) == ("aedat3", FRAME, {})
    assert imported.notes == ["assumed: rows from the top, polarity bit 1 brighter, time in microseconds"]
    monkeypatch.setattr(read_aedat3, "BATCH_EVENTS", 13)
    assert_equal(read_events(path), EVENTS)


def test_known_values(tmp_path: Path) -> None:
    """Assert one event by hand: 0x00060016 is column 3, row 5, brighter, valid."""
    word = struct.pack("<II", 3 << 17 | 5 << 2 | 0b11, 77)
    head = struct.pack("<hhiiiiii", 1, 1, 8, 4, 2, 1, 1, 1)
    imported = read_events(write(tmp_path / "a.aedat", head + word))
    assert event_rows(imported) == [(0, 3, 5, 1)]
    assert imported.t_offset_us == 2 * 2**31 + 77


def test_the_clock_may_overflow(tmp_path: Path) -> None:
    """Assert that time goes on beyond 31 bits."""
    events = EVENTS._replace(t=EVENTS.t + 2**31 - 1_000_000)
    assert_equal(read_events(write(tmp_path / "a.aedat", packets_of(events))), events)


def test_everything_else_is_counted(tmp_path: Path) -> None:
    """Assert that frames, IMU samples, triggers and events of other cameras, or not valid, are named and counted."""
    frame, imu = bytes(36 + 20), bytes(36)
    content = (
        packet(2, [frame, frame], size=56)
        + packet(3, [imu] * 5, size=36)
        + packet(0, [bytes(8)] * 3)
        + packets_of(EVENTS)
        + packet(1, [polarity(2**31 - 1, 1, 1, 1, valid=0)] * 4)
        + packet(1, [polarity(5, 1, 1, 1)] * 6, source=2)
        + packet(12, [bytes(12)], size=12)
    )
    imported = read_events(write(tmp_path / "a.aedat", content))
    assert_equal(imported, EVENTS)
    assert imported.left_out == {
        "special events": 3,
        "frames": 2,
        "IMU samples": 5,
        "events of type 12": 1,
        "events of source 2": 6,
        "events marked as not valid": 4,
    }


def imu(t: int, values: list[float], valid: int = 1) -> bytes:
    return struct.pack(f"<Ii{len(values)}f", valid, t, *values)


@pytest.mark.parametrize(("kind", "name", "count"), [(3, "imu", 7), (4, "imu9", 10)])
def test_imu_samples_are_kept(tmp_path: Path, kind: int, name: str, count: int) -> None:
    """Assert times, values and units of IMU samples, by the layout of libcaer, over an overflow of the clock."""
    events = EVENTS._replace(t=EVENTS.t + 2**31 - 1_000_000)
    size = 8 + 4 * count
    values = [[k + axis / 8 for axis in range(count)] for k in range(5)]
    before = [imu(2**31 - 900_000 + k, values[k]) for k in range(2)] + [imu(5, values[0], valid=0)]
    after = [imu(700 + k, values[k]) for k in range(2, 5)]
    others = packet(kind, [imu(9, values[0])], source=2, size=size)
    content = (
        packet(kind, before, size=size) + packets_of(events) + packet(kind, after, overflows=1, size=size) + others
    )
    imported = read_events(write(tmp_path / "a.aedat", content))
    assert_equal(imported, events)
    (stream,) = imported.streams
    assert stream.name == name
    times = [2**31 - 900_000, 2**31 - 899_999, *(2**31 + 702 + k for k in range(3))]
    assert (stream.t_us + imported.t_offset_us).tolist() == times
    names = [f"{part}_{axis}" for part in ("accelerometer", "gyroscope") for axis in "xyz"]
    names += ["temperature", *(f"magnetometer_{axis}" for axis in "xyz")][: count - 6]
    assert list(stream.columns) == names
    assert np.array_equal(np.stack(list(stream.columns.values()), axis=1), values)
    assert (stream.units["accelerometer_z"], stream.units["gyroscope_x"], stream.units["temperature"]) == (
        "g",
        "deg/s",
        "degC",
    )
    assert imported.left_out == {"IMU samples of source 2": 1}
    assert f"1 IMU samples were left out: they are marked as invalid or are not {name}" in imported.notes


def test_triggers_are_kept(tmp_path: Path) -> None:
    """Assert that edges and pulses on all inputs come, called as AEDAT4 does, and other special events do not."""
    first = int(EVENTS.t[0])
    special = [struct.pack("<Ii", kind << 1 | 1, first + kind) for kind in (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 14)]
    content = packets_of(EVENTS) + packet(0, special) + packet(0, [struct.pack("<Ii", 2 << 1, first + 99)])
    imported = read_events(write(tmp_path / "a.aedat", content))
    (stream,) = imported.streams
    assert stream.t_us.tolist() == [2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert stream.columns["source"].tolist() == [1, 2, 3] * 3
    assert stream.columns["input"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert imported.left_out == {}
    assert "5 special events were left out: they are marked as invalid or are not triggers" in imported.notes


def test_samples_of_another_size_stay_counted(tmp_path: Path) -> None:
    """Assert that IMU samples in another layout than the published one are left out and counted."""
    content = packets_of(EVENTS) + packet(3, [bytes([1]) + bytes(39)] * 3, size=40)
    imported = read_events(write(tmp_path / "a.aedat", content))
    assert imported.streams == [] and imported.left_out == {"IMU samples": 3}


def test_of_a_cut_file_what_is_whole(tmp_path: Path) -> None:
    """Assert that a file that ends in a packet, or is damaged there, gives the packets before, and says so."""
    path = write(tmp_path / "a.aedat", packets_of(EVENTS, 1000))
    whole = path.read_bytes()
    end = len(HEAD + END) + 2 * (28 + 8000)
    for content in (whole[:-10], whole[: end + 11], whole[:end] + struct.pack("<h", -5) + whole[end + 2 :]):
        path.write_bytes(content)
        imported = read_events(path)
        assert_equal(imported, EVENTS.part(0, 2000))
        assert f"damaged or cut short: {len(content) - end} bytes after byte {end} are lost" in imported.notes


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (HEAD + END, "no event stream"),
        (HEAD + END + packet(2, [bytes(56)] * 3, size=56), "found:    3 frames"),
        (HEAD + b"1234", "the header of the file does not end"),
        (HEAD.replace(b"RAW", b"SerializedTS,PNGFrames") + END, "found:    SerializedTS,PNGFrames"),
        (HEAD.replace(b"3.1", b"3.0") + END, "version of AEDAT 3"),
        (HEAD + END + packet(1, []), "has no events"),
        (HEAD + END + struct.pack("<hhiiiiii", 1, 1, 8, 4, 0, 2**31 - 1, 1, 1), "no readable packet"),
        (HEAD.replace(b"DAVIS240C", b"Unknown") + END + packet(1, [polarity(1, 9999, 1, 1)]), "frame size"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    """Assert that files without events, or in another coding, are refused with what they hold."""
    path = tmp_path / "a.aedat"
    path.write_bytes(content)
    said = refusal(path)
    assert words in said
    assert (NOT_RECORDED in said) == ("found:    3 frames" in said)


def test_as_tonic_reads_them(tmp_path: Path) -> None:
    """Assert equal events with tonic, which reads the events of the DVS Gesture data set."""
    io = tonic_io()
    path = write(tmp_path / "a.aedat", packets_of(EVENTS))
    _, theirs = io.read_dvs_red(path)
    imported = read_events(path)
    assert np.array_equal(theirs["t"] - theirs["t"][0], imported.events.t)
    for name in "xyp":
        assert np.array_equal(theirs[name], getattr(imported.events, name))
