"""AEDAT4 files: whole ones are read as they are, of damaged ones what is intact, and nothing hangs."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read import aedat4_packets, read_aedat4
from evetac_cli.formats.read.source import NOT_RECORDED
from evetac_cli.formats.write.event_files import AEDAT4_EVENT, aedat4_description
from tests.importing import FRAME, refusal, same
from tests.quick import few


def store(dv: Any, t: Any, x: Any, y: Any, p: Any) -> Any:
    events = dv.EventStore()
    for row in zip(t, x, y, p, strict=True):
        events.push_back(*(int(value) for value in row[:3]), bool(row[3]))
    return events


@pytest.fixture(scope="module")
def aedat4(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Events]:
    """An AEDAT4 file in several packets, and the events in it."""
    dv = pytest.importorskip("dv_processing")
    rng = np.random.default_rng(8)
    t = np.sort(rng.integers(0, 50_000, 5000)) + 1_600_000_000_000_000
    t[0] = 1_600_000_000_000_000
    x, y, p = rng.integers(0, 346, 5000), rng.integers(0, 260, 5000), rng.integers(0, 2, 5000)
    path = tmp_path_factory.mktemp("aedat4") / "a.aedat4"
    config = dv.io.MonoCameraWriter.Config("DAVIS346_1")
    config.addEventStream((346, 260))
    writer = dv.io.MonoCameraWriter(str(path), config)
    for part in (slice(k, k + 1000) for k in range(0, 5000, 1000)):
        writer.writeEventPacket(store(dv, t[part], x[part], y[part], p[part]).toPacket())
    del writer
    return path, Events(t - t[0], x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


@pytest.fixture
def spans(aedat4: tuple[Path, Events]) -> list[tuple[int, int]]:
    """Where its packets lie, found by the rule of the format: stream and size before each."""
    data = aedat4[0].read_bytes()
    at = 18 + struct.unpack_from("<I", data, 14)[0]
    packets = []
    for _ in range(5):
        size = struct.unpack_from("<i", data, at + 4)[0]
        packets.append((at, at + 8 + size))
        at += 8 + size
    return packets


def test_aedat4_is_read(aedat4: tuple[Path, Events]) -> None:
    """Assert that events, frame and clock are those that were written."""
    imported = read_events(aedat4[0])
    assert same(imported.events, aedat4[1])
    assert (imported.format, imported.frame_px, imported.notes) == ("aedat4", (346, 260), [])
    assert imported.t_offset_us == 1_600_000_000_000_000
    assert "leave out --frame-size" in refusal(aedat4[0], frame_px=FRAME)


def test_cut_aedat4_keeps_what_arrived(aedat4: tuple[Path, Events], spans: Any, tmp_path: Path) -> None:
    """Assert that a cut file gives the events of its complete packets, says so, and is refused where there are none."""
    path, written = aedat4
    whole = path.read_bytes()
    cut = tmp_path / "cut.aedat4"
    for length, packets in ((spans[0][1], 1), (spans[3][1] - 1, 3), (spans[4][0] + 3, 4), (spans[4][1], 5)):
        cut.write_bytes(whole[:length])
        imported = read_events(cut)
        assert same(imported.events, written.part(0, 1000 * packets))
        assert len(imported.notes) == 1
        if packets < 5:
            lost = length - spans[packets - 1][1]
            assert f"kept {1000 * packets} events from {packets} complete packets; {lost} bytes" in imported.notes[0]
    for length in (1, 11, 14, 17, 18, spans[0][0] // 2, spans[0][0] - 1, spans[0][0], spans[0][0] + 8, spans[0][1] - 1):
        cut.write_bytes(whole[:length])
        refusal(cut)


def test_aedat4_that_was_never_closed_is_read(aedat4: tuple[Path, Events], spans: Any, tmp_path: Path) -> None:
    """Assert that the file of a recorder that was killed gives all complete packets, with a note."""
    path, written = aedat4
    data = bytearray(path.read_bytes()[: spans[3][1]])
    position = struct.pack("<q", spans[4][1])  # of the packet table, written into the header when a file is closed
    assert data.count(position) == 1
    data[data.index(position) : data.index(position) + 8] = struct.pack("<q", -1)
    killed = tmp_path / "killed.aedat4"
    killed.write_bytes(data)
    imported = read_events(killed)
    assert same(imported.events, written.part(0, 4000))
    assert imported.notes == ["the recorder never closed the file: kept 4000 events from 4 packets"]


def test_damaged_aedat4_headers_are_refused(aedat4: tuple[Path, Events], tmp_path: Path) -> None:
    """Assert that no damage in the header leads to anything but words, or to the events after all."""
    path, written = aedat4
    whole = path.read_bytes()
    broken = tmp_path / "broken.aedat4"
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(60):
        data = bytearray(whole)
        # the fields before the tree of settings, and the start of the tree
        for at in rng.integers(14, 120, 3):
            data[at] = rng.integers(256)
        broken.write_bytes(data)
        try:
            imported = read_events(broken)
        except InputError:
            refused += 1
        else:
            assert same(imported.events, written)
    assert 30 < refused < 60


def test_packets_with_impossible_or_no_events_are_read(tmp_path: Path) -> None:
    """Assert that events outside the frame are dropped one by one, and that a packet may be empty."""
    aedat = pytest.importorskip("faery").extension.aedat
    path = tmp_path / "a.aedat4"
    rows = np.zeros(10, AEDAT4_EVENT)
    rows["t"] = np.arange(10)
    rows["x"][3] = 99
    with aedat.Encoder(path, aedat4_description(aedat, (200, 80)), ("lz4", 1)) as encoder:
        encoder.write(0, rows[:5])
        encoder.write(0, rows[:0])
        encoder.write(0, rows[5:])
    data = path.read_bytes()
    path.write_bytes(data.replace(b">200<", b">050<"))  # a frame smaller than what the packets hold
    imported = read_events(path)
    assert (imported.events.size, imported.counts["out_of_frame"], imported.frame_px) == (9, 1, (50, 80))
    assert imported.notes == ["10% of the events are outside 50x80 and were dropped; is this frame size right?"]


@pytest.mark.parametrize("compression", [None, ("lz4", 1), ("zstd", 3)])
def test_payloads_as_faery_reads_them(tmp_path: Path, compression: Any) -> None:
    """Assert equal events with another library, however the packets are compressed."""
    aedat = pytest.importorskip("faery").extension.aedat
    rng = np.random.default_rng(5)
    rows = np.zeros(20_000, AEDAT4_EVENT)
    rows["t"] = 1_600_000_000_000_000 + np.sort(rng.integers(0, 10**6, len(rows)))
    rows["x"], rows["y"], rows["on"] = (rng.integers(0, most, len(rows)) for most in (640, 480, 2))
    path = tmp_path / "a.aedat4"
    with aedat.Encoder(path, aedat4_description(aedat, FRAME), compression) as encoder:
        for first in range(0, len(rows), 3000):
            encoder.write(0, rows[first : first + 3000])
    with aedat.Decoder(path) as decoder:
        theirs = np.concatenate([packet for _, packet in decoder])
    imported = read_events(path)
    assert np.array_equal(theirs["t"].astype(np.int64), imported.events.t + imported.t_offset_us)
    for name, column in (("x", imported.events.x), ("y", imported.events.y), ("on", imported.events.p)):
        assert np.array_equal(theirs[name], column)


def test_streams_are_chosen_by_name(tmp_path: Path) -> None:
    """Assert that of several event streams the first by name is read, the others are noted, and each can be had."""
    dv = pytest.importorskip("dv_processing")
    path = tmp_path / "stereo.aedat4"
    left, right = dv.io.MonoCameraWriter.Config("cam_10"), dv.io.MonoCameraWriter.Config("cam_1")
    left.addEventStream((100, 80))
    right.addEventStream((60, 50))
    writer = dv.io.StereoCameraWriter(str(path), left, right)
    writer.left.writeEvents(store(dv, range(3), range(3), range(3), [1] * 3))
    writer.right.writeEvents(store(dv, range(5), range(5), range(5), [0] * 5))
    del writer
    first = read_events(path)
    assert (first.events.size, first.frame_px) == (5, (60, 50))
    assert first.notes == [
        "read the event stream cam_1/events; the file also has: cam_10/events (choose with --stream)",
        "left out: packets of events of cam_10/events 1",
    ]
    other = read_events(path, stream="cam_10/events")
    assert (other.events.size, other.frame_px) == (3, (100, 80))
    assert "expected: cam_1/events or cam_10/events" in refusal(path, stream="events")


@pytest.mark.parametrize(
    ("name", "events", "frame", "slices", "frames"),
    [
        ("dvxplorer_static_noise.aedat4", 255_283, (640, 480), 2700, 0),
        ("davis346.aedat4", 78_830, (346, 260), 2360, 59),
        ("multistream.aedat4", 9_193, (346, 260), 3814, 25),
    ],
)
def test_real_aedat4(
    name: str, events: int, frame: tuple[int, int], slices: int, frames: int, outside_file: Callable[[str], Path]
) -> None:
    """Assert that the makers' test files give their known numbers of events, and what else they hold is counted."""
    pytest.importorskip("faery")
    imported = read_events(outside_file(name))
    assert (imported.events.size, imported.frame_px, imported.slices) == (events, frame, slices)
    assert sum(imported.counts.values()) == imported.sorted == 0
    assert imported.left_out.get("frames", 0) == frames
    assert [note.partition(":")[0] for note in imported.notes] in (["kept", "left out"], ["kept"])
    assert imported.events.t[0] == 0


