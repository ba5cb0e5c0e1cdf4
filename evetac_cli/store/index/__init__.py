"""The index of a data set: the properties of all stage files in a folder, in one JSON file, so that none is opened.

FOLDER/.evetac-index.json has a row for every `*.h5` in the folder and its subfolders. Damaged files have the reason in
their row; HDF5 files of other programs have no kind. A row is used if size, time of change and inode of its file are
the same, so listing the folder shows whether the index is up to date. Only unreadable files are tried each time,
because the reason may be permissions, the storage, or an older evetac.

The time of change (ctime) is used and not that of the last writing (mtime): `cp -p`, `rsync -t` and backups restore
files with an old mtime, and other contents may have the same size. The ctime cannot be set by a user. A data set that
was copied to another folder is read once again there.

Of two concurrent commands, the later one replaces the index of the earlier one, and what is missing is read again.
"""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import EvetacError, InputError
from evetac_cli.store.index.rows import NOT_THERE, IndexRow, Seen, describe
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.text_files import read_bytes

__all__ = (
    "NAME", "Describe", "Index", "IndexRow", "Known", "Seen", "describe", "one_by_one", "read_index",
)  # fmt: skip

NAME = ".evetac-index.json"
FORMAT = 6  # an index of another format is made again
MOST_BYTES = 1 << 27  # some 400,000 files; a larger index is not read

_TEXT = (str, type(None))
_TYPES: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(IndexRow._fields, _TEXT),
    **dict.fromkeys(("size_bytes", "changed_ns", "inode"), (int,)),
    **dict.fromkeys(("object", "seed"), (int, *_TEXT)),
    **dict.fromkeys(("trial", "slices"), (int, type(None))),
    "path": (str,),
    "simulated": (bool, type(None)),
    "dot_radius_px": (float, type(None)),
}

Progress = Callable[[int, int], None]
# Describes files, given by their paths.
Describe = Callable[[Path, Mapping[str, Seen], Progress], Iterable[IndexRow]]


class Index(NamedTuple):
    """An index that is up to date, and the changes that were made for this."""

    rows: list[IndexRow]  # sorted by path
    read: int  # files that were added or changed, or could not be read before
    removed: int
    stored: bool  # False if the folder cannot be written to

    @property
    def foreign(self) -> list[IndexRow]:
        """The rows of HDF5 files of other programs, which are skipped."""
        return [row for row in self.rows if row.kind is None and row.error is None]

    @property
    def foreign_note(self) -> str:
        """A note with their number; empty if there is none."""
        names = [row.path for row in self.foreign]
        if not names:
            return ""
        several = f"s of other programs ({names[0]}, ...)" if len(names) > 1 else f" of another program ({names[0]})"
        return f"skipped: {len(names):,} HDF5 file{several}"


def one_by_one(folder: Path, files: Mapping[str, Seen], progress: Progress) -> Iterator[IndexRow]:
    """Describe files in this process, one after the other."""
    for number, (name, seen) in enumerate(files.items()):
        progress(number, len(files))
        yield describe(folder, name, *seen)


