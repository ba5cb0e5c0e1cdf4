"""The index on disk: one SQLite table, which is read as untrusted data; new rows are added to a copy of it.

The table is untrusted because the folder may come from another person. Only a table in evetac's format is read, only
rows of existing files are used, and each value is checked. Any other file of that name is left unchanged, and the stage
files are then read each time.

Rows are added to a copy, which then replaces the old table, and not to the table itself. Storage shared by several
computers often has no locks, and a process may be killed at any time. SQLite would then leave a journal, which the next
program to open the table would execute, even if it was forged. With a copy, readers of the old table can continue. Of
two concurrent commands, the later one copies the rows of the earlier one, or replaces them, and the files are then read
once more. Copying the table of a million trials, 1.3 GB, takes seconds; reading the status of their files takes
minutes.
"""

import os
import sqlite3
import stat
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import InputError, shortened
from evetac_cli.store.index.rows import IndexRow
from evetac_cli.text_files import as_utf8

NAME = ".evetac-index.sqlite"
FORMAT = 5  # of the table; an index of another format is created again
MOST_SLICES = 1 << 40  # 35 years; sums of such numbers are valid in SQLite too
# Limits for an existing index; those by evetac have 300 bytes per row, and rows of files that were removed since.
MOST_ROW_BYTES = 1 << 16
MOST_SQL_BYTES = 1 << 12
MOST_UNKNOWN_ROWS = 100_000
STEPS_A_ROW = 200  # limit of steps of SQLite's machine per row, which needs 30
STEPS_AT_ONCE = 10_000
COPIED_BYTES = 8 << 20  # at a time

SIMULATED, SLICES = map(IndexRow._fields.index, ("simulated", "slices"))
_CREATE = f"CREATE TABLE files ({', '.join(IndexRow._fields)}, PRIMARY KEY (path)) WITHOUT ROWID"
_BEGINS, _ENDS = "CREATE TABLE files (path, ", ", PRIMARY KEY (path)) WITHOUT ROWID"  # of every format
_INSERT = f"INSERT OR REPLACE INTO files VALUES ({', '.join('?' * len(IndexRow._fields))})"
SELECT = f"SELECT {', '.join(IndexRow._fields)} FROM files"
_OPTIONAL_TEXT = (str, type(None))
_TYPES: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(IndexRow._fields, _OPTIONAL_TEXT),
    "path": (str, bytes),
    **dict.fromkeys(("size_bytes", "changed_ns", "inode"), (int,)),
    **dict.fromkeys(("object", "seed"), (int, str, type(None))),
    **dict.fromkeys(("trial", "slices", "simulated"), (int, type(None))),
    "dot_radius_px": (float, type(None)),
}


class Lies(NamedTuple):
    """The contents of the index's file: its rows by their paths, None if there is no readable index.

    removed: paths of rows whose files are missing. note: why the file may not be replaced, if evetac did not make it.
    """

    rows: dict[str, IndexRow] | None = None
    removed: Sequence[str] = ()
    note: str = ""


def is_index(path: Path) -> bool:
    """Whether a file is an index made by evetac, in any format, so that it may be replaced or removed."""
    return path.name == NAME and os.path.lexists(path) and not read(path, ()).note


def read(path: Path, wanted: Collection[str]) -> Lies:
    """Return the rows of wanted files; no database of another program is opened, and nothing that could block."""
    with IndexTable(path) as table:
        return table.read(wanted)


class IndexTable:
    """An existing index, open for reading; `note` has the reason if the file was not made by evetac.

    If the file is replaced meanwhile, the old contents are still read here.
    """

    def __init__(self, path: Path) -> None:
        self.note = ""
        self._table: sqlite3.Connection | None = None
        self._steps, self._most = 0, STEPS_A_ROW * MOST_UNKNOWN_ROWS
        try:
            kind = os.lstat(path)
        except FileNotFoundError:
            return
        except OSError as error:
            self.note = _note(error.strerror or "it cannot be accessed")
            return
        if not stat.S_ISREG(kind.st_mode):
            self.note = _note("it is not a regular file")
        elif kind.st_size:
            self._open(path)

    def __enter__(self) -> "IndexTable":
        return self

    def __exit__(self, *_: object) -> None:
        if self._table is not None:
            self._table.close()

    def _open(self, path: Path) -> None:
        try:
            table = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        except sqlite3.Error as error:
            self.note = _note(str(error))
            return
        try:
            table.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_ROW_BYTES)
            table.setlimit(sqlite3.SQLITE_LIMIT_SQL_LENGTH, MOST_SQL_BYTES)
            table.set_progress_handler(self._too_many, STEPS_AT_ONCE)
            sql = _sql(table)
            if sql is None or not (sql.startswith(_BEGINS) and sql.endswith(_ENDS)):
                self.note = _note("it does not have the table of an index")
            elif sql == _CREATE and _format(table) == FORMAT:
                self._table = table
        except sqlite3.Error as error:
            self.note = _note(str(error))
        finally:
            if self._table is None:
                table.close()

    @property
    def is_index(self) -> bool:
        """Whether it is an index by evetac in the current format."""
        return self._table is not None

    def _too_many(self) -> bool:
        self._steps += STEPS_AT_ONCE
        return self._steps > self._most

    def read(self, wanted: Collection[str]) -> Lies:
        """Return all rows of the wanted files."""
        if self._table is None:
            return Lies(note=self.note)
        most = 10 * len(wanted) + MOST_UNKNOWN_ROWS
        self._steps, self._most = 0, STEPS_A_ROW * most
        rows: dict[str, IndexRow] = {}
        removed: list[str] = []
        possible: set[tuple[type, ...]] = set()
        try:
            for number, found in enumerate(self._table.execute(SELECT)):
                if number > most or not _is_possible(found, possible):
                    return Lies()
                row = IndexRow(name_of(found[0]), *found[1:])
                if row.path in wanted:
                    rows[row.path] = row
                else:
                    removed.append(row.path)
        except sqlite3.Error:  # a damaged index, or a forged one
            return Lies()
        return Lies(rows, removed)

    def row(self, name: str) -> IndexRow | None:
        """Return the row of one file, by its path in the folder; None if there is none or it is invalid."""
        if self._table is None:
            return None
        self._steps, self._most = 0, STEPS_A_ROW * STEPS_AT_ONCE
        try:
            found = self._table.execute(f"{SELECT} WHERE path = ?", (_stored_name(name),)).fetchone()
        except sqlite3.Error:
            return None
        return IndexRow(name, *found[1:]) if found is not None and _is_possible(found, set()) else None


