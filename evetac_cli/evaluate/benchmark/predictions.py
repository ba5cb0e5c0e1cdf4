"""Predictions for a benchmark: their tables, read and checked strictly, and written.

A folder may have any of the CSV tables; a task without a table has no figure. Errors name file, line, expected and
found.
"""

import csv
import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.errors import InputError
from evetac_cli.evaluate.benchmark.data_set import Benchmark, Cells, Truth, read_columns
from evetac_cli.store.hdf5.disk import taking_the_place_of

COLUMNS = {
    "onset": ("recording", "onset_ms"),
    "warning": ("recording", "ms", "score"),
    "force": ("recording", "ms", "fx_n", "fy_n"),
    "dots": ("recording", "ms", "dot", "x_px", "y_px"),
}
ONSET_KINDS = ("slip",)
WARNING_KINDS = ("slip", "handling", "vibration", "lift")
PAGE = "docs/benchmark.md describes the tables"


@dataclass
class Predictions:
    """Predictions by task and recording; None for a task without predictions.

    onset_ms: first detection, None for none; warning: score in each ms (slices,), NaN before the first; force_n:
    (instants, 2); dot_xy_px: (instants, dots, 2), at the instants of the truth.
    """

    onset_ms: dict[str, int | None] | None = None
    warning: dict[str, NDArray[np.float32]] | None = None
    force_n: dict[str, Floats] | None = None
    dot_xy_px: dict[str, Floats] | None = None
    tables: dict[str, str] = field(default_factory=dict)  # task -> digest of its file


def find(given: Path) -> dict[str, Path]:
    """Return the tables of a folder, or a single table, by task; InputError if there are none."""
    if not given.exists():
        raise InputError("no such file or folder", where="--predictions", found=str(given))
    paths = sorted(given.iterdir()) if given.is_dir() else [given]
    found = {path.stem: path for path in paths if path.suffix == ".csv" and path.stem in COLUMNS}
    if not found:
        names = ", ".join(f"{task}.csv" for task in COLUMNS)
        raise InputError("no predictions", where=str(given), expected=f"some of {names}", hint=PAGE)
    return found


def read(given: Path, benchmark: Benchmark, truth: Mapping[str, Truth]) -> Predictions:
    """Read and check the tables of a folder, or a single one; InputError for the first invalid or missing row."""
    made = Predictions()
    for task, path in find(given).items():
        made.tables[task] = hashlib.sha256(path.read_bytes()).hexdigest()
        table = _Table(path, read_columns(path, COLUMNS[task]))
        if task == "onset":
            made.onset_ms = _onsets(table, benchmark, truth)
        elif task == "warning":
            made.warning = _warnings(table, benchmark, truth)
        elif task == "force":
            made.force_n = _at_instants(task, table, benchmark, truth)
        else:
            made.dot_xy_px = _at_instants(task, table, benchmark, truth)
    return made


class _Table:
    """The cells of a table, with the lines for errors."""

    def __init__(self, path: Path, cells: Cells) -> None:
        self.path, self.cells = path, cells
        self.rows = len(cells["recording"])

    def fault(self, row: int, expected: str, found: str) -> InputError:
        """Return the error of a row."""
        where = f"{self.path}, line {row + 2}"
        return InputError("not a prediction of this task", where=where, expected=expected, found=found[:80], hint=PAGE)

    def recording(self, row: int, known: Mapping[str, Any], kinds: str) -> str:
        """Return the recording of a row, one of those to be judged."""
        name = self.cells["recording"][row].strip()
        if name not in known:
            raise self.fault(row, f"a recording of kind {kinds}", name or "nothing")
        return name

    def number(self, row: int, column: str, below: int | None = None) -> float:
        """Return a finite number; with `below`, a whole one from 0."""
        text = self.cells[column][row].strip()
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if below is None and not math.isfinite(value):
            raise self.fault(row, f"{column}: a finite number", text or "nothing")
        if below is not None and not (value.is_integer() and 0 <= value < below):
            raise self.fault(row, f"{column}: a whole number from 0 to {below - 1}", text or "nothing")
        return value

    def missing(self, what: str) -> InputError:
        """Return the error of a row that is not there."""
        return InputError("a row is missing", where=str(self.path), expected=what, hint=PAGE)


def _onsets(table: _Table, benchmark: Benchmark, truth: Mapping[str, Truth]) -> dict[str, int | None]:
    known = {entry.name: entry for entry in benchmark.of_kinds(*ONSET_KINDS)}
    found: dict[str, int | None] = {}
    for row in range(table.rows):
        name = table.recording(row, known, "slip")
        if name in found:
            raise table.fault(row, "one row for each recording", f"another one for {name}")
        empty = not table.cells["onset_ms"][row].strip()
        found[name] = None if empty else int(table.number(row, "onset_ms", truth[name].slices))
    for name in known:
        if name not in found:
            raise table.missing(f"one for {name}; onset_ms is empty if nothing is detected")
    return found


