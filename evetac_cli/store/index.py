"""The index of a data set: what each stage file in a folder is, in one SQLite file, so that nobody opens them all.

It is the table `files` of FOLDER/.evetac-index.sqlite, a row for every `*.h5` in the folder and those below it, broken
ones with their reason. A row is made again when size or time of change of its file differ: one look at the folder, in
which no file is opened, says whether the index is up to date. Only what could not be read is tried each time: the
reason may lie in permissions, the storage, or an older evetac.

Why the time of change (ctime) and not that of the last writing (mtime): `cp -p`, `rsync -t` and backups bring files
back with an old mtime, and another content may have the same size. Nobody can set the ctime;
a data set that was copied to another place is read once again there.

Why it is written anew as a whole: a new file takes the place of the old one at once, also on storage that several
computers share, where SQLite cannot lock. Whoever reads the old one goes on with it, of two commands at once the later
one wins, and both wrote what is right.
"""

import json
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import EvetacError, InputError

NAME = ".evetac-index.sqlite"
FORMAT = 3  # of the table; an index of another format is made again
LARGEST = 2**63 - 1  # whole number of SQLite


class Row(NamedTuple):
    """What the index says of a file; None where a file of its kind has no such thing, or it is unknown."""

    path: str  # from the folder on
    size_bytes: int
    changed_ns: int
    kind: str | None = None  # none for a file that cannot be read
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


ERROR = Row._fields.index("error")
Seen = dict[str, tuple[int, int]]  # size and time of change of files, by their paths
_CREATE = f"CREATE TABLE files ({', '.join(Row._fields)}, PRIMARY KEY (path)) WITHOUT ROWID"
_INSERT = f"INSERT INTO files VALUES ({', '.join('?' * len(Row._fields))})"


class Index(NamedTuple):
    """An index that is up to date: its table, and what was to be done for that."""

    table: sqlite3.Connection
    read: int  # files that were added or changed, or could not be read before
    removed: int
    stored: bool  # False where the folder cannot be written to: the table is in memory


@contextmanager
def open_index(folder: Path, progress: Callable[[int, int], None] = lambda done, total: None) -> Iterator[Index]:
    """The index of a folder, made again as far as files changed; InputError if it is no folder.

    progress: of the files that have to be read.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), expected="a folder of stage files")
    path, seen = folder / NAME, _look(folder)
    known = _read(path)
    stored = known is not None
    known = known or {}
    stale = [name for name, stat in seen.items() if known.get(name, ())[1:3] != stat or known[name][ERROR] is not None]
    removed = len(known.keys() - seen.keys())
    rows = {name: known[name] for name in seen.keys() - set(stale)}
    try:
        for number, name in enumerate(stale):
            progress(number, len(stale))
            rows[name] = tuple(describe(folder, name, *seen[name]))
    except KeyboardInterrupt:
        _store(path, rows.values())  # the next goes on from here
        raise
    if not stored or rows != known:
        stored = _store(path, rows.values())
        if not stored:
            table = _filled(sqlite3.connect(":memory:"), rows.values())
    if stored:
        table = _open(path)
    try:
        yield Index(table, len(stale), removed, stored)
    finally:
        table.close()


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
                path = f"{inner}{name}".encode("utf-8", "backslashreplace").decode()  # SQLite keeps no other names
                try:
                    stat = entry.stat()
                    seen[path] = (stat.st_size, stat.st_ctime_ns)
                except OSError:  # a link to nothing
                    seen[path] = (0, 0)
    return seen


def _open(path: Path) -> sqlite3.Connection:
    """The index as it lies there; it never changes, for a new one takes its place."""
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)


def _read(path: Path) -> dict[str, tuple[Any, ...]] | None:
    """All rows by the paths of their files; None where there is no index that can be read."""
    try:
        with closing(_open(path)) as table:
            if table.execute("PRAGMA user_version").fetchone() != (FORMAT,):
                return None
            return {row[0]: row for row in table.execute(f"SELECT {', '.join(Row._fields)} FROM files")}
    except sqlite3.Error:
        return None


def _filled(table: sqlite3.Connection, rows: Iterable[tuple[Any, ...]]) -> sqlite3.Connection:
    with table:
        table.execute(_CREATE)
        table.executemany(_INSERT, rows)
        table.execute(f"PRAGMA user_version = {FORMAT}")
    return table


def _store(path: Path, rows: Iterable[tuple[Any, ...]]) -> bool:
    """Let a new index take the place of the old one; False if the folder cannot be written to."""
    from evetac_cli.store.disk import existing_folder, taking_the_place_of

    try:
        existing_folder(path.parent)
        with taking_the_place_of(path) as temporary:
            _filled(sqlite3.connect(temporary), rows).close()
    except (InputError, sqlite3.OperationalError):
        return False
    return True


# --- what a file is ---------------------------------------------------------------------------------------------------


def describe(folder: Path, name: str, size_bytes: int, changed_ns: int) -> Row:
    """The row of a file; one that cannot be read has its reason."""
    from evetac_cli.store.files import StageFile

    try:
        with StageFile(folder / name) as file:
            return Row(name, size_bytes, changed_ns, **_figures(file))
    except EvetacError as error:
        reason = f"{error.message}: {error.found}" if error.found else error.message
        return Row(name, size_bytes, changed_ns, error=reason)
    except (OSError, MemoryError) as error:
        return Row(name, size_bytes, changed_ns, error=str(error) or type(error).__name__)


def _figures(file: Any) -> dict[str, Any]:
    header = file.header
    recording: dict[str, Any] = recording_of(header, header["history"]) or {}
    parameters = recording.get("parameters", {})
    scene = parameters.get("scene")
    seed = recording.get("seed") if recording else header["seed"]
    return {
        "kind": file.kind,
        "recipe_id": header["id"],
        "recording": recording.get("id"),
        "object": _plain(parameters.get("object")),
        "sensor": _plain(parameters.get("sensor")) or _sensor_name(file),
        "seed": _plain(seed),
        "trial": _plain(parameters.get("trial")),
        "scene": _plain(scene.get("name")) if isinstance(scene, dict) else None,
        "outcome": _outcome(file),
        "slices": _slices(file),
        "simulated": header["simulated"],
    }


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
    return value if isinstance(value, str) else None


def _sensor_name(file: Any) -> str | None:
    return str(file.read("sensor/name")) if file.kind == "recording" else None


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
