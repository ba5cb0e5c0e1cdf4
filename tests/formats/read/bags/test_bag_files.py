"""The files of a bag: what lies beside a file, bags in several files, and what the metadata of a folder are worth."""

import os
import re
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.bags import bag_files
from evetac_cli.formats.read.bags.bag_files import zstd_module
from tests.formats.read.bags.bag_writing import START_S, Types, Write, drawn, listed, packets, shifted, write_mcap
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


@pytest.mark.parametrize(("share", "cut"), [(0.3, False), (0.7, True)])
def test_what_waits_is_read_up_to_a_damage(whole: Path, tmp_path: Path, share: float, cut: bool) -> None:
    """Assert that of a damaged or cut `-wal` what is before the damage comes, and that a note names the file."""
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
    assert "read together with bag_0.db3-wal (" in imported.notes[0]


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


@pytest.mark.parametrize("said", ['""', "my_own_plugin"])
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


@pytest.mark.parametrize("text", ["", "{", "rosbag2_bagfile_information: []"])
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
    assert "not all parts of one bag" in refusal(folder)
    words = refusal(about(folder, *(f"trial_{number}.mcap" for number in range(3))))
    assert "trial_1.mcap" in words
    assert event_rows(read_events(folder / "trial_0.mcap")) == shifted(EVENTS)[:140]


def test_files_that_are_not_read_are_named(tmp_path: Path) -> None:
    """Assert that a note names files that the metadata do not list."""
    folder = about(split(tmp_path / "bag"), "trial_0.mcap", "trial_1.mcap", count=28)
    imported = read_events(folder)
    assert event_rows(imported) == shifted(EVENTS)[:280]
    assert imported.notes == [
        "not read: trial_2.mcap, which metadata.yaml does not list; give the file itself to read it"
    ]


def test_ways_of_packing_that_are_not_read_are_refused(tmp_path: Path) -> None:
    """Assert that metadata with another way of packing are believed: its messages would look damaged."""
    folder = about(split(tmp_path / "bag", 1), "trial_0.mcap", compression_format="lz4")
    assert "the compression of the bag is not supported" in refusal(folder)


@pytest.mark.parametrize("bag", ["db3", "mcap"])
def test_packed_files_are_read(write: Write, bag: str) -> None:
    """Assert that a file that was packed as a whole is read, with its twin that was not removed, or refused if cut."""
    types = Types(bag)
    events = drawn(60_000)
    folder = write(bag, types, {"/e": packets(types, events, 500)}, "plain")
    (plain,) = folder.glob(f"*.{bag}")
    (folder / "metadata.yaml").unlink()
    if bag == "mcap":
        write_mcap(plain, types, {"/e": packets(types, events, 500)}, chunk_size=20_000)
    packed = plain.with_name(f"{plain.name}.zstd")
    packed.write_bytes(zstd_module().compress(plain.read_bytes()))
    assert read_events(folder).size == events.size  # the recorder was killed before it removed the file
    plain.unlink()
    assert read_events(folder).size == events.size
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size * 7 // 10])
    assert "the compressed file is cut short" in refusal(folder)


def test_no_copy_is_left(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the copy of a file is gone once others are read, and that of a process that was killed, too."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    bag_files._bag.cache_clear()
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
    bag_files._bag.cache_clear()
    assert not list(scratch.iterdir())
