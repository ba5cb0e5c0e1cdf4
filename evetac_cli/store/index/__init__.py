"""The index of a data set: the properties of all stage files in a folder, in one SQLite file, so that none is opened.

It is the table `files` of FOLDER/.evetac-index.sqlite, with a row for every `*.h5` in the folder and its subfolders.
Damaged files have the reason in their row; HDF5 files of other programs have no kind. A row is updated if size, time of
change or inode of its file differ, so listing the folder shows whether the index is up to date. Only unreadable files
are tried each time, because the reason may be permissions, the storage, or an older evetac.

The time of change (ctime) is used and not that of the last writing (mtime): `cp -p`, `rsync -t` and backups restore
files with an old mtime, and other contents may have the same size. The ctime cannot be set by a user. A data set that
was copied to another folder is read once again there.

rows     the row of a file
table    the file on disk, which may come from another user
known    whether outputs are up to date, without opening a file
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
from evetac_cli.store.index.rows import NOT_THERE, IndexRow, Seen, describe
from evetac_cli.store.index.table import FORMAT, NAME, is_index

__all__ = (
    "FORMAT", "FOREIGN", "NAME", "Describe", "Index", "IndexRow", "Seen", "describe", "foreign_note", "is_index",
    "one_by_one", "open_index",
)  # fmt: skip

# SQL condition for HDF5 files of other programs, which are skipped.
FOREIGN = "kind IS NULL AND error IS NULL"
KEEP_S = 60.0  # interval at which new rows are saved: reading a million trials takes hours

Progress = Callable[[int, int], None]
# Describes files, given by their paths, and passes on rows as they are made.
Describe = Callable[[Path, Mapping[str, Seen], Progress, Callable[[Sequence[IndexRow]], None]], None]


class Index(NamedTuple):
    """An index that is up to date: its table, in memory, and the changes that were made for this."""

    table: sqlite3.Connection
    read: int  # files that were added or changed, or could not be read before
    removed: int
    stored: bool  # False if the folder cannot be written to, or another file has the index's name
    note: str  # note on another file that has the index's name; empty otherwise

    def rows(self, where: str = "1", values: Sequence[Any] = ()) -> list[IndexRow]:
        """Return the rows that satisfy an SQL condition, sorted by their paths."""
        selected_rows = self.table.execute(f"{table.SELECT} WHERE {where} ORDER BY path", values)
        return sorted(IndexRow(table.name_of(path), *more) for path, *more in selected_rows)


def foreign_note(index: Index) -> str:
    """Return a note with the number of skipped HDF5 files of other programs; empty if there is none."""
    names = [row.path for row in index.rows(FOREIGN)]
    if not names:
        return ""
    several = f"s of other programs ({names[0]}, ...)" if len(names) > 1 else f" of another program ({names[0]})"
    return f"skipped: {len(names):,} HDF5 file{several}"


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
    """Yield the index of a folder, updated for changed files; InputError if it is not a folder.

    progress: counts the files that have to be read.
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
        """Store new rows, unless another file has the index's name."""
        nonlocal is_stored, kept_s
        if lies.note or (is_stored and not waiting and not removed):
            return
        is_stored = (is_stored and table.add(path, waiting, removed)) or table.write(path, rows.values())
        waiting.clear()
        removed.clear()
        kept_s = time.monotonic()

    def take(new_rows: Sequence[IndexRow]) -> None:
        for row in new_rows:
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
        keep()  # the next run continues from here
        raise
    keep()
    with closing(table.fill(sqlite3.connect(":memory:"), rows.values())) as filled:
        yield Index(filled, len(stale), len(lies.removed), is_stored, lies.note)


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
                try:
                    seen[f"{inner}{name}"] = Seen.of(entry.stat())
                except OSError:  # a link to nothing
                    seen[f"{inner}{name}"] = NOT_THERE
    return seen
