"""index: build or update the index of a data set; and the answers of `info FOLDER`, which uses the index."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from evetac_cli.console import print_table, say
from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.store.index import FOREIGN, Describe, Index, IndexRow, one_by_one, open_index
from evetac_cli.text_files import as_utf8

HIDDEN = ("changed_ns", "inode", "dot_radius_px", "grid")  # used to check whether a row, or an output, is up to date
NAMES = tuple(name for name in IndexRow._fields if name not in HIDDEN)  # columns for --where, shown in rows
SHOWN = ("path", "object", "sensor", "seed", "trial", "outcome")
COUNTED = ("object", "sensor", "scene", "outcome")  # a table of counts for each
MOST_UNREADABLE = 20  # files that are listed with their reasons
MISSING = "none"
TRUTH: dict[str, Any] = {"yes": 1, "no": 0}  # values of `simulated` as shown in a table


# Stage files, including damaged ones; all others are FOREIGN.
_OURS = "(kind IS NOT NULL OR error IS NOT NULL)"
_TOTALS = f"SELECT COUNT(CASE WHEN {_OURS} THEN 1 END), COUNT(error), MAX(simulated) FROM files"
# Recordings that slip according to their truth, or to labels made from them.
_SLIPPING = (
    "kind = 'recording' AND (outcome = 'slips' OR (outcome IS NULL AND recipe_id IN"
    " (SELECT recording FROM files WHERE kind = 'labels' AND outcome = 'slips')))"
)


@contextmanager
def indexed(folder: Path, progress: Progress, describe_files: Describe = one_by_one) -> Iterator[Index]:
    """Open the up-to-date index of a folder; print a note if a file with its name is not an index."""
    with open_index(folder, progress, describe_files) as index:
        if index.note:
            say(f"{folder}: {index.note}")
        yield index


def run(folders: list[Path], progress: Progress = silent, describe_files: Describe = one_by_one) -> Outcome:
    """Return a row for every folder: the number of its files, and of those that had to be read."""
    rows = []
    simulated = False
    for folder in folders:
        with indexed(folder, progress, describe_files) as index:
            files, unreadable, any_simulated = _one(index, _TOTALS)
            simulated |= bool(any_simulated)
            row = {"folder": str(folder), "files": files, "read": index.read, "removed": index.removed}
            rows.append({**row, "unreadable": unreadable, "foreign": _foreign(index), "stored": index.stored})
    return Outcome(rows, simulated, {"folders": len(rows)})


def show(result: Outcome) -> None:
    """Print the rows as a table."""
    print_table("index", result.rows, result.summary, simulated=result.simulated)


def answer(folder: Path, conditions: Sequence[str], progress: Progress = silent) -> Outcome:
    """Return counts of a data set's files and covariates of its slips; with conditions (`object=3`) its files."""
    where, values = _condition(conditions)
    with indexed(folder, progress) as index:
        rows = _files(index, where, values) if conditions else list(_counts(index))
        files, unreadable, _ = _one(index, _TOTALS)
        simulated = _one(index, f"SELECT MAX(simulated) FROM files WHERE {where}", values)[0]
        summary = {"folder": str(folder), "files": files, "unreadable": unreadable, "foreign": _foreign(index)}
        if not conditions:
            covariates, covariate_summary = _covariates(index, folder, progress)
            rows, summary = rows + covariates, summary | covariate_summary
    if conditions:
        summary["fit"] = len(rows)
    return Outcome(rows, bool(simulated), summary)


