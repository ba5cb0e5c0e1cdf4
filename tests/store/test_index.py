"""The index of a data set is right whatever becomes of its files, and opens none of them to see that."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.errors import InputError
from evetac_cli.resources import PACKAGE
from evetac_cli.store import index
from evetac_cli.store.files import StageFile
from evetac_cli.store.hdf5 import disk
from evetac_cli.store.index import rows
from evetac_cli.store.layout.ancestry import recording_of
from tests.conftest import Made


def table(folder: Path) -> dict[str, index.IndexRow]:
    """The rows of a folder's index by path."""
    return {row.path: row for row in index.read_index(folder).rows}


def read(folder: Path) -> tuple[int, int]:
    """How many files had to be read for an index that is up to date, and how many are gone."""
    now = index.read_index(folder)
    return now.read, now.removed


@pytest.fixture
def folder(made: Made, tmp_path: Path) -> Path:
    """A data set: two trajectories, a model in a folder of its own, and what is no part of it."""
    for path in made.recordings[:2]:
        for kind in ("recording", "labels", "tracks", "features"):
            shutil.copy(made.beside(path, kind), tmp_path)
    (tmp_path / "models").mkdir()
    shutil.copy(made.model, tmp_path / "models")
    (tmp_path / "broken-off.recording.part").mkdir()
    shutil.copy(made.recordings[0], tmp_path / "broken-off.recording.part" / "000000.h5")
    shutil.copy(made.recordings[0], tmp_path / ".a.h5")
    (tmp_path / "notes.txt").write_text("h5")
    return tmp_path


def test_a_row_says_what_a_file_is(folder: Path, made: Made) -> None:
    """Assert that files made from a recording have its object, seed and scene, and a model has its own seed."""
    rows = table(folder)
    assert len(rows) == 9
    recording = made.recordings[0].name
    kinds = {kind: rows[recording.replace(".recording.", f".{kind}.")] for kind in ("recording", "labels", "features")}
    for kind, row in kinds.items():
        assert (row.kind, row.sensor, row.scene, row.outcome, row.error) == (kind, "evetac", "short", "slips", None)
        assert (row.object, row.seed, row.simulated) == (kinds["recording"].object, kinds["recording"].seed, 1)
        assert row.slices == kinds["recording"].slices and row.slices
        assert row.size_bytes == (folder / row.path).stat().st_size
    assert kinds["recording"].object is not None and kinds["recording"].trial is not None
    model = rows[f"models/{made.model.name}"]
    assert (model.kind, model.object, model.scene, model.outcome) == ("model", None, None, None)


def test_a_grasp_has_an_outcome(made: Made, tmp_path: Path) -> None:
    """Assert that what became of a grasp stands in its row, and its object is not that of the detector's training."""
    shutil.copy(made.grasp, tmp_path)
    (row,) = table(tmp_path).values()
    assert row.kind == "recording" and row.outcome in ("dropped", "lifted", "balanced")
    with StageFile(made.grasp) as file:
        own = file.header["parameters"]
    assert (row.object, row.scene) == (own["object"], own["scene"]["name"])


def test_whose_object_a_file_has() -> None:
    """Assert that it is that of the one recording behind a file, by whatever ways, and nobody's where there are two."""

    def header(kind: str, id_: str, *parents: str) -> dict[str, Any]:
        return {"kind": kind, "id": id_, "parents": list(parents)}

    history = {
        one["id"]: one
        for one in (
            header("recording", "a"),
            header("recording", "b"),
            header("recording", "c"),
            header("tracks", "tracks of a", "a"),
            header("report", "of a and b", "a", "b"),
            header("features", "of c", "c"),
            header("model", "trained on b", "b"),
        )
    }

    def behind(*parents: str) -> str | None:
        recording = recording_of(header("features", "new", *parents), history)
        return None if recording is None else recording["id"]

    assert recording_of(history["a"], history) is history["a"]
    assert behind("a", "tracks of a") == behind("tracks of a", "a") == behind("a", "trained on b") == "a"
    assert behind("of a and b", "of c") is behind("of c", "of a and b") is behind("a", "b") is behind() is None


def test_it_follows_the_files(folder: Path) -> None:
    """Assert that rows are right after files were added, changed, broken and removed, and that only these are read."""
    assert read(folder) == (9, 0)
    assert read(folder) == (0, 0)
    first, second, third, *_ = sorted(path.name for path in folder.glob("*.h5") if path.name[0] != ".")
    shutil.copy(folder / first, folder / "models" / "added.labels.h5")
    (folder / second).write_bytes((folder / second).read_bytes()[:-100])
    (folder / third).unlink()
    assert read(folder) == (2, 1)
    rows = table(folder)
    assert len(rows) == 9
    assert rows["models/added.labels.h5"].kind == rows[first].kind
    assert rows[second].kind is None and rows[second].error == "cannot be opened: it is truncated"
    assert third not in rows
    shutil.copy(folder / first, folder / second)
    assert table(folder)[second].error is None


