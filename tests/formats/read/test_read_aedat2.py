"""AEDAT 2 of jAER and v2e: words by the published layouts, packed here by hand, and as tonic reads them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read import read_aedat2
from tests.importing import assert_equal, drawn, event_rows, refusal, tonic_io

CHIPS = {
    "DVS128": ("ch.unizh.ini.jaer.chip.retina.DVS128", (128, 128)),
    "DAVIS240C": ("eu.seebetter.ini.chips.davis.DAVIS240C", (240, 180)),
    "DAVIS346": ("eu.seebetter.ini.chips.davis.Davis346blue", (346, 260)),
}
HEAD = b"#!AER-DAT2.0\r\n# This is a raw AE data file - do not edit\r\n# Timestamps tick is 1 us\r\n"


def address(chip: str, x: int, y: int, p: int) -> int:
    """The address of a pixel as jAER stores it: columns from the right, rows from the bottom."""
    width, height = CHIPS[chip][1]
    x, y = width - 1 - x, height - 1 - y
    if chip == "DVS128":
        return y << 8 | x << 1 | (1 - p)
    return y << 22 | x << 12 | p << 11


def write(path: Path, words: list[tuple[int, int]], chip: str | None = None, head: bytes = HEAD) -> Path:
    named = f"# AEChip: {CHIPS[chip][0]}\r\n".encode() if chip else b""
    path.write_bytes(head + named + b"".join(struct.pack(">II", *word) for word in words))
    return path


def words_of(events: Events, chip: str) -> list[tuple[int, int]]:
    return [(address(chip, x, y, p), t) for t, x, y, p in zip(*(c.tolist() for c in events), strict=True)]


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("chip", CHIPS)
def test_every_chip(tmp_path: Path, chip: str, named: bool) -> None:
    """Assert that events, frame and clock come out of the words of each chip, whether the file names it or not."""
    events = drawn(3000, CHIPS[chip][1])
    path = write(tmp_path / "a.aedat", words_of(events, chip), chip if named else None)
    imported = read_events(path)
    assert_equal(imported, events)
    assert (imported.format, imported.frame_px, imported.left_out) == ("aedat2", CHIPS[chip][1], {})
    (note,) = imported.notes
    assert ("by its addresses" in note) != named
    assert "rows from the bottom" in note


def test_known_values(tmp_path: Path) -> None:
    """Assert three addresses by hand: a DVS128's brighter event has polarity bit 0, a DAVIS's has 1."""
    path = write(tmp_path / "a.aedat", [(127 << 8 | 127 << 1, 5), (0 << 8 | 1 << 1 | 1, 9)], "DVS128")
    assert event_rows(read_events(path)) == [(0, 0, 0, 1), (4, 126, 127, 0)]
    path = write(tmp_path / "a.aedat", [(259 << 22 | 345 << 12 | 1 << 11, 5), (1 << 22 | 2 << 12, 9)], "DAVIS346")
    assert event_rows(read_events(path)) == [(0, 0, 0, 1), (4, 343, 258, 0)]


def test_a_file_without_a_chip_takes_the_frame_that_is_said(tmp_path: Path) -> None:
    """Assert that rows and columns are turned round in the frame that the user says, and a chip's is not changed."""
    events = drawn(200, (240, 180))
    path = write(tmp_path / "a.aedat", words_of(events, "DAVIS240C"))
    larger = read_events(path, frame_px=(346, 260))
    assert np.array_equal(larger.events.x, events.x + 106) and np.array_equal(larger.events.y, events.y + 80)
    path = write(tmp_path / "a.aedat", words_of(events, "DAVIS240C"), "DAVIS240C")
    assert "leave out --frame-size" in refusal(path, frame_px=(346, 260))


def test_what_is_no_pixel_is_counted(tmp_path: Path) -> None:
    """Assert that samples of frames and IMU and external events are left out, counted, and no events."""
    events = drawn(20, (240, 180))
    others = [(1 << 31 | 5 << 22, 1000)] * 3 + [(1 << 31 | 0b11 << 10, 1000)] * 7 + [(1 << 10 | 2, 1000)] * 2
    path = write(tmp_path / "a.aedat", others + words_of(events, "DAVIS240C"), "DAVIS240C")
    imported = read_events(path)
    assert_equal(imported, events)
    assert imported.left_out == {"frame samples": 3, "IMU values": 7, "external events": 2}
    assert imported.notes[0] == "left out: frame samples 3, IMU values 7, external events 2"
    path = write(tmp_path / "a.aedat", [(1 << 15, 5), *words_of(drawn(9, (128, 128)), "DVS128")], "DVS128")
    assert read_events(path).left_out == {"external events": 1}


