"""Parse the seeds given to a script, and append its results to a file as JSON lines."""

import argparse
import json
import re
from collections.abc import Iterable
from pathlib import Path

from evetac_cli.jobs import Row, Rows


def seeds_of(text: str) -> range:
    """Parse FIRST-LAST, or one number, into seeds; ArgumentTypeError, for argparse, if it is invalid."""
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
    if first > last:
        raise argparse.ArgumentTypeError(f"expected FIRST-LAST, such as 0-99, found {text}")
    return range(first, last + 1)


def rows_in(path: Path) -> Rows:
    """Return the rows of a file, or none if it does not exist; SystemExit for an invalid line."""
    rows: Rows = []
    for number, line in enumerate(path.read_text().splitlines() if path.exists() else [], 1):
        try:
            row = json.loads(line)
        except ValueError:
            row = None
        if not isinstance(row, dict):
            raise SystemExit(f"{path}, line {number}: expected a row, found {line[:40]!r}; delete that line")
        rows.append(row)
    return rows


def add_rows(path: Path, rows: Iterable[Row]) -> None:
    """Append rows to a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.writelines(json.dumps(row) + "\n" for row in rows)
