"""Read a small table, CSV or Parquet, as columns of text: of predictions, for a strict check by the caller."""

import csv
import io
from pathlib import Path

from evetac_cli.errors import InputError, missing_extra
from evetac_cli.text_files import read_text

MOST_BYTES = 1 << 30
PARQUET = ".parquet"
Cells = dict[str, list[str]]


def read_columns(path: Path, names: tuple[str, ...]) -> Cells:
    """Return the cells of a table by column, as text; an unknown value is an empty text.

    InputError if the columns are not exactly `names`, in any order, or a line has another number of cells.
    MissingLibrary for Parquet without pyarrow.
    """
    found = _parquet(path) if path.suffix == PARQUET else _csv(path, names)
    if sorted(found) != sorted(names):
        _refuse_columns(path, names, list(found))
    return found


def _refuse_columns(path: Path, names: tuple[str, ...], found: list[str]) -> None:
    raise InputError(
        "other columns", where=f"{path}, line 1", expected=", ".join(names), found=", ".join(found)[:200] or "none"
    )


def _csv(path: Path, names: tuple[str, ...]) -> Cells:
    rows = csv.reader(io.StringIO(read_text(path, MOST_BYTES).removeprefix("\ufeff"), newline=""))
    head = [cell.strip() for cell in next(rows, [])]
    if sorted(head) != sorted(names):
        _refuse_columns(path, names, head)
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


def _parquet(path: Path) -> Cells:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:
        raise missing_extra("Parquet needs the library pyarrow", "convert", where=str(path)) from None
    try:
        table = parquet.read_table(path)
    except (OSError, ArrowException) as error:
        raise InputError(f"not a Parquet table: {error}", where=str(path)) from None
    return {
        name: ["" if value is None else str(value) for value in column.to_pylist()]
        for name, column in zip(table.column_names, table.columns, strict=True)
    }