@pytest.mark.parametrize("name", few(["dvxplorer_static_noise", "davis346", "multistream"], "davis346"))
def test_damage_costs_no_more_than_the_packets_it_hits(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outside_file: Callable[[str], Path]
) -> None:
    """Assert that truncated and damaged copies give every event of every packet that was not hit.

    Cameras' packets carry no checksum, so a damaged one may decode: then its times may be impossible, which is refused.
    """
    pytest.importorskip("faery")
    monkeypatch.setattr(read_aedat4, "BATCH_EVENTS", 0)  # a batch a packet
    source = outside_file(f"{name}.aedat4")
    raw = source.read_bytes()
    with source.open("rb") as handle:
        header = aedat4_packets.read_header(handle, "")
        number = next(stream.number for stream in header.streams if stream.kind == "EVTS")
        packets = aedat4_packets.walk(handle, header, number).spans
        every = (aedat4_packets.walk(handle, header, stream.number).spans for stream in header.streams)
        all_packets = [span for spans in every for span in spans]
        events = [part.t.size for part in read_aedat4.open_aedat4(source, None, None).batches]
    damaged = tmp_path / "damaged.aedat4"
    rng = np.random.default_rng(2)
    refused = 0
    for case in range(24):
        data = bytearray(raw)
        at = int(rng.integers(header.size, len(raw)))
        stop = len(raw) if case % 3 == 0 else at + (1 if case % 3 == 1 else 300)
        if case % 3 == 0:
            del data[at:]
        else:
            data[at:stop] = bytes(byte ^ 0x55 for byte in data[at:stop])
        damaged.write_bytes(data)
        # the eight bytes before a packet lead to the next one: where they are hit, the file ends
        hit_head = any(at < begin and stop > begin - 8 for begin, _ in all_packets)
        after = len(raw) if hit_head else stop
        intact = sum(count for (begin, end), count in zip(packets, events, strict=True) if end <= at or begin > after)
        if not intact:
            continue
        try:
            imported = read_events(damaged)
        except InputError as error:
            assert case % 3 and "time" in error.message, (case, at)
            refused += 1
            continue
        assert imported.events.size >= intact, (case, at)
        said = [note for note in imported.notes if not note.startswith(("left out: ", "kept: "))]
        assert said or imported.events.size + sum(imported.counts.values()) == sum(events)
    assert refused < 12


