"""Seeds that a script is asked for, and the rows that it keeps, in JSON lines, as they come."""

import argparse
import json
import re
from collections.abc import Iterable
from pathlib import Path

from evetac_cli.jobs import Row, Rows


def seeds_of(text: str) -> range:
    """The seeds that FIRST-LAST, or one number, names; ArgumentTypeError for other text, as of `type` in argparse."""
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
    if first > last:
        raise argparse.ArgumentTypeError(f"expected FIRST-LAST, such as 0-99, found {text}")
    return range(first, last + 1)


def rows_in(path: Path) -> Rows:
    """The rows of a file, none where there is no such file; SystemExit for a line that is no row."""
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
    """Add rows to the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.writelines(json.dumps(row) + "\n" for row in rows)
