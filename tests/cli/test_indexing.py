"""What is up to date by the index of a folder, without opening a file; what a run adds to it; `index --jobs`."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import pytest

from evetac_cli.cli import indexing
from evetac_cli.inspect import validate
from evetac_cli.store import index
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Recipe
from tests.conftest import Made
from tests.make import answer_of, evetac

COMMANDS = {
    "label": ("label", "--after-ms", "25"),
    "track": ("track",),
    "featurize": ("featurize",),
}


@pytest.fixture
def folder(made: Made, tmp_path: Path) -> Path:
    """Two trials, of which everything has been made."""
    for path in made.recordings[:2]:
        for kind in ("recording", "labels", "tracks", "features"):
            shutil.copy(made.beside(path, kind), tmp_path)
    return tmp_path


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The names of stage files that are opened."""
    names: list[str] = []
    original = StageFile.__init__

    def noting(self: StageFile, path: Path, *kinds: Any) -> None:
        names.append(Path(path).name)
        original(self, path, *kinds)

    monkeypatch.setattr(StageFile, "__init__", noting)
    yield names


def indexed(folder: Path) -> None:
    index.read_index(folder)


def status(folder: Path, *words: str) -> list[str]:
    return [row["status"] for row in answer_of(words[0], folder, *words[1:])["rows"]]


@pytest.mark.parametrize("words", COMMANDS.values(), ids=COMMANDS)
def test_nothing_is_opened_of_what_the_index_knows(words: tuple[str, ...], folder: Path, opened: list[str]) -> None:
    """Assert that a command has nothing to do by the index, and says it as it does when it opens the files."""
    said = answer_of(words[0], folder, *words[1:])
    assert len(opened) >= 4
    assert not (folder / index.NAME).exists()
    indexed(folder)
    opened.clear()
    assert answer_of(words[0], folder, *words[1:]) == said
    assert [row["status"] for row in said["rows"]] == ["up to date"] * 2
    assert opened == []
    one = next(folder.glob("*.recording.h5"))
    assert answer_of(words[0], one, *words[1:])["rows"][0]["status"] == "up to date"
    assert opened == []


def touch(path: Path) -> None:
    os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns))


def change_in_place(path: Path) -> None:
    """Another content of the same size, with the old time of writing."""
    was = path.stat()
    with h5py.File(path, "r+") as h5:
        h5["confidence"][()] = 0.125
    os.utime(path, ns=(was.st_atime_ns, was.st_mtime_ns))
    assert path.stat().st_size == was.st_size


def exchange(path: Path) -> None:
    """A copy in its place."""
    shutil.copy2(path, path.with_suffix(".copy"))
    path.with_suffix(".copy").replace(path)


@pytest.mark.parametrize("kind", ["recording", "labels"])
@pytest.mark.parametrize("change", [touch, exchange], ids=lambda change: change.__name__)
def test_files_that_changed_are_opened(
    kind: str, change: Callable[[Path], None], folder: Path, opened: list[str]
) -> None:
    """Assert that an input or output that was touched or exchanged is opened, once, and that the index learns of it."""
    indexed(folder)
    path = sorted(folder.glob(f"*.{kind}.h5"))[0]
    change(path)
    opened.clear()
    assert status(folder, *COMMANDS["label"]) == ["up to date"] * 2
    assert path.name in opened
    other = sorted(folder.glob(f"*.{kind}.h5"))[1]
    assert other.name not in opened
    opened.clear()
    assert status(folder, *COMMANDS["label"]) == ["up to date"] * 2
    assert opened == []
    assert index.read_index(folder).read == 0


def test_an_output_that_was_changed_in_place_is_looked_at(folder: Path, opened: list[str]) -> None:
    """Assert that damage of the same size, at the same time of writing, is found and not called up to date."""
    indexed(folder)
    path = sorted(folder.glob("*.labels.h5"))[0]
    with h5py.File(path, "r+") as h5:
        h5["onset_slice"][()] = 1
    run = evetac(*COMMANDS["label"][:1], folder, *COMMANDS["label"][1:])
    assert run.exit_code == 2 and "not a valid evetac file" in run.stderr
    for _ in range(2):
        assert evetac(*COMMANDS["label"][:1], folder, *COMMANDS["label"][1:]).exit_code == 2
    assert path.name in opened


