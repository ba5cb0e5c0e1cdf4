"""The files of a bag: what lies beside a file, bags in several files, and what the metadata of a folder are worth."""

import os
import re
import shutil
import sqlite3
import struct
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.bags import bag_files, open_bag
from evetac_cli.formats.read.bags.bag_files import zstd_module
from evetac_cli.formats.streams import read_stream
from tests.formats.read.bags.bag_writing import START_S, Types, Write, drawn, listed, mono, shifted, write_mcap
from tests.importing import event_rows, refusal
from tests.patience import PATIENCE_S

EVENTS = drawn(400)


def messages(types: Types, size: int = 10) -> list[Any]:
    """All events in messages of so many."""
    rows = listed(EVENTS)
    return [types.array(rows[k : k + size]) for k in range(0, len(rows), size)]


def state(folder: Path) -> dict[str, tuple[bytes, int]]:
    """What a folder holds."""
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()}


def opened(whole: Path, copy: Path, journal: str) -> tuple[sqlite3.Connection, list[tuple[Any, ...]]]:
    """A database like another, without its messages, open for writing in a mode of its journal; and the messages."""
    shutil.copyfile(whole, copy)
    database = sqlite3.connect(copy)
    rows = database.execute("SELECT * FROM messages").fetchall()
    database.execute("DELETE FROM messages")
    database.commit()
    database.execute("VACUUM")
    assert database.execute(f"PRAGMA journal_mode = {journal}").fetchone() == (journal.lower(),)
    return database, rows


