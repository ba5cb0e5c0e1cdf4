"""An index that somebody sends along with a folder: only a table that evetac makes is believed, and nothing waits."""

import json
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.store import index
from evetac_cli.store.made_folders import new_folder, require_replaceable
from tests import small_files
from tests.quick import few

ENDLESS = "WITH RECURSIVE many(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM many) SELECT"
COLUMNS = ", ".join(index.IndexRow._fields)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings and their index."""
    for name in "ab":
        small_files.recording(tmp_path / f"{name}.recording.h5")
    with index.open_index(tmp_path):
        pass
    return tmp_path


def changed(*commands: str) -> Callable[[Path], None]:
    """What somebody does to a sound index with SQLite."""

    def change(path: Path) -> None:
        table = sqlite3.connect(path, isolation_level=None)
        table.execute("PRAGMA writable_schema = ON")
        for command in commands:
            table.execute(command)
        table.close()

    return change


def instead(*commands: str) -> Callable[[Path], None]:
    """Another database in its place."""

    def change(path: Path) -> None:
        path.unlink()
        changed(*commands, f"PRAGMA user_version = {index.FORMAT}")(path)

    return change


def linked(path: Path) -> None:
    path.rename(path.with_name("elsewhere.sqlite"))
    path.symlink_to(path.with_name("elsewhere.sqlite"))


def to_a_device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def view(select: str) -> Callable[[Path], None]:
    columns = ", ".join(
        f"{value} AS {name}" for name, value in zip(index.IndexRow._fields, select.split(";"), strict=False)
    )
    rest = ", ".join(f"NULL AS {name}" for name in index.IndexRow._fields[select.count(";") + 1 :])
    return instead(f"CREATE VIEW files AS {ENDLESS} {columns}, {rest} FROM many")


NOT_OURS: dict[str, Callable[[Path], None]] = {
    "endless rows": view("'a' || n;1;1"),
    "huge values": view("zeroblob(900000000);1;1"),
    "endless work": view(f"({ENDLESS} COUNT(*) FROM many);1;1"),
    "a trigger": changed("CREATE TRIGGER t AFTER INSERT ON files BEGIN DELETE FROM files; END"),
    "another table beside it": changed("CREATE TABLE more (x)"),
    "an index on an expression": changed(f"CREATE INDEX i ON files ({'abs(' * 20}size_bytes{')' * 20})"),
    "columns that are computed": instead(
        "CREATE TABLE files (path, size_bytes AS (length(zeroblob(1000000000))), changed_ns)"
    ),
    "a virtual table": changed(
        "UPDATE sqlite_master SET sql = 'CREATE VIRTUAL TABLE files USING fts5(path)', rootpage = 0"
    ),
    "a table of another program": instead("CREATE TABLE thesis (chapter)", "INSERT INTO thesis VALUES ('one')"),
    "a link": linked,
    "a link to a device": to_a_device,
    "a pipe": pipe,
    "a folder": a_folder,
    "text": lambda path: path.write_text("my notes") and None,
    "only the beginning": lambda path: path.write_bytes(path.read_bytes()[:100]) and None,
}
OURS: dict[str, Callable[[Path], None]] = {
    "nothing": lambda path: path.write_bytes(b"") and None,
    "bytes for a text": changed("UPDATE files SET sensor = x'00ff'"),
    "a number for a text": changed("UPDATE files SET scene = 7"),
    "a fraction for a number": changed("UPDATE files SET trial = 0.5"),
    "a text for a number": changed("UPDATE files SET slices = 'many'"),
    "slices beyond counting": changed("UPDATE files SET slices = 9223372036854775807"),
    "slices below nothing": changed("UPDATE files SET slices = -1"),
    "simulated and more": changed("UPDATE files SET simulated = 2"),
    "text that is no UTF-8": changed("UPDATE files SET sensor = CAST(x'fffe' AS TEXT)"),
    "a long text": changed("UPDATE files SET sensor = printf('%.*c', 100000, 'x')"),
    "no size": changed("UPDATE files SET size_bytes = NULL"),
    "rows without end, nearly": changed(
        f"INSERT INTO files WITH RECURSIVE many(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM many LIMIT 120000)"
        f" SELECT n || '.h5', {', '.join('NULL' for _ in index.IndexRow._fields[1:])} FROM many"
    ),
    "another format": changed("PRAGMA user_version = 4"),
    "an index of before": instead(
        "CREATE TABLE files (path, size_bytes, changed_ns, kind, PRIMARY KEY (path)) WITHOUT ROWID",
        "INSERT INTO files VALUES ('a.recording.h5', 1, 2, 'recording')",
    ),
}


def answers(folder: Path) -> Any:
    """What each command says of the folder."""
    said = {}
    for words in (["info", folder], ["index", folder], ["info", folder, "--where", "kind=recording"]):
        result = CliRunner().invoke(app, [*map(str, words), "--json"])
        assert result.exit_code == 0, result.output
        said[words[0], len(words)] = (json.loads(result.stdout), result.stderr)
    return said


def rows(folder: Path) -> list[index.IndexRow]:
    with index.open_index(folder) as opened:
        return opened.rows()


@pytest.mark.parametrize("name", few(NOT_OURS, "endless rows", "a link", "a pipe", "text"))
def test_what_evetac_did_not_make_is_left_as_it_is(name: str, folder: Path) -> None:
    """Assert that every command answers rightly, says that something else lies there, and does not touch it."""
    right = rows(folder)
    path = folder / index.NAME
    NOT_OURS[name](path)
    before = path.lstat()
    assert not index.is_index(path)
    for shown, words in answers(folder).values():
        assert "was not made by evetac" in words
        assert all(row.get("read", 2) == 2 and not row.get("stored") for row in shown["rows"])
    assert rows(folder) == right
    now = path.lstat()
    assert (now.st_mode, now.st_ino, now.st_mtime_ns) == (before.st_mode, before.st_ino, before.st_mtime_ns)
    assert not list(folder.glob(f"{index.NAME}-*"))


@pytest.mark.parametrize("name", few(OURS, "nothing", "bytes for a text", "rows without end, nearly"))
def test_an_index_of_ours_with_senseless_contents_is_made_again(name: str, folder: Path) -> None:
    """Assert that no value that an index cannot have is believed, that it is replaced, and read at once after that."""
    right = rows(folder)
    path = folder / index.NAME
    OURS[name](path)
    assert index.is_index(path)
    with index.open_index(folder) as opened:
        assert (opened.read, opened.stored, opened.note) == (2, True, "")
        assert opened.rows() == right
    with index.open_index(folder) as opened:
        assert (opened.read, opened.rows()) == (0, right)
    assert all(not words for _, words in answers(folder).values())


def test_rows_of_files_that_are_not_there_are_not_believed(folder: Path) -> None:
    """Assert that a row for a file elsewhere, or for one that is gone, is in no answer."""
    right = rows(folder)
    values = ", ".join(
        "1" if name in ("size_bytes", "changed_ns", "inode") else "NULL" for name in index.IndexRow._fields[1:]
    )
    changed(f"INSERT INTO files ({COLUMNS}) VALUES ('../../../etc/passwd', {values})")(folder / index.NAME)
    with index.open_index(folder) as opened:
        assert (opened.read, opened.removed, opened.rows()) == (0, 1, right)
    with index.open_index(folder) as opened:
        assert (opened.read, opened.removed) == (0, 0)


def test_a_row_without_a_kind_is_counted_under_none(folder: Path) -> None:
    """Assert that `info` of a folder whose index says an outcome of what is no file of ours ends in its tables."""
    changed("UPDATE files SET kind = NULL, outcome = 'x' WHERE path = 'a.recording.h5'")(folder / index.NAME)
    run = CliRunner().invoke(app, ["info", str(folder), "--json"])
    assert run.exit_code == 0, run.output
    assert all(None not in row and "null" not in row for row in json.loads(run.stdout)["rows"])


def test_any_damage_to_an_index(folder: Path) -> None:
    """Assert that whatever bytes are changed, the answer is right, in words and in the end."""
    right = rows(folder)
    path = folder / index.NAME
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, 600 if rng.random() < 0.5 else len(damaged), 1 + rng.integers(8)):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        now = rows(folder)
        assert [row[:3] for row in now] == [row[:3] for row in right]


def test_what_a_header_says_is_text_that_can_be_kept(tmp_path: Path) -> None:
    """Assert that names of sensors and scenes that are no UTF-8, or are long, have a row, as text."""
    from evetac_cli.store.files import StageFile, write_stage
    from evetac_cli.store.layout.provenance import Recipe

    made = small_files.events()
    parameters = {"sensor": "\udcff", "scene": {"name": "s" * 10_000}, "object": "\ud800", "trial": "three"}
    small_files.recording(tmp_path / "b.recording.h5")
    with StageFile(tmp_path / "b.recording.h5") as file:
        arrays = {name: file.read(name) for name in file.contents()}
    assert made.size
    write_stage(tmp_path / "a.recording.h5", Recipe("recording", 1, parameters, seed=2**70), arrays)
    first, _ = rows(tmp_path)
    assert (first.sensor, first.object, first.seed, first.trial) == ("\\udcff", "\\ud800", str(2**70), None)
    assert first.scene is not None and 100 < len(first.scene) < 1000
    with index.open_index(tmp_path) as opened:
        assert opened.read == 0


def test_an_index_in_a_folder_that_evetac_made_is_no_strangers_file(tmp_path: Path) -> None:
    """Assert that a folder is still replaced with --force after `info` looked at it, but not with another index."""
    folder = tmp_path / "hub"
    with new_folder(folder, force=False) as unfinished:
        small_files.recording(unfinished / "a.recording.h5")
    with index.open_index(folder):
        pass
    require_replaceable(folder, force=True)
    NOT_OURS["text"](folder / index.NAME)
    with pytest.raises(Exception, match="is not replaced"):
        require_replaceable(folder, force=True)
