"""The index of a data set: what each stage file in a folder is, in one SQLite file, so that nobody opens them all.

It is the table `files` of FOLDER/.evetac-index.sqlite, a row for every `*.h5` in the folder and those below it, broken
ones with their reason, HDF5 files of other programs without a kind. A row is made again when size, time of change or
inode of its file differ: one look at the folder, in which no file is opened, says whether the index is up to date. Only
what could not be read is tried each time: the reason may lie in permissions, the storage, or an older evetac.

Why the time of change (ctime) and not that of the last writing (mtime): `cp -p`, `rsync -t` and backups bring files
back with an old mtime, and another content may have the same size. Nobody can set the ctime;
a data set that was copied to another place is read once again there.

rows     what a row says of a file
table    the file on disk, which may be anybody's
known    whether outputs are up to date, answered without opening a file
"""

import os
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.store.index import table
from evetac_cli.store.index.rows import NOT_THERE, IndexRow, Seen, describe, recording_of, scene_words
from evetac_cli.store.index.table import FORMAT, NAME, is_index

__all__ = (
    "FORMAT", "FOREIGN", "NAME", "Describe", "Index", "IndexRow", "Seen", "describe", "foreign_note", "is_index",
    "one_by_one", "open_index", "recording_of", "scene_words",
)  # fmt: skip

# The condition of HDF5 files of other programs, which are passed over.
FOREIGN = "kind IS NULL AND error IS NULL"
KEEP_S = 60.0  # so often what was read so far is kept: reading a million trials takes hours

Progress = Callable[[int, int], None]
# Describes files, which are given by their paths, and hands over rows as they come.
Describe = Callable[[Path, Mapping[str, Seen], Progress, Callable[[Sequence[IndexRow]], None]], None]


class Index(NamedTuple):
    """An index that is up to date: its table, in memory, and what was to be done for that."""

    table: sqlite3.Connection
    read: int  # files that were added or changed, or could not be read before
    removed: int
    stored: bool  # False where the folder cannot be written to, or something else has the index's name
    note: str  # what to know of something else that has the index's name; empty otherwise

    def rows(self, where: str = "1", values: Sequence[Any] = ()) -> list[IndexRow]:
        """The rows for which a condition of SQL holds, by their paths."""
        chosen = self.table.execute(f"{table.SELECT} WHERE {where} ORDER BY path", values)
        return sorted(IndexRow(table.name_of(path), *more) for path, *more in chosen)


def foreign_note(index: Index) -> str:
    """How many HDF5 files of other programs were passed over, in words; empty if there is none."""
    names = [row.path for row in index.rows(FOREIGN)]
    if not names:
        return ""
    several = f"s of other programs ({names[0]}, ...)" if len(names) > 1 else f" of another program ({names[0]})"
    return f"passed over: {len(names):,} HDF5 file{several}"


def one_by_one(
    folder: Path, files: Mapping[str, Seen], progress: Progress, take: Callable[[Sequence[IndexRow]], None]
) -> None:
    """Describe files in this process, one after the other."""
    for number, (name, seen) in enumerate(files.items()):
        progress(number, len(files))
        take([describe(folder, name, *seen)])


@contextmanager
def open_index(
    folder: Path, progress: Progress = lambda done, total: None, describe_files: Describe = one_by_one
) -> Iterator[Index]:
    """The index of a folder, made again as far as files changed; InputError if it is no folder.

    progress: of the files that have to be read.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), expected="a folder of stage files")
    path, seen = folder / NAME, _look(folder)
    lies = table.read(path, seen)
    rows = dict(lies.rows or {})
    waiting: list[IndexRow] = []
    removed = list(lies.removed)
    is_stored, kept_s = lies.rows is not None, time.monotonic()

    def keep() -> None:
        """Store what is new, unless something else has the index's name."""
        nonlocal is_stored, kept_s
        if lies.note or (is_stored and not waiting and not removed):
            return
        is_stored = (is_stored and table.add(path, waiting, removed)) or table.write(path, rows.values())
        waiting.clear()
        removed.clear()
        kept_s = time.monotonic()

    def take(made: Sequence[IndexRow]) -> None:
        for row in made:
            rows[row.path] = row
            if lies.rows is None or lies.rows.get(row.path) != row:
                waiting.append(row)
        if time.monotonic() - kept_s > KEEP_S:
            keep()

    stale = {name: at for name, at in seen.items() if name not in rows or rows[name].seen != at or rows[name].error}
    for name in stale:
        rows.pop(name, None)
    try:
        describe_files(folder, stale, progress, take)
    except KeyboardInterrupt:
        keep()  # the next goes on from here
        raise
    keep()
    with closing(table.fill(sqlite3.connect(":memory:"), rows.values())) as filled:
        yield Index(filled, len(stale), len(lies.removed), is_stored, lies.note)


def _look(folder: Path) -> dict[str, Seen]:
    """What is seen of every stage file below a folder; folders of recordings in progress are left out."""
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
                try:
                    seen[f"{inner}{name}"] = Seen.of(entry.stat())
                except OSError:  # a link to nothing
                    seen[f"{inner}{name}"] = NOT_THERE
    return seen
