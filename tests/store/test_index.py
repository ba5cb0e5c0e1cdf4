"""The index of a data set is right whatever becomes of its files, and opens none of them to see that."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.store import index
from evetac_cli.store.files import StageFile
from evetac_cli.store.hdf5 import disk
from evetac_cli.store.made_folders import new_folder, require_replaceable
from tests import small_files
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


# An index that somebody sends along with a folder: only rows that evetac can have written are used.


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """Two recordings and their index."""
    for name in "ab":
        small_files.recording(tmp_path / f"{name}.recording.h5")
    index.read_index(tmp_path)
    return tmp_path


def changed(**values: Any) -> Callable[[Path], None]:
    """A sound index with other values in its first row."""

    def change(path: Path) -> None:
        content = json.loads(path.read_text())
        row = index.IndexRow(*content["rows"][0])._replace(**values)
        path.write_text(json.dumps({**content, "rows": [row, *content["rows"][1:]]}))

    return change


def written(text: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(text) and None


def test_any_damage_to_an_index(two: Path) -> None:
    """Assert that whatever bytes are changed, each file has its row."""
    right = index.read_index(two).rows
    path = two / index.NAME
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(damaged), 1 + rng.integers(8)):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        assert [row[:4] for row in index.read_index(two).rows] == [row[:4] for row in right]


def test_an_index_in_a_folder_that_evetac_made_is_no_strangers_file(tmp_path: Path) -> None:
    """Assert that a folder is still replaced with --force after `info` looked at it."""
    hub = tmp_path / "hub"
    with new_folder(hub, force=False) as unfinished:
        small_files.recording(unfinished / "a.recording.h5")
    index.read_index(hub)
    assert (hub / index.NAME).exists()
    require_replaceable(hub, force=True)
