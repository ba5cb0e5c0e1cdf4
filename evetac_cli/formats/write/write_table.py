"""Write trials as tables with one row per slice: Parquet, CSV, or one Parquet data set of many trials.

The first columns are `t_ms`, the start of the slice, and the facts that identify the trial: `trial`, `object`,
`sensor`, `seed`, `outcome`, `simulated`. The columns of slice_columns.py follow. Unknown values are null; pandas shows
null as NaN, and sums in polars and duckdb skip it. In Parquet, units and meanings are metadata of the columns, and the
headers of the files are stored as JSON under `evetac` in the metadata of the table.

A data set has one file per trial in Hive-style folders `object=8/sensor=evetac/`. pandas, polars, duckdb, Spark and
pyarrow turn these folders into columns and skip folders that a query does not select. Seed and outcome are columns of
the files, because seeds are many and the outcome depends on the labels. All files have the same columns; a column
that a trial has no data for is null. If the object or sensor of any trial is unknown, that fact becomes a column of the
files too, because pandas cannot read a folder name that means null.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.formats.write.slice_columns import (
    Opener,
    SliceColumns,
    TrialFiles,
    WrittenFolder,
    columns_of,
    not_in_tables,
)
from evetac_cli.jobs import Progress
from evetac_cli.text_files import csv_text

BATCH_BYTES = 32_000_000  # slices written at once, as one row group
PARTITIONS = ("object", "sensor")
COMPRESSION = "zstd"


def load_pyarrow(where: str) -> Any:
    """Import pyarrow with the submodules that are used here; raise MissingLibrary if it is not installed."""
    with needs_extra("tables need pyarrow", "convert", where):
        import pyarrow
        import pyarrow.csv
        import pyarrow.parquet
    return pyarrow


def write_parquet(files: TrialFiles, path: Path, progress: Progress) -> list[str]:
    """Write one trial as a Parquet file; return what could not be shown."""
    arrow = load_pyarrow(str(path.parent))
    columns, facts = columns_of(files), files.facts()
    write_rows(arrow, table_schema(arrow, columns, typed([facts])), files, columns, facts, path, progress)
    return [*files.notes, *not_in_tables(files.recording)]


def write_csv(files: TrialFiles, path: Path, progress: Progress) -> list[str]:
    """Write one trial as CSV with a header line; return what could not be shown.

    Texts are escaped so that a spreadsheet does not evaluate them as formulas.
    """
    arrow = load_pyarrow(str(path.parent))
    columns = columns_of(files)
    facts = {name: csv_text(value) if isinstance(value, str) else value for name, value in files.facts().items()}
    table = table_schema(arrow, columns, typed([facts]))
    with arrow.csv.CSVWriter(path, table) as writer:
        for batch in _batches(arrow, table, files, columns, facts, progress):
            writer.write_batch(batch)
    return [*files.notes, *not_in_tables(files.recording)]


def write_data_set(
    sources: Sequence[Path],
    opened: Opener,
    folder: Path,
    progress: Progress,
    places: Sequence[tuple[str, str]] = (),
) -> WrittenFolder:
    """Write many trials as one Parquet data set in a folder; raise InputError if two trials would get the same file.

    places: the folder and the name of each trial, instead of folders by object and sensor and the recordings' names.
    """
    arrow = load_pyarrow(str(folder.parent))
    schemas, facts, slices = [], [], []
    for number, source in enumerate(sources):
        with opened(source) as files:
            facts.append({**files.facts(), **({"trial": places[number][1]} if places else {})})
            schemas.append(table_schema(arrow, columns_of(files), {}))
            slices.append(len(files.recording))
    known = [name for name in PARTITIONS if all(trial_facts[name] is not None for trial_facts in facts)]
    partitions = [] if places else known
    types = {name: type_ for name, type_ in typed(facts).items() if name not in partitions}
    table = arrow.unify_schemas([table_schema(arrow, [], types), *schemas])
    notes, done = [], 0
    for number, (source, trial_facts, rows) in enumerate(zip(sources, facts, slices, strict=True)):
        parts = [places[number][0]] if places else [_partition(name, trial_facts[name]) for name in partitions]
        path = folder.joinpath(*parts, f"{trial_facts['trial'].replace('/', '__')}.parquet")
        if path.exists():
            raise InputError("two recordings would be written to the same file", where=str(source), found=path.name)
        path.parent.mkdir(parents=True, exist_ok=True)

        with opened(source) as files:
            shown = partial(_further, progress, done, sum(slices))
            write_rows(arrow, table, files, columns_of(files), trial_facts, path, shown)
            notes += [f"{trial_facts['trial']}: {note}" for note in (*files.notes, *not_in_tables(files.recording))]
        done += rows
    simulated = any(trial_facts["simulated"] for trial_facts in facts)
    return WrittenFolder(simulated, notes, {"slices": sum(slices), "columns": len(table) + len(partitions)})


def _further(progress: Progress, before: int, of: int, now: float, total: float, doing: str = "") -> None:
    progress(before + now, of, doing)


def typed(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the types of the columns that identify trials: int64 if all values are integers, otherwise string."""
    types: dict[str, Any] = dict.fromkeys(facts[0], "string") | {"simulated": "bool"}
    for name in ("object", "seed"):
        values = [one[name] for one in facts if one[name] is not None]
        if values and all(isinstance(value, int) and abs(value) < 2**63 for value in values):
            types[name] = "int64"
    return types


