"""Bags that were cut or are damaged: whole chunks of MCAP come and the rest is said; others say what helps."""

import re
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mcap")
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from rosbags.rosbag1 import Writer as Writer1

from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.bags.read_rosbag import open_rosbag
from evetac_cli.formats.read.time_order import OrderOptions
from evetac_cli.formats.streams import read_stream
from tests.formats.read.bags.bag_writing import Types, Write, drawn, listed, packets, shifted, write_bag, write_mcap
from tests.importing import event_rows, refusal
from tests.quick import few

EVENTS = drawn(20_000)
ROWS = shifted(EVENTS)
SIZE = 100  # events of a message
PACKINGS = ("none", "lz4", "bz2")


def ros1(path: Path, packing: str = "none", chunk_bytes: int = 20_000) -> Path:
    """A bag of ROS 1 in small chunks, with another topic between the events."""
    types = Types("ros1")
    writer = Writer1(path)
    if packing != "none":
        writer.set_compression(Writer1.CompressionFormat[packing.upper()])
    writer.chunk_threshold = chunk_bytes
    with writer:
        events = writer.add_connection("/e", "event_camera_msgs/msg/EventPacket", typestore=types.store)
        numbers = writer.add_connection("/n", "std_msgs/msg/Float64", typestore=types.store)
        for number, message in enumerate(packets(types, EVENTS, SIZE)):
            writer.write(events, (1 + number) * 10**9, types.raw(message))
            writer.write(numbers, (1 + number) * 10**9, types.raw(types.make("std_msgs/msg/Float64", float(number))))
    return path


