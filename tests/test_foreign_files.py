"""HDF5 files of other programs in a folder, an export of ours among them, are passed over, and counted."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from evetac_cli.formats.write.event_files import write_dsec
from evetac_cli.jobs import silent
from evetac_cli.store.recordings.read import open_recording
from tests import small_files
from tests.make import answer_of, evetac
from tests.quick import few


def dsec(path: Path) -> None:
    with open_recording(path.parent / "a.recording.h5") as recording:
        write_dsec(recording, path, silent)


def arrays(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["x"] = np.arange(10)


def links_elsewhere(path: Path) -> None:
    with h5py.File(path, "w", libver="latest") as file:
        file["passwords"] = h5py.ExternalLink("/etc/passwd", "/")


FOREIGN: dict[str, tuple[str, Callable[[Path], None]]] = {
    "our own export": ("a.dsec.h5", dsec),
    "a name of ours": ("b.recording.h5", arrays),
    "links to elsewhere": ("d.links.h5", links_elsewhere),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "data").mkdir()
    header = small_files.recording(tmp_path / "data" / "a.recording.h5")
    small_files.tracks(tmp_path / "data" / "a.tracks.h5", header)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"


@pytest.mark.parametrize("name", few(FOREIGN, "a name of ours", "links to elsewhere"))
def test_they_are_passed_over_and_counted(name: str, folder: Path) -> None:
    """Assert that every command that takes a folder works as without it, and says what it passed over."""
    file, make = FOREIGN[name]
    make(folder / file)
    shown = answer_of("info", "data")
    assert shown["summary"] == {"folder": "data", "files": 2, "unreadable": 0, "foreign": 1}
    shown = answer_of("info", "data", "--where", "kind=none")
    assert [(row["path"], row["error"]) for row in shown["rows"]] == [(file, None)]
    shown = answer_of("report", "data")
    assert shown["rows"][0]["unreadable"] == 0
    assert f"1 HDF5 file of another program ({file})" in (folder / "report.html").read_text()
    shown = answer_of("share", "data", "-o", "hub")
    assert f"skipped: 1 HDF5 file of another program ({file})" in shown["summary"]["notes"]
    assert sorted(path.name for path in Path("hub/data").iterdir()) == ["a.recording.h5", "a.tracks.h5"]
    shown, said = answer_of("validate", "data"), evetac("validate", "data", "--json").stderr
    assert [row["valid"] for row in shown["rows"]] == [True, True]
    assert (f"skipped: 1 HDF5 file of other programs ({file})" in said) == (file.count(".") > 1)
    shown = answer_of("info", *(str(path) for path in folder.glob("a.*.h5") if path.name != file))
    assert len(shown["rows"]) == 2


def test_many_of_them_and_nothing_else(folder: Path) -> None:
    """Assert that several are counted, and that a folder of them alone is none of ours, in words."""
    for number in range(3):
        arrays(folder / f"n{number}.other.h5")
    assert answer_of("info", "data")["summary"]["foreign"] == 3
    said = evetac("validate", "data", "--json").stderr
    assert "skipped: 3 HDF5 files of other programs (n0.other.h5)" in said
    for path in folder.glob("a.*"):
        path.unlink()
    for words, expected in (
        (("report", "data"), "no evetac files"),
        (("share", "data", "-o", "hub"), "nothing to"),
    ):
        result = evetac(*words)
        assert result.exit_code == 2 and expected in result.stderr
    assert "other programs" in evetac("report", "data").stderr


def test_a_file_that_is_named_is_still_refused(folder: Path) -> None:
    """Assert that a foreign file among those named one by one is an error, with the way to import it."""
    arrays(folder / "results.other.h5")
    result = evetac("validate", "data/results.other.h5", "--json")
    assert result.exit_code == 2
    assert "record --from" in json.loads(result.stdout)["rows"][0]["faults"]
    result = evetac("info", "data/results.other.h5")
    assert result.exit_code == 2 and "was not made by evetac" in result.stderr


def test_pipes_and_devices_beside_the_files(folder: Path) -> None:
    """Assert that what could wait for ever is not opened, whatever its name: a page, a table, a stage file."""
    for name in ("a.html", "b.csv", "c.parquet", "report.html.tmp"):
        os.mkfifo(folder / name)
    (folder / "d.csv").symlink_to("/dev/zero")
    (folder / "e.html").symlink_to("/dev/zero")
    for words in (("report", "data"), ("info", "data"), ("share", "data", "-o", "hub"), ("validate", "data")):
        answer_of(*words)
    os.mkfifo(folder / "f.recording.h5")
    shown = answer_of("info", "data")
    assert shown["summary"]["unreadable"] == 1
    result = evetac("validate", "data/f.recording.h5")
    assert result.exit_code == 2
