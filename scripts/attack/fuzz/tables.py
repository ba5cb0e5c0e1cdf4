"""Write and damage a data set, a Parquet table and a sensor's file.

A Parquet table is rewritten with other types, rows, pages and names, or single bytes are damaged.
"""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.text_files import as_toml
from scripts.attack.fuzz.plain_files import Rng, damage_bytes

DATA = ("first.recording.h5", "first.tracks.h5", "first.labels.h5", "piece.recording.h5", "events.h5")
TYPES = ("int8", "uint64", "float16", "float32", "float64", "bool", "string", "binary", "timestamp[ns]", "date32",
         "decimal128(38, 10)", "duration[us]", "large_string", "null")  # fmt: skip


def write(folder: Path) -> None:
    """Write the folder `data`, and a complete sensor as TOML."""
    (folder / "data").mkdir()
    for name in DATA:
        shutil.copy(folder / name, folder / "data")
    (folder / "own.sensor.toml").write_text(as_toml({"name": "own", **as_table(one_sensor("evetac"))}))


def damage_parquet(path: Path, rng: Rng) -> str:
    """Rewrite a table with one change, or damage its bytes."""
    if rng.random() < 0.3:
        return damage_bytes(path, rng)
    try:
        table = pq.read_table(path)
        if table.num_rows > 1_000_000:
            return "large already"
        change = PARQUET[rng.integers(len(PARQUET))]
        table, description = change(table, rng)
        pq.write_table(table, path, **_options(rng, table.num_rows * table.num_columns // 4))
    except (pa.ArrowException, OSError, ValueError, TypeError, NotImplementedError) as error:
        return f"not possible ({type(error).__name__})"
    return description


def _options(rng: Rng, rows: int) -> dict[str, object]:
    return {
        "compression": str(rng.choice(["none", "snappy", "gzip", "zstd", "lz4", "brotli"])),
        "use_dictionary": bool(rng.random() < 0.5),
        "data_page_version": str(rng.choice(["1.0", "2.0"])),
        "data_page_size": int(rng.choice([1, 1000, 1 << 20, 1 << 30])),
        "row_group_size": max(int(rng.choice([1, 7, 1 << 20])), rows // 10_000),  # more groups take minutes to write
        "store_schema": bool(rng.random() < 0.5),
    }


def _column(table: pa.Table, rng: Rng) -> int:
    return int(rng.integers(table.num_columns))


def _put(table: pa.Table, at: int, column: object) -> pa.Table:
    return table.set_column(at, table.column_names[at], column)


def _type(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    at, kind = _column(table, rng), str(rng.choice(TYPES))
    wanted = pa.decimal128(38, 10) if kind.startswith("decimal") else pa.type_for_alias(kind)
    return _put(table, at, table.column(at).cast(wanted, safe=False)), f"{table.column_names[at]} as {kind}"


def _nested(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    at, rows = _column(table, rng), range(table.num_rows)
    values: Sequence[object] = [[row] * int(rng.integers(4)) for row in rows] if rng.random() < 0.5 else [
        {"a": row, "b": {"t_ms": row}} for row in rows]  # fmt: skip
    return _put(table, at, pa.array(values)), f"{table.column_names[at]} nested"


def _odd(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    at = _column(table, rng)
    values = np.zeros(table.num_rows)
    number = float(rng.choice([np.nan, np.inf, -np.inf, 1e308, -0.0, 2.0**63, -1.0]))
    values[rng.integers(max(1, table.num_rows)) :] = number
    return _put(table, at, pa.array(values)), f"{table.column_names[at]} = {number}"


def _nulls(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    at = _column(table, rng)
    mask = rng.random(table.num_rows) < 0.5
    return _put(table, at, pa.array(np.arange(table.num_rows), mask=mask)), f"{table.column_names[at]} with nulls"


def _many(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    count = int(10 ** rng.uniform(1, 7.2)) // max(1, table.num_columns)
    columns = [pa.array(np.zeros(count, np.int64)) for _ in table.column_names]
    return pa.Table.from_arrays(columns, names=table.column_names), f"{count} equal rows"


def _text(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    size = min(int(10 ** rng.uniform(2, 7)), 10**8 // max(1, table.num_rows))  # for all rows, if each row has it
    column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(table.num_rows, np.int32)), pa.array(["x" * size]))
    return _put(table, _column(table, rng), column), f"a text of {size} in each row"


def _names(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    names = list(table.column_names)
    names[_column(table, rng)] = str(rng.choice([*names, "", "t_s", "a.b", "x" * 5000, "\x1b[2J", "t_ms [s]", "=1"]))
    return table.rename_columns(names), f"names {[name[:10] for name in names]}"


def _wide(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    count = int(rng.integers(1, 700))
    columns = [table.column(_column(table, rng)) for _ in range(count)]
    return pa.Table.from_arrays(columns, names=[f"c{at}_t_ms" for at in range(count)]), f"{count} columns"


PARQUET: tuple[Callable[[pa.Table, Rng], tuple[pa.Table, str]], ...] = (
    _type, _type, _nested, _odd, _odd, _nulls, _many, _text, _names, _wide,
)  # fmt: skip

FAMILIES: dict[str, Callable[[Path, Rng], str]] = {"parquet": damage_parquet}
