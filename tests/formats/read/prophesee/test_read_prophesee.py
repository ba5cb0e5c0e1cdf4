"""Prophesee's RAW and DAT files: as faery writes them, as cameras write them, and damaged."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.prophesee import read_prophesee
from evetac_cli.formats.read.time_order import OrderOptions
from tests.importing import FRAME, assert_equal, drawn, event_rows, refusal

faery = pytest.importorskip("faery")
from faery.file_encoder import events_to_file  # noqa: E402

KINDS = (("evt2", "raw"), ("evt3", "raw"), ("dat2", "dat"))


def write(path: Path, events: Events, kind: str) -> Path:
    array = np.zeros(events.size, faery.EVENTS_DTYPE)
    for column, name in zip(events, ("t", "x", "y", "on"), strict=True):
        array[name] = column
    events_to_file([array[:2000], array[2000:]], path, FRAME, version=kind, zero_t0=False)
    return path


@pytest.mark.parametrize(("kind", "suffix"), KINDS)
def test_files_of_faery_are_read(tmp_path: Path, kind: str, suffix: str) -> None:
    """Assert that every event, its time and the frame come out, whatever the file is called."""
    events = drawn(5000)
    path = write(tmp_path / f"a.{suffix}", events, kind)
    imported = read_events(path)
    assert event_rows(imported) == list(
        zip((events.t - events.t[0]).tolist(), *(c.tolist() for c in events[1:]), strict=True)
    )
    assert (imported.format, imported.frame_px, imported.notes) == ("prophesee", FRAME, [])
    assert imported.t_offset_us == events.t[0]
    assert event_rows(read_events(path.rename(tmp_path / "events"))) == event_rows(imported)


def evt3(t_us: Any, row: int = 5) -> list[int]:
    """Words as a sensor sends them: the high bits of time whenever they change, and one event each."""
    words, high = [], -1
    for t in t_us:
        if t >> 12 != high:
            high = t >> 12
            words.append(8 << 12 | high & 0xFFF)
        words += [6 << 12 | t & 0xFFF, row, 2 << 12 | 1 << 11 | 7]
    return words


def raw(path: Path, words: Any, head: bytes = b"% evt 3.0\n% geometry 640x480\n% end\n", rest: bytes = b"") -> Path:
    path.write_bytes(head + np.array(words, "<u2").tobytes() + rest)
    return path


def evt21(events: Events) -> Any:
    """Words of 64 bits as the maker's page lays them out, one event each: the lowest bit of 32 columns is set."""
    words, high = [], -1
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 60 | (high & 0xFFFFFFF) << 32)
        words.append(p << 60 | (t & 63) << 54 | x // 32 * 32 << 43 | y << 32 | 1 << x % 32)
    return np.array(words, "<u8")


HEAD_21 = b"% format EVT21;height=480;width=640\n% geometry 640x480\n% end\n"
SWAPPED_21 = (
    b"% format EVT21;endianness=legacy;height=480;width=640\n% end\n",
    b"% evt 2.1\n% endianness legacy\n% geometry 640x480\n% end\n",
)


@pytest.mark.parametrize("head", [HEAD_21, *SWAPPED_21])
def test_evt21_is_read(tmp_path: Path, head: bytes) -> None:
    """Assert that words of EVT2.1 give their events, also those of sensors that send the upper half first."""
    events = drawn(3000)
    words = evt21(events)
    if b"legacy" in head:
        words = words.view("<u4").reshape(-1, 2)[:, ::-1]
    path = tmp_path / "a.raw"
    path.write_bytes(head + words.tobytes())
    imported = read_events(path)
    assert_equal(imported, events)
    assert (imported.format, imported.frame_px, imported.notes) == ("prophesee", FRAME, [])


def test_vectors_of_evt21(tmp_path: Path) -> None:
    """Assert that each of the 32 bits is a column, counted from the word's own."""
    word = 1 << 60 | 5 << 54 | 64 << 43 | 7 << 32 | 1 << 31 | 0b101
    path = tmp_path / "a.raw"
    path.write_bytes(HEAD_21 + struct.pack("<QQ", 8 << 60 | 2 << 32, word))
    imported = read_events(path)
    assert event_rows(imported) == [(0, 64, 7, 1), (0, 66, 7, 1), (0, 95, 7, 1)]
    assert imported.t_offset_us == 2 * 64 + 5


def test_the_clock_of_evt21_may_wrap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that 34 bits of microseconds wrap without a gap, in blocks of any size."""
    monkeypatch.setattr(read_prophesee, "BLOCK_BYTES", 1 << 12)
    events = drawn(3000, start_us=(1 << 34) - 1_000_000)
    path = tmp_path / "a.raw"
    path.write_bytes(HEAD_21 + evt21(events).tobytes())
    assert_equal(read_events(path), events)


def test_other_words_of_evt21(tmp_path: Path) -> None:
    """Assert that words before the first time are left out, the maker's own passed over, and unknown ones refused."""
    words = [1 << 60 | 1, 8 << 60, 14 << 60, 15 << 60, 1 << 60 | 3, 0]
    path = tmp_path / "a.raw"
    path.write_bytes(HEAD_21 + np.array(words, "<u8").tobytes())
    imported = read_events(path)
    assert event_rows(imported) == [(0, 0, 0, 1), (0, 1, 0, 1)]
    assert imported.notes == ["left out 8 bytes before the first time stamp"]
    path.write_bytes(HEAD_21 + np.array([*words[1:], 7 << 60], "<u8").tobytes())
    assert f"type 0x7 at byte {len(HEAD_21) + 40}" in refusal(path)


def test_triggers_are_kept(tmp_path: Path) -> None:
    """Assert that external triggers become a stream in the recording's clock, in every encoding."""
    path = tmp_path / "a.raw"
    evt2 = [8 << 28, 1 << 28, 10 << 28 | 5 << 22 | 3 << 8 | 1, 8 << 28 | 1, 10 << 28 | 3 << 8, 1 << 28 | 9 << 22]
    for head, words in (
        (HEAD_21, np.array([*(word << 32 | 1 for word in evt2)], "<u8")),
        (b"% evt 2.0\n% geometry 640x480\n% end\n", np.array(evt2, "<u4")),
        (
            b"% evt 3.0\n% geometry 640x480\n% end\n",
            np.array(
                [*evt3([0]), 6 << 12 | 5, 10 << 12 | 3 << 8 | 1, 6 << 12 | 64, 10 << 12 | 3 << 8, *evt3([73])], "<u2"
            ),
        ),
    ):
        path.write_bytes(head + words.tobytes())
        imported = read_events(path)
        assert (imported.events.t.tolist(), imported.left_out) == ([0, 73], {})
        assert imported.notes == ["kept: 2 samples of triggers"]
        (stream,) = imported.streams
        columns = {name: values.tolist() for name, values in stream.columns.items()}
        assert (stream.name, stream.t_us.tolist()) == ("triggers", [5, 64])
        assert columns == {"id": [3, 3], "edge": [1, 0]}


@pytest.mark.parametrize(("kind", "suffix"), [("EVT2", "raw"), ("EVT3", "raw"), ("DAT", "dat")])
def test_as_expelliarmus_reads_them(tmp_path: Path, kind: str, suffix: str) -> None:
    """Assert equal events with another library on one file.

    expelliarmus 1.1.12 counts the high bits of time of EVT3 twice, of the words that evt3() above packs too: of its
    times only the lower 12 bits are right.
    """
    wizard = pytest.importorskip("expelliarmus").Wizard(encoding=kind)
    path = write(tmp_path / f"a.{suffix}", drawn(5000), {"EVT2": "evt2", "EVT3": "evt3", "DAT": "dat2"}[kind])
    theirs = wizard.read(path)
    imported = read_events(path)
    right = 1 << 12 if kind == "EVT3" else 1 << 62
    assert np.array_equal(theirs["t"] % right, (imported.events.t + imported.t_offset_us) % right)
    for name in "xyp":
        assert np.array_equal(theirs[name], getattr(imported.events, name))


def test_the_clock_may_wrap(tmp_path: Path) -> None:
    """Assert that 24 bits of microseconds wrap twice in 40 s without a gap."""
    t = np.arange(0, 40_000_000, 2000)
    assert np.array_equal(read_events(raw(tmp_path / "a.raw", evt3(t))).events.t, t)


def test_words_before_the_first_time_are_left_out(tmp_path: Path) -> None:
    """Assert that a file that begins in the middle of a stream begins with its first complete time."""
    t = np.arange(8_000_000, 8_100_000, 500)
    words = evt3(t)
    begins = words.index(8 << 12 | (8_000_000 >> 12) + 1)
    imported = read_events(raw(tmp_path / "a.raw", words[2:]))
    assert imported.t_offset_us == ((8_000_000 >> 12) + 1) * 4096 + t[np.searchsorted(t, 8_003_584)] - 8_003_584
    assert imported.events.size == len(t) - (begins - 1) // 3
    assert imported.notes == [f"left out {2 * (begins - 2)} bytes before the first time stamp"]


@pytest.mark.parametrize("block_bytes", [4, 10, 1 << 20])
def test_a_damaged_word_near_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int) -> None:
    """Assert that words of undefined types are judged by the whole file, in blocks of any size."""
    monkeypatch.setattr(read_prophesee, "BLOCK_BYTES", block_bytes)
    words = evt3(range(5000, 5100))
    imported = read_events(raw(tmp_path / "a.raw", [words[0], 9 << 12, *words[1:]]))
    assert (imported.events.size, imported.left_out) == (100, {"words of undefined types": 1})
    words = [words[0], *[9 << 12] * 40, *words[1:]]
    assert "40 of 341 words are of undefined types" in refusal(raw(tmp_path / "b.raw", words))


