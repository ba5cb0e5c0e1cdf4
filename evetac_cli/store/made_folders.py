"""Atomic writing of folders with many files. A folder may be replaced only if it is still as evetac wrote it.

Next to a folder NAME is `.NAME.evetac-files.json`, which lists the files that evetac wrote into it, with their sizes
and times of writing. A folder is replaced only if all of its files are listed and unchanged. Files that others added
or edited are never removed: a repository, notes, a card with a paragraph added by the user.

The list is next to the folder and not in it. The reasons: polars treats every file of a folder as a part of the data
set, and the list should not be uploaded with the folder.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evetac_cli.errors import InputError, UnavailableError
from evetac_cli.store.hdf5.disk import (
    existing_folder,
    locked,
    missing_folders,
    remove_empty,
    remove_with_contents,
    taking_the_place_of,
    temporary_name,
)
from evetac_cli.text_files import parse_json, read_text

LIST = ".{}.evetac-files.json"
MOST_LIST_BYTES = 1 << 28  # enough for two million files
MOST_NAMED = 4  # files listed in the error that a folder is not replaced


def list_path(folder: Path) -> Path:
    """Return the path of the list of a folder's files."""
    folder = folder.resolve()
    return folder.with_name(LIST.format(folder.name))


def require_replaceable(folder: Path, *, force: bool) -> None:
    """Raise InputError if `folder` exists, unless it is empty or, with `force`, unchanged since evetac wrote it."""
    if not os.path.lexists(folder):
        existing_folder(folder.parent)
        return
    if folder.is_symlink() or not folder.is_dir():
        raise InputError("the output is not a folder", where=str(folder))
    if not any(folder.iterdir()):
        return
    if not force:
        hint = "--force replaces it if only evetac wrote into it, -o NAME writes to another folder"
        raise InputError("the output exists", where=str(folder), hint=hint)
    _refuse_unexpected(folder, folder)


@contextmanager
def new_folder(folder: Path, *, force: bool) -> Iterator[Path]:
    """Yield a new folder, which replaces `folder` if the block succeeds, and is removed if it fails.

    InputError as for `require_replaceable`, before the block and again before anything is removed, and if writing
    fails.
    """
    require_replaceable(folder, force=force)
    new_parents = missing_folders(folder.parent)
    temporary = temporary_name(folder)
    before = temporary.with_name(f"{temporary.name.removesuffix('.tmp')}.before.tmp")
    try:
        temporary.mkdir(parents=True)
        yield temporary
        with locked(folder), taking_the_place_of(list_path(folder)) as unfinished:
            unfinished.write_text(json.dumps({"files": _files(temporary)}, indent=0) + "\n")
            if not force:
                require_replaceable(folder, force=False)
            if folder.is_dir():
                folder.replace(before)  # after this no program can add to it by its name
                _refuse_unexpected(before, folder)
            temporary.replace(folder)
    except BaseException as error:
        remove_with_contents(temporary)
        remove_empty(new_parents)
        if isinstance(error, OSError):
            raise InputError(f"cannot be written: {error.strerror or error}", where=str(folder)) from error
        raise
    finally:
        if folder.exists():
            remove_with_contents(before)
        elif before.exists():
            before.replace(folder)


def _refuse_unexpected(now: Path, folder: Path) -> None:
    """Raise InputError if the contents of `folder`, which are `now` there, are not those that evetac wrote."""
    try:
        listed = dict(parse_json(read_text(list_path(folder), MOST_LIST_BYTES))["files"])
    except (InputError, UnavailableError, ValueError, TypeError, KeyError):
        listed = {}
    foreign = [name for name, mark in _files(now).items() if listed.get(name) != mark]
    if foreign:
        message = "the folder has files that evetac did not make, or that were changed, so it is not replaced"
        found, hint = ", ".join(foreign[:MOST_NAMED]), "-o NAME writes to another folder; or move your own files away"
        raise InputError(message, where=str(folder), found=found, hint=hint)


def _files(folder: Path) -> dict[str, list[int]]:
    """Return size and time of writing in ns of everything below a folder, by its path there, but for folders."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_symlink() or not path.is_dir())
    looked = {str(path.relative_to(folder)): path.lstat() for path in paths}
    return {name: [status.st_size, status.st_mtime_ns] for name, status in looked.items()}
