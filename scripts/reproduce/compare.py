"""Compare a table that was made again with the stored one: equal rows, differences, and figures in intervals.

    python scripts/reproduce/compare.py COMMIT    # the tables of docs/results with those of an earlier commit

renamed.json lists the columns that got another name since, by file.
"""

import json
import lzma
import math
import re
import subprocess
import sys
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels.estimates import LEVEL, Estimate, cluster_weights, ratio_of_clusters, share
from scripts.reproduce.checks import Check, Figure

FEWEST = 3  # units of resampling for an interval
ROOT = Path(__file__).resolve().parents[2]
RENAMED = Path(__file__).with_name("renamed.json")


def renamed(value: Any, file: str) -> Any:
    """Return the contents of a file of docs/results with the names that its columns have now, also in cells."""
    found = json.loads(RENAMED.read_text())
    names = {old: new for pattern, pairs in found.items() if fnmatch(file, pattern) for old, new in pairs.items()}

    def of(value: Any) -> Any:
        if isinstance(value, dict):
            return {names.get(name, name): of(each) for name, each in value.items()}
        if isinstance(value, list):
            return [of(each) for each in value]
        return (
            re.sub(r"\{(\w+)", lambda cell: "{" + names.get(cell[1], cell[1]), value)
            if isinstance(value, str)
            else value
        )

    return of(value)


def changed_since(commit: str) -> list[str]:
    """Return the files of docs/results that differ from those of a commit in more than the names of columns."""
    git = ("git", "-C", str(ROOT))
    listed = subprocess.run(
        [*git, "ls-tree", "-r", "--name-only", commit, "docs/results"], capture_output=True, check=True
    )
    found = []
    for path in listed.stdout.decode().split():
        old = subprocess.run([*git, "show", f"{commit}:{path}"], capture_output=True, check=True).stdout
        now = ROOT.joinpath(path).read_bytes() if ROOT.joinpath(path).exists() else b""
        old_lines, new_lines = (_parsed(data, path) for data in (old, now))
        if renamed(old_lines, path.removeprefix("docs/results/")) != new_lines:
            found.append(path)
    return found


def _parsed(data: bytes, path: str) -> Any:
    if ".json" not in path:
        return data.hex()
    text = (lzma.decompress(data) if path.endswith(".xz") else data).decode()
    return [json.loads(line) for line in text.splitlines()] if ".jsonl" in path else json.loads(text or "null")


def named(row: Row, check: Check) -> str:
    """Return the name of a row: its columns of the key."""
    return ", ".join(str(row.get(name)) for name in check.key)


def by_key(rows: Rows, check: Check) -> dict[tuple[Any, ...], Row]:
    """Return rows by the columns that identify them."""
    return {tuple(row.get(name) for name in check.key): row for row in rows}


def differences(made: Rows, kept: Rows, check: Check) -> list[str]:
    """Return every figure in which a row made again differs from the stored one, in words, and rows of one alone."""
    ours, theirs = by_key(made, check), by_key(kept, check)
    found = [f"{named(row, check)}: only in the stored table" for key, row in theirs.items() if key not in ours]
    found += [f"{named(row, check)}: only in the table made again" for key, row in ours.items() if key not in theirs]
    for key in (key for key in theirs if key in ours):
        for name, old in theirs[key].items():
            new = ours[key].get(name)
            if name not in check.unpromised and new != old and not (new in ("", None) and old in ("", None)):
                found.append(f"{named(theirs[key], check)}: {name} {_in_words(new, old)}")
    return found


def _in_words(new: Any, old: Any) -> str:
    numbers = all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in (new, old))
    return f"{new!r} instead of {old!r}" + (f", by {new - old:.3g}" if numbers else "")


def value_of(row: Row, figure: Figure) -> float | None:
    """Return a figure of a table's row; None if the row has none."""
    above, below = row.get(figure.above), row.get(figure.below) if figure.below else 1
    return None if above is None or not below else float(above) / float(below)


def interval(trials: Rows, figure: Figure) -> Estimate | None:
    """Return a figure of trials with its 95 % interval; None with fewer than three units that have it.

    Units (objects, recordings) are resampled. For a share the interval also covers Wilson's, by the number of different
    trials, since resampling gives no width to a share of 0 or 1. For a mean it also covers Student's, by units, since
    resampling few units gives too narrow intervals.
    """
    having = [row for row in trials if row.get(figure.above) is not None]
    units = [row["unit"] for row in having]
    if len(set(units)) < FEWEST:
        return None
    above = np.array([float(row[figure.above]) for row in having])
    below = np.array([float(row[figure.below]) if figure.below else 1.0 for row in having])
    if figure.squared:
        above = above**2
    found = ratio_of_clusters(above, below, cluster_weights(units))
    if found is None:
        return None
    if figure.below or all(isinstance(row[figure.above], bool) for row in having):
        models = len(having) / len({(row.get("file"), row["unit"]) for row in having})  # several judge the same trial
        count = max(1, round(float(below.sum()) / models))
        other = share(min(count, round(found.value * count)), count)
    else:
        other = _student(above, units)
    low, high = min(found.low, other.low), max(found.high, other.high)
    if figure.squared:
        return Estimate(*(math.sqrt(max(0.0, one)) for one in (found.value, low, high)))
    return Estimate(found.value, low, high)


def _student(values: NDArray[np.float64], units: Sequence[Any]) -> Estimate:
    """Return the mean over units with Student's interval."""
    from scipy import stats

    by_unit: dict[Any, list[float]] = {}
    for unit, value in zip(units, values, strict=True):
        by_unit.setdefault(unit, []).append(float(value))
    means = np.array([np.mean(one) for one in by_unit.values()])
    half = float(stats.t.ppf((1 + LEVEL) / 2, len(means) - 1) * means.std(ddof=1) / math.sqrt(len(means)))
    return Estimate(float(means.mean()), float(means.mean()) - half, float(means.mean()) + half)


def judged(trials: Rows, made: Rows, kept: Rows, check: Check) -> Rows:
    """Return a row for every figure of the stored table that the check repeats.

    equal: the check gives the same value, as it must if all trials of the row were repeated; inside: the stored value
    is in the interval of the check; None if there is no interval.
    """
    ours = by_key(made, check)
    members: dict[tuple[Any, ...], Rows] = {}
    for trial in trials:
        members.setdefault(tuple(trial.get(name) for name in check.key), []).append(trial)
    shown = []
    for key, row in by_key(kept, check).items():
        for figure in check.figures:
            stored = value_of(row, figure)
            if key not in ours or stored is None:
                continue
            again = value_of(ours[key], figure)
            if check.trials is None:  # a ratio of counts, or a share of a count
                count = int(ours[key].get(figure.below or figure.count) or 0)
                found = share(round((again or 0.0) * count), count) if count else None
            else:
                found = interval(members.get(key, []), figure)
            near = 1e-9 * max(1.0, abs(stored))  # of the ends of the interval, which rounding moves
            inside = None if found is None else found.low - near <= stored <= found.high + near
            ends = {"low": found.low, "high": found.high} if found else {"low": None, "high": None}
            what = {"row": named(row, check), "figure": figure.name, "stored": stored, "again": again}
            shown.append({**what, **ends, "equal": again == stored, "inside": True if again == stored else inside})
    return shown


if __name__ == "__main__":
    changed = changed_since(sys.argv[1])
    print(*changed, f"{len(changed)} files of docs/results differ from those of {sys.argv[1]}", sep="\n")
    sys.exit(bool(changed))
