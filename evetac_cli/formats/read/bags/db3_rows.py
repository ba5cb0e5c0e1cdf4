"""Read the rows of ROS 2 bags in SQLite (`.db3`), complete or cut, with Python's sqlite3.

Why not with rosbags: it opens files in a mode in which SQLite ignores the files next to them. It also reads in the
order of an index, in which a recorder that was killed may not have listed the last rows. Here the table itself is read,
never an index; a cut or damaged file is read from both ends as far as its pages exist. The types of all values are
checked, no function defined in the file is executed, and the file is never written to.
"""

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.read.bags.bag_chunks import Connection, Record, Table

MAGIC = b"SQLite format 3\x00"
MOST_VALUE_BYTES = 512 << 20  # of a message
HEAD_BYTES, PAGE_BYTES_AT, PAGES_AT = 100, 16, 28  # size of the file's head, and offsets in it
ROWS_AT_ONCE = 1 << 16
MESSAGES_AT_ONCE = 16
READS = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ}
FUNCTIONS = {"count"}
DEFINED_AS = "ros2msg"


class Db3File:
    """A file of SQLite: its connections, and its messages."""

    def __init__(self, path: Path, where: str) -> None:
        """Read the list of messages; raise InputError if it cannot be read. where: the file's name in messages."""
        self.path, self.where = path, where
        self.table = Table()
        try:
            self._read(salvage=False)
        except sqlite3.DatabaseError as error:
            self._read(salvage=True, trouble=str(error))
        for number, one in self.table.connections.items():
            times = self._rows["time_ns"][self._rows["topic"] == number]
            self.table.connections[number] = one._replace(msgcount=len(times))
            if (times[1:] < times[:-1]).any():
                self.table.disordered.add(number)
            if len(times):
                self.table.spans_ns[number] = int(times[0]), int(times[-1])
        self.connections = [one for _, one in sorted(self.table.connections.items())]

    def messages(self, numbers: Collection[int], lost: Counter[str], *, by_reception: bool) -> Iterator[Record]:
        """Yield all messages of some connections in the file's order; damaged ones are counted in `lost`.

        by_reception: in order of reception instead.
        """
        rows = self._rows[np.isin(self._rows["topic"], list(numbers))]
        if by_reception:
            rows = rows[np.argsort(rows["time_ns"], kind="stable")]
        with closing(self._connected(salvage=self.table.cut_short)) as database:
            for first in range(0, len(rows), MESSAGES_AT_ONCE):
                some = rows[first : first + MESSAGES_AT_ONCE]
                contents = _contents(database, some["row"].tolist(), lost)
                for row, number, time_ns in some.tolist():
                    content = contents.get(row)
                    if isinstance(content, bytes):
                        yield number, time_ns, content

    def _connected(self, *, salvage: bool) -> sqlite3.Connection:
        """Open the file read-only; with `salvage` also if it is shorter than its head states."""
        uri = f"file:{quote(str(self.path.resolve()))}?mode=ro&immutable=1"
        database = sqlite3.connect(uri, uri=True)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_VALUE_BYTES)
        database.execute("PRAGMA trusted_schema = OFF")
        if salvage:
            database.execute("PRAGMA writable_schema = ON")  # only in memory: it lets SQLite open a file that was cut
        database.execute("SELECT count(*) FROM sqlite_master").fetchone()
        database.set_authorizer(_allowed)
        return database

    def _read(self, *, salvage: bool, trouble: str = "") -> None:
        """Fill the table with the connections and rows that can be read."""
        try:
            with closing(self._connected(salvage=salvage)) as database:
                self._check_tables(database)
                self.table.connections = {one.number: one for one in self._topics(database)}
                self._rows, whole = _rows(database, salvage=salvage)
        except sqlite3.DatabaseError as error:
            if not salvage:
                raise
            raise self._unreadable(str(error)) from None
        if not salvage:
            return
        if not len(self._rows):
            raise self._unreadable(trouble)
        missing = _missing_bytes(self.path)
        lost = f"; {missing:,} bytes at its end are missing" if missing > 0 else ""
        kept = f"kept {len(self._rows):,} messages" + ("" if whole else ", all that can still be read")
        self.table.notes.append(f"cut short or damaged ({trouble}): {kept}{lost}")
        self.table.cut_short = True

    def _unreadable(self, trouble: str) -> InputError:
        missing = _missing_bytes(self.path)
        found = trouble + (f"; {missing:,} bytes at its end are missing" if missing > 0 else "")
        hint = "if the original is longer, copy it again" if missing > 0 else ""
        return InputError("no message of the database can be read", where=self.where, found=found, hint=hint)

    def _check_tables(self, database: sqlite3.Connection) -> None:
        """Raise InputError unless topics and messages are plain tables; a view or virtual table could be anything."""
        rows = database.execute("SELECT name, type, rootpage FROM sqlite_master").fetchall()
        kinds = {str(name): (kind, page) for name, kind, page in rows if kind in ("table", "view")}
        tables = {name: kinds.get(name, ("", 0)) for name in ("topics", "messages")}
        if any(kind != "table" or not page for kind, page in tables.values()):
            names = ", ".join(sorted(kinds))[:200] or "no table"
            raise InputError("not a ROS 2 bag", where=self.where, expected="tables topics and messages", found=names)
        self._has_definitions = kinds.get("message_definitions", ("", 0))[0] == "table"

    def _topics(self, database: sqlite3.Connection) -> Iterator[Connection]:
        definitions: dict[str, str] = {}
        if self._has_definitions:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {str(kind): str(text) for kind, how, text in database.execute(query) if how == DEFINED_AS}
        for number, name, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
            if not isinstance(number, int):
                raise InputError("the id of a topic is not a number", where=self.where, found=str(number)[:40])
            yield Connection(number, str(name), str(kind), str(encoding), definitions.get(str(kind), ""))


