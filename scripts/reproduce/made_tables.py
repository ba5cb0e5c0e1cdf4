"""Make a table from evaluations or from rows of a script, with its facts, and store it as docs/results/NAME.json."""

import dataclasses
import json
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.common.marks import Source
from evetac_cli.jobs import Row, Rows
from scripts.paper import rows as paper_rows
from scripts.paper import ten
from scripts.reproduce.facts import Refusal, commit_facts, facts, machine, methods, of_freeze, words_for
from scripts.reproduce.table_text import fill, keys
from scripts.reproduce.tables import Column, Evaluation, Table

COUNTS = ("recordings", "objects", "models", "training_steps", "trials")  # counts that define the size of a run


def shown_rows(table: Table, rows: list[Row]) -> list[Row]:
    """Return the figures that the table shows (all for a measured one) and the keys of the paper's figures."""
    columns = [*table.columns, *([table.across] if table.across else [])]
    wanted = {key for column in columns for part in (column.heading, column.cell, column.paper) for key in keys(part)}
    wanted |= {"evaluation", *paper_rows.needed(table.name), *ten.needed(table.name)}
    for key in wanted & PAPER.columns.keys():
        wanted |= {*PAPER.columns[key].needs, *PAPER.columns[key].may_need}
    return [{key: value for key, value in row.items() if table.measured or key in wanted} for row in rows]


def layout(column: Column) -> Row:
    """Return the layout of a column, as JSON."""
    return {"heading": column.heading, "cell": column.cell, **({"paper": column.paper} if column.paper else {})}


def result(table: Table, evaluations: dict[str, Evaluation], commands: Iterable[str]) -> Row:
    """Return a table for storage; its facts come from the reports, or from a measurement without reports."""
    headers = [evaluation.header for evaluation in evaluations.values() if evaluation.header]
    about = {key: value for evaluation in evaluations.values() for key, value in (evaluation.about or {}).items()}
    known = facts(headers) | about.pop("sizes", {})
    rows, columns = table.rows(evaluations), table.columns
    if table.measured:
        columns = tuple(column for column in columns if any(fill(column.cell, row) for row in rows))
        about["summaries"] = {name: evaluation.summary for name, evaluation in evaluations.items()}
    about |= covariates(evaluations)
    return {
        "name": table.name,
        "title": table.title.format(**words_for(known)),
        "simulated": any(evaluation.simulated for evaluation in evaluations.values()),
        **commit_facts(),
        "commands": list(commands),
        "methods": methods(headers),
        "recipe_ids": [header["id"] for header in headers],
        "sizes": known,
        "source": dataclasses.asdict(Source.of(headers)),
        "sources": sources(evaluations, rows),
        "columns": [layout(column) for column in columns],
        "across": layout(table.across) if table.across else None,
        "notes": list(table.notes),
        "rows": shown_rows(table, rows),
    } | about


def sources(evaluations: dict[str, Evaluation], rows: Rows) -> Row:
    """Return the source of each evaluation that rows name as theirs, by which the paper's figures are marked."""
    named = {row["evaluation"] for row in rows if "evaluation" in row}
    headers = {name: evaluation.header for name, evaluation in evaluations.items() if name in named}
    return {name: dataclasses.asdict(Source.of([header])) for name, header in headers.items() if header}


def covariates(evaluations: dict[str, Evaluation]) -> Row:
    """Return the covariates of the slips that a table evaluates; with several evaluations, by evaluation."""
    slips = {name: [row for row in evaluation.rows if "covariate" in row] for name, evaluation in evaluations.items()}
    if not slips or not all(slips.values()):
        return {}
    distinct: dict[str, list[Row]] = {}
    for name, rows in slips.items():
        if rows not in distinct.values():
            distinct[name] = rows
    if len(distinct) == 1:
        return {"covariates": next(iter(distinct.values()))}
    tagged = [
        {**row, "covariate": f"{name.rpartition('-')[2]}: {row['covariate']}"}
        for name, rows in distinct.items()
        for row in rows
    ]
    return {"covariates": tagged}


def extent(value: Any) -> int:
    return len(value) if isinstance(value, list) else int(value)


def smaller(new: Row, old: Row) -> list[str]:
    """Return in which counts a new table is smaller than the existing one, in words."""
    counts = ((name, extent(new["sizes"].get(name, 0)), extent(old["sizes"].get(name, 0))) for name in COUNTS)
    return [f"{name.replace('_', ' ')} {ours} (there {theirs})" for name, ours, theirs in counts if ours < theirs]


def keep(table: Row, folder: Path, *, replace: bool) -> None:
    """Write a table as JSON; Refusal if it would replace a larger run's."""
    path = folder / f"{table['name']}.json"
    if path.exists() and not replace and (less := smaller(table, json.loads(path.read_text()))):
        raise Refusal(f"{path} was not replaced, because this run is smaller: {', '.join(less)}; try --replace")
    write(folder, table)


def write(folder: Path, *tables: Row) -> None:
    """Write tables as NAME.json into a folder, each whole or not at all, and print their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    for table in tables:
        path = folder / f"{table['name']}.json"
        unfinished = path.with_suffix(".json.part")
        unfinished.write_text(json.dumps(table, indent=1) + "\n")
        unfinished.replace(path)
        sys.stdout.write(f"{path}\n")


def table_of(
    name: str,
    title: str,
    columns: dict[str, str],
    rows: list[Row],
    command: str,
    sizes: dict[str, Any],
    *,
    notes: Sequence[str] = (),
) -> Row:
    """Return a table of simulated rows that a script measured, with the current commit and computer.

    columns: the cell (a format string over a row) of each heading; command: the command that makes the table; sizes:
    seeds and numbers of trials.
    """
    table = {
        "name": name,
        "title": title,
        "simulated": True,
        **commit_facts(),
        "commands": [command],
        "methods": {},
        "recipe_ids": [],
        "sizes": sizes,
        "columns": [{"heading": heading, "cell": cell} for heading, cell in columns.items()],
        "across": None,
        "notes": list(notes),
        "rows": rows,
        "machine": machine(),
    }
    return table | of_freeze(table)


def models_in_words(given: Sequence[str]) -> str:
    """Return the values of --model, NAME=FILE each, as part of a command, without the files' folders."""
    named = (each.partition("=") for each in given)
    return " ".join(shlex.quote(f"{name}={Path(path).name}") for name, _, path in named)
