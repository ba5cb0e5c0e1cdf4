"""The index of a data set: what each stage file in a folder is, in one SQLite file, so that nobody opens them all.

It is the table `files` of FOLDER/.evetac-index.sqlite, a row for every `*.h5` in the folder and those below it, broken
ones with their reason, HDF5 files of other programs without a kind. A row is made again when size or time of change of
its file differ: one look at the folder, in which no file is opened, says whether the index is up to date. Only what
could not be read is tried each time: the reason may lie in permissions, the storage, or an older evetac.

Why the time of change (ctime) and not that of the last writing (mtime): `cp -p`, `rsync -t` and backups bring files
back with an old mtime, and another content may have the same size. Nobody can set the ctime;
a data set that was copied to another place is read once again there.

Why it is written anew as a whole: a new file takes the place of the old one at once, also on storage that several
computers share, where SQLite cannot lock. Whoever reads the old one goes on with it, of two commands at once the later
one wins, and both wrote what is right.

Why what lies there is read like a stranger's file: the folder may come from anybody. Only the table that evetac makes
is read, as far as it has rows of files that are there, and each value is looked at; what is asked for is asked of a
copy in memory. Anything else of that name is left as it is, and the files are read each time.
"""

import json
import os
import sqlite3
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import EvetacError, ForeignFile, InputError, shortened
from evetac_cli.text_files import as_utf8

NAME = ".evetac-index.sqlite"
FORMAT = 4  # of the table; an index of another format is made again
LARGEST = 2**63 - 1  # whole number of SQLite
MOST_SLICES = 1 << 40  # 35 years; sums of them are numbers of SQLite too
# Of an index that is found; ours have 300 bytes a row, and rows of files that were removed since.
MOST_ROW_BYTES = 1 << 16
MOST_SQL_BYTES = 1 << 12
MOST_UNKNOWN_ROWS = 100_000
STEPS_A_ROW = 200  # of SQLite's machine, which takes 30
STEPS_AT_ONCE = 10_000

# The condition of HDF5 files of other programs, which are passed over.
FOREIGN = "kind IS NULL AND error IS NULL"


class IndexRow(NamedTuple):
    """What the index says of a file; None where a file of its kind has no such thing, or it is unknown."""

    path: str  # from the folder on
    size_bytes: int
    changed_ns: int
    kind: str | None = None  # none for a file that cannot be read, or that another program made
    recipe_id: str | None = None
    recording: str | None = None  # recipe id of the one recording that it was made from, or is
    object: int | str | None = None
    sensor: str | None = None
    seed: int | str | None = None
    trial: int | None = None
    scene: str | None = None
    outcome: str | None = None  # slips, held; of a grasp: dropped, lifted, balanced
    slices: int | None = None
    simulated: bool | None = None
    error: str | None = None  # why it cannot be read


ERROR, SIMULATED, SLICES = map(IndexRow._fields.index, ("error", "simulated", "slices"))
Seen = dict[str, tuple[int, int]]  # size and time of change of files, by their paths
_CREATE = f"CREATE TABLE files ({', '.join(IndexRow._fields)}, PRIMARY KEY (path)) WITHOUT ROWID"
_BEGINS, _ENDS = "CREATE TABLE files (path, ", ", PRIMARY KEY (path)) WITHOUT ROWID"  # of every format
_INSERT = f"INSERT INTO files VALUES ({', '.join('?' * len(IndexRow._fields))})"
_SELECT = f"SELECT {', '.join(IndexRow._fields)} FROM files"
_OPTIONAL_TEXT = (str, type(None))
_TYPES: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(IndexRow._fields, _OPTIONAL_TEXT),
    "path": (str, bytes),
    **dict.fromkeys(("size_bytes", "changed_ns"), (int,)),
    **dict.fromkeys(("object", "seed"), (int, str, type(None))),
    **dict.fromkeys(("trial", "slices", "simulated"), (int, type(None))),
}


class Index(NamedTuple):
    """An index that is up to date: its table, in memory, and what was to be done for that."""

    table: sqlite3.Connection
    read: int  # files that were added or changed, or could not be read before
    removed: int
    stored: bool  # False where the folder cannot be written to, or something else has the index's name
    note: str  # what to know of something else that has the index's name; empty otherwise

    def rows(self, where: str = "1", values: Sequence[Any] = ()) -> list[IndexRow]:
        """The rows for which a condition of SQL holds, by their paths."""
        chosen = self.table.execute(f"{_SELECT} WHERE {where} ORDER BY path", values)
        return sorted(IndexRow(_name(path), *more) for path, *more in chosen)


def foreign_note(index: Index) -> str:
    """How many HDF5 files of other programs were passed over, in words; empty if there is none."""
    names = [row.path for row in index.rows(FOREIGN)]
    if not names:
        return ""
    several = f"s of other programs ({names[0]}, ...)" if len(names) > 1 else f" of another program ({names[0]})"
    return f"passed over: {len(names):,} HDF5 file{several}"


