"""New folders of many files, all or nothing; and which folder may be replaced: one that is still as evetac made it.

Beside a folder NAME lies `.NAME.evetac-files.json`, which lists the files that evetac wrote into it: of each its size,
and what shows that nobody changed it. A folder is replaced only if all that is in it is listed there, and unchanged.
What somebody else put into it, or edited, is never removed: a repository, notes, a card with a paragraph of one's own.

Why beside the folder and not in it: polars takes every file of a folder for a part of the data set, and what is
uploaded from there should hold no list of ours.
"""

import hashlib
import json
import math
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
    missing_folders,
    remove_empty,
    remove_with_contents,
    taking_the_place_of,
    temporary_name,
)
from evetac_cli.text_files import parse_json, read_text

LIST = ".{}.evetac-files.json"
MOST_LIST_BYTES = 1 << 28  # of two million files
# Files that people edit are small, and are compared byte by byte; of larger ones size and time of writing have to do.
MOST_COMPARED_BYTES = 1 << 20
MOST_NAMED = 4  # of what keeps a folder from being replaced

Listed = Mapping[str, tuple[int, str | int]]  # name from the folder on -> bytes, and SHA-256 or time of writing in ns


def list_path(folder: Path) -> Path:
    """Where the list of the files of a folder lies."""
    folder = folder.resolve()
    return folder.with_name(LIST.format(folder.name))


def require_replaceable(folder: Path, *, force: bool) -> None:
    """InputError where something is there already: but for an empty folder, and with `force` one as evetac made it."""
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
        hint = "-o NAME writes elsewhere" if strange else "--force replaces it, -o NAME writes elsewhere"
        raise InputError("the output exists", where=str(folder), hint=hint)
    _refuse(folder, listed, strange)


@contextmanager
def new_folder(folder: Path, *, force: bool) -> Iterator[Path]:
    """A new folder to write into, which takes the place of `folder` when the block ends well, and leaves no trace else.

    InputError as of `require_replaceable`, before the block and again before anything is removed; and if the disk does
    not take it.
    """
    require_replaceable(folder, force=force)
    made = missing_folders(folder.parent)
    temporary = temporary_name(folder)
    before = temporary.with_name(f"{temporary.name.removesuffix('.tmp')}.before.tmp")
    try:
        temporary.mkdir(parents=True)
        yield temporary
        with taking_the_place_of(list_path(folder)) as unfinished:
            files = {name: _look(temporary / name) for name, _ in _entries(temporary)}
            unfinished.write_text(json.dumps({"files": files}, indent=0) + "\n")
            if folder.is_dir():
                folder.replace(before)  # from here on nobody adds to it by its name
                listed = _listed(folder)
                _refuse(folder, listed, list(islice(_strange(before, listed), MOST_NAMED + 1)))
            temporary.replace(folder)
    except BaseException as error:
        remove_with_contents(temporary)
        remove_empty(made)
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
    message = "the folder holds files that evetac did not make, or that were changed since, and is not replaced"
    raise InputError(
        message if listed else "nothing shows that evetac made this folder, so it is not replaced",
        where=str(folder),
        expected=f"files as {list_path(folder).name} lists them",
        found=", ".join(strange[:MOST_NAMED]) + more,
        hint="-o NAME writes elsewhere; or move away what is yours",
    )


def _entries(folder: Path, inside: str = "") -> Iterator[tuple[str, bool]]:
    """Name, from the folder on, of all that is no folder, in order, and whether it is a regular file."""
    for entry in sorted(os.scandir(folder / inside), key=lambda one: one.name):
        if entry.is_dir(follow_symlinks=False):
            yield from _entries(folder, f"{inside}{entry.name}/")
        else:
            yield f"{inside}{entry.name}", entry.is_file(follow_symlinks=False)


def _strange(folder: Path, listed: Listed) -> Iterator[str]:
    """What is in a folder and not as it was listed; of a folder none of whose files is listed the folder alone.

    An index of ours is none of it: looking at a folder makes one.
    """
    own = {name.partition("/")[0] for name in listed}
    said = set()
    for name, is_regular in _entries(folder):
        top = name.partition("/")[0]
        if name in listed and is_regular:
            if not _is_as(folder / name, *listed[name]):
                yield f"{name} (changed)"
        elif name.rpartition("/")[2] == index.NAME and index.is_index(folder / name):
            continue
        elif top in own:
            yield name
        elif top not in said:
            said.add(top)
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
    """The files that evetac wrote into a folder; none where there is no list that can be read."""
    try:
        said: Any = parse_json(read_text(list_path(folder), MOST_LIST_BYTES), most_values=math.inf)
        files = said["files"]
        return {str(name): (int(size), mark) for name, (size, mark) in files.items() if type(mark) in (int, str)}
    except (InputError, UnavailableError, ValueError, TypeError, KeyError, AttributeError):
        return {}