def test_vectors_are_read(tmp_path: Path) -> None:
    """Assert that words of twelve and of eight columns give an event for every bit."""
    words = [
        8 << 12 | 1,
        6 << 12 | 10,
        5,
        3 << 12 | 1 << 11 | 16,
        4 << 12 | 0b101,
        5 << 12 | 0b11,
        6 << 12 | 11,
        4 << 12 | 1,
    ]
    assert event_rows(read_events(raw(tmp_path / "a.raw", words))) == [
        (0, 16, 5, 1),
        (0, 18, 5, 1),
        (0, 28, 5, 1),
        (0, 29, 5, 1),
        (1, 36, 5, 1),
    ]


@pytest.mark.parametrize(
    ("head", "frame"),
    [
        (b"% evt 3.0\n% geometry 640x480\n", None),
        (b"% Date 2026-01-01\n% evt 3.0\n% format EVT3;height=480;width=640\n% end\n", None),
        (b"% date 2026-01-01\n% format EVT3;height=480;width=640\n% end\n", None),
        (b"% evt 3.0\n% end\n", FRAME),
    ],
)
def test_the_frame_is_found_or_guessed(tmp_path: Path, head: bytes, frame: tuple[int, int] | None) -> None:
    """Assert that the header tells the frame in any of its ways, and where it does not, a guess is said to be one."""
    path = raw(tmp_path / "a.raw", evt3(range(0, 9000, 500)), head)
    guessed = [note for note in read_events(path).notes if "--frame-size" in note]
    assert len(guessed) == (frame is not None)
    assert read_events(path, frame_px=frame).frame_px == FRAME
    assert read_events(path, frame_px=frame).events.size == 18


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"% evt 4.0\n% end\n", "expected: EVT2, EVT2.1 or EVT3"),
        (b"% format HISTO3D;height=480;width=640\n% end\n", "found:    histo3d"),
        (b"% Data file\n% Version 7\n% Width 640\n% Height 480\n", "version of DAT"),
        (b"% evt 3.0\n% geometry 640x480", "ends inside its header"),
        (b"% evt 3.0\n% geometry 640x4\n% end\n", "none of the events can be used"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, head: bytes, words: str) -> None:
    """Assert that encodings that are not read here, and frames that the events leave, are refused by name."""
    assert words in refusal(raw(tmp_path / "a.raw", evt3(range(0, 9000, 500)), head))


