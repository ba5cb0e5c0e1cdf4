"""An index that somebody sends along with a folder: only rows that evetac can have written are used, nothing waits."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.store import index
from evetac_cli.store.made_folders import new_folder, require_replaceable
from tests import small_files
from tests.make import answer_of
from tests.quick import few


@pytest.fixture
def folder(tmp_path: Path) -> Path:
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


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def to_a_device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


DAMAGE: dict[str, Callable[[Path], None]] = {
    "a number for a text": changed(scene=7),
    "a table for a text": changed(sensor={"a": 1}),
    "a text for a number": changed(slices="many"),
    "no size": changed(size_bytes=None),
    "a list for a path": changed(path=["a.recording.h5"]),
    "nothing": written(""),
    "text": written("my notes"),
    "a list": written("[1]"),
    "another format": written('{"format": 5, "rows": []}'),
    "rows that are none": written(f'{{"format": {index.FORMAT}, "rows": [1, 2]}}'),
    "too few columns": written(f'{{"format": {index.FORMAT}, "rows": [["a.recording.h5"]]}}'),
    "deep lists": written("[" * 100_000),
    "only the beginning": lambda path: path.write_bytes(path.read_bytes()[:100]) and None,
    "too large": lambda path: os.truncate(path, index.MOST_BYTES + 1),
    "a pipe": pipe,
    "a folder": a_folder,
    "a link to a device": to_a_device,
}


@pytest.mark.parametrize("name", few(DAMAGE, "a table for a text", "deep lists", "a pipe", "a folder"))
def test_a_damaged_index_is_not_used(name: str, folder: Path) -> None:
    """Assert that the files are read instead, and that it is replaced if it is a file."""
    right = index.read_index(folder).rows
    path = folder / index.NAME
    DAMAGE[name](path)
    is_replaced = path.is_file() or path.is_symlink()
    now = index.read_index(folder)
    assert (now.rows, now.read, now.stored) == (right, 2, is_replaced)
    now = index.read_index(folder)
    assert (now.rows, now.read) == (right, 0 if is_replaced else 2)


def test_rows_of_files_that_are_not_there_are_not_used(folder: Path) -> None:
    """Assert that a row for a file elsewhere, or for one that is gone, is in no answer."""
    right = index.read_index(folder).rows
    changed(path="../../../etc/passwd")(folder / index.NAME)
    now = index.read_index(folder)
    assert (now.rows, now.read, now.removed) == (right, 1, 1)


def test_a_row_without_a_kind_is_counted_under_none(folder: Path) -> None:
    """Assert that `info` of a folder whose index says an outcome of what is no file of ours ends in its tables."""
    changed(kind=None, outcome="x")(folder / index.NAME)
    assert all(None not in row and "null" not in row for row in answer_of("info", folder)["rows"])


def test_any_damage_to_an_index(folder: Path) -> None:
    """Assert that whatever bytes are changed, each file has its row."""
    right = index.read_index(folder).rows
    path = folder / index.NAME
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(damaged), 1 + rng.integers(8)):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        assert [row[:4] for row in index.read_index(folder).rows] == [row[:4] for row in right]


def test_what_a_header_says_is_text_that_can_be_kept(tmp_path: Path) -> None:
    """Assert that names of sensors and scenes that are no UTF-8, or are long, have a row, as text."""
    from evetac_cli.store.files import StageFile, write_stage
    from evetac_cli.store.layout.provenance import Recipe

    parameters = {"sensor": "\udcff", "scene": {"name": "s" * 10_000}, "object": "\ud800", "trial": "three"}
    small_files.recording(tmp_path / "b.recording.h5")
    with StageFile(tmp_path / "b.recording.h5") as file:
        arrays = {name: file.read(name) for name in file.contents()}
    write_stage(tmp_path / "a.recording.h5", Recipe("recording", 1, parameters, seed=2**70), arrays)
    first, _ = index.read_index(tmp_path).rows
    assert (first.sensor, first.object, first.seed, first.trial) == ("\\udcff", "\\ud800", str(2**70), None)
    assert first.scene is not None and 100 < len(first.scene) < 1000
    assert index.read_index(tmp_path).read == 0


def test_an_index_in_a_folder_that_evetac_made_is_no_strangers_file(tmp_path: Path) -> None:
    """Assert that a folder is still replaced with --force after `info` looked at it."""
    folder = tmp_path / "hub"
    with new_folder(folder, force=False) as unfinished:
        small_files.recording(unfinished / "a.recording.h5")
    index.read_index(folder)
    assert (folder / index.NAME).exists()
    require_replaceable(folder, force=True)
