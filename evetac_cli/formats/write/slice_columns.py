"""Read a trial as columns with one row per slice, from which tables and data sets for policies are written.

Each dataset with one row per slice is read as columns of plain numbers, one per dot and per coordinate x and y. A
column's name consists of the dataset's path, the dot, x or y, and the unit: `displacement_17_x_px`. Columns of touch
begin with `touch_`. Touch maps, which exist for fewer times than slices, are left out: xarray opens the touch file.
Data with its own clock (gripper, control, other streams of the trial) appears in each slice as the last row before the
slice ends, together with the time of that row. Images of a stream are left out.

Why dots are not lists: pandas stores a list as an object that it cannot compute with, and CSV has no lists. Plain
columns are selected by a pattern in pandas, polars and duckdb, and Parquet reads only the selected ones.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.store.data_set import describe
from evetac_cli.store.files import StageFile, stem
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.schema import Dataset
from evetac_cli.store.recordings import streams
from evetac_cli.store.recordings.read import Recording
from evetac_cli.text_files import as_utf8, parse_json

Masked = np.ma.MaskedArray[Any, Any]
KINDS = ("recording", "tracks", "labels", "touch", "features")  # of two columns with the same name, the first is kept
PREFIX = {"touch": "touch_"}


class TrialFiles(NamedTuple):
    """The open files of one trial by kind, including its recording, and notes on what was left out.

    slip_probability: a detector's output per slice, NaN before its first; None if no detector was requested.
    """

    by_kind: Mapping[str, StageFile]
    notes: Sequence[str] = ()
    slip_probability: NDArray[np.float32] | None = None

    @property
    def recording(self) -> Recording:
        """The recording of the trial."""
        recording = self.by_kind["recording"]
        assert isinstance(recording, Recording)
        return recording

    @property
    def simulated(self) -> bool:
        """Whether any of the files is simulated: the recording, or the training data of a model that was used."""
        return any(bool(file.header["simulated"]) for file in self.by_kind.values())

    def facts(self) -> dict[str, Any]:
        """Return the facts that identify a trial: name, object, sensor, seed, outcome (None if unknown), simulated."""
        row = self._described("recording")
        outcome = row.outcome
        if outcome is None and "labels" in self.by_kind:
            outcome = self._described("labels").outcome
        return {
            "trial": as_utf8(stem(self.recording.path)),
            "object": row.object,
            "sensor": row.sensor or None,
            "seed": row.seed,
            "outcome": outcome,
            "simulated": bool(self.recording.header["simulated"]),
        }

    def _described(self, kind: str) -> Any:
        path = self.by_kind[kind].path
        return describe(path.parent, path.name)


Opener = Callable[[Path], AbstractContextManager[TrialFiles]]


@contextmanager
def recording_alone(path: Path) -> Iterator[TrialFiles]:
    """Open a recording without the other files of its trial."""
    with Recording(path) as recording:
        yield TrialFiles({"recording": recording})


class WrittenFolder(NamedTuple):
    """Facts about a data set that was written: whether any trial is simulated, what was left out, and figures."""

    simulated: bool
    left_out: list[str]
    figures: dict[str, Any]


class SliceColumns(NamedTuple):
    """The columns of one dataset; read(start, stop) returns the slices [start, stop) as (rows, columns).

    Unknown values are masked: NaN, slices before the first row of a clock, slices after the end of a file.
    """

    names: tuple[str, ...]
    meanings: tuple[str, ...]
    unit: str
    dtype: np.dtype[Any]
    read: Callable[[int, int], Masked]


def columns_of(files: TrialFiles) -> list[SliceColumns]:
    """Return all columns of a trial except its time; features repeat some of tracks and labels, which appear once."""
    groups = [_event_counts(files.recording)]
    dots = _dot_words(files)
    for kind in KINDS:
        if kind in files.by_kind:
            groups += _of_file(files.by_kind[kind], dots)
    if files.slip_probability is not None:
        groups.append(_of_detector(files.slip_probability))
    seen: set[str] = set()
    kept = []
    for columns in groups:
        if seen.isdisjoint(columns.names):
            kept.append(columns)
            seen.update(columns.names)
    return kept


def read_columns(columns: Sequence[SliceColumns], names: Sequence[str], slices: int) -> Masked:
    """Return all slices of the named columns, (slices, columns), as float32; raise KeyError if a name is missing."""
    by_name: dict[str, Masked] = {}
    for group in columns:
        wanted = [name for name in group.names if name in names]
        values = group.read(0, slices) if wanted else None
        by_name |= {name: values[:, group.names.index(name)] for name in wanted if values is not None}
    table = _none_known(slices, len(names), np.dtype(np.float32))
    for at, name in enumerate(names):
        table[:, at] = by_name[name]
    return table


def not_in_tables(recording: Recording) -> list[str]:
    """Return texts on data that no slice shows: earlier rows of a clock within a slice, and images of streams."""
    texts = []
    for group in _clocks(recording):
        t_us = recording.read(f"{group}/t_us")
        shown = np.unique(_rows_at(t_us, 0, len(recording)))
        missing = len(t_us) - int((shown >= 0).sum())
        after = int((t_us >= len(recording) * SLICE_US).sum())
        why = [f"{missing - after} because a later row of the same slice is shown"] if missing > after else []
        why += [f"{after} after the end of the last slice"] if after else []
        texts += [f"{missing} of {len(t_us)} rows of {group}: {', '.join(why)}"] if missing else []
        texts += [f"images of {group}"] if recording.has(f"{group}/frames") else []
    return texts


def _clocks(file: StageFile) -> list[str]:
    """Return the groups whose rows have their own clock."""
    return [path.removesuffix("/t_us") for path in file.contents() if path.endswith("/t_us")]


def _event_counts(recording: Recording) -> SliceColumns:
    def read(start: int, stop: int) -> Masked:
        return np.ma.array(np.diff(recording.starts[start : stop + 1]).astype(np.int32)[:, None])

    return SliceColumns(("events_total",), ("all events of the slice",), "", np.dtype(np.int32), read)


def _of_detector(probability: NDArray[np.float32]) -> SliceColumns:
    def read(start: int, stop: int) -> Masked:
        return _masked(probability[start:stop, None])

    meaning = "slip probability by the detector whose header is stored with those of the files"
    return SliceColumns(("model_probability",), (meaning,), "", np.dtype(np.float32), read)


def _dot_words(files: TrialFiles) -> Callable[[int], str]:
    """Return a function that describes the position of a dot, by its number, in the grid."""
    grids = (file.contents().get("sensor/dot_xy_px") for file in files.by_kind.values())
    columns = next((shape[1] for _, shape in filter(None, grids) if shape[1]), None)
    if columns is None:
        return lambda number: f"dot {number}"
    return lambda number: f"dot {number} (row {number // columns}, column {number % columns})"


def _of_file(file: StageFile, dot: Callable[[int], str]) -> Iterator[SliceColumns]:
    stored, table = file.contents(), schema.load(file.kind)
    clocks = {group: file.read(f"{group}/t_us") for group in _clocks(file)}
    described = [(path, row) for path in stored if (row := table.find(path)) is not None]
    order = {row.path: place for place, row in enumerate(table.datasets)}
    for path, row in sorted(described, key=lambda pair: order[pair[1].path]):
        along, *across = row.dims or ("",)
        group = path.rpartition("/")[0]
        read: Callable[[int, int], Masked]
        if set(across) - {"dots", 2}:
            continue
        if along == "slices":
            read = partial(_by_slice, file, path, stored[path][1])
        elif group in clocks and row.dims:
            read = partial(_by_clock, file, path, stored[path][1], np.dtype(row.dtype), clocks[group])
        else:
            continue
        unit = row.unit or _unit_of_column(file, group, path.rpartition("/")[2])
        pairs = _names_and_meanings(replace(row, path=path, unit=unit), stored[path][1], PREFIX.get(file.kind, ""), dot)
        names, meanings = tuple(name for name, _ in pairs), tuple(words for _, words in pairs)
        yield SliceColumns(names, meanings, unit, np.dtype(row.dtype), read)


def _unit_of_column(file: StageFile, group: str, column: str) -> str:
    """Return the unit of a stream's column, which the group's `about` states; empty for all other datasets."""
    if not group.startswith(f"{streams.GROUP}/"):
        return ""
    return as_utf8(str(parse_json(file.read(f"{group}/about")).get("units", {}).get(column, "")))


def _names_and_meanings(
    row: Dataset, shape: Sequence[int], prefix: str, dot: Callable[[int], str]
) -> list[tuple[str, str]]:
    """Return name and meaning of each column of a dataset, in the order in which its rows are flattened."""
    base = prefix + row.path.replace("/", "_")
    unit = f"_{row.unit.lower()}"
    ending = unit if row.unit and base.endswith(unit) else ""
    base = base.removesuffix(ending)
    parts = [("", "")]
    for dim, size in zip((row.dims or ())[1:], shape[1:], strict=True):
        if dim == 2:
            base = base.removesuffix("_xy")
            each = [("_x", "x"), ("_y", "y")]
        else:
            digits = max(2, len(str(size - 1)))
            each = [(f"_{number:0{digits}d}", dot(number)) for number in range(size)]
        parts = [(name + more, f"{words}, {where}") for name, words in parts for more, where in each]
    return [(base + name + ending, row.meaning + words) for name, words in parts]


def _masked(values: NDArray[Any]) -> Masked:
    return np.ma.masked_invalid(values) if values.dtype.kind == "f" else np.ma.array(values)


def _none_known(rows: int, columns: int, dtype: np.dtype[Any]) -> Masked:
    return np.ma.MaskedArray(np.zeros((rows, columns), dtype), mask=np.ones((rows, columns), bool))


def _by_slice(file: StageFile, path: str, shape: Sequence[int], start: int, stop: int) -> Masked:
    values = file.read(path, min(start, shape[0]), min(stop, shape[0])).reshape(-1, int(np.prod(shape[1:])))
    short = stop - start - len(values)
    if not short:
        return _masked(values)
    longer = _none_known(stop - start, values.shape[1], values.dtype)
    longer[: len(values)] = _masked(values)
    return longer


def _rows_at(t_us: NDArray[np.int64], start: int, stop: int) -> NDArray[np.int64]:
    """Return the index of the last row before the end of each slice; -1 if there is none yet."""
    ends = np.arange(start + 1, stop + 1, dtype=np.int64) * SLICE_US
    return np.asarray(np.searchsorted(t_us, ends) - 1)


def _by_clock(
    file: StageFile,
    path: str,
    shape: Sequence[int],
    dtype: np.dtype[Any],
    t_us: NDArray[np.int64],
    start: int,
    stop: int,
) -> Masked:
    at = _rows_at(t_us, start, stop)
    columns = int(np.prod(shape[1:]))
    if not len(at) or at[-1] < 0:
        return _none_known(len(at), columns, dtype)
    first = max(int(at[0]), 0)
    values = file.read(path, first, int(at[-1]) + 1).reshape(-1, columns)
    rows = _none_known(len(at), columns, dtype)
    rows[at >= 0] = _masked(values[at[at >= 0] - first])
    return rows
