"""A benchmark's folder: its tables, its recordings, the instants at which dots and forces are judged, and the truth.

Only the scorer reads the truth.
"""

import csv
import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.errors import InputError
from evetac_cli.evaluate.slip.warnings import slip_begins
from evetac_cli.store.hdf5.checked_hdf5 import CheckedHdf5
from evetac_cli.text_files import MOST_JSON_BYTES, parse_json, read_text

NAME, VERSION = "evetac-bench", 2
ABOUT = "benchmark.json"
MADE_BY = "make benchmark (docs/benchmark.md)"
MOST_TABLE_BYTES = 1 << 30
Cells = dict[str, list[str]]
TRUTH_COLUMNS = ("recording", "true_sensor", "true_object", "motion", "seed")
DATASETS = (
    *("slip", "visible_slip_share", "normal_force_n", "onset_ms"),
    *("dots_ms", "dot_xy_px", "force_ms", "shear_force_n"),
)


class BenchmarkTrial(NamedTuple):
    """A recording to be judged."""

    name: str
    kind: str
    split: str
    sensor: str
    path: Path


@dataclass(frozen=True)
class Benchmark:
    """A benchmark's folder. digest: of what determines its scores; queries: task -> (recording, ms) that are judged."""

    folder: Path
    size: str
    digest: str
    entries: dict[str, BenchmarkTrial]
    mm_per_px: dict[str, float]
    queries: dict[str, list[tuple[str, int]]]

    def of_kinds(self, *kinds: str) -> list[BenchmarkTrial]:
        """Return the recordings of some kinds."""
        return [entry for entry in self.entries.values() if entry.kind in kinds]


def read(folder: Path) -> Benchmark:
    """Read the tables of a folder; InputError if it is not a benchmark of this version, or not complete."""
    about, digest = _about(folder)
    columns = read_columns(folder / "recordings.csv", ("recording", "kind", "split", "sensor"))
    rows = zip(*(columns[name] for name in ("recording", "kind", "split", "sensor")), strict=True)
    entries = {
        name: BenchmarkTrial(name, kind, split, sensor, folder / "inputs" / f"{name}.recording.h5")
        for name, kind, split, sensor in rows
    }
    if entries.keys() != about["recordings"].keys():
        where, expected = str(folder / "recordings.csv"), f"the {len(about['recordings'])} recordings of {ABOUT}"
        raise InputError("other recordings", where=where, expected=expected, found=str(len(entries)), hint=MADE_BY)
    missing = [str(entry.path) for entry in entries.values() if not entry.path.exists()]
    if missing:
        raise InputError("a recording is missing", where=missing[0], expected=f"{len(entries)} files", hint=MADE_BY)
    scales = read_columns(folder / "sensors.csv", ("sensor", "mm_per_px"))
    mm_per_px = dict(zip(scales["sensor"], map(float, scales["mm_per_px"]), strict=True))
    queries = {}
    for task in ("dots", "force"):
        instants = read_columns(folder / "queries" / f"{task}.csv", ("recording", "ms"))
        queries[task] = [(name, int(ms)) for name, ms in zip(instants["recording"], instants["ms"], strict=True)]
    return Benchmark(folder, str(about["size"]), digest, entries, mm_per_px, queries)


def _about(folder: Path) -> tuple[dict[str, Any], str]:
    """Return benchmark.json and its digest; InputError if it is not that of this version."""
    path = folder / ABOUT
    about, text = read_json(path, "not a benchmark")
    found = (about.get("name"), about.get("version")) if isinstance(about, dict) else (None, None)
    if found != (NAME, VERSION) or not isinstance(about.get("recordings"), dict):
        raise InputError("another benchmark", where=str(path), expected=f"{NAME} {VERSION}", found=f"{found}")
    return about, hashlib.sha256(text.encode()).hexdigest()


