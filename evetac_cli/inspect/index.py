"""index: make the index of a data set, or bring it up to date; and what `info FOLDER` answers from it."""

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

HIDDEN = ("changed_ns", "inode", "dot_radius_px", "grid")  # what tells whether a row, or an output, is up to date
NAMES = tuple(name for name in IndexRow._fields if name not in HIDDEN)  # that --where knows, and a row shows
SHOWN = ("path", "object", "sensor", "seed", "trial", "outcome")
COUNTED = ("object", "sensor", "scene", "outcome")  # of each kind of file, a table each
MOST_UNREADABLE = 20  # of the files that are named with their reasons
MISSING = "none"
TRUTH: dict[str, Any] = {"yes": 1, "no": 0}  # as simulated is shown in a table


# Stage files, broken ones among them; all others are FOREIGN.
_OURS = "(kind IS NOT NULL OR error IS NOT NULL)"
_TOTALS = f"SELECT COUNT(CASE WHEN {_OURS} THEN 1 END), COUNT(error), MAX(simulated) FROM files"
# Recordings that slip by their truth, or by labels that were made from them.
_SLIPPING = (
    "kind = 'recording' AND (outcome = 'slips' OR (outcome IS NULL AND recipe_id IN"
    " (SELECT recording FROM files WHERE kind = 'labels' AND outcome = 'slips')))"
)


@contextmanager
def indexed(folder: Path, progress: Progress, describe_files: Describe = one_by_one) -> Iterator[Index]:
    """The index of a folder, up to date; what lies in its place and is none is said."""
    with open_index(folder, progress, describe_files) as index:
        if index.note:
            say(f"{folder}: {index.note}")
        yield index


def run(folders: list[Path], progress: Progress = silent, describe_files: Describe = one_by_one) -> Outcome:
    """A row for every folder: how many files it has, and how many had to be read for that."""
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
    """What a data set holds: counts of its files, covariates of its slips; with conditions (`object=3`) its files."""
    where, values = _condition(conditions)
    with indexed(folder, progress) as index:
        rows = _files(index, where, values) if conditions else list(_counts(index))
        files, unreadable, _ = _one(index, _TOTALS)
        simulated = _one(index, f"SELECT MAX(simulated) FROM files WHERE {where}", values)[0]
        summary = {"folder": str(folder), "files": files, "unreadable": unreadable, "foreign": _foreign(index)}
        if not conditions:
            covariates, said = _covariates(index, folder, progress)
            rows, summary = rows + covariates, summary | said
    if conditions:
        summary["fit"] = len(rows)
    return Outcome(rows, bool(simulated), summary)


def for_people(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of files with the columns that fit into a terminal: --json has all; other rows stay as they are."""
    broken = any(row.get("error") for row in rows)
    names = ("path", "error") if broken else SHOWN
    return [{name: row[name] for name in names} if "path" in row else row for row in rows]


def _files(index: Index, where: str, values: list[Any]) -> list[dict[str, Any]]:
    rows = [{name: getattr(row, name) for name in NAMES} for row in index.rows(where, values)]
    for row in rows:
        row["simulated"] = None if row["simulated"] is None else bool(row["simulated"])
    return rows


def _covariates(index: Index, folder: Path, progress: Progress) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows of covariates of the recordings that slip, and of how many they are; nothing where none does."""
    names = [row.path for row in index.rows(_SLIPPING)]
    if not names:
        return [], {}
    from evetac_cli.inspect import info_slip  # with what reads recordings, which an index does without

    return info_slip.of_folder(folder, names, progress)


def _foreign(index: Index) -> int:
    return int(_one(index, f"SELECT COUNT(*) FROM files WHERE {FOREIGN}")[0])


def _counts(index: Index) -> list[dict[str, Any]]:
    """Counts of files by kind, and of each kind by object, sensor, scene and outcome; files that cannot be read."""
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
    """SQL of `NAME=VALUE` conditions, all of which have to hold; InputError for a name that there is not.

    A value is a text, a number, a range of whole numbers (`7-9`), `none`, or several of these with commas.
    """
    parts: list[str] = []
    values: list[Any] = []
    for condition in conditions:
        name, _, wanted = condition.partition("=")
        if not wanted or name not in NAMES:
            near = get_close_matches(name, NAMES, n=1)
            raise InputError(
                "no such condition",
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
                # As bytes, for a path need not be text; what is stored of other texts has its odd bytes spelt out.
                ways.append(f"{name} = ?" if name == "simulated" else f"CAST({name} AS BLOB) = ?")
                wanted_bytes = os.fsencode(value) if name == "path" else as_utf8(value).encode()
                values.append(TRUTH.get(value, as_utf8(value)) if name == "simulated" else wanted_bytes)
        parts.append(f"({' OR '.join(ways)})")
    return " AND ".join(parts) or "1", values
