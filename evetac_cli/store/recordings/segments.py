"""Writing of recordings of devices: closed segments in NAME.part/, joined into one file at the end.

A single HDF5 file that is being appended to is unreadable after a kill and destroyed by a full disk. Here every segment
is a separate small file, complete once it is renamed. So in any case only the last quarter of a second is lost, in wall
time, plus slices that a late caller has not passed on. Trials that can be simulated again are written once
(trial_writer.py). A left-over folder NAME.part/ means that a recording was interrupted; it has everything that
`evetac validate --repair` needs (recovery.py).

Segments are not compressed: this would take a tenth of the time in which they fill, at a million events per second, and
the recorder must not leave its devices unread for that long. Each dataset has its CRC-32 instead, to detect damage.
"""

import errno
import fcntl
import json
import os
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from isal import isal_zlib

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.store.files import put_header, replacing
from evetac_cli.store.hdf5.checked_hdf5 import CheckedHdf5, row_blocks
from evetac_cli.store.hdf5.chunks import RowWriter, put
from evetac_cli.store.hdf5.disk import check_free, missing_folders, new_file, remove_empty
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.netcdf import describe_dataset
from evetac_cli.store.layout.provenance import ContentDigest, Header, Recipe
from evetac_cli.store.recordings.trial_writer import TrialBuffer

SEGMENT_S = 0.25  # at most one segment in this time, in wall time
SEGMENT_EVENTS = 4_000_000  # ... unless this many events wait in memory
COUNTS = "events_per_slice"
STARTS = "ms_to_idx"
BLOCK_ROWS = 1 << 16  # rows of lost slices written at a time
WRITE_HINTS = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "free some space on this disk"),
    errno.ENOENT: "the folder was moved or removed; if moved, evetac validate --repair recovers what it has",
}
STATIC = "static.h5"
LATE = "late.h5"  # datasets known only at the end, of a recording that is to be joined later
LOCK = "lock"
JOINED = "joined"  # marks a folder whose recording is complete but which was not removed
SEGMENT = "([0-9]{6,})[.](h5|tmp)"  # name of a segment; .tmp: possibly closed, but not yet renamed
OWN = re.compile(rf"{LOCK}|{JOINED}|(static|late)[.](h5|tmp)|{SEGMENT}")
# Attributes of a segment, of its datasets, and of STATIC.
FIRST_SLICE = "first_slice"
CRC = "crc32"
RECIPE = "recipe"


