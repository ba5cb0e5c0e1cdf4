"""A file that cannot be looked at now is neither valid nor invalid, is named with the reason, and loses nothing."""

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import pytest

from evetac_cli import text_files
from evetac_cli.errors import InputError, UnavailableError, cannot_read
from evetac_cli.formats import imports
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.streams import read_stream
from evetac_cli.inspect import validate
from evetac_cli.store.files import StageFile
from evetac_cli.store.hdf5 import checked_hdf5
from evetac_cli.store.recordings import segments
from tests import small_files
from tests.make import evetac
from tests.store.recordings.test_recovery import STATIC, broken_off

HOLD = """
import sys, h5py
with h5py.File(sys.argv[1], sys.argv[2]) as file:
    print("open", flush=True)
    sys.stdin.read()
"""
BUSY = "another program has this file open for writing"


@contextmanager
def opened_elsewhere(path: Path, mode: str = "a") -> Iterator[subprocess.Popen[str]]:
    """Another process holds the file open."""
    command = [sys.executable, "-c", HOLD, str(path), mode]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "open\n"
        yield holder
        holder.communicate()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A trial of a recording and its tracks, and another one."""
    header = small_files.recording(tmp_path / "a.recording.h5")
    small_files.tracks(tmp_path / "a.tracks.h5", header)
    small_files.recording(tmp_path / "b.recording.h5")
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        "track {f} -o {o}/a.tracks.h5",
        "attach {f} --stream pose=pose.csv -o {o}/new.recording.h5",
        "record --from {f} -o {o}/new.recording.h5",
        "record --camera replay:{f} -o {o}/new.recording.h5",
        "trim b.recording.h5 --to-ms 10 -o {f} --force",
    ],
)
def test_commands_say_who_has_a_file_open(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the program is named, that nothing is called wrong, and that nothing was written or replaced."""
    path = folder / "a.recording.h5"
    monkeypatch.chdir(folder)
    (folder / "pose.csv").write_text("t_ms,x\n1,2\n3,4\n")
    out = folder.parent / f"{folder.name}-out"
    before, inode = path.read_bytes(), path.stat().st_ino
    with opened_elsewhere(path) as holder:
        result = evetac(*command.format(f="a.recording.h5", o=out).split(), "--json")
    shown = json.loads(result.stdout)["error"]
    assert (shown["kind"], shown["message"], result.exit_code) == ("UnavailableError", BUSY, 1), shown
    assert f"({holder.pid})" in shown["found"]
    assert "LOCKING" not in result.stdout  # the lock is no leftover
    assert (path.read_bytes(), path.stat().st_ino) == (before, inode)
    assert not out.exists() or not list(out.iterdir())


def test_a_busy_file_is_neither_valid_nor_invalid(folder: Path) -> None:
    """Assert the row, the words and exit code 1; 2 where another file is invalid; 0 once the file is free."""
    path = folder / "a.recording.h5"
    with opened_elsewhere(path):
        result = evetac("validate", path, "--json")
        shown = json.loads(result.stdout)
        (row,) = shown["rows"]
        assert (row["valid"], row["faults"], result.exit_code) == (None, None, 1)
        assert BUSY in row["not_checked"]
        assert shown["summary"] == {"files": 1, "invalid": 0, "not_checked": 1}
        (folder / "broken.recording.h5").write_bytes(b"no")
        result = evetac("validate", folder, "--json")
        assert json.loads(result.stdout)["summary"] == {"files": 4, "invalid": 1, "not_checked": 1}
        assert result.exit_code == 2
        assert "invalid: 1" in evetac("validate", folder).stdout
    assert evetac("validate", path).exit_code == 0


def test_a_file_that_is_only_read_elsewhere_is_free(folder: Path) -> None:
    """Assert that a reader beside us changes nothing."""
    with opened_elsewhere(folder / "a.recording.h5", "r"):
        assert evetac("validate", folder / "a.recording.h5").exit_code == 0


def test_folders_pass_over_a_busy_file_with_its_reason(folder: Path) -> None:
    """Assert that info, view and report of a folder go on, name it, and read it once it is free."""
    with opened_elsewhere(folder / "a.tracks.h5"):
        shown = json.loads(evetac("info", folder, "--json").stdout)
        assert shown["summary"]["unreadable"] == 1
        (reason,) = (row["reason"] for row in shown["rows"] if "reason" in row)
        assert reason.startswith(BUSY)
        result = evetac("view", folder / "a.recording.h5", "-o", folder / "a.html", "--json")
        assert BUSY in json.loads(result.stdout)["summary"]["notes"]
        result = evetac("report", folder, "--json")
        assert json.loads(result.stdout)["rows"][0]["unreadable"] == 1
    assert json.loads(evetac("info", folder, "--json").stdout)["summary"]["unreadable"] == 0