def _sql(table: sqlite3.Connection) -> str | None:
    """Return the SQL statement of the table `files`, if there is nothing else."""
    entries = table.execute("SELECT type, name, sql FROM sqlite_master LIMIT 2").fetchall()
    is_one = len(entries) == 1 and entries[0][:2] == ("table", "files") and isinstance(entries[0][2], str)
    return entries[0][2] if is_one else None


def _format(table: sqlite3.Connection) -> Any:
    return table.execute("PRAGMA user_version").fetchone()[0]


def _note(reason: str) -> str:
    return (
        f"{NAME} was not made by evetac ({shortened(as_utf8(reason))}) and is left unchanged, so all files are"
        " read each time; move it away to have them read only once"
    )


def _is_possible(row: tuple[Any, ...], possible: set[tuple[type, ...]]) -> bool:
    """Whether a row is valid; possible: combinations of types that are known to be valid, which is extended."""
    types = tuple(map(type, row))
    if types not in possible:
        if not all(kind in _TYPES[name] for name, kind in zip(IndexRow._fields, types, strict=True)):
            return False
        possible.add(types)
    return row[SIMULATED] in (None, 0, 1) and 0 <= (row[SLICES] or 0) <= MOST_SLICES


def name_of(path: str | bytes) -> str:
    """Return a path from the table as a str; the table has the bytes of a path that is not UTF-8."""
    return os.fsdecode(path) if isinstance(path, bytes) else path


def _stored_name(path: str) -> str | bytes:
    """Return a path in the form of the table: as bytes if it is not UTF-8, the only text of SQLite."""
    return path if as_utf8(path) == path else os.fsencode(path)


def _stored(rows: Iterable[IndexRow]) -> Iterator[tuple[Any, ...]]:
    for path, *more in rows:
        yield _stored_name(path), *(as_utf8(value) if isinstance(value, str) else value for value in more)


def fill(table: sqlite3.Connection, rows: Iterable[IndexRow]) -> sqlite3.Connection:
    """Create the table of an index in an empty database, and return the database."""
    with table:
        table.execute(_CREATE)
        table.executemany(_INSERT, _stored(rows))
        table.execute(f"PRAGMA user_version = {FORMAT}")
    return table


def write(path: Path, rows: Iterable[IndexRow]) -> bool:
    """Replace the old index by one with these rows; False if the folder cannot be written to."""
    with suppress(InputError, sqlite3.Error), _replacing(path) as temporary:
        fill(sqlite3.connect(temporary), rows).close()
        return True
    return False


def add(path: Path, rows: Iterable[IndexRow], removed: Iterable[str] = ()) -> bool:
    """Replace the old index by one with these rows added, and those of removed files deleted.

    False if there is no old index to which rows can be added, or if the folder cannot be written to.
    """
    with suppress(InputError, _NoIndex), _replacing(path) as temporary:
        if not (_copied(path, temporary) and _changed(temporary, rows, removed)):
            raise _NoIndex
        return True
    return False


class _NoIndex(Exception):
    """There is no index to which rows could be added."""


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    from evetac_cli.store.hdf5.disk import existing_folder, taking_the_place_of  # loads h5py, needed only here

    existing_folder(path.parent)
    with taking_the_place_of(path) as temporary:
        yield temporary


def _copied(path: Path, to: Path) -> bool:
    """Copy a regular file, even if the path is replaced meanwhile; False if there is none."""
    try:
        source = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    with open(source, "rb", buffering=0) as old:
        if not stat.S_ISREG(os.fstat(source).st_mode):
            return False
        with open(to, "xb", buffering=0) as new:
            while part := old.read(COPIED_BYTES):
                new.write(part)
    return True


def _changed(path: Path, rows: Iterable[IndexRow], removed: Iterable[str]) -> bool:
    """Add rows to an index's table and delete some; False if it is not evetac's table, or is damaged."""
    with closing(sqlite3.connect(path)) as table:
        try:
            table.execute("PRAGMA journal_mode = OFF")  # no other process uses this file
            table.execute("PRAGMA synchronous = OFF")
            if _sql(table) != _CREATE or _format(table) != FORMAT:
                return False
            with table:
                table.executemany(_INSERT, _stored(rows))
                table.executemany("DELETE FROM files WHERE path = ?", ((_stored_name(name),) for name in removed))
        except sqlite3.DatabaseError:
            return False
    return True
