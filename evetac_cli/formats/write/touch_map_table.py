"""Write the touch maps of a trial as a Parquet table with one row per cell of each map.

The columns are `t_ms`, the start of the map's slice, the facts that identify the trial as in other tables, the centre
of the cell (`x_mm`, `y_mm`), and the map's values. Cells without contact are included, so that every map has the same
number of rows. A map becomes an image with `map.pivot(index="y_mm", columns="x_mm", values="pressure_pa")`.

Why maps are not lists in the table of slices: maps exist only every few slices, pandas stores a list as an object that
it cannot compute with, and programs interpret nested lists differently. One row per cell can be filtered, grouped and
joined on `t_ms` in pandas, polars and duckdb. To get arrays, open the touch file with xarray.
"""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, made_by
from evetac_cli.formats.arrow_columns import repeated, to_arrow
from evetac_cli.formats.write.slice_columns import TrialFiles
from evetac_cli.formats.write.write_table import COMPRESSION, field_of, load_pyarrow, provenance, typed
from evetac_cli.jobs import Progress
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.schema import Dataset

MAPS = "map/slice"
BATCH_ROWS = 250_000  # written at once, as one row group
PLACES = ("x", "y")


class CellColumn(NamedTuple):
    """A column of the table: its name, its dataset, and the index of its direction x or y, if the dataset has both."""

    name: str
    of: Dataset
    direction: int | None

    @property
    def meaning(self) -> str:
        """A text for the metadata of the column."""
        return self.of.meaning if self.direction is None else f"{self.of.meaning}, {PLACES[self.direction]}"


def cell_columns() -> list[CellColumn]:
    """Return the columns that a touch file has for each cell of each map, in the order of its schema."""
    columns = []
    for row in schema.load("touch").datasets:
        if row.dims is None or row.dims[0] != "maps" or row.path == MAPS:
            continue
        name = row.path.removeprefix("map/")
        if 2 not in row.dims:
            columns.append(CellColumn(name, row, None))
            continue
        ending = f"_{row.unit.lower()}"
        base = name.removesuffix(ending)
        columns += [CellColumn(f"{base}_{place}{ending}", row, at) for at, place in enumerate(PLACES)]
    return columns


def write(files: TrialFiles, path: Path, progress: Progress) -> list[str]:
    """Write the maps of one trial; return what was left out. Raises InputError if the trial has no touch maps."""
    arrow = load_pyarrow(str(path.parent))
    touch = files.by_kind.get("touch")
    if touch is None or not touch.has(MAPS):
        found = "no touch file next to it" if touch is None else f"{touch.path.name} without maps"
        where = str(files.recording.path)
        raise InputError("the recording has no touch maps", where=where, found=found, hint=made_by("touch"))
    facts, columns, field = files.facts(), cell_columns(), partial(field_of, arrow)
    fields = [field("t_ms", arrow.int64(), "ms", "start of the map's slice, which lasts 1 ms")]
    fields += [
        field(name, arrow.type_for_alias(type_), "", f"{name} of the trial") for name, type_ in typed([facts]).items()
    ]
    fields += [
        field(f"{place}_mm", arrow.float64(), "mm", f"{place} of the cell's centre, from the centre of the frame")
        for place in PLACES
    ]
    fields += [
        field(one.name, arrow.from_numpy_dtype(np.dtype(one.of.dtype)), one.of.unit, one.meaning) for one in columns
    ]
    table = arrow.schema(fields, metadata={"evetac": json.dumps(provenance(files, facts))})
    with arrow.parquet.ParquetWriter(path, table, compression=COMPRESSION) as writer:
        for values in _blocks(touch, columns, progress):
            arrays = {name: _column(arrow, column) for name, column in values.items()}
            rows = len(values["t_ms"])
            arrays |= {name: repeated(arrow, facts[name], table.field(name).type, rows) for name in facts}
            writer.write_batch(arrow.record_batch([arrays[one.name] for one in table], schema=table))
    return list(files.notes)


def _column(arrow: Any, values: NDArray[Any]) -> Any:
    """Return an Arrow column in which unknown values (NaN) are null, as in other tables."""
    return to_arrow(arrow, values, np.isnan(values) if values.dtype.kind == "f" else None)


def _blocks(touch: StageFile, columns: list[CellColumn], progress: Progress) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield rows in batches of several maps: one row per cell, ordered by map and row of the map."""
    x_mm, y_mm = touch.read("map/x_mm"), touch.read("map/y_mm")
    cells, maps = len(x_mm) * len(y_mm), touch.length(MAPS)
    at_once = max(1, BATCH_ROWS // max(cells, 1))
    for first in range(0, maps, at_once):
        progress(first, maps, "maps")
        slices = touch.read(MAPS, first, first + at_once)
        values = {
            "t_ms": np.repeat(slices.astype(np.int64), cells),
            "x_mm": np.tile(x_mm, len(slices) * len(y_mm)),
            "y_mm": np.tile(np.repeat(y_mm, len(x_mm)), len(slices)),
        }
        read: dict[str, NDArray[Any]] = {}
        for one in columns:
            if one.of.path not in read:
                read = {one.of.path: touch.read(one.of.path, first, first + at_once)}
            block = read[one.of.path]
            values[one.name] = (block if one.direction is None else block[:, one.direction]).reshape(-1)
        yield values
    progress(maps, maps, "maps")
