"""info FOLDER: counts of a data set's files, or those that satisfy conditions."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.store.data_set import FileRow, foreign_files, read_data_set
from evetac_cli.text_files import as_utf8

NAMES = FileRow._fields  # columns for --where
SHOWN = ("path", "object", "sensor", "seed", "trial", "outcome")
COUNTED = ("object", "sensor", "scene", "outcome")  # a table of counts for each
MOST_UNREADABLE = 20  # files that are listed with their reasons
MISSING = "none"
RANGE = re.compile("([0-9]{1,18})-([0-9]{1,18})")


def answer(folder: Path, conditions: Sequence[str], progress: Progress = silent) -> Outcome:
    """Return counts of a data set's files; with conditions (`object=3`) its files."""
    fits = [_condition(condition) for condition in conditions]
    every = read_data_set(folder, progress)
    selected = [row for row in every if all(fit(row) for fit in fits)]
    foreign = len(foreign_files(every))
    unreadable = sum(row.error is not None for row in every)
    totals = {"files": len(every) - foreign, "unreadable": unreadable, "foreign": foreign}
    summary: dict[str, Any] = {"folder": str(folder), **totals}
    if conditions:
        rows = [row._asdict() for row in selected]
        summary["fit"] = len(rows)
    else:
        rows = _counts(every)
    return Outcome(rows, any(row.simulated for row in selected), summary)


def for_people(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of files with the columns that fit into a terminal; --json has all. Other rows are unchanged."""
    broken = any(row.get("error") for row in rows)
    names = ("path", "error") if broken else SHOWN
    return [{name: row[name] for name in names} if "path" in row else row for row in rows]


def _counts(rows: Sequence[FileRow]) -> list[dict[str, Any]]:
    """Return counts of files by kind, per object, sensor, scene and outcome, and the files that cannot be read."""
    by_kind: dict[str, list[FileRow]] = {}
    for row in rows:
        if row.kind is not None:
            by_kind.setdefault(row.kind, []).append(row)
    kinds = sorted(by_kind)
    counts: list[dict[str, Any]] = []
    for kind in kinds:
        lengths = [row.slices for row in by_kind[kind] if row.slices is not None]
        numbers = {"files": len(by_kind[kind]), "simulated": sum(bool(row.simulated) for row in by_kind[kind])}
        sizes = {"slices": sum(lengths) if lengths else None, "size_mb": sum(r.size_bytes for r in by_kind[kind]) / 1e6}
        counts.append({"kind": kind, **numbers, **sizes})
    for name in COUNTED:
        numbers_of = {kind: Counter(getattr(row, name) for row in by_kind[kind]) for kind in kinds}
        values = {value for of_kind in numbers_of.values() for value in of_kind if value is not None}
        ordered = sorted(values, key=lambda value: (isinstance(value, str), value))
        counts += [{name: value, **{kind: numbers_of[kind][value] for kind in kinds}} for value in ordered]
    unreadable = [row for row in rows if row.error is not None][:MOST_UNREADABLE]
    return counts + [{"unreadable": row.path, "reason": row.error} for row in unreadable]


def _condition(condition: str) -> Callable[[FileRow], bool]:
    """Return a function that returns whether a row satisfies `NAME=VALUE`; raise InputError for an unknown name.

    A value is a text, a number, a range of whole numbers (`7-9`), `none`, or several of these separated by commas.
    """
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
    ranges = [(int(limits[1]), int(limits[2])) for limits in map(RANGE.fullmatch, wanted.split(",")) if limits]
    # A path need not be valid text; in other texts, invalid bytes are escaped.
    texts = {text for value in wanted.split(",") if value != MISSING for text in (value, as_utf8(value))}

    def fits(row: FileRow) -> bool:
        value = getattr(row, name)
        if value is None:
            return MISSING in wanted.split(",")
        if isinstance(value, bool):
            return ("yes" if value else "no") in texts
        return str(value) in texts or (isinstance(value, int) and any(low <= value <= high for low, high in ranges))

    return fits