def test_real_frames_are_no_events(outside_file: Callable[[str], Path]) -> None:
    """Assert that a file of frames is refused in words."""
    words = refusal(outside_file("frames_only.aedat4"))
    assert "frames but no event stream" in words and "found:    frames 20" in words
    assert f"try:      {NOT_RECORDED}" in words


def zeros(kind: bytes, size: int, per_item: int) -> Any:
    """A packet of zeros, as many events or tables as `size` bytes hold, packed with Zstandard."""
    zstandard = pytest.importorskip("zstandard")
    body = bytearray(size)
    struct.pack_into("<II4sHHHHiII", body, 0, size - 4, 16, kind, 6, 8, 4, 0, 8, 4, (size - 32) // per_item)
    return zstandard.ZstdCompressor(level=19).compress(bytes(body))


def test_a_small_file_does_not_become_a_large_one(tmp_path: Path) -> None:
    """Assert that a few kB which unpack to millions of events are refused, before all of them are unpacked."""
    aedat = pytest.importorskip("faery").extension.aedat
    path = tmp_path / "a.aedat4"
    with aedat.Encoder(path, aedat4_description(aedat, FRAME), ("zstd", 3)) as encoder:
        encoder.write(0, np.zeros(10, AEDAT4_EVENT))
    packet = zeros(b"EVTS", 1 << 24, 16)
    with path.open("rb") as file:
        header = aedat4_packets.read_header(file, str(path))
    whole = path.read_bytes()[: header.size].replace(struct.pack("<q", header.table), struct.pack("<q", -1))
    path.write_bytes(whole + 40 * (struct.pack("<ii", 0, len(packet)) + packet))
    words = refusal(path)
    assert "unpack to too much" in words and "84 MB from" in words