ROW = np.dtype([("row", "<i8"), ("topic", "<i8"), ("time_ns", "<i8")])


def _rows(database: sqlite3.Connection, *, salvage: bool) -> tuple[NDArray[Any], bool]:
    """Return row id, topic and time of every message, in the file's order, and whether these are all.

    With `salvage`, rows are read from the first as far as possible, and then from the last one backwards.
    """
    rows, error = _scanned(database, "ASC")
    if error is None:
        return rows, True
    if not salvage:
        raise error
    last, _ = _scanned(database, "DESC")
    if len(rows):
        last = last[last["row"] > rows["row"][-1]]
    return np.concatenate([rows, last[::-1]]), False


def _scanned(database: sqlite3.Connection, order: str) -> tuple[NDArray[Any], sqlite3.DatabaseError | None]:
    """Return rows in order of their row id until one cannot be read, and that error, if any."""
    parts: list[NDArray[Any]] = [np.empty(0, ROW)]
    some: list[tuple[int, int, int]] = []
    trouble = None
    try:
        query = f"SELECT rowid, topic_id, timestamp FROM messages NOT INDEXED ORDER BY rowid {order}"
        for row in database.execute(query):
            if all(type(number) is int for number in row):
                some.append(row)
            if len(some) == ROWS_AT_ONCE:
                parts.append(np.array(some, ROW))
                some = []
    except sqlite3.DatabaseError as error:
        trouble = error
    return np.concatenate([*parts, np.array(some, ROW)]), trouble


def page_bytes(head: bytes) -> int:
    """Return the page size that a file's head states; 1 if it is invalid."""
    size = int.from_bytes(head[PAGE_BYTES_AT : PAGE_BYTES_AT + 2])
    return 1 << 16 if size == 1 else max(1, size)


def _contents(database: sqlite3.Connection, rows: list[int], lost: Counter[str]) -> dict[int, Any]:
    """Return the messages in some rows; those that cannot be read are counted in `lost`."""
    marks = ", ".join("?" * len(rows))
    try:
        contents = dict(database.execute(f"SELECT rowid, data FROM messages WHERE rowid IN ({marks})", rows))
    except sqlite3.DatabaseError as error:
        if len(rows) > 1:
            return {row: content for one in rows for row, content in _contents(database, [one], lost).items()}
        lost[str(error)] += 1
        return {}
    odd = sum(not isinstance(contents.get(row), bytes) for row in rows)
    if odd:
        lost["a row has no message"] += odd
    return contents


def _missing_bytes(path: Path) -> int:
    """Return the bytes by which a file is shorter than its head states."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        size = file.seek(0, 2)
    return int.from_bytes(head[PAGES_AT : PAGES_AT + 4]) * page_bytes(head) - size


def _allowed(action: int, name: str | None, function: str | None, *_: str | None) -> int:
    """Authorize only reading of tables."""
    fine = action in READS or (action == sqlite3.SQLITE_FUNCTION and function in FUNCTIONS)
    return sqlite3.SQLITE_OK if fine else sqlite3.SQLITE_DENY