def read_index(
    folder: Path, progress: Progress = lambda done, total: None, describe_files: Describe = one_by_one
) -> Index:
    """Return the index of a folder, updated for changed files; InputError if it is not a folder.

    progress: counts the files that have to be read.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), expected="a folder of stage files")
    path, seen = folder / NAME, _look(folder)
    old = _load(path)
    rows = {name: row for name, row in old.items() if row.seen == seen.get(name) and row.error is None}
    stale = {name: at for name, at in seen.items() if name not in rows}
    try:
        for row in describe_files(folder, stale, progress):
            rows[row.path] = row
    finally:  # after an interrupt, the next run continues from here
        stored = rows == old or _store(path, rows.values())
    return Index(sorted(rows.values()), len(stale), len(old.keys() - seen.keys()), stored)


class Known:
    """The rows of files in the indexes of their folders, for the time of one check.

    Outputs are found up to date without opening a file: the recipe ids of the inputs are known, from which a
    stage computes the recipe of its output. If anything is missing or differs, the files are opened.

    A run updates an existing index but does not create one. A user who created an index wants answers from it, also
    about the files of this run; but a user who runs `label` does not expect a hidden file in the folder. The index is
    that of the folder, or of the nearest parent that has one.
    """

    def __init__(self) -> None:
        self._rows: dict[Path, dict[str, IndexRow]] = {}
        self._places: dict[Path, tuple[Path, str] | None] = {}

    def row(self, path: Path, *kinds: str) -> IndexRow | None:
        """Return the row of a file of these kinds that is unchanged since it was read; None if there is none."""
        place = self.place(path.parent)
        row = None if place is None else self._rows[place[0]].get(f"{place[1]}{path.name}")
        if row is None or row.kind not in kinds or row.recipe_id is None or row.error is not None:
            return None
        return row if row.seen == _seen(path) else None

    def header(self, path: Path, *kinds: str) -> Header | None:
        """Return the part of such a file's header that is needed for the recipe of a file made from it."""
        row = self.row(path, *kinds)
        return None if row is None else {"id": row.recipe_id, "simulated": bool(row.simulated), "seed": row.seed}

    def is_up_to_date(self, output: Path, recipe: Recipe) -> bool:
        """Whether `output` is known to have the result of this recipe; if False, it may still have it."""
        row = self.row(output, recipe.kind)
        return row is not None and row.recipe_id == recipe.id

    def place(self, folder: Path) -> tuple[Path, str] | None:
        """Return the folder whose index covers a folder, and the path from there; None without an index."""
        if folder not in self._places:
            self._places[folder] = place = _place(folder)
            if place is not None and place[0] not in self._rows:
                self._rows[place[0]] = _load(place[0] / NAME)
        return self._places[folder]

    def learn(self, paths: Iterable[Path], progress: Progress) -> None:
        """Add the files that are missing in the index of their folder, or that have changed, and store it."""
        stale: dict[Path, dict[str, Seen]] = {}
        for path in dict.fromkeys(paths):
            place, seen = self.place(path.parent), _seen(path)
            if place is None or seen is None or not path.name.endswith(".h5") or path.name.startswith("."):
                continue
            folder, name = place[0], f"{place[1]}{path.name}"
            row = self._rows[folder].get(name)
            if row is None or row.seen != seen:
                stale.setdefault(folder, {})[name] = seen
        for folder, files in stale.items():
            self._rows[folder] |= {row.path: row for row in one_by_one(folder, files, progress)}
            _store(folder / NAME, self._rows[folder].values())


def _seen(path: Path | str) -> Seen | None:
    with suppress(OSError):
        return Seen.of(os.stat(path))
    return None


def _place(folder: Path) -> tuple[Path, str] | None:
    inner, above = "", folder.absolute()
    while not (above / NAME).is_file():
        name = above.name
        if not name or name in (".", "..") or name.startswith(".") or name.endswith(".part") or above.is_symlink():
            return None  # an index does not cover such folders
        inner, above = f"{name}/{inner}", above.parent
    return above, inner


def _load(path: Path) -> dict[str, IndexRow]:
    """Return the rows of an index by their paths; none if there is no index, or a damaged one or another format."""
    try:
        table: Any = json.loads(read_bytes(path, MOST_BYTES))
        rows = [IndexRow(*row) for row in table["rows"]] if table["format"] == FORMAT else []
    except (EvetacError, ValueError, TypeError, LookupError, RecursionError):
        return {}
    types = {tuple(map(type, row)) for row in rows}
    is_valid = all(kind in _TYPES[name] for row in types for name, kind in zip(IndexRow._fields, row, strict=True))
    return {row.path: row for row in rows} if is_valid else {}


def _store(path: Path, rows: Iterable[IndexRow]) -> bool:
    """Replace the index; False if the folder cannot be written to."""
    from evetac_cli.store.hdf5.disk import existing_folder, taking_the_place_of  # loads h5py, needed only here

    with suppress(InputError):
        existing_folder(path.parent)
        with taking_the_place_of(path) as temporary:
            temporary.write_text(json.dumps({"format": FORMAT, "rows": list(rows)}), encoding="ascii")
            return True
    return False


def _look(folder: Path) -> dict[str, Seen]:
    """Return the status of every stage file below a folder, without folders of recordings in progress."""
    seen: dict[str, Seen] = {}
    folders = [""]
    while folders:
        inner = folders.pop()
        try:
            entries = list(os.scandir(folder / inner))
        except FileNotFoundError:  # removed meanwhile
            continue
        for entry in entries:
            name = entry.name
            if name.startswith("."):
                continue
            if entry.is_dir(follow_symlinks=False):
                folders += [] if name.endswith(".part") else [f"{inner}{name}/"]
            elif name.endswith(".h5"):
                seen[f"{inner}{name}"] = _seen(entry.path) or NOT_THERE  # a link to nothing
    return seen