@pytest.mark.parametrize(
    "change", [{"size_bytes": 1}, {"inode": 1}, {"recipe_id": None}, {"kind": "tracks"}, {"error": "x"}], ids=str
)
@pytest.mark.parametrize("of", ["recording", "labels"])
def test_a_row_counts_as_a_whole(change: dict[str, Any], of: str, folder: Path, opened: list[str]) -> None:
    """Assert that files are opened where size, inode, kind or recipe id in the index are not theirs."""
    rows = index.read_index(folder).rows
    index._store(folder / index.NAME, [row._replace(**change) if row.kind == of else row for row in rows])
    opened.clear()
    assert status(folder, *COMMANDS["label"]) == ["up to date"] * 2
    assert len(opened) >= 4


def test_other_parameters_are_refused_as_ever(folder: Path, opened: list[str]) -> None:
    """Assert that an output of another recipe is refused in the same words, and replaced with --force alone."""
    without = evetac("label", folder, "--after-ms", "30")
    indexed(folder)
    with_index = evetac("label", folder, "--after-ms", "30")
    assert without.exit_code == with_index.exit_code == 2
    assert without.stderr == with_index.stderr and "another recipe" in with_index.stderr
    opened.clear()
    assert status(folder, "label", "--after-ms", "30", "--force") == ["made"] * 2
    opened.clear()
    assert status(folder, "label", "--after-ms", "30") == ["up to date"] * 2
    assert opened == []


def test_another_grid_is_another_recipe(folder: Path, opened: list[str]) -> None:
    """Assert that with a grid of one's own the files are opened, also if it is the one in the recording."""
    one = sorted(folder.glob("*.recording.h5"))[0]
    grid = folder / "grid.json"
    assert evetac("export", "--format", "calibration", one, "-o", grid).exit_code == 0
    indexed(folder)
    opened.clear()
    evetac("track", one, "--calibration", grid)
    assert one.name in opened


def test_what_a_run_makes_is_learned(folder: Path, opened: list[str]) -> None:
    """Assert that an index that is there has the rows of files that were made, and answers for them next time."""
    indexed(folder)
    for path in folder.glob("*.features.h5"):
        path.unlink()
    assert status(folder, "featurize") == ["made"] * 2
    opened.clear()
    assert status(folder, "featurize") == ["up to date"] * 2
    assert opened == []
    now = index.read_index(folder)
    assert (now.read, now.removed, len(now.rows)) == (0, 0, 8)
    assert all(row["valid"] for row in validate.run(sorted(folder.glob("*.features.h5"))).rows)


def test_no_index_is_made_uninvited(folder: Path) -> None:
    """Assert that commands that make files leave no index where there was none."""
    for path in folder.glob("*.labels.h5"):
        path.unlink()
    assert status(folder, *COMMANDS["label"]) == ["made"] * 2
    assert status(folder, *COMMANDS["label"]) == ["up to date"] * 2
    assert not list(folder.glob(".evetac*"))


def test_the_index_of_a_folder_above_counts(folder: Path, opened: list[str]) -> None:
    """Assert that files in a folder below are known by the index of the data set."""
    (folder / "object 3").mkdir()
    for path in folder.glob("*.h5"):
        path.rename(folder / "object 3" / path.name)
    indexed(folder)
    opened.clear()
    assert status(folder / "object 3", "track") == ["up to date"] * 2
    assert opened == []


def test_known_says_nothing_of_what_is_not_there(folder: Path) -> None:
    """Assert that a file that is gone, was never there, or lies beside no index is not known."""
    indexed(folder)
    path = sorted(folder.glob("*.labels.h5"))[0]
    known = index.Known()
    assert known.row(path, "labels") is not None
    assert known.row(path, "tracks") is None
    assert known.row(folder / "none.labels.h5", "labels") is None
    assert not known.is_up_to_date(path, Recipe("labels", 1, {}))
    path.unlink()
    assert known.row(path, "labels") is None
    assert known.row(folder.parent / "a.labels.h5", "labels") is None


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
