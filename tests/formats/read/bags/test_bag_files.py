"""The files of a bag: what lies beside a file, bags in several files, and what the metadata of a folder are worth."""

import os
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


def test_what_waits_beside_a_database_is_named(write: Write) -> None:
    """Assert that a database whose last messages wait in another file is refused, and how they are merged is said."""
    types = Types("db3")
    path = next(write("db3", types, {"/e": messages(types)}, "whole").glob("*.db3"))
    wal = path.with_name(f"{path.name}-wal")
    wal.write_bytes(b"more")
    assert "wal_checkpoint" in refusal(path)
    wal.write_bytes(b"")
    assert event_rows(read_events(path)) == shifted(EVENTS)


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


def test_all_files_of_a_folder_are_one_bag(tmp_path: Path) -> None:
    """Assert that a bag in several files is read whole, in the order of its metadata."""
    folder = about(split(tmp_path / "bag"), *(f"trial_{number}.mcap" for number in range(3)))
    imported = read_events(folder)
    assert event_rows(imported) == shifted(EVENTS)
    assert imported.notes == []


@pytest.mark.parametrize("text", [None, "", "{", "rosbag2_bagfile_information: []"])
def test_files_without_metadata(tmp_path: Path, text: str | None) -> None:
    """Assert that one file is read without metadata, and that several are refused with the command that makes them."""
    for parts in (1, 3):
        folder = split(tmp_path / f"bag{parts}", parts)
        if text is not None:
            (folder / "metadata.yaml").write_text(text)
        if parts == 3:
            assert "ros2 bag reindex" in refusal(folder)
            continue
        imported = read_events(folder)
        assert event_rows(imported) == shifted(EVENTS)
        assert imported.notes == ["the folder has no usable metadata.yaml; read trial_0.mcap"]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    """Assert that a bag of which a listed file is missing is refused, and that its files can be read alone."""
    folder = split(tmp_path / "bag")
    (folder / "trial_1.mcap").unlink()
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


def test_no_copy_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the unpacked copy of a file is gone once others are read, and that of a process that was killed."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    bag_files._bag.cache_clear()
    packed = []
    for name in ("one", "two", "three"):
        plain = split(tmp_path / name, 1) / "trial_0.mcap"
        plain.with_name(f"{plain.name}.zstd").write_bytes(zstd_module().compress(plain.read_bytes()))
        plain.unlink()
        packed.append(plain.parent)
    code = f"""
import os
from evetac_cli.formats.imports import read_events
read_events({str(packed[0])!r})
os.kill(os.getpid(), 9)
"""
    environment = os.environ | {"TMPDIR": str(scratch)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=False, timeout=PATIENCE_S)
    (of_dead,) = scratch.iterdir()
    assert (of_dead / "copy").is_file()
    read_events(packed[0])
    (of_this,) = scratch.iterdir()
    assert of_this != of_dead
    for path in packed[1:]:
        read_events(path)
    assert len(list(scratch.iterdir())) == 2 and not of_this.exists()
    bag_files._bag.cache_clear()
    assert not list(scratch.iterdir())