def _warnings(table: _Table, benchmark: Benchmark, truth: Mapping[str, Truth]) -> dict[str, NDArray[np.float32]]:
    known = {entry.name: entry for entry in benchmark.of_kinds(*WARNING_KINDS)}
    found: dict[str, NDArray[np.float32]] = {}
    last: dict[str, int] = {}
    for row in range(table.rows):
        name = table.recording(row, known, ", ".join(WARNING_KINDS))
        ms = int(table.number(row, "ms", truth[name].slices))
        if ms <= last.get(name, -1):
            raise table.fault(row, f"ms above {last[name]}, the one before in {name}", str(ms))
        last[name] = ms
        score = found.setdefault(name, np.full(truth[name].slices, np.nan, np.float32))
        score[ms] = table.number(row, "score")
    for name in known:
        if name not in found:
            raise table.missing(f"at least one for {name}")
    return {name: held_on(score) for name, score in found.items()}


def held_on(score: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return scores (slices,) in which a ms without one has the one before; NaN before the first."""
    last = np.maximum.accumulate(np.where(np.isnan(score), -1, np.arange(len(score))))
    return np.where(last < 0, np.float32(np.nan), score[last])


def _at_instants(task: str, table: _Table, benchmark: Benchmark, truth: Mapping[str, Truth]) -> dict[str, Floats]:
    """Return the predictions of task force (instants, 2) or dots (instants, dots, 2) by recording."""
    instants: dict[str, dict[int, int]] = {}  # recording -> ms -> its place among those that are judged
    for name, ms in benchmark.queries[task]:
        of_name = instants.setdefault(name, {})
        of_name[ms] = len(of_name)
    kinds, *columns = ("press", "fx_n", "fy_n") if task == "force" else ("any", "x_px", "y_px")
    shapes = {
        name: (len(places), 2) if task == "force" else truth[name].dot_xy_px.shape for name, places in instants.items()
    }
    found = {name: np.full(shape, np.nan) for name, shape in shapes.items()}
    for row in range(table.rows):
        name = table.recording(row, instants, kinds)
        ms = int(table.number(row, "ms", truth[name].slices))
        if ms not in instants[name]:
            raise table.fault(row, f"an instant of {name} in queries/{task}.csv", f"{ms} ms")
        at: tuple[int, ...] = (instants[name][ms],)
        if task == "dots":
            at += (int(table.number(row, "dot", shapes[name][1])),)
        if np.isfinite(found[name][at][0]):
            raise table.fault(row, "one row for each instant and dot", f"another one for {name}")
        found[name][at] = [table.number(row, column) for column in columns]
    for name, values in found.items():
        for place, *dot in np.argwhere(~np.isfinite(values[..., 0]))[:1].tolist():
            which = "".join(f", dot {number}" for number in dot)
            raise table.missing(f"one for {name} at {list(instants[name])[place]} ms{which}")
    return found


def rows_of(made: Predictions, truth: Mapping[str, Truth]) -> Iterator[tuple[str, Iterable[Sequence[Any]]]]:
    """Yield the tables of predictions: task and rows without heading; warnings only where the score changes."""
    if made.onset_ms is not None:
        yield "onset", [(name, "" if ms is None else ms) for name, ms in made.onset_ms.items()]
    if made.warning is not None:
        yield "warning", (row for name, score in made.warning.items() for row in _changes(name, score))
    if made.force_n is not None:
        rows = (
            (name, int(ms), *map(float, force))
            for name, forces in made.force_n.items()
            for ms, force in zip(truth[name].force_ms, forces, strict=True)
        )
        yield "force", rows
    if made.dot_xy_px is not None:
        rows = (
            (name, int(ms), dot, *map(float, at))
            for name, places in made.dot_xy_px.items()
            for ms, dots in zip(truth[name].dots_ms, places, strict=True)
            for dot, at in enumerate(dots)
        )
        yield "dots", rows


def _changes(name: str, score: NDArray[np.float32]) -> Iterator[tuple[str, int, float]]:
    known = ~np.isnan(score)
    changed = known & (np.concatenate([[np.nan], score[:-1]]) != score)
    yield from ((name, int(ms), float(score[ms])) for ms in np.flatnonzero(changed))


def write(folder: Path, made: Predictions, truth: Mapping[str, Truth]) -> None:
    """Write predictions as the tables that `read` reads, each complete or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    for task, rows in rows_of(made, truth):
        with taking_the_place_of(folder / f"{task}.csv") as temporary, temporary.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS[task], *rows])
