"""`index --jobs`."""

import os
import shutil
from pathlib import Path

import h5py
import pytest

from evetac_cli.cli import indexing
from evetac_cli.store import index
from tests.conftest import Made
from tests.make import answer_of, evetac


@pytest.fixture
def folder(made: Made, tmp_path: Path) -> Path:
    """Two trials, of which everything has been made."""
    for path in made.recordings[:2]:
        for kind in ("recording", "labels", "tracks", "features"):
            shutil.copy(made.beside(path, kind), tmp_path)
    return tmp_path


def test_several_processes_make_the_same_index(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that `index --jobs` has the rows of `index`, of broken files and those of other programs too."""
    (folder / "broken.h5").write_text("no")
    with h5py.File(folder / "foreign.h5", "w") as h5:
        h5["x"] = 1
    monkeypatch.setattr(indexing, "FEW", 1)
    (made,) = answer_of("index", folder, "--jobs", 2)["rows"]
    assert (made["files"], made["read"], made["unreadable"], made["foreign"]) == (9, 10, 1, 1)
    by_processes = index.read_index(folder).rows
    (folder / index.NAME).unlink()
    assert index.read_index(folder).rows == by_processes
    assert evetac("index", folder, "--jobs", 0).exit_code == 2


def test_a_file_that_takes_a_process_down(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that this is an error in words."""
    monkeypatch.setattr(indexing, "FEW", 1)
    monkeypatch.setattr(index, "describe", dying)
    run = evetac("index", folder, "--jobs", 2)
    assert run.exit_code == 1 and "a process that reads files died" in run.stderr


def dying(*_: object) -> None:
    os._exit(9)