def killed(whole: Path, folder: Path, *, in_file: int) -> Path:
    """What a recorder leaves that was killed: so many messages in the database, the others in what waits beside it."""
    folder.mkdir()
    made, left = folder.with_name(f"{folder.name}.making.db3"), folder / "bag_0.db3"
    database, rows = opened(whole, made, "WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    for number, row in enumerate(rows):
        database.execute("INSERT INTO messages VALUES(?, ?, ?, ?)", row)
        database.commit()
        if number + 1 == in_file:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    for path in made.parent.glob(f"{made.name}*"):
        shutil.copyfile(path, folder / path.name.replace(made.name, left.name))
    database.close()
    return left


@pytest.fixture
def whole(write: Write) -> Path:
    """The file of a bag in SQLite, with all events in 40 messages."""
    types = Types("db3")
    return next(write("db3", types, {"/e": messages(types)}, "whole").glob("*.db3"))


@pytest.mark.parametrize(("in_file", "named"), [(0, "file"), (7, "folder"), (39, "with metadata")])
def test_what_waits_beside_a_database_is_read(whole: Path, tmp_path: Path, in_file: int, named: str) -> None:
    """Assert that all messages come, whatever part of them waits beside the file, and that no file is touched."""
    left = killed(whole, tmp_path / "left", in_file=in_file)
    if named == "with metadata":
        text = whole.with_name("metadata.yaml").read_text().replace("whole.db3", left.name)
        (left.parent / "metadata.yaml").write_text(text)
    before = state(left.parent)
    assert set(before) - {"metadata.yaml"} == {"bag_0.db3", "bag_0.db3-wal", "bag_0.db3-shm"}
    left.parent.chmod(0o555)
    try:
        imported = read_events(left if named == "file" else left.parent)
    finally:
        left.parent.chmod(0o755)
    assert event_rows(imported) == shifted(EVENTS)
    assert "read together with bag_0.db3-wal (" in " ".join(imported.notes)
    assert state(left.parent) == before


def test_a_stream_is_read_with_what_waits_too(write: Write, tmp_path: Path) -> None:
    """Assert that attach gets the samples that wait beside a database, and says so."""
    types = Types("db3")
    numbers = [types.make("std_msgs/msg/Float64", float(k)) for k in range(40)]
    file = next(write("db3", types, {"/n": numbers}, "numbers").glob("*.db3"))
    stream, notes = read_stream(str(killed(file, tmp_path / "left", in_file=5)), "n")
    assert stream.columns["data"].tolist() == list(range(40))
    assert "bag_0.db3-wal" in notes[0]


def unfinished(whole: Path, left: Path) -> Path:
    """What a recorder leaves that was killed in a transaction: 20 messages, and a journal to take back the others."""
    database, rows = opened(whole, left.with_name("made.db3"), "DELETE")
    database.executemany("INSERT INTO messages VALUES(?, ?, ?, ?)", rows[:20])
    database.commit()
    database.execute("PRAGMA cache_size = 1")
    database.executemany("INSERT INTO messages VALUES(?, ?, ?, ?)", rows[20:])
    left.mkdir()
    for ending in ("", "-journal"):
        shutil.copyfile(left.with_name(f"made.db3{ending}"), left / f"bag.db3{ending}")
    database.close()
    return left / "bag.db3"


def test_what_was_not_finished_is_taken_back(whole: Path, tmp_path: Path) -> None:
    """Assert that a transaction that was being written is undone by the journal beside the file, in a copy."""
    left = unfinished(whole, tmp_path / "left").parent
    before = state(left)
    assert len(before["bag.db3-journal"][0]) > 512
    imported = read_events(left / "bag.db3")
    assert event_rows(imported) == shifted(EVENTS)[:200]
    assert "read together with bag.db3-journal (" in imported.notes[0]
    assert state(left) == before


def test_a_journal_removes_no_other_file(whole: Path, tmp_path: Path) -> None:
    """Assert that a journal that names another file is refused: SQLite itself removes what it names."""
    path = unfinished(whole, tmp_path / "left")
    named = tmp_path / "of-somebody.txt"
    named.write_bytes(b"anything\n" * 99)
    name = str(named).encode()
    end = struct.pack(">II", len(name), sum(name)) + bytes.fromhex("d9d505f920a163d7")
    with path.with_name("bag.db3-journal").open("ab") as journal:
        journal.write(struct.pack(">I", (1 << 30) // 4096 + 1) + name + end)
    shutil.copytree(path.parent, tmp_path / "again")
    assert "names another file" in refusal(path)
    assert named.exists()
    database = sqlite3.connect(tmp_path / "again" / "bag.db3")
    database.execute("SELECT count(*) FROM messages").fetchone()
    database.close()
    assert not named.exists()  # what SQLite does


@pytest.mark.parametrize(("share", "cut"), [(0.3, False), (0.9, False), (0.7, True)])
def test_what_waits_is_read_up_to_a_damage(whole: Path, tmp_path: Path, share: float, cut: bool) -> None:
    """Assert that of a damaged or cut `-wal` what is before the damage comes, and that a note tells of the rest."""
    left = killed(whole, tmp_path / "left", in_file=7)
    wal = left.with_name("bag_0.db3-wal")
    data = bytearray(wal.read_bytes())
    at = int(share * len(data))
    if cut:
        del data[at:]
    else:
        data[at : at + 9] = b"\xff" * 9
    wal.write_bytes(data)
    imported = read_events(left)
    assert 70 < imported.size < EVENTS.size
    assert event_rows(imported) == shifted(EVENTS)[: imported.size]
    assert "damaged, or left from an earlier use" in imported.notes[0]


def test_what_an_earlier_turn_left_is_no_loss(whole: Path, tmp_path: Path) -> None:
    """Assert that pages that were long joined, and lie behind those that wait, do no harm."""
    made, left = tmp_path / "made.db3", tmp_path / "left"
    left.mkdir()
    database, rows = opened(whole, made, "WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    for number, row in enumerate(rows):
        database.execute("INSERT INTO messages VALUES(?, ?, ?, ?)", row)
        database.commit()
        if number == 35:
            database.execute("PRAGMA wal_checkpoint")  # leaves the pages there, to be written over
    for path in tmp_path.glob("made.db3*"):
        shutil.copyfile(path, left / path.name)
    database.close()
    imported = read_events(left / "made.db3")
    assert event_rows(imported) == shifted(EVENTS)
    assert "read together with made.db3-wal (" in imported.notes[0]


def test_a_bag_that_is_being_written_is_refused(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a database that changes while it is copied is not read as a mixture of two states."""
    left = killed(whole, tmp_path / "left", in_file=7)
    copy = shutil.copyfile

    def and_more(source: Any, target: Any) -> None:
        copy(source, target)
        with left.with_name("bag_0.db3-wal").open("ab") as wal:
            wal.write(b"more")

    monkeypatch.setattr(bag_files.shutil, "copyfile", and_more)
    assert "being written" in refusal(left)


@pytest.mark.parametrize("said", ['""', "mcap", "sqlite3", "my_own_plugin"])
@pytest.mark.parametrize("bag", ["db3", "mcap"])
def test_the_files_say_how_a_bag_is_stored(write: Write, bag: str, said: str) -> None:
    """Assert that the storage that the metadata name, or leave empty, does not matter."""
    types = Types(bag)
    folder = write(bag, types, {"/e": messages(types)})
    about = folder / "metadata.yaml"
    text = re.sub("storage_identifier: .*", f"storage_identifier: {said}", about.read_text())
    assert f"storage_identifier: {said}\n" in text
    about.write_text(text)
    imported = read_events(folder)
    assert event_rows(imported) == shifted(EVENTS)
    assert imported.notes == []


def split(folder: Path, parts: int = 3, start: int = 0) -> Path:
    """A folder of a bag in several files of MCAP, without metadata."""
    types = Types("mcap")
    every = messages(types)
    folder.mkdir()
    size = -(-len(every) // parts)
    for number in range(parts):
        some = range(size * number, min(size * (number + 1), len(every)))
        topics, times = {"/e": [every[at] for at in some]}, [START_S + at for at in some]
        write_mcap(folder / f"trial_{start + number}.mcap", types, topics, times=times)
    return folder


def about(folder: Path, *names: str, count: int = 40, **more: str) -> Path:
    """Metadata that list these files."""
    fields = {"version": 5, "storage_identifier": "mcap", "message_count": count, **more}
    lines = [*(f"  {name}: {value}" for name, value in fields.items()), "  relative_file_paths:"]
    text = "\n".join(["rosbag2_bagfile_information:", *lines, *(f"  - {name}" for name in names)])
    (folder / "metadata.yaml").write_text(text + "\n")
    return folder


@pytest.mark.parametrize("start", [0, 8])
def test_all_files_of_a_folder_are_one_bag(tmp_path: Path, start: int) -> None:
    """Assert that a bag in several files is read whole, in the order of its numbers, with metadata and without."""
    folder = split(tmp_path / "bag", 3, start)
    imported = read_events(folder)
    assert event_rows(imported) == shifted(EVENTS)
    (note,) = imported.notes
    assert "no metadata.yaml" in note and f"trial_{start}.mcap, trial_{start + 1}.mcap" in note
    about(folder, *(f"trial_{start + number}.mcap" for number in range(3)))
    imported = read_events(folder)
    assert event_rows(imported) == shifted(EVENTS)
    assert imported.notes == []


@pytest.mark.parametrize("text", ["", "{", "rosbag2_bagfile_information: {}", "rosbag2_bagfile_information: []", "- 5"])
def test_metadata_that_are_none_are_done_without(tmp_path: Path, text: str) -> None:
    """Assert that metadata that were not finished, or are something else, cost nothing but a note."""
    folder = split(tmp_path / "bag")
    (folder / "metadata.yaml").write_text(text)
    imported = read_events(folder)
    assert event_rows(imported) == shifted(EVENTS)
    assert "metadata.yaml cannot be used" in imported.notes[0]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    """Assert that a bag of which a file is missing is refused, listed or not, and that its files can be read alone."""
    folder = split(tmp_path / "bag")
    (folder / "trial_1.mcap").unlink()
    words = refusal(folder)
    assert "a part of the bag is missing" in words and "number 1" in words
    words = refusal(about(folder, *(f"trial_{number}.mcap" for number in range(3))))
    assert "trial_1.mcap" in words and f"{folder}/trial_0.mcap" in words
    assert event_rows(read_events(folder / "trial_0.mcap")) == shifted(EVENTS)[:140]


def test_files_that_are_not_read_are_named(tmp_path: Path) -> None:
    """Assert that a note names files that the metadata do not list, and parts beside a file that is named itself."""
    folder = about(split(tmp_path / "bag"), "trial_0.mcap", "trial_1.mcap", count=28)
    imported = read_events(folder)
    assert event_rows(imported) == shifted(EVENTS)[:280]
    assert imported.notes == [
        "not read: trial_2.mcap, which metadata.yaml does not list; give the file itself to read it"
    ]
    imported = read_events(folder / "trial_1.mcap")
    assert imported.size == 140
    assert imported.notes == ["next to it: trial_0.mcap, trial_2.mcap, which may be parts of the same recording"]
    (folder / "trial_0.mcap").rename(folder / "begin.mcap")
    about(folder, "begin.mcap", "trial_1.mcap", count=28)
    notes = read_events(folder / "begin.mcap").notes
    assert notes == ["next to it: trial_1.mcap, which may be parts of the same recording"]
    shutil.copyfile(folder / "trial_2.mcap", tmp_path / "alone.mcap")
    assert read_events(tmp_path / "alone.mcap").notes == []


def test_parts_of_ros_1_are_named(write: Write, tmp_path: Path) -> None:
    """Assert that the parts that rosbag's --split makes are named, each with the date on which it was begun."""
    types = Types("ros1")
    names = ["press_2024-05-01-10-00-00_0", "press_2024-05-01-10-05-00_1", "rub_2024-05-01-10-05-00_1", "other_1_x"]
    for name in names:
        path = write("ros1", types, {"/e": messages(types)}, name)
    notes = read_events(path.with_name(f"{names[0]}.bag")).notes
    assert notes == [f"next to it: {names[1]}.bag, which may be parts of the same recording"]
    assert read_events(path).notes == []


def test_odd_numbers_of_files(tmp_path: Path) -> None:
    """Assert that two files of one number are not one bag, and that a number out of all measure costs nothing."""
    folder = split(tmp_path / "bag")
    types = Types("mcap")
    other = write_mcap(tmp_path / "trial_01.mcap", types, {"/e": messages(types)[:1]}).rename(folder / "trial_01.mcap")
    assert "not parts of one bag" in refusal(folder)
    other.rename(folder / "trial_100000000.mcap")
    tracemalloc.start()
    words = refusal(folder)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "a part of the bag is missing" in words and "number 3, number 4" in words
    assert most < 10 << 20


def test_a_folder_of_other_files_asks_which(tmp_path: Path) -> None:
    """Assert that files with names of their own are not taken for one bag."""
    types = Types("mcap")
    for name in ("left", "right"):
        write_mcap(tmp_path / f"{name}.mcap", types, {"/e": messages(types)})
    words = refusal(tmp_path)
    assert "not parts of one bag" in words and "left.mcap, right.mcap" in words


@pytest.mark.parametrize(
    ("count", "said"), [(40, []), (41, ["41 messages; it has 40"]), (7, ["7 messages; it has 40"])]
)
def test_metadata_that_say_another_count_are_noted(tmp_path: Path, count: int, said: list[str]) -> None:
    """Assert that all messages come whatever the metadata say, and that a note tells of the difference."""
    folder = about(split(tmp_path / "bag", 1), "trial_0.mcap", count=count)
    imported = read_events(folder)
    assert event_rows(imported) == shifted(EVENTS)
    said = f"metadata.yaml states {count} messages, but the bag has 40"
    assert imported.notes == ([] if count == 40 else [said])


def test_ways_of_packing_that_are_not_read_are_refused(tmp_path: Path) -> None:
    """Assert that metadata with another way of packing are believed: its messages would look damaged."""
    folder = about(split(tmp_path / "bag", 1), "trial_0.mcap", compression_format="lz4")
    assert "the compression of the bag is not supported" in refusal(folder)


@pytest.mark.parametrize("bag", ["db3", "mcap"])
def test_packed_files_are_read(write: Write, bag: str) -> None:
    """Assert that a file that was packed as a whole is read, with its twin that was not removed, or refused if cut."""
    types = Types(bag)
    events = drawn(60_000)
    folder = write(bag, types, {"/e": packets(types, events)}, "plain")
    (plain,) = folder.glob(f"*.{bag}")
    (folder / "metadata.yaml").unlink()
    if bag == "mcap":
        write_mcap(plain, types, {"/e": packets(types, events)}, chunk_size=20_000)
    packed = plain.with_name(f"{plain.name}.zstd")
    packed.write_bytes(zstd_module().compress(plain.read_bytes()))
    assert read_events(folder).size == events.size  # the recorder was killed before it removed the file
    plain.unlink()
    assert read_events(folder).size == events.size
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size * 7 // 10])
    assert "the compressed file is cut short" in refusal(folder)


def packets(types: Types, events: Events, size: int = 500) -> list[Any]:
    """Events in packets of so many."""
    made = []
    for number, first in enumerate(range(0, events.size, size)):
        part = events.part(first, first + size)
        base_ns = 1000 * int(part.t[0])
        made.append(types.packet(mono(part, base_ns), "mono", number, base_ns))
    return made


def test_no_copy_is_left(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the copy of a file is gone once others are read, and that of a process that was killed, too."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    open_bag._bag.cache_clear()
    left = killed(whole, tmp_path / "one", in_file=7)
    code = f"""
import os
from evetac_cli.formats.imports import read_events
read_events({str(left)!r})
os.kill(os.getpid(), 9)
"""
    environment = os.environ | {"TMPDIR": str(scratch)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=False, timeout=PATIENCE_S)
    (of_dead,) = scratch.iterdir()
    assert (of_dead / "copy").is_file()
    read_events(left)
    (of_this,) = scratch.iterdir()
    assert of_this != of_dead
    for name in ("two", "three", "four"):
        read_events(killed(whole, tmp_path / name, in_file=7))
    assert len(list(scratch.iterdir())) == 2 and not of_this.exists()
    open_bag._bag.cache_clear()
    assert not list(scratch.iterdir())
