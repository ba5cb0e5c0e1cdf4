"""Write the files of a data set that describe it for lerobot: tasks, one row per episode, and JSON."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evetac_cli.formats.write.lerobot.episode_files import EpisodePlace
from evetac_cli.formats.write.lerobot.statistics import Figures, as_lists


def place_columns(what: str, place: EpisodePlace) -> dict[str, int]:
    """Return the location of an episode as columns of its row."""
    return {f"{what}/chunk_index": place.chunk, f"{what}/file_index": place.file}


def episode_table(
    arrow: Any,
    lies: Mapping[str, Any],
    statistics: Mapping[str, Figures],
    facts: Mapping[str, Any],
    types: Mapping[str, Any],
) -> Any:
    """Return the row of an episode: the locations of its frames and pictures, its statistics, and its trial's facts."""
    row = dict(lies)
    for name, figures in as_lists(statistics).items():
        row |= {f"stats/{name}/{figure}": value for figure, value in figures.items()}
    table = arrow.Table.from_pylist([row])
    for name, type_ in types.items():
        value = facts[name]
        value = str(value) if type_ == "string" and value is not None else value
        table = table.append_column(name, arrow.array([value], arrow.type_for_alias(type_)))
    return table


def write_tasks(arrow: Any, path: Path, tasks: Sequence[str]) -> None:
    """Write the tasks in the form of a pandas table with the tasks as index, which lerobot expects."""
    text = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    index = {"name": "task", "field_name": "task", **text}
    number = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    head = {"name": None, "field_name": None, **text, "metadata": {"encoding": "UTF-8"}}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [head],
        "columns": [{**number, "metadata": None}, index],
        "creator": {"library": "pyarrow", "version": arrow.__version__},
        "pandas_version": "2.2.0",
    }
    table = arrow.table({"task_index": arrow.array(range(len(tasks)), arrow.int64()), "task": arrow.array(tasks)})
    arrow.parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def write_json(path: Path, content: Any) -> None:
    """Write one of the JSON files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False), encoding="utf-8")
