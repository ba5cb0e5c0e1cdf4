"""Atomic writing of folders with many files. A folder may be replaced only if it is still as evetac wrote it.

Next to a folder NAME is `.NAME.evetac-files.json`, which lists the files that evetac wrote into it, with their sizes
and a mark that detects changes. A folder is replaced only if all of its files are listed and unchanged. Files that
others added or edited are never removed: a repository, notes, a card with a paragraph added by the user.

The list is next to the folder and not in it. The reasons: polars treats every file of a folder as a part of the data
set, and the list should not be uploaded with the folder.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from evetac_cli.errors import InputError, UnavailableError
from evetac_cli.store import index
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
# Files that people edit are small and are compared by their hash; larger ones by size and time of writing.
MOST_COMPARED_BYTES = 1 << 20
MOST_NAMED = 4  # files listed in the error that a folder is not replaced

Listed = Mapping[str, tuple[int, str | int]]  # path in the folder -> bytes, and SHA-256 or time of writing in ns


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
    if next(_entries(folder), None) is None:
        return
    listed = _listed(folder)
    strange = list(islice(_strange(folder, listed), MOST_NAMED + 1))
    if not force:
        elsewhere = "-o NAME writes to another folder"
        hint = elsewhere if strange else f"--force replaces it, {elsewhere}"
        raise InputError("the output exists", where=str(folder), hint=hint)
    _refuse(folder, listed, strange)


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
        files = {name: _look(temporary / name) for name, _ in _entries(temporary)}
        with locked(folder), taking_the_place_of(list_path(folder)) as unfinished:
            unfinished.write_text(json.dumps({"files": files}, indent=0) + "\n")
            if not force:
                require_replaceable(folder, force=False)
            if folder.is_dir():
                folder.replace(before)  # after this no program can add to it by its name
                listed = _listed(folder)
                _refuse(folder, listed, list(islice(_strange(before, listed), MOST_NAMED + 1)))
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


def _refuse(folder: Path, listed: Listed, strange: list[str]) -> None:
    if not strange:
        return
    more = ", and more" if len(strange) > MOST_NAMED else ""
    message = "the folder has files that evetac did not make, or that were changed, so it is not replaced"
    raise InputError(
        message if listed else "the folder has no list of files by evetac, so it is not replaced",
        where=str(folder),
        expected=f"files as listed in {list_path(folder).name}",
        found=", ".join(strange[:MOST_NAMED]) + more,
        hint="-o NAME writes to another folder; or move your own files away",
    )


def _entries(folder: Path, inside: str = "") -> Iterator[tuple[str, bool]]:
    """Yield the path in the folder of everything but folders, in order, and whether it is a regular file."""
    for entry in sorted(os.scandir(folder / inside), key=lambda one: one.name):
        if entry.is_dir(follow_symlinks=False):
            yield from _entries(folder, f"{inside}{entry.name}/")
        else:
            yield f"{inside}{entry.name}", entry.is_file(follow_symlinks=False)


def _strange(folder: Path, listed: Listed) -> Iterator[str]:
    """Yield the entries of a folder that are not listed or were changed; a subfolder without listed files only once.

    An index by evetac does not count, since `info` creates one.
    """
    own = {name.partition("/")[0] for name in listed}
    reported = set()
    for name, is_regular in _entries(folder):
        top = name.partition("/")[0]
        if name in listed and is_regular:
            if not _is_as(folder / name, *listed[name]):
                yield f"{name} (changed)"
        elif name.rpartition("/")[2] == index.NAME and is_regular:
            continue
        elif top in own:
            yield name
        elif top not in reported:
            reported.add(top)
            yield f"{top}/" if top != name else name


def _look(path: Path) -> tuple[int, str | int]:
    stat = path.stat()
    return stat.st_size, _digest(path) if stat.st_size <= MOST_COMPARED_BYTES else stat.st_mtime_ns


def _is_as(path: Path, size: int, mark: str | int) -> bool:
    stat = path.stat()
    if stat.st_size != size:
        return False
    return stat.st_mtime_ns == mark if isinstance(mark, int) else _digest(path) == mark


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _listed(folder: Path) -> Listed:
    """Return the files that evetac wrote into a folder; none if there is no readable list."""
    try:
        content: Any = parse_json(read_text(list_path(folder), MOST_LIST_BYTES))
        files = content["files"]
        return {str(name): (int(size), mark) for name, (size, mark) in files.items() if type(mark) in (int, str)}
    except (InputError, UnavailableError, ValueError, TypeError, KeyError, AttributeError):
        return {}
