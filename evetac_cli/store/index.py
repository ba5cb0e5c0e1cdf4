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
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from evetac_cli.errors import EvetacError, ForeignFile, InputError, shortened
from evetac_cli.store.layout.ancestry import recording_of, scene_words
from evetac_cli.text_files import as_utf8, read_bytes

NAME = ".evetac-index.json"
FORMAT = 7  # an index of another format is made again
MOST_BYTES = 1 << 27  # some 400,000 files; a larger index is not read


class Seen(NamedTuple):
    """File status that identifies an unchanged file; zeros for a missing file.

    Two files of a folder have different inodes, and the time of change (ctime) cannot be set. So a file with the same
    three values is unchanged. The only exception is a change in place, to the same size, within the tick of the
    storage's clock (4 ms on Linux) in which the status was read.
    """

    size_bytes: int
    changed_ns: int
    inode: int

    @classmethod
    def of(cls, status: os.stat_result) -> "Seen":
        """Return the part of a file status that identifies an unchanged file."""
        return cls(status.st_size, status.st_ctime_ns, status.st_ino)


NOT_THERE = Seen(0, 0, 0)


class IndexRow(NamedTuple):
    """The row of a file; a value is None if it does not exist for this kind of file, or if it is unknown."""

    path: str  # relative to the folder
    size_bytes: int
    changed_ns: int
    inode: int
    kind: str | None = None  # None for an unreadable file, or one of another program
    recipe_id: str | None = None
    recording: str | None = None  # recipe id of the only recording from which it was made, or which it is
    object: int | str | None = None
    sensor: str | None = None
    seed: int | str | None = None
    trial: int | None = None
    scene: str | None = None
    outcome: str | None = None  # slips, held; for a grasp: dropped, lifted, balanced
    slices: int | None = None
    simulated: bool | None = None
    error: str | None = None  # reason why the file cannot be read

    @property
    def seen(self) -> Seen:
        """The status of the file when it was read."""
        return Seen(self.size_bytes, self.changed_ns, self.inode)


Progress = Callable[[int, int], None]


class _Stored(msgspec.Struct):
    """The contents of the index file."""

    format: int
    rows: list[IndexRow]


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


def read_index(folder: Path, progress: Progress = lambda done, total: None) -> Index:
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
        for number, (name, at) in enumerate(stale.items()):
            progress(number, len(stale))
            rows[name] = describe(folder, name, *at)
    finally:  # after an interrupt, the next run continues from here
        stored = rows == old or _store(path, rows.values())
    return Index(sorted(rows.values()), len(stale), len(old.keys() - seen.keys()), stored)


def _seen(path: Path | str) -> Seen | None:
    with suppress(OSError):
        return Seen.of(os.stat(path))
    return None


def _load(path: Path) -> dict[str, IndexRow]:
    """Return the rows of an index by their paths; none if there is no index, or a damaged one or another format."""
    try:
        stored = msgspec.convert(json.loads(read_bytes(path, MOST_BYTES)), _Stored)
    except (EvetacError, ValueError, RecursionError, msgspec.ValidationError):
        return {}
    return {row.path: row for row in stored.rows} if stored.format == FORMAT else {}


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


def describe(folder: Path, name: str, size_bytes: int, changed_ns: int, inode: int) -> IndexRow:
    """Return the row of a file; an unreadable file has its reason, one of another program neither kind nor reason.

    The whole file is checked, because a row is later trusted without another check.
    """
    from evetac_cli.store.files import StageFile

    seen = Seen(size_bytes, changed_ns, inode)
    try:
        with StageFile(folder / name) as file:
            file.check()
            return IndexRow(name, *seen, **_figures(file))
    except ForeignFile:
        return IndexRow(name, *seen)
    except EvetacError as error:
        reason = f"{error.message}: {error.found}" if error.found else error.message
        return IndexRow(name, *seen, error=reason)
    except (OSError, MemoryError) as error:
        return IndexRow(name, *seen, error=str(error) or type(error).__name__)


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


def _plain(value: Any) -> Any:
    """Return a whole number or a text; None for anything else. Tables cannot hold numbers of more than 64 bits."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value if abs(value) < 2**63 else str(value)
    return shortened(as_utf8(value)) if isinstance(value, str) else None


def _sensor_name(file: Any) -> str | None:
    return _plain(file.read("sensor/name")) if file.kind == "recording" else None


def _outcome(file: Any) -> str | None:
    """Return whether the object slipped, by labels or a simulation's truth, or the outcome of a grasp."""
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