def mcap(path: Path, **options: Any) -> Path:
    """An MCAP file in small chunks, with another topic between the events."""
    types = Types("mcap")
    numbers = [types.make("std_msgs/msg/Float64", float(number)) for number in range(EVENTS.size // SIZE)]
    return write_mcap(
        path, types, {"/e": packets(types, EVENTS, SIZE), "/n": numbers}, **{"chunk_size": 20_000, **options}
    )


def ends(path: Path) -> list[tuple[int, int]]:
    """Where each chunk of a whole file ends, and how many packets of events lie up to there."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        counts = []
        for one in summary.chunk_indexes:
            channel = next(number for number, channel in summary.channels.items() if channel.topic == "/e")
            file.seek(one.message_index_offsets[channel] + 9 + 2)
            counts.append(struct.unpack("<I", file.read(4))[0] // 16)
    ends = [one.chunk_start_offset + one.chunk_length for one in summary.chunk_indexes]
    return list(zip(ends, np.cumsum(counts).tolist(), strict=True))


@pytest.mark.parametrize("packing", few(["NONE", "LZ4", "ZSTD"], "ZSTD"))
def test_whole_chunks_of_a_cut_file_come(packing: str, tmp_path: Path) -> None:
    """Assert that every message of each chunk that ends before the cut comes, no other, and that the loss is said."""
    whole = mcap(tmp_path / "a.mcap", compression=CompressionType[packing])
    data, chunks = whole.read_bytes(), ends(whole)
    assert len(chunks) > 5
    assert event_rows(read_events(whole)) == ROWS
    rng = np.random.default_rng(1)
    cuts = [end + more for end, _ in chunks for more in (-1, 0, 1)] + rng.integers(chunks[0][0], len(data), 20).tolist()
    for cut in cuts:
        expected = SIZE * max((count for end, count in chunks if end <= cut), default=0)
        path = tmp_path / f"cut{whole.suffix}"
        path.write_bytes(data[:cut])
        if not expected:
            assert "no message can be read" in refusal(path)
            continue
        source = open_rosbag(path, None, None)
        imported = read_events(path)
        assert event_rows(imported) == ROWS[:expected]
        assert source.cut_short
        words = " ".join(imported.notes)
        messages = int(re.findall("kept ([0-9]+) messages", words)[0])
        assert messages >= 2 * expected // SIZE - 1  # with those of the other topic
        assert "bytes are lost" in words or "the bag was not closed" in words


@pytest.mark.parametrize("packing", PACKINGS)
def test_cut_bags_of_ros_1_say_what_helps(packing: str, tmp_path: Path) -> None:
    """Assert that a bag of ROS 1 whose index is missing is refused, and that the message names what restores it."""
    whole = ros1(tmp_path / "a.bag", packing)
    assert event_rows(read_events(whole)) == ROWS
    data = whole.read_bytes()
    for share in (0.1, 0.5, 0.999):
        path = tmp_path / "cut.bag.active"
        path.write_bytes(data[: int(share * len(data))])
        assert "`rosbag reindex" in refusal(path)


OPTIONS: dict[str, dict[str, Any]] = {
    "as the library writes it": {},
    "not in chunks": {"use_chunking": False},
    "nothing in the summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
    "never closed": {"finish": False},
    "never closed, not in chunks": {"finish": False, "use_chunking": False},
}


@pytest.mark.parametrize("what", OPTIONS)
def test_no_index_is_needed(what: str, tmp_path: Path) -> None:
    """Assert that all messages of MCAP files come, with whatever parts of the summary a writer leaves out."""
    path = mcap(tmp_path / "a.mcap", **OPTIONS[what])
    imported = read_events(path)
    complete = "finish" not in OPTIONS[what]
    expected = ROWS if complete else ROWS[: imported.size]
    assert event_rows(imported) == expected and imported.size > 0.9 * EVENTS.size
    others = imported.left_out["messages on /n (std_msgs/msg/Float64)"]
    assert others == imported.size // SIZE if complete else others >= imported.size // SIZE - 1
    kept = others + imported.size // SIZE
    said = f"the bag was not closed, probably because its recorder was killed: kept {kept} messages"
    assert [note for note in imported.notes if "left out" not in note] == ([] if complete else [said])


@pytest.mark.parametrize("packing", ["ZSTD", "NONE"])
def test_what_is_before_a_damaged_chunk_comes(packing: str, tmp_path: Path) -> None:
    """Assert that the chunks before a damaged one come, and that a note tells of the loss and what may save more."""
    whole = mcap(tmp_path / "a.mcap", compression=CompressionType[packing])
    chunks = ends(whole)
    data = bytearray(whole.read_bytes())
    data[chunks[4][0] - 40 : chunks[4][0] - 20] = bytes(20)
    whole.write_bytes(data)
    imported = read_events(whole)
    assert event_rows(imported) == ROWS[: SIZE * chunks[3][1]]
    assert "`mcap recover`" in " ".join(imported.notes)


@pytest.mark.parametrize("share", [0.2, 0.6, 0.9999])
def test_a_cut_database_is_refused(share: float, write: Write, tmp_path: Path) -> None:
    """Assert that a database that was cut anywhere says how much is missing, and what would help."""
    types = Types("db3")
    (whole,) = write("db3", types, {"/e": packets(types, EVENTS, SIZE)}).glob("*.db3")
    path = tmp_path / "cut.db3"
    size = int(share * whole.stat().st_size)
    path.write_bytes(whole.read_bytes()[:size])
    words = refusal(path)
    missing = f"{whole.stat().st_size - size:,} bytes at its end are missing"
    assert missing in words and "copy it again" in words and "`sqlite3 FILE .recover`" in words


HOSTILE = {
    "a view": ("CREATE VIEW messages AS WITH RECURSIVE t(x) AS (SELECT 1 UNION ALL SELECT x FROM t) SELECT x FROM t"),
    "a column that is computed": (
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
        " data BLOB AS (zeroblob(900000000)))"
    ),
    "a table of another program": "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
    "texts in place of numbers": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id TEXT, timestamp TEXT, data)",
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_database_that_computes_is_refused(what: str, tmp_path: Path) -> None:
    """Assert that views, computed columns and virtual tables in place of messages run nothing."""
    path = tmp_path / "a.db3"
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
    database.execute("INSERT INTO topics VALUES(1, '/e', 'dvs_msgs/msg/EventArray', 'cdr')")
    database.execute(HOSTILE[what])
    if "TABLE" in HOSTILE[what] and "VIRTUAL" not in HOSTILE[what]:
        columns = "topic_id, timestamp" + ("" if " AS " in HOSTILE[what] else ", data")
        values = "'one', 'now', x'00'" if "TEXT" in HOSTILE[what] else "1, 1"
        database.execute(f"INSERT INTO messages({columns}) VALUES({values})")
    database.commit()
    database.close()
    assert refusal(path)


def test_messages_of_ros_1_in_mcap_come(tmp_path: Path) -> None:
    """Assert that MCAP files that were made of bags of ROS 1 are read, with the layout of ROS 1."""
    types = Types("ros1")
    rows = listed(EVENTS)[:500]
    numbers: Sequence[Any] = [types.make("std_msgs/msg/Float64", float(k)) for k in range(5)]
    messages = [types.array(rows[k : k + 100]) for k in range(0, 500, 100)]
    path = write_mcap(tmp_path / "a.mcap", types, {"/e": messages, "/n": numbers}, coding="ros1")
    assert event_rows(read_events(path)) == ROWS[:500]
    stream, _ = read_stream(f"{path}:/n", "n")
    assert stream.columns["data"].tolist() == [0, 1, 2, 3, 4]


def test_mutated_bags_give_events_or_words(tmp_path: Path) -> None:
    """Assert that bags of every kind, cut and damaged anywhere, never end in anything else."""
    types = Types("db3")
    bags = [
        ros1(tmp_path / "a.bag", "lz4"),
        mcap(tmp_path / "a.mcap"),
        mcap(tmp_path / "b.mcap", use_chunking=False),
        next(write_bag(tmp_path, "db3", types, {"/e": packets(types, EVENTS, SIZE)}, name="c").glob("*.db3")),
    ]
    rng = np.random.default_rng(2)
    for whole in bags:
        data = whole.read_bytes()
        for trial in range(25):
            mutated = bytearray(data)
            if trial % 3 == 0:
                del mutated[rng.integers(20, len(mutated)) :]
            for at in rng.integers(13, len(mutated), 6 if trial % 2 else 0):
                mutated[at] = rng.integers(256)
            path = tmp_path / f"mutated{whole.suffix}"
            path.write_bytes(mutated)
            try:
                imported = read_events(path, order=OrderOptions(sort=True))
                assert imported.size <= EVENTS.size
            except Exception as error:
                assert type(error).__name__ == "InputError", (whole, trial)