def test_the_mark_that_a_killed_writer_leaves(folder: Path) -> None:
    """Assert that a file marked as open for writing, by whoever, is not called damaged, and what takes the mark off."""
    with h5py.File(folder / "open.h5", "w", libver="latest") as file:
        file["x"] = 1
        file.flush()
        shutil.copy(folder / "open.h5", folder / "left.h5")
    with pytest.raises(UnavailableError, match=r"marked as open for writing(.|\n)*h5clear -s"):
        StageFile(folder / "left.h5")
    (row,) = validate.run([folder / "left.h5"]).rows
    assert row["valid"] is None


@pytest.mark.parametrize("number", [errno.EACCES, errno.ESTALE, errno.EMFILE, errno.EIO, errno.ENOLCK, errno.EBUSY])
def test_what_the_system_refuses_says_nothing_of_the_file(
    number: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that it was not checked, for HDF5, TOML and text alike; the hint on locks if there are none."""
    path = folder / "a.recording.h5"

    def refuse(*_: Any, **__: Any) -> Any:
        raise OSError(number, f"Unable to open (errno = {number})")

    with monkeypatch.context() as patch:
        patch.setattr(h5py, "File", refuse)
        (row,) = validate.run([path]).rows
    assert (row["valid"], row["faults"]) == (None, None)
    assert (BUSY if number == errno.EBUSY else os.strerror(number)) in row["not_checked"]
    assert ("LOCKING" in row["not_checked"]) == (number == errno.ENOLCK)
    with StageFile(path) as file, monkeypatch.context() as patch:
        patch.setattr(checked_hdf5.CheckedHdf5, "text", refuse)
        with pytest.raises(UnavailableError):
            file.read("sensor/name")
    (folder / "own.toml").write_text("like = 'evetac'\n")
    (folder / "events.txt").write_text("1 2 3 1\n")
    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(UnavailableError):
        text_files.read_toml(folder / "own.toml")
    with pytest.raises(UnavailableError):
        read_events(folder / "events.txt")


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EISDIR, errno.EINVAL])
def test_a_wrong_name_or_damaged_bytes_are_input(number: int, tmp_path: Path) -> None:
    """Assert that errors which will come again next time are those of what was given."""
    assert isinstance(cannot_read(OSError(number, os.strerror(number)), tmp_path), InputError)


def test_an_event_file_that_grows_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that what was read of it is not taken for the whole, nor a half-written end for damage."""
    path = tmp_path / "events.txt"
    path.write_text("1 2 3 1\n2 2 3 0\n3 2")  # its last line is being written
    head = imports._head

    def grow(path: Path) -> bytes:
        said = head(path)
        with path.open("a") as file:
            file.write(" 3 1\n")
        return said

    monkeypatch.setattr(imports, "_head", grow)
    with pytest.raises(UnavailableError, match="changed while it was read"):
        read_events(path, frame_px=(640, 480))
    monkeypatch.undo()
    assert read_events(path, frame_px=(640, 480)).size == 3


def test_a_folder_that_grows_while_it_is_read(tmp_path: Path) -> None:
    """Assert that a file added to a bag is noticed."""
    stamps = text_files.FileStamps(tmp_path)
    (tmp_path / "metadata.yaml").touch()
    with pytest.raises(UnavailableError, match="changed while it was read"):
        stamps.check()


def test_a_table_that_grows_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a stream of a file that another program writes is not taken for the whole."""
    path = tmp_path / "pose.csv"
    path.write_text("t_ms,x\n1,2\n3,4\n")
    assert len(read_stream(str(path), "pose")[0].t_us) == 2
    from evetac_cli.formats import streams

    read = streams.read_table

    def grow(path: Path, *given: Any) -> Any:
        result = read(path, *given)
        with path.open("a") as file:
            file.write("5,6\n")
        return result

    monkeypatch.setattr(streams, "read_table", grow)
    with pytest.raises(UnavailableError, match="changed while it was read"):
        read_stream(str(path), "pose")


@pytest.mark.parametrize("name", ["static.h5", "000001.h5"])
def test_repair_waits_for_segments_that_cannot_be_read_now(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that neither `repair` nor a new recording gives up what is left because it cannot be looked at now."""
    folder = broken_off(tmp_path, [5, 5, 5])
    before = sorted(path.name for path in folder.iterdir())
    opened = h5py.File

    def refuse(path: Any, *more: Any, **options: Any) -> Any:
        if str(path).endswith(name):
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, *more, **options)

    monkeypatch.setattr(h5py, "File", refuse)
    (row,) = validate.repair([folder]).rows
    assert row["status"] == "not repaired" and "Permission denied" in row["fault"]
    with pytest.raises(InputError, match="interrupted recording"):
        segments.RecordingWriter(folder.with_name("a.recording.h5"), STATIC)
    assert sorted(path.name for path in folder.iterdir()) == sorted({*before, "lock"})
    monkeypatch.undo()
    assert validate.repair([folder]).rows[0]["status"] == "repaired"