def test_a_change_of_the_same_size_is_seen(folder: Path) -> None:
    """Assert that another content is seen that has the size and the time of writing of the old one."""
    right = table(folder)
    path = next(folder.glob("*.labels.h5"))
    was = path.stat()
    path.write_bytes(bytes(was.st_size))
    os.utime(path, ns=(was.st_atime_ns, was.st_mtime_ns))
    assert (path.stat().st_size, path.stat().st_mtime_ns) == (was.st_size, was.st_mtime_ns)
    assert read(folder) == (1, 0)
    assert right[path.name].error is None and table(folder)[path.name].error is not None


def test_nothing_is_opened_where_nothing_changed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that an index that is up to date is neither made nor written again."""
    before = table(folder)
    written = (folder / index.NAME).stat().st_mtime_ns
    monkeypatch.setattr(index, "describe", lambda *_: pytest.fail("opened"))
    assert table(folder) == before
    assert (folder / index.NAME).stat().st_mtime_ns == written


def test_what_could_not_be_read_is_tried_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a reason that passed leaves the index though the file did not change; no other file is read."""
    name, reads = next(folder.glob("*.tracks.h5")).name, index.describe

    def refuse(folder: Path, name: str, *seen: int) -> index.IndexRow:
        return index.IndexRow(name, *seen, error="cannot be opened: Permission denied")

    right = table(folder)
    (folder / name).touch()
    monkeypatch.setattr(index, "describe", refuse)
    assert table(folder)[name].error is not None
    written = (folder / index.NAME).stat().st_mtime_ns
    assert read(folder) == (1, 0) and (folder / index.NAME).stat().st_mtime_ns == written
    monkeypatch.setattr(index, "describe", reads)
    assert read(folder) == (1, 0)
    assert table(folder)[name].recipe_id == right[name].recipe_id
    assert read(folder) == (0, 0)


def test_a_folder_that_cannot_be_written_to(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that it is answered all the same, from memory, and that an old index is used as far as it is right."""

    def refuse(path: Path) -> Path:
        raise InputError("the output folder cannot be written to", where=str(path))

    before = table(folder)
    monkeypatch.setattr(disk, "existing_folder", refuse)
    assert table(folder) == before
    (folder / next(iter(before))).unlink()
    for _ in range(2):
        assert len(table(folder)) == 8
        assert not index.read_index(folder).stored
    (folder / index.NAME).unlink()
    assert len(table(folder)) == 8
    assert not (folder / index.NAME).exists()


def test_an_interrupt_keeps_what_was_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the next one goes on where Ctrl-C came."""

    def progress(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        index.read_index(folder, progress)
    assert read(folder) == (5, 0)
    assert len(table(folder)) == 9


def test_several_at_once(folder: Path) -> None:
    """Assert that commands that index the same folder at the same time all answer rightly, and leave it right."""
    program = (
        "import sys; from pathlib import Path; from evetac_cli.store import index\n"
        "rows = index.read_index(Path(sys.argv[1])).rows\n"
        "print(len(rows), sum(row.error is not None for row in rows))"
    )
    (folder / "broken.h5").write_text("no")
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    run = [sys.executable, "-c", program, str(folder)]
    started = [subprocess.Popen(run, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    assert [one.communicate()[0].strip() for one in started] == ["10 1"] * 3
    assert read(folder) == (1, 0)
    assert [path.name for path in folder.iterdir() if path.name.startswith(".evetac")] == [index.NAME]


def test_names_and_links_that_lead_nowhere(tmp_path: Path) -> None:
    """Assert that a name that is no text, a link to nothing and a folder with the name of a file do no harm."""
    (tmp_path / "link.h5").symlink_to(tmp_path / "nothing.h5")
    (tmp_path / "round").symlink_to(tmp_path)
    (tmp_path / "folder.h5").mkdir()
    with open(os.fsencode(tmp_path) + b"/\xff.h5", "wb") as file:
        file.write(b"no")
    rows = table(tmp_path)
    assert set(rows) == {"link.h5", "\udcff.h5"}
    assert all(row.error for row in rows.values())
    assert read(tmp_path) == (2, 0)
    assert table(tmp_path) == rows


def test_a_file_is_no_data_set(made: Made) -> None:
    """Assert that only a folder has an index."""
    with pytest.raises(InputError, match="no such folder"):
        index.read_index(made.recordings[0])


def test_seeds_that_tables_cannot_hold() -> None:
    """Assert that a whole number of more than 64 bits is kept as text."""
    assert rows._plain(2**63) == str(2**63)
    kept = [rows._plain(value) for value in (2**63 - 1, -5, "a", True, 1.5, [1], None)]
    assert kept == [2**63 - 1, -5, "a", *[None] * 4]