def _partition(name: str, value: Any) -> str:
    return f"{name}={quote(str(value), safe='')}"


def table_schema(arrow: Any, columns: Sequence[SliceColumns], types: Mapping[str, Any]) -> Any:
    """Return Arrow's schema: time, the trial's facts, the columns; each with its unit and meaning as metadata."""
    fields = [field_of(arrow, "t_ms", arrow.int64(), "ms", "start of the slice, which lasts 1 ms")]
    fields += [
        field_of(arrow, name, arrow.type_for_alias(type_), "", f"{name} of the trial") for name, type_ in types.items()
    ]
    for group in columns:
        type_ = arrow.from_numpy_dtype(group.dtype)
        pairs = zip(group.names, group.meanings, strict=True)
        fields += [field_of(arrow, name, type_, group.unit, meaning) for name, meaning in pairs]
    return arrow.schema(fields)


def field_of(arrow: Any, name: str, type_: Any, unit: str, meaning: str) -> Any:
    """Return a field of Arrow's schema with its unit and meaning as metadata; `1` means no unit."""
    return arrow.field(name, type_, metadata={"units": unit or "1", "long_name": meaning})


def to_arrow(arrow: Any, values: NDArray[Any], missing: NDArray[np.bool_] | None = None) -> Any:
    """Return a column of numbers or booleans (rows,) as an Arrow array, null where `missing` is set; NaN stays NaN.

    By its buffers, because pyarrow imports pandas when it converts Python or numpy values, which takes longer than
    writing a trial.
    """
    column = np.ascontiguousarray(values)
    data = np.packbits(column, bitorder="little") if column.dtype == np.bool_ else column
    valid = None
    if missing is not None and missing.any():
        valid = arrow.py_buffer(np.packbits(~missing, bitorder="little"))
    return arrow.Array.from_buffers(arrow.from_numpy_dtype(column.dtype), len(column), [valid, arrow.py_buffer(data)])


def repeated(arrow: Any, value: str | int | bool | None, type_: Any, rows: int) -> Any:
    """Return a column with the same value in every row; type_: Arrow's string, int64 or bool."""
    if value is None:
        return arrow.nulls(rows, type_)
    if type_ == arrow.string():
        text = str(value).encode()
        ends = np.array([0, len(text)], np.int32)
        one = arrow.Array.from_buffers(type_, 1, [None, arrow.py_buffer(ends), arrow.py_buffer(text)])
    else:
        one = to_arrow(arrow, np.array([value], np.bool_ if type_ == arrow.bool_() else np.int64))
    return arrow.repeat(one[0], rows)


def write_rows(
    arrow: Any,
    table: Any,
    files: TrialFiles,
    columns: Sequence[SliceColumns],
    facts: Mapping[str, Any],
    path: Path,
    progress: Progress,
) -> None:
    """Write the slices of a trial as a Parquet file with all columns of the schema; missing columns are null."""
    described = table.with_metadata({"evetac": json.dumps(provenance(files, facts))})
    with arrow.parquet.ParquetWriter(path, described, compression=COMPRESSION) as writer:
        for batch in _batches(arrow, described, files, columns, facts, progress):
            writer.write_batch(batch)


def _batches(
    arrow: Any,
    table: Any,
    files: TrialFiles,
    columns: Sequence[SliceColumns],
    facts: Mapping[str, Any],
    progress: Progress,
) -> Iterator[Any]:
    """Yield the slices of a trial in batches of about BATCH_BYTES, with all columns of the schema."""
    slices = len(files.recording)
    at_once = max(1, BATCH_BYTES // (8 * len(table)))
    for first in range(0, slices, at_once):
        stop = min(first + at_once, slices)
        progress(first, slices, "slices")
        arrays = {"t_ms": to_arrow(arrow, np.arange(first, stop))}
        for group in columns:
            values = group.read(first, stop)
            mask = np.ma.getmaskarray(values)
            for at, name in enumerate(group.names):
                arrays[name] = to_arrow(arrow, values.data[:, at], mask[:, at])
        for name in facts:
            if name in table.names:
                type_ = table.field(name).type
                arrays[name] = repeated(arrow, facts[name], type_, stop - first)
        rows = [
            arrays[field.name] if field.name in arrays else arrow.nulls(stop - first, field.type) for field in table
        ]
        yield arrow.record_batch(rows, schema=table)
    progress(slices, slices, "slices")


def provenance(files: TrialFiles, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the provenance of a trial: the header of each of its files, and its sensor; ancestors appear as ids."""
    recording = files.recording
    return {
        **facts,
        "t_offset_us": int(recording.read("t_offset")),
        "sensor_datasets": {name: _plain(value) for name, value in recording.sensor_datasets().items()},
        "headers": {
            kind: {name: value for name, value in file.header.items() if name != "history"}
            for kind, file in files.by_kind.items()
        },
    }


def _plain(value: Any) -> Any:
    """Return a dataset as JSON values; NaN, which marks a missing dot, becomes null."""
    if isinstance(value, str):
        return value
    array = np.asarray(value)
    if array.dtype.kind == "f":
        array, missing = array.astype(object), np.isnan(array)
        array[missing] = None
    return array.tolist()