def _name(path: str | bytes) -> str:
    """A path as Python has it, from the table, where one that is no UTF-8 stands as its bytes."""
    return os.fsdecode(path) if isinstance(path, bytes) else path


def _stored(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """A row as the table has it: SQLite has no text but UTF-8."""
    path = row[0]
    return row if as_utf8(path) == path else (os.fsencode(path), *row[1:])


@contextmanager
def open_index(folder: Path, progress: Callable[[int, int], None] = lambda done, total: None) -> Iterator[Index]:
    """The index of a folder, made again as far as files changed; InputError if it is no folder.

    progress: of the files that have to be read.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), expected="a folder of stage files")
    path, seen = folder / NAME, _look(folder)
    lies = _read(path, seen)
    known = lies.rows or {}
    stale = [name for name, stat in seen.items() if known.get(name, ())[1:3] != stat or known[name][ERROR] is not None]
    rows = {name: known[name] for name in seen.keys() - set(stale)}
    try:
        for number, name in enumerate(stale):
            progress(number, len(stale))
            _, *made = describe(folder, name, *seen[name])
            rows[name] = (name, *(as_utf8(value) if isinstance(value, str) else value for value in made))
    except KeyboardInterrupt:
        if not lies.note:
            _store(path, rows.values())  # the next goes on from here
        raise
    stored = lies.rows is not None
    if not lies.note and (not stored or lies.removed or rows != known):
        stored = _store(path, rows.values())
    with closing(_filled(sqlite3.connect(":memory:"), rows.values())) as table:
        yield Index(table, len(stale), lies.removed, stored, lies.note)


def _look(folder: Path) -> Seen:
    """Size and time of change of every stage file below a folder; folders of recordings in progress are left out."""
    seen: Seen = {}
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
                    about = entry.stat()
                    seen[f"{inner}{name}"] = (about.st_size, about.st_ctime_ns)
                except OSError:  # a link to nothing
                    seen[f"{inner}{name}"] = (0, 0)
    return seen


class _Lies(NamedTuple):
    """What lies in the index's place: its rows by their paths, None where there is none that can be read.

    removed: rows of files that are no longer there. note: why it may not be replaced, for evetac did not make it.
    """

    rows: dict[str, tuple[Any, ...]] | None = None
    removed: int = 0
    note: str = ""


def is_index(path: Path) -> bool:
    """Whether a file is an index that evetac made, of whatever format, and so may be replaced or removed."""
    lies = _read(path, {})
    return path.name == NAME and os.path.lexists(path) and not lies.note


def _read(path: Path, seen: Seen) -> _Lies:
    """The rows of files that were seen; no other program's database is opened, and nothing that could wait."""
    try:
        kind = os.lstat(path)
    except FileNotFoundError:
        return _Lies()
    except OSError as error:
        return _Lies(note=_note(error.strerror or "it cannot be looked at"))
    if not stat.S_ISREG(kind.st_mode):
        return _Lies(note=_note("it is no file"))
    if not kind.st_size:
        return _Lies()
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as table:
            return _checked(table, seen)
    except sqlite3.Error as error:
        return _Lies(note=_note(str(error)))


def _note(reason: str) -> str:
    return (
        f"evetac did not make {NAME} ({shortened(as_utf8(reason))}): it is left as it is, so all files are"
        " read each time; if you move it away, they are read once"
    )


def _checked(table: sqlite3.Connection, seen: Seen) -> _Lies:
    """The rows of an open database, as far as it is an index; sqlite3.Error where it is none, or leads astray."""
    most = 10 * len(seen) + MOST_UNKNOWN_ROWS
    steps = 0

    def too_many() -> bool:
        nonlocal steps
        steps += STEPS_AT_ONCE
        return steps > STEPS_A_ROW * most

    table.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_ROW_BYTES)
    table.setlimit(sqlite3.SQLITE_LIMIT_SQL_LENGTH, MOST_SQL_BYTES)
    table.set_progress_handler(too_many, STEPS_AT_ONCE)
    made = table.execute("SELECT type, name, sql FROM sqlite_master LIMIT 2").fetchall()
    is_ours = len(made) == 1 and made[0][:2] == ("table", "files") and isinstance(made[0][2], str)
    if not is_ours or not (made[0][2].startswith(_BEGINS) and made[0][2].endswith(_ENDS)):
        return _Lies(note=_note("it holds something else than the table of an index"))
    rows: dict[str, tuple[Any, ...]] = {}
    removed = 0
    try:
        if made[0][2] != _CREATE or table.execute("PRAGMA user_version").fetchone() != (FORMAT,):
            return _Lies()
        possible: set[tuple[type, ...]] = set()
        for number, row in enumerate(table.execute(_SELECT)):
            types = tuple(map(type, row))
            if types not in possible and not _are_possible(types):
                return _Lies()
            possible.add(types)
            if number > most or row[SIMULATED] not in (None, 0, 1) or not 0 <= (row[SLICES] or 0) <= MOST_SLICES:
                return _Lies()
            name = _name(row[0])
            if name in seen:
                rows[name] = (name, *row[1:])
            else:
                removed += 1
    except sqlite3.Error:  # an index of ours that was damaged, or made to look like one
        return _Lies()
    return _Lies(rows, removed)


