"""Tables that a script measures by itself, as results.py shows them, with the commit that they were made by."""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from likeness_trials import commit_in_words

from evetac_cli.jobs import Row

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results"


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
) -> Row:
    """A table of simulated rows: heading -> cell of each column, the command that makes it, and what it was made of."""
    made = commit_in_words()
    return {
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
    }


def models_in_words(given: Sequence[str]) -> str:
    """What --model was given, NAME=FILE each, as a command that shows no folder."""
    named = (each.partition("=") for each in given)
    return " ".join(shlex.quote(f"{name}={Path(path).name}") for name, _, path in named)


def write(folder: Path, *tables: Row) -> None:
    """Write tables as NAME.json into a folder, and say where they are."""
    for table in tables:
        path = folder / f"{table['name']}.json"
        path.write_text(json.dumps(table, indent=1) + "\n")
        sys.stdout.write(f"{path}\n")
