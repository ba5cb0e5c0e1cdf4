"""A stored table as Markdown: its rows, the paper's figures beside them, how it was made.

A result file has flat rows and describes how to show them. `columns` lists a heading and a cell for each column, as
Python format strings over a row. If rows are spread over columns, `across` describes one column for each distinct
heading. A figure from the paper is shown in brackets with its mark. Both come from evetac_cli/evaluate, for
the row and the `source` of its table. `methods` lists the method version of each command that made the data. Versions
that have changed since are listed above the table.
"""

import re
import string
from collections.abc import Iterable
from typing import Any

from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.common.marks import Source
from evetac_cli.jobs import Row
from scripts.reproduce import facts
from scripts.reproduce.facts import ROOT, method, ranges

Result = dict[str, Any]
MOST_ROWS = 10  # of a table that a page shows unfolded


def keys(template: str) -> list[str]:
    """Return the names used in a format string."""
    return [name for _, name, _, _ in string.Formatter().parse(template) if name]


def fill(template: str, row: Row) -> str:
    """Fill in a format string from a row.

    A part between commas is dropped if the row lacks one of its figures. A bool is shown as yes or no.
    """
    parts = template.split(", ")
    shown = {key: ("no", "yes")[value] if isinstance(value, bool) else value for key, value in row.items()}
    return ", ".join(part.format(**shown) for part in parts if all(row.get(key) is not None for key in keys(part)))


def published(column: Row, row: Row, result: Result) -> tuple[str, str]:
    """Return the paper's figures for a cell and their comparison mark, both empty if the paper has none."""
    source = Source.from_json(result.get("sources", {}).get(row.get("evaluation")) or result.get("source", {}))
    known = {key: beside for key in keys(column.get("paper", "")) if (beside := PAPER.beside(key, row, source))}
    if not known:
        return "", ""
    (mark,) = {beside.mark for beside in known.values()}  # figures of one row and column share their mark
    return fill(column["paper"], {key: beside.value for key, beside in known.items()}), mark


def cell(column: Row, row: Row, result: Result) -> str:
    """Return evetac's figure, followed by the paper's figure and its mark in brackets."""
    ours = fill(column["cell"], row)
    figures, mark = published(column, row, result)
    return f"{ours} ({figures}, {mark})" if figures else ours


def lines(result: Result) -> list[list[str]]:
    """Return the headings of a table, then its rows, as text."""
    columns, across = result["columns"], result.get("across")
    heads = [column["heading"] for column in columns]
    if across is None:
        return [heads, *([cell(column, row, result) for column in columns] for row in result["rows"])]
    spread = list(dict.fromkeys(fill(across["heading"], row) for row in result["rows"]))
    groups: dict[tuple[str, ...], dict[str, str]] = {}
    for row in result["rows"]:
        group = groups.setdefault(tuple(cell(column, row, result) for column in columns), {})
        group[fill(across["heading"], row)] = cell(across, row, result)
    return [
        [*heads, *spread],
        *([*first, *(group.get(head, "") for head in spread)] for first, group in groups.items()),
    ]


def changes(result: Result) -> list[str]:
    """Return a text such as `label 5 (now 6)` for each command whose method has changed since the result was made."""
    return [
        f"{command} {number} (now {today})"
        for command, number in result["methods"].items()
        if (today := method(command)) != number
    ]


def how_made(result: Result) -> str:
    """Return a sentence with the seeds, core hours and computer behind a result; its file also has the commands."""
    words = f"Commands: `docs/results/{result['name']}.json`"
    scripts = [ROOT / word for command in result["commands"] for word in command.split() if word.startswith("scripts/")]
    if not all(script.exists() for script in scripts):
        words += ", by a script that was removed after that commit"
    sizes = result.get("sizes") or {}
    for what, name in (("recordings", "recording_seeds"), ("trainings", "training_seeds")):
        if seeds := sizes.get(name):
            words += f"; seeds of {what} {ranges(seeds)}"
    return "; ".join(filter(None, [words, facts.in_words(result)])) + "."


def as_table(heads: list[str], rows: Iterable[list[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (heads, ["---"] * len(heads), *rows))


def folded(heading: str, parts: Iterable[str]) -> str:
    """Return parts of a page that open when the heading is clicked, on GitHub as on the site."""
    summary = re.sub("`([^`]*)`", r"<code>\1</code>", heading)
    return "\n\n".join(['<details markdown="1">', f"<summary>{summary}</summary>", *parts, "</details>"])


def text(result: Result) -> str:
    """Return a result as Markdown: title, table, notes and seeds; a table of more than ten rows is folded."""
    heads, *rows = lines(result)
    title = ("Simulated. " if result["simulated"] else "") + result["title"]
    made = result["made"]
    if older := changes(result):
        made += f"; older method versions: {', '.join(older)}"
    parts = [as_table(heads, rows), *result["notes"], how_made(result)]
    if len(rows) > MOST_ROWS:
        return folded(f"{title} ({made}), {len(rows)} rows", parts) + "\n"
    return "\n\n".join([f"{title} ({made}):", *parts]) + "\n"


def as_figure(value: Any) -> str:
    """Return a value of a row as text, with three significant digits for a float below 100."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def measured_text(stored: Row) -> str:
    """Return a stored table of run times as Markdown: a sentence, and the rows."""
    heads = list(dict.fromkeys(key for row in stored["rows"] for key in row))
    rows = [[as_figure(row.get(key)).replace("_", " ") for key in heads] for row in stored["rows"]]
    table = as_table([head.replace("_", " ") for head in heads], rows)
    heading = stored["conditions"]
    return (folded(heading, [table]) if len(rows) > MOST_ROWS else f"{heading}:\n\n{table}") + "\n"