class RecordingWriter:
    """Appends slices and rows; `path` is written only by `finish`.

    Rows are named by their schema path, such as `gripper/t_us`, and may come at any rate.
    """

    def __init__(self, path: Path, static: Mapping[str, Any], *, recipe: Recipe | None = None) -> None:
        """Create NAME.part/; static: the datasets that are known beforehand (sensor/..., t_offset).

        A left-over NAME.part/ with segments is refused. With a `recipe`, an interrupted recording can be repaired.
        """
        self.path = path
        self.folder = _part_folder(path)
        self._replaces = os.path.lexists(path)  # an existing file was allowed to be replaced
        self._made = missing_folders(path.parent)
        self._lock: BinaryIO | None = None
        self._claim()
        try:
            about = {} if recipe is None else {RECIPE: json.dumps(vars(recipe.carried()), allow_nan=False)}
            self._write(self.folder / STATIC, static, about)
        except BaseException:
            self.discard()
            raise
        self._waiting = TrialBuffer()
        self._counts: list[int] = []  # events of each waiting slice
        self._segments = 0
        self._slices = 0
        self.events = 0
        self._closed_at = time.monotonic()

    def _claim(self) -> None:
        """Create and lock the folder; the lock distinguishes a recording in progress from an interrupted one."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            _refuse_unexpected(self.folder)
            self._lock = locked_part(self.folder)  # held until finish() or discard()
        except (FileExistsError, NotADirectoryError):
            raise InputError("the output folder is a file", where=str(self.folder)) from None
        except OSError as error:
            raise InputError(f"cannot be created: {error.strerror}", where=str(self.folder)) from None
        try:
            _refuse_segments(self.folder)
        except InputError:
            self._unlock()
            raise
        remove_parts(self.folder, keep=LOCK)

    def append(self, events: Events, rows: Mapping[str, Any] | None = None) -> None:
        """Add one slice (its events may be none) and one row to each of the named datasets; arrays are not copied."""
        self.append_slices(events, (events.size,), {name: (row,) for name, row in (rows or {}).items()})

    def append_slices(self, events: Events, counts: Sequence[int], rows: Mapping[str, Sequence[Any]]) -> None:
        """Add slices: all of their events, the number of events of each, and a row of each named dataset for each."""
        self._waiting.append(events, {})
        for name, column in rows.items():
            self._waiting.rows.setdefault(name, []).extend(column)
        self._counts += counts
        self.events += events.size
        if self._waiting.event_count >= SEGMENT_EVENTS or time.monotonic() - self._closed_at >= SEGMENT_S:
            self.close_segment()

    def append_rows(self, rows: Mapping[str, Any]) -> None:
        """Add one row to each of the named datasets, independent of slices."""
        self._waiting.append_rows(rows)

    def close_segment(self) -> None:
        """Write all waiting data as the next segment."""
        if self._counts or (self._slices and self._waiting.rows):  # rows may come after the last slice
            counts = np.array(self._counts, np.int64)
            arrays = {COUNTS: counts, **self._waiting.columns()}
            self._write(self.folder / f"{self._segments:06d}.h5", arrays, {FIRST_SLICE: self._slices})
            self._segments += 1
            self._slices += len(counts)
            self._waiting, self._counts = TrialBuffer(), []
        self._closed_at = time.monotonic()

    def finish(self, recipe: Recipe, late: Mapping[str, Any] | None = None) -> Header:
        """Close, join all segments to `path` and remove the folder; late: datasets that are known only at the end."""
        self.close_segment()
        parts = [self.folder / f"{number:06d}.h5" for number in range(self._segments)]
        header = join(self.folder, self.path, recipe, late or {}, parts, replaces=self._replaces)
        with suppress(OSError):  # on a full disk
            (self.folder / JOINED).touch()
        self.discard()
        return header

    @property
    def segments(self) -> int:
        """Number of segments written."""
        return self._segments

    def leave(self) -> None:
        """Unlock the folder, whose contents wait for `evetac validate --repair`; without a segment it is removed."""
        if self._segments == 0:
            self.discard()
        self._unlock()

    def leave_complete(self, late: Mapping[str, Any]) -> None:
        """Close, and leave the folder with what `evetac validate --repair` needs for the same result as `finish`."""
        self.close_segment()
        self._write(self.folder / LATE, late, {})
        self.leave()

    def discard(self) -> None:
        """Remove the folder, of a recording that was joined or is not wanted."""
        remove_parts(self.folder)  # before unlocking: another process may be waiting for the lock
        remove_empty(self._made)
        self._unlock()

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.close()

    @staticmethod
    def _write(path: Path, arrays: Mapping[str, Any], about: Mapping[str, Any]) -> None:
        temporary = path.with_suffix(".tmp")
        table = schema.load("recording")
        try:
            with new_file(temporary) as h5:
                h5.attrs.update(about)
                for name, value in arrays.items():
                    if isinstance(value, str):
                        put(h5, name, value)
                    else:
                        h5.create_dataset(name, data=value, track_times=False).attrs[CRC] = checksum(value)
                    describe_dataset(h5[name], table.find(name))
            temporary.replace(path)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink()
            message = f"a segment cannot be written: {error.strerror or error}"
            hint = WRITE_HINTS.get(error.errno or 0, "")
            raise InputError(message, where=str(path.parent), hint=hint) from error


def refuse_leftover(path: Path) -> None:
    """Raise InputError if a recording of this name is in progress, or was interrupted and waits for repair."""
    folder = _part_folder(path)
    if not folder.is_dir():
        return
    if (folder / LOCK).is_file():
        locked_part(folder).close()
    _refuse_segments(folder)


def locked_part(folder: Path) -> BinaryIO:
    """Open and lock the lock file of a folder NAME.part/; InputError if another process records there."""
    lock = open(folder / LOCK, "ab")  # noqa: SIM115
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        hint = "wait until it ends, or use another name with -o"
        raise InputError("another process is recording here", where=str(folder), hint=hint) from None
    return lock


def _refuse_segments(folder: Path) -> None:
    if (folder / JOINED).exists():
        return
    if any(re.fullmatch(SEGMENT, file.name) for file in folder.iterdir()):
        message = "an interrupted recording is here, which cannot be made again"
        hint = f"evetac validate --repair {folder}, or use another name with -o"
        raise InputError(message, where=str(folder), hint=hint)


def _part_folder(path: Path) -> Path:
    return path.with_name(path.name.removesuffix(".h5") + ".part")


def checksum(value: Any) -> int:
    """Return the CRC-32 of the bytes of an array, as stored with it in a segment."""
    return int(isal_zlib.crc32(np.ascontiguousarray(value).reshape(-1).view(np.uint8)))


def join(
    folder: Path,
    path: Path,
    recipe: Recipe,
    late: Mapping[str, Any],
    parts: Sequence[Path | int],
    *,
    replaces: bool = False,
) -> Header:
    """Join segments of NAME.part/ to one recording, block by block, so that memory does not grow with its length.

    parts: the segments in their order. A number is a number of lost slices, which are empty, with NaN in datasets that
    have a row per slice. Values are not checked: the data of devices are kept as they are. The digest of the stored
    arrays is part of the recipe, because such a recording cannot be made again. InputError if `path` exists, unless
    `replaces`.
    """
    per_slice = _float_of_every_slice(parts)
    with CheckedHdf5(folder / STATIC) as static:
        whole = {**whole_datasets(static), **late}
    with replacing(path, partial(check_free, path, force=replaces)) as h5:
        joined = _JoinedDatasets(h5, whole)
        for part in parts:
            if isinstance(part, int):
                joined.append_lost(part, per_slice)
            else:
                joined.append_segment(part)
        joined.close(str(folder))
        header = Recipe(**{**vars(recipe), "seed": None, "content": joined.digest.hexdigest()}).header()
        put_header(h5, header)
    return header


class _JoinedDatasets:
    """The datasets of a recording that is joined, with their digest; whole: those that do not grow."""

    def __init__(self, h5: Any, whole: Mapping[str, Any]) -> None:
        self.digest = ContentDigest()
        self._h5 = h5
        self._shapes = {name: schema.describe(value) for name, value in whole.items()}
        self._writers: dict[str, RowWriter] = {}
        self._events = 0
        for name, value in whole.items():
            put(h5, name, value)
            self.digest.update(name, value)
        self._append(STARTS, np.zeros(1, np.int64))

    def _append(self, name: str, rows: Any) -> None:
        """Append rows to a dataset, which is created by the first rows."""
        if name not in self._writers:
            self._writers[name] = RowWriter(self._h5, name, rows.dtype, rows.shape[1:])
        writer = self._writers[name]
        writer.append(rows)
        self.digest.update(name, rows)
        self._shapes[name] = (rows.dtype.name, (writer.rows, *rows.shape[1:]))

    def append_lost(self, slices: int, per_slice: Mapping[str, tuple[Any, tuple[int, ...]]]) -> None:
        """Append empty slices, with NaN in the datasets `per_slice`, of which it has the type and shape of a row."""
        for first in range(0, slices, BLOCK_ROWS):
            count = min(BLOCK_ROWS, slices - first)
            self._append(STARTS, np.full(count, self._events, np.int64))
            for name, (dtype, row_shape) in per_slice.items():
                self._append(name, np.full((count, *row_shape), np.nan, dtype))

    def append_segment(self, path: Path) -> None:
        """Append the rows of a segment."""
        with CheckedHdf5(path) as segment:
            for name, dataset in segment.datasets().items():
                for rows in row_blocks(dataset):
                    if name != COUNTS:
                        self._append(name, rows)
                    else:
                        ends = self._events + np.cumsum(rows)
                        self._append(STARTS, ends.astype(np.int64))
                        self._events = int(ends[-1]) if len(ends) else self._events

    def close(self, where: str) -> None:
        """Complete the datasets; InputError if they do not agree with the schema."""
        table = schema.load("recording")
        for column in Events._fields:  # a recording without any slice still has these columns
            name = f"events/{column}"
            described = table.find(name)
            if name not in self._writers and described is not None:
                self._append(name, np.empty(0, described.dtype))
        for writer in self._writers.values():
            writer.close()
        schema.refuse("recording", schema.problems(table, self._shapes), where)


def whole_datasets(file: CheckedHdf5) -> dict[str, Any]:
    """Return the datasets of a file that were known at the start of a recording, or only at its end."""
    return {
        name: file.text(name, dataset.id) if schema.describe_stored(dataset) == "utf8" else dataset[()]
        for name, dataset in file.datasets().items()
    }


def _float_of_every_slice(parts: Sequence[Path | int]) -> dict[str, tuple[Any, tuple[int, ...]]]:
    """Return name -> (dtype, shape of a row) of the float datasets with a row per slice, which may be NaN."""
    table = schema.load("recording")
    first = next((part for part in parts if isinstance(part, Path)), None)
    if first is None or len(parts) < 2:
        return {}
    with CheckedHdf5(first) as segment:
        columns = {name: (dataset.dtype, dataset.shape[1:]) for name, dataset in segment.datasets().items()}
    described = {name: table.find(name) for name in columns}
    return {
        name: columns[name]
        for name, row in described.items()
        if row is not None and row.dims and row.dims[0] == "slices" and row.dtype.startswith("float")
    }


def unexpected_entries(folder: Path) -> list[str]:
    """Return the names of entries that were not written by a recorder."""
    return sorted(path.name for path in folder.iterdir() if not OWN.fullmatch(path.name) or not _is_file(path))


def _refuse_unexpected(folder: Path) -> None:
    """Raise InputError if a folder has anything that was not written by a recorder."""
    if names := unexpected_entries(folder):
        hint = "move it away, or use another name with -o"
        raise InputError("this folder is not from a recording", where=str(folder), found=", ".join(names), hint=hint)


def remove_parts(folder: Path, *, keep: str = "") -> list[str]:
    """Remove a recorder's files, and the folder if it is then empty; return the names of remaining entries.

    keep: a file that stays, and with it the folder.
    """
    with suppress(OSError):  # an unreadable folder stays
        for path in folder.iterdir():
            if path.name != keep and OWN.fullmatch(path.name) and _is_file(path):
                with suppress(OSError):
                    path.unlink()
        left = [name for name in unexpected_entries(folder) if name != keep]
        if not keep:
            folder.rmdir()
        return left
    return unexpected_entries(folder) if folder.is_dir() else []


def _is_file(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()
