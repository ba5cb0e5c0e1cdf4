"""Folders are replaced only where all that is in them is as evetac made it."""

import os
import shutil
from pathlib import Path

import pytest

from evetac_cli.errors import InputError
from evetac_cli.store.made_folders import list_path, new_folder


def make(folder: Path, text: str = "first", *, force: bool = False) -> None:
    with new_folder(folder, force=force) as unfinished:
        (unfinished / "README.md").write_text(text)
        (unfinished / "data").mkdir()
        (unfinished / "data" / "a.parquet").write_text(f"numbers {text}")
        (unfinished / "data" / "b.parquet").write_text("more")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def add(name: str, content: bytes = b"mine") -> "Change":
    def change(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)

    return change


def link(folder: Path) -> None:
    (folder / "README.md").rename(folder.parent / "elsewhere.md")
    (folder / "README.md").symlink_to(folder.parent / "elsewhere.md")


def touch(folder: Path) -> None:
    was = (folder / "data" / "b.parquet").stat()
    os.utime(folder / "data" / "b.parquet", ns=(was.st_atime_ns, was.st_mtime_ns + 1_000_000_000))


Change = type(touch)
CHANGES = {
    "a note": (add("thesis.tex"), "thesis.tex"),
    "a repository": (add(".git/HEAD"), ".git/"),
    "a card of the same length": (add("README.md", b"FIRST"), "README.md"),
    "a large file written anew": (touch, "data/b.parquet"),
    "a link in place of a file": (link, "README.md"),
    "a pipe": (lambda folder: os.mkfifo(folder / "pipe"), "pipe"),
    "a list that is gone": (lambda folder: list_path(folder).unlink(), "README.md"),
    "a list that is none": (lambda folder: list_path(folder).write_text("[1, 2"), "README.md"),
    "a list of odd things": (lambda folder: list_path(folder).write_text('{"files": {"README.md": 3}}'), "README.md"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_was_added_or_edited_is_never_removed(name: str, tmp_path: Path) -> None:
    """Assert that a folder that is not as evetac made it is refused with --force, with the reason, and stays."""
    folder = tmp_path / "hub"
    make(folder)
    change, said = CHANGES[name]
    change(folder)
    before = {path.name: path.lstat() for path in folder.rglob("*")}
    with pytest.raises(InputError, match="is not replaced") as refused:
        make(folder, "second", force=True)
    assert said in str(refused.value)
    assert {path.name: path.lstat() for path in folder.rglob("*")} == before
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".tmp")]


def test_a_folder_as_evetac_made_it_is_replaced_with_force(tmp_path: Path) -> None:
    """Assert that it is replaced with --force alone, also where files are missing."""
    folder = tmp_path / "hub"
    make(folder)
    with pytest.raises(InputError, match="the output exists") as refused:
        make(folder, "second")
    assert "--force replaces it" in refused.value.hint
    (folder / "data" / "a.parquet").unlink()
    make(folder, "second", force=True)
    assert (folder / "README.md").read_text() == "second"
    assert contents(folder).keys() == {"README.md", "data/a.parquet", "data/b.parquet"}
    (folder / "empty" / "inside").mkdir(parents=True)  # of which nothing is lost
    make(folder, "third", force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [list_path(folder).name, "hub"]
    shutil.rmtree(folder)
    make(folder, "fourth")  # a list without a folder is in nobody's way
    assert (folder / "README.md").read_text() == "fourth"


def test_an_empty_folder_is_taken(tmp_path: Path) -> None:
    """Assert that one in which there is nothing needs no --force, and that other things of its name are refused."""
    (tmp_path / "hub").mkdir()
    make(tmp_path / "hub")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "hub")
    for name in ("file", "link"):
        with pytest.raises(InputError, match="the output is not a folder"):
            make(tmp_path / name, force=True)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_note_written_while_the_work_goes_on_is_kept(tmp_path: Path) -> None:
    """Assert that it is looked at again before it is removed, and that the old folder then is in its place."""
    folder = tmp_path / "hub"
    make(folder)
    before = contents(folder)
    with pytest.raises(InputError, match=r"notes\.txt"), new_folder(folder, force=True) as unfinished:
        (unfinished / "README.md").write_text("second")
        (folder / "notes.txt").write_text("an hour's work")
    assert contents(folder) == {**before, "notes.txt": b"an hour's work"}
    assert sorted(path.name for path in tmp_path.iterdir()) == [list_path(folder).name, "hub"]
    (folder / "notes.txt").unlink()
    make(folder, "second", force=True)  # its list is still the old one


def test_an_error_leaves_the_old_folder_and_its_list(tmp_path: Path) -> None:
    """Assert that nothing changes where the work fails, and that folders made on the way go."""
    folder = tmp_path / "new" / "hub"
    with pytest.raises(KeyError), new_folder(folder, force=False) as unfinished:
        (unfinished / "README.md").write_text("half")
        raise KeyError
    assert list(tmp_path.iterdir()) == []
    make(folder)
    with pytest.raises(KeyboardInterrupt), new_folder(folder, force=True):
        raise KeyboardInterrupt
    make(folder, "second", force=True)
    assert (folder / "README.md").read_text() == "second"


def test_of_two_runs_onto_one_folder_the_second_is_refused(tmp_path: Path) -> None:
    """Assert that a folder that another run put there meanwhile stays, and nothing else is left."""
    folder = tmp_path / "data"
    with pytest.raises(InputError, match="the output exists"), new_folder(folder, force=False) as late:
        (late / "a.txt").write_text("late")
        with new_folder(folder, force=False) as early:
            (early / "a.txt").write_text("early")
    assert (folder / "a.txt").read_text() == "early"
    assert sorted(one.name for one in tmp_path.iterdir()) == [".data.evetac-files.json", "data"]
    with new_folder(folder, force=True) as again:
        (again / "a.txt").write_text("again")
    assert (folder / "a.txt").read_text() == "again"