def read_json(path: Path, missing: str) -> tuple[Any, str]:
    """Return the content of a JSON file of a benchmark, and its text; InputError, with `missing`, if there is none."""
    if not path.exists():
        raise InputError(missing, where=str(path.parent), expected=path.name, hint=MADE_BY)
    text = read_text(path, MOST_JSON_BYTES)
    try:
        return parse_json(text), text
    except ValueError as error:
        raise InputError(f"not valid JSON: {error}", where=str(path)) from None


class Truth(NamedTuple):
    """The truth of a recording: in each ms, and at the instants that are judged.

    slips: gross slip in contact (slices,); share: slipping share of the visible contact; held: contact; onset_ms: first
    gross slip after the grip began to open, None without; dot_xy_px: (instants, dots, 2); shear_n: (instants, 2).
    """

    sensor: str
    object_name: str
    slips: Flags
    share: NDArray[np.float32]
    held: Flags
    onset_ms: int | None
    dots_ms: NDArray[np.int64]
    dot_xy_px: Floats
    force_ms: NDArray[np.int64]
    shear_n: Floats

    @property
    def slices(self) -> int:
        """Length of the recording in ms."""
        return len(self.slips)

    @property
    def slip_begins(self) -> list[int]:
        """The slices at which gross slip begins."""
        return slip_begins(self.slips)


def read_truth(benchmark: Benchmark) -> dict[str, Truth]:
    """Return the truth of every recording by its name; InputError if a file is missing or damaged."""
    path = benchmark.folder / "truth" / "recordings.csv"
    if not path.exists():
        raise InputError("the truth is missing", where=str(path), hint=f"scores need the folder truth/: {MADE_BY}")
    columns = read_columns(path, TRUTH_COLUMNS)
    every = {name: about for name, *about in zip(*(columns[name] for name in TRUTH_COLUMNS[:3]), strict=True)}
    missing = [name for name in benchmark.entries if name not in every]
    if missing:
        raise InputError("the truth of a recording is missing", where=str(path), expected=missing[0], hint=MADE_BY)
    return {name: _of_file(path.with_name(f"{name}.h5"), *every[name]) for name in benchmark.entries}


def _of_file(path: Path, sensor: str, object_name: str) -> Truth:
    with CheckedHdf5(path, "the truth of a recording", MADE_BY) as file:
        datasets = file.datasets()
        missing = [name for name in DATASETS if name not in datasets]
        if missing:
            raise InputError("not the truth of a recording", where=str(path), expected=missing[0], hint=MADE_BY)
        values: dict[str, Any] = {name: datasets[name][()] for name in DATASETS}
    held = np.asarray(values["normal_force_n"]) > 0.0
    onset = int(values["onset_ms"])
    return Truth(
        sensor,
        object_name,
        (np.asarray(values["slip"]) > 0) & held,
        np.asarray(values["visible_slip_share"], np.float32),
        held,
        None if onset < 0 else onset,
        np.asarray(values["dots_ms"], np.int64),
        np.asarray(values["dot_xy_px"], np.float64),
        np.asarray(values["force_ms"], np.int64),
        np.asarray(values["shear_force_n"], np.float64),
    )


def read_columns(path: Path, names: tuple[str, ...]) -> Cells:
    """Return the cells of a table by column, as text; an unknown value is an empty text.

    InputError if the columns are not exactly `names`, in any order, or a line has another number of cells.
    """
    rows = csv.reader(io.StringIO(read_text(path, MOST_TABLE_BYTES).removeprefix("\ufeff"), newline=""))
    head = [cell.strip() for cell in next(rows, [])]
    if sorted(head) != sorted(names):
        found = ", ".join(head)[:200] or "none"
        raise InputError("other columns", where=f"{path}, line 1", expected=", ".join(names), found=found)
    every: list[list[str]] = []
    for row in rows:
        if len(row) != len(head):
            expected, cells = f"{len(head)} cells: {', '.join(head)}", ",".join(row)
            raise InputError(
                "not a row of this table", where=f"{path}, line {rows.line_num}", expected=expected, found=cells[:100]
            )
        every.append(row)
    columns = [list(column) for column in zip(*every, strict=True)] if every else [[] for _ in head]
    return dict(zip(head, columns, strict=True))