def for_people(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of files with the columns that fit into a terminal; --json has all. Other rows are unchanged."""
    broken = any(row.get("error") for row in rows)
    names = ("path", "error") if broken else SHOWN
    return [{name: row[name] for name in names} if "path" in row else row for row in rows]


def _files(index: Index, where: str, values: list[Any]) -> list[dict[str, Any]]:
    rows = [{name: getattr(row, name) for name in NAMES} for row in index.rows(where, values)]
    for row in rows:
        row["simulated"] = None if row["simulated"] is None else bool(row["simulated"])
    return rows


def _covariates(index: Index, folder: Path, progress: Progress) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return rows of covariates of the recordings that slip, and their number; empty if none slips."""
    names = [row.path for row in index.rows(_SLIPPING)]
    if not names:
        return [], {}
    from evetac_cli.inspect import info_slip  # imported here because an index does not need to read recordings

    return info_slip.of_folder(folder, names, progress)


def _foreign(index: Index) -> int:
    return int(_one(index, f"SELECT COUNT(*) FROM files WHERE {FOREIGN}")[0])


def _counts(index: Index) -> list[dict[str, Any]]:
    """Return counts of files by kind, per object, sensor, scene and outcome, and the files that cannot be read."""
    select = (
        "SELECT kind, COUNT(*) AS files, SUM(simulated) AS simulated, SUM(slices) AS slices,"
        " SUM(size_bytes) / 1e6 AS size_mb FROM files WHERE kind IS NOT NULL GROUP BY kind ORDER BY kind"
    )
    rows = _dicts(index, select)
    kinds = [row["kind"] for row in rows]
    for name in COUNTED:
        groups = (
            f"SELECT {name}, kind, COUNT(*) FROM files WHERE {name} IS NOT NULL AND kind IS NOT NULL"
            f" GROUP BY {name}, kind ORDER BY {name}"
        )
        by_value: dict[Any, dict[str, Any]] = {}
        for value, kind, files in index.table.execute(groups):
            by_value.setdefault(value, {name: value, **dict.fromkeys(kinds, 0)})[kind] = files
        rows += by_value.values()
    unreadable = index.rows("error IS NOT NULL")[:MOST_UNREADABLE]
    return rows + [{"unreadable": row.path, "reason": row.error} for row in unreadable]


def _dicts(index: Index, select: str) -> list[dict[str, Any]]:
    cursor = index.table.execute(select)
    names = [column[0] for column in cursor.description]
    return [dict(zip(names, row, strict=True)) for row in cursor]


def _one(index: Index, select: str, values: Sequence[Any] = ()) -> Any:
    return index.table.execute(select, values).fetchone()


def _condition(conditions: Sequence[str]) -> tuple[str, list[Any]]:
    """Return SQL for `NAME=VALUE` conditions that must all be satisfied; raise InputError for an unknown name.

    A value is a text, a number, a range of whole numbers (`7-9`), `none`, or several of these separated by commas.
    """
    parts: list[str] = []
    values: list[Any] = []
    for condition in conditions:
        name, _, wanted = condition.partition("=")
        if not wanted or name not in NAMES:
            near = get_close_matches(name, NAMES, n=1)
            raise InputError(
                "not a valid condition",
                where="--where",
                expected=f"NAME=VALUE, with a NAME of {', '.join(NAMES)}",
                found=condition,
                hint=f"did you mean {near[0]}=...?" if near else "",
            )
        ways = []
        for value in wanted.split(","):
            if value == MISSING:
                ways.append(f"{name} IS NULL")
            elif limits := re.fullmatch("([0-9]{1,18})-([0-9]{1,18})", value):
                ways.append(f"(typeof({name}) = 'integer' AND {name} BETWEEN ? AND ?)")
                values += [int(limits[1]), int(limits[2])]
            else:
                # As bytes, because a path need not be valid text; in other stored texts, invalid bytes are escaped.
                ways.append(f"{name} = ?" if name == "simulated" else f"CAST({name} AS BLOB) = ?")
                wanted_bytes = os.fsencode(value) if name == "path" else as_utf8(value).encode()
                values.append(TRUTH.get(value, as_utf8(value)) if name == "simulated" else wanted_bytes)
        parts.append(f"({' OR '.join(ways)})")
    return " AND ".join(parts) or "1", values