def test_the_clock_may_wrap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that 32 bits of microseconds wrap without a gap, in any blocks, also with an event late over it."""
    monkeypatch.setattr(read_aedat2, "BATCH_WORDS", 3)
    start = 2**32 - 5000
    t = start + np.arange(10) * 1000
    words = [(address("DVS128", 1, 2, 1), int(us) % 2**32) for us in t]
    imported = read_events(write(tmp_path / "a.aedat", words, "DVS128"))
    assert imported.events.t.tolist() == (t - start).tolist()
    assert "the file's clock wrapped once, at index 5; the times are unwrapped" in imported.notes
    late = [*words[:5], (words[0][0], 100), (words[0][0], 2**32 - 10), *words[7:]]
    imported = read_events(write(tmp_path / "a.aedat", late, "DVS128"))
    assert imported.events.t.tolist() == [0, 1000, 2000, 3000, 4000, 4990, 5100, 7000, 8000, 9000]
    assert imported.sorted == 1


def test_the_head_ends_where_jaer_says(tmp_path: Path) -> None:
    """Assert that words which begin with the byte of `#` are words, after jAER's last line or no text."""
    first = (0x23 << 24 | 0x00001000, 7)  # row 140 of a DAVIS, time 7: control characters
    for head in (HEAD + b"#End Of ASCII Header\r\n", HEAD):
        path = write(tmp_path / "a.aedat", [first, first], None, head)
        assert event_rows(read_events(path, frame_px=(346, 260))) == [(0, 344, 119, 0)] * 2


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (HEAD, "has no events"),
        (HEAD + b"# AEChip: ch.unizh.ini.jaer.chip.cochlea.CochleaAMS1c\r\n" + bytes(8), "unsupported chip"),
        (HEAD + struct.pack(">II", 511 << 22 | 1023 << 12, 0), "do not fit a DVS128 or DAVIS"),
        (HEAD + (b"#" + b"x" * 65000 + b"\r\n") * 300, "the header of the file does not end"),
        (b"#!AER-DAT1.0\r\n" + bytes(12), "AEDAT of another version"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    """Assert that other chips and files without events are refused in words."""
    path = tmp_path / "a.aedat"
    path.write_bytes(content)
    assert words in refusal(path)


def test_a_cut_file_keeps_whole_events(tmp_path: Path) -> None:
    """Assert that half an event at the end is noted."""
    path = write(tmp_path / "a.aedat", words_of(drawn(50, (128, 128)), "DVS128"), "DVS128")
    path.write_bytes(path.read_bytes()[:-3])
    imported = read_events(path)
    assert imported.events.size == 49
    assert "cut short: the last 5 bytes are an incomplete event" in imported.notes


@pytest.mark.parametrize("chip", ["DVS128", "DAVIS346"])
def test_as_tonic_reads_them(tmp_path: Path, chip: str) -> None:
    """Assert equal events with tonic 1.7, which turns a DAVIS346 round as we do, and a DVS128 not."""
    io = tonic_io()
    events = drawn(2000, CHIPS[chip][1])
    path = write(tmp_path / "a.aedat", words_of(events, chip), chip)
    imported = read_events(path)
    width, height = CHIPS[chip][1]
    if chip == "DVS128":
        _, theirs = io.read_dvs_128(path)
        x, y, p = width - 1 - theirs["y"], height - 1 - theirs["x"], ~theirs["p"]
    else:
        _, theirs = io.read_davis_346(path)
        x, y, p = theirs["x"], theirs["y"], theirs["p"]
    assert np.array_equal(theirs["t"] - theirs["t"][0], imported.events.t)
    for ours, other in zip(imported.events[1:], (x, y, p), strict=True):
        assert np.array_equal(ours, other)