def test_files_without_events(tmp_path: Path) -> None:
    """Assert that a header alone is no recording, and half a word at the end is noted."""
    assert "has no events" in refusal(raw(tmp_path / "a.raw", []))
    imported = read_events(raw(tmp_path / "a.raw", evt3([0, 7]), rest=b"\1"))
    assert (imported.events.size, imported.notes) == (2, ["cut short: the last 1 bytes are an incomplete word"])


@pytest.mark.parametrize(("kind", "suffix"), KINDS)
def test_damaged_files_are_refused_or_read(tmp_path: Path, kind: str, suffix: str) -> None:
    """Assert that a file that is cut or damaged anywhere gives events or words, and never anything else."""
    whole = write(tmp_path / f"a.{suffix}", drawn(2500), kind).read_bytes()
    rng = np.random.default_rng(2)
    broken = tmp_path / f"b.{suffix}"
    plain = 0  # trials of which the damage is said
    for trial in range(60):
        data = bytearray(whole)
        if trial % 2:
            del data[rng.integers(3, len(data)) :]
        else:
            for at in rng.integers(3, len(data) if trial % 4 else 120, 8):
                data[at] = rng.integers(256)
        broken.write_bytes(data)
        try:
            imported = read_events(broken, order=OrderOptions(sort=True))
            assert imported.events.size < 30_000
            plain += bool(sum(imported.counts.values()) or imported.left_out or imported.notes)
        except InputError:
            plain += 1
    assert plain > 15
