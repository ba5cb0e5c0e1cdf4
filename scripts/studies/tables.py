"""Build and write the tables that scripts measure directly, in the format of results.py and with their commit."""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from evetac_cli.jobs import Row
from scripts.reproduce import run_facts
from scripts.studies.likeness.trials import commit_in_words

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"


def table_of(
    name: str,
    title: str,
    columns: dict[str, str],
    rows: list[Row],
    command: str,
    sizes: dict[str, Any],
    *,
    across: dict[str, str] | None = None,
    notes: Sequence[str] = (),
    hours: float | None = None,
) -> Row:
    """Return a table of simulated rows, with the current commit and computer.

    columns: the cell (a format string over a row) of each heading; command: the command that makes the table; sizes:
    seeds and numbers of trials; hours: core hours spent, if they were measured.
    """
    made = commit_in_words()
    table = {
        "name": name,
        "title": title,
        "simulated": True,
        "made": f"commit {made}",
        "commit": made.partition(",")[0],
        "uncommitted_changes": "," in made,
        "commands": [command],
        "methods": {},
        "recipe_ids": [],
        "sizes": sizes,
        "columns": [{"heading": heading, "cell": cell} for heading, cell in columns.items()],
        "across": across,
        "notes": list(notes),
        "rows": rows,
        "machine": run_facts.machine(),
        **({} if hours is None else {"hours": hours}),
    }
    return table | run_facts.of_freeze(table)


def models_in_words(given: Sequence[str]) -> str:
    """Return the values of --model, NAME=FILE each, as part of a command, without the files' folders."""
    named = (each.partition("=") for each in given)
    return " ".join(shlex.quote(f"{name}={Path(path).name}") for name, _, path in named)


def write(folder: Path, *tables: Row) -> None:
    """Write tables as NAME.json into a folder, and print their paths."""
    for table in tables:
        path = folder / f"{table['name']}.json"
        path.write_text(json.dumps(table, indent=1) + "\n")
        sys.stdout.write(f"{path}\n")
