"""A folder with many files appears as a whole, and nothing that is in a folder is ever removed."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from evetac_cli.errors import InputError
from evetac_cli.store.made_folders import new_folder


def make(folder: Path, text: str = "first") -> None:
    with new_folder(folder) as unfinished:
        (unfinished / "README.md").write_text(text)
        (unfinished / "data").mkdir()
        (unfinished / "data" / "a.parquet").write_text(f"numbers {text}")


TAKEN: dict[str, Callable[[Path], object]] = {
    "one that evetac made": make,
    "a note": lambda folder: folder.mkdir() or (folder / "notes.txt").touch(),
    "an empty folder inside": lambda folder: (folder / "inside").mkdir(parents=True),
    "a file": lambda folder: folder.touch(),
    "a pipe": os.mkfifo,
    "a link to an empty folder": lambda folder: (
        folder.with_name("other").mkdir() or folder.symlink_to(folder.with_name("other"))
    ),
}


@pytest.mark.parametrize("name", TAKEN)
def test_what_is_there_stays(name: str, tmp_path: Path) -> None:
    """Assert that a folder with anything in it, and anything else of that name, is refused and stays."""
    TAKEN[name](tmp_path / "hub")
    before = {path: path.lstat() for path in tmp_path.rglob("*")}
    with pytest.raises(InputError, match=r"the output (exists|is not a folder)"):
        make(tmp_path / "hub", "second")
    assert {path: path.lstat() for path in tmp_path.rglob("*")} == before


def test_an_empty_folder_is_taken(tmp_path: Path) -> None:
    """Assert that a folder with nothing in it is filled."""
    (tmp_path / "hub").mkdir()
    make(tmp_path / "hub")
    assert (tmp_path / "hub" / "data" / "a.parquet").read_text() == "numbers first"
    assert list(tmp_path.iterdir()) == [tmp_path / "hub"]


@pytest.mark.parametrize("error", [KeyError, KeyboardInterrupt])
def test_an_error_leaves_nothing(error: type[BaseException], tmp_path: Path) -> None:
    """Assert that what was written until an error goes, with the folders made on the way."""
    with pytest.raises(error), new_folder(tmp_path / "new" / "hub") as unfinished:
        (unfinished / "README.md").write_text("half")
        raise error
    assert list(tmp_path.iterdir()) == []


def test_what_appears_while_the_work_goes_on_is_kept(tmp_path: Path) -> None:
    """Assert that a folder that another run, or a user, fills meanwhile stays, and nothing else is left."""
    folder = tmp_path / "data"
    with pytest.raises(InputError, match="the output exists"), new_folder(folder) as late:
        (late / "a.txt").write_text("late")
        make(folder, "early")
    assert (folder / "README.md").read_text() == "early"
    assert list(tmp_path.iterdir()) == [folder]