def _are_possible(types: Sequence[type]) -> bool:
    """Whether each value of a row is of a type that its column may have."""
    return all(kind in _TYPES[name] for name, kind in zip(IndexRow._fields, types, strict=True))


def _filled(table: sqlite3.Connection, rows: Iterable[tuple[Any, ...]]) -> sqlite3.Connection:
    with table:
        table.execute(_CREATE)
        table.executemany(_INSERT, map(_stored, rows))
        table.execute(f"PRAGMA user_version = {FORMAT}")
    return table


def _store(path: Path, rows: Iterable[tuple[Any, ...]]) -> bool:
    """Let a new index take the place of the old one; False if the folder cannot be written to."""
    from evetac_cli.store.hdf5.disk import existing_folder, taking_the_place_of

    try:
        existing_folder(path.parent)
        with taking_the_place_of(path) as temporary:
            _filled(sqlite3.connect(temporary), rows).close()
    except (InputError, sqlite3.OperationalError):
        return False
    return True


# --- what a file is ---------------------------------------------------------------------------------------------------


def describe(folder: Path, name: str, size_bytes: int, changed_ns: int) -> IndexRow:
    """The row of a file; one that cannot be read has its reason, one of another program neither kind nor reason."""
    from evetac_cli.store.files import StageFile

    try:
        with StageFile(folder / name) as file:
            file.check()
            return IndexRow(name, size_bytes, changed_ns, **_figures(file))
    except ForeignFile:
        return IndexRow(name, size_bytes, changed_ns)
    except EvetacError as error:
        reason = f"{error.message}: {error.found}" if error.found else error.message
        return IndexRow(name, size_bytes, changed_ns, error=reason)
    except (OSError, MemoryError) as error:
        return IndexRow(name, size_bytes, changed_ns, error=str(error) or type(error).__name__)


def _figures(file: Any) -> dict[str, Any]:
    header = file.header
    recording: dict[str, Any] = recording_of(header, header["history"]) or {}
    parameters = recording.get("parameters", {})
    seed = recording.get("seed") if recording else header["seed"]
    trial = _plain(parameters.get("trial"))
    return {
        "kind": file.kind,
        "recipe_id": header["id"],
        "recording": _plain(recording.get("id")),
        "object": _plain(parameters.get("object")),
        "sensor": _plain(parameters.get("sensor")) or _sensor_name(file),
        "seed": _plain(seed),
        "trial": trial if isinstance(trial, int) else None,
        "scene": _plain(scene_words(parameters, "name")),
        "outcome": _outcome(file),
        "slices": _slices(file),
        "simulated": header["simulated"],
    }


def scene_words(parameters: Mapping[str, Any], key: str) -> str | None:
    """What a recording's parameters say of its scene, its `name` or `summary`; None where they say nothing in words."""
    named = parameters.get("scene")
    words = named.get(key) if isinstance(named, dict) else None
    return words if isinstance(words, str) else None


def recording_of(header: dict[str, Any], history: dict[str, Any]) -> dict[str, Any] | None:
    """The header of the one recording that a file was made from, itself if it is one; None where there are several.

    What a model was trained on does not count.
    """
    recordings: dict[str, dict[str, Any]] = {}
    waiting, passed = [header], set()
    while waiting:
        one = waiting.pop()
        if one["kind"] == "recording":
            recordings[one["id"]] = one
            continue
        for parent in one["parents"]:
            if parent in history and parent not in passed and not history[parent]["kind"].endswith("model"):
                passed.add(parent)
                waiting.append(history[parent])
    return next(iter(recordings.values())) if len(recordings) == 1 else None


def _plain(value: Any) -> Any:
    """A value as SQLite keeps it; None for what is no number and no text."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value if abs(value) <= LARGEST else str(value)
    return shortened(as_utf8(value)) if isinstance(value, str) else None


def _sensor_name(file: Any) -> str | None:
    return _plain(file.read("sensor/name")) if file.kind == "recording" else None


def _outcome(file: Any) -> str | None:
    """Whether the object slipped, by labels or the truth of a simulation; what became of a grasp."""
    if file.has("control/outcome"):
        try:
            figures = json.loads(file.read("control/outcome"))
            return "balanced" if figures["balanced"] else "lifted" if figures["lifted"] else "dropped"
        except (ValueError, KeyError, TypeError):
            return None
    if file.has("onset_slice"):
        return "slips" if int(file.read("onset_slice")) >= 0 else "held"
    if file.has("truth/slip"):
        return "slips" if file.read("truth/slip").any() else "held"
    return None


_BY_SLICE = {"recording": "ms_to_idx", "labels": "label", "tracks": "dot_xy_px", "features": "events_total"}


def _slices(file: Any) -> int | None:
    if file.kind not in _BY_SLICE:
        return None
    rows: int = file.length(_BY_SLICE[file.kind])
    return rows - 1 if file.kind == "recording" else rows
