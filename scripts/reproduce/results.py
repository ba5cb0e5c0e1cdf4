"""Write the tables of docs/results/ as Markdown into the README and the pages of docs/.

    python scripts/reproduce/results.py [--results docs/results] [README.md docs/...]
    python scripts/reproduce/results.py --show slip-by-object     # prints one table, also one that no page has

Two comments in a page mark the position of a table: `<!-- table NAME -->` and `<!-- end of NAME -->`. The text made
from docs/results/NAME.json is written between them; pages have only some of the tables. The README's table `summary`
takes one cell from each of several tables. studies/likeness/tables.py makes the tables of docs/evidence/likeness.md.
Tables of run times, in measured/, have their own mark, `<!-- measured NAME -->`. `freeze` marks the sentences on the
frozen commit, with the number of frozen files that have changed since.

A result file has flat rows and describes how to show them. `columns` lists a heading and a cell for each column, as
Python format strings over a row. If rows are spread over columns, `across` describes one column for each distinct
heading. A figure from the paper is shown in brackets with its mark. Both come from evetac_cli/evaluate, for
the row and the `source` of its table. `methods` lists the method version of each command that made the data. Versions
that have changed since are listed above the table.
"""

import argparse
import importlib
import json
import re
import string
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from evetac_cli.cli.config import with_config
from evetac_cli.evaluate.common.source import Source
from evetac_cli.evaluate.subjects import PAPER
from evetac_cli.jobs import Row
from scripts.paper import page as paper_page
from scripts.paper.summary import SUMMARY
from scripts.reproduce import frozen, run_facts
from scripts.studies.likeness import convergence as likeness_convergence
from scripts.studies.likeness import grid as likeness_grid
from scripts.studies.likeness import sensitivity as likeness_sensitivity
from scripts.studies.likeness import tables as likeness_tables

Result = dict[str, Any]
ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted((DOCS / "evidence").glob("*.md"))]


MEASURED = "measured"  # folder of the tables of run times, and the word of their marks
FREEZE = "freeze"  # the sentences on the frozen commit, which are no table
LIKENESS = ("likeness-counted", "likeness-off", "likeness-others")  # of public facts, by studies/likeness/tables.py
# Tables made by separate scripts, each from its own rows in docs/results/likeness or scripts/paper/rows.json.
OF_SCRIPTS = {
    "likeness-sensitivity": likeness_sensitivity.as_page,
    "likeness-convergence": likeness_convergence.as_page,
    "likeness-grid": likeness_grid.as_page,
    "likeness-answer": lambda results, as_table: likeness_tables.answer(results) + "\n",
    "likeness-topics": lambda results, as_table: likeness_tables.topics(results) + "\n",
    **paper_page.AS_PAGES,
}
MOST_ROWS = 10  # of a table that a page shows unfolded
# The module that defines METHOD, the method version, of each command.
MODULES = {name: command.module for name, command in with_config().items()}
MODULES["train-force --method touch"] = "stages.force.adapt_touch"


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


def method(command: str) -> int:
    """Return the current method version of a command."""
    return int(importlib.import_module(f"evetac_cli.{MODULES[command]}").METHOD)


def changes(result: Result) -> list[str]:
    """Return a text such as `label 5 (now 6)` for each command whose method has changed since the result was made."""
    return [
        f"{command} {number} (now {today})"
        for command, number in result["methods"].items()
        if (today := method(command)) != number
    ]


def ranges(values: Iterable[int]) -> str:
    """Return numbers as ranges, such as `1-3, 8`, or the ends if there are more than six."""
    parts: list[list[int]] = []
    for value in sorted(set(values)):
        if parts and value == parts[-1][-1] + 1:
            parts[-1].append(value)
        else:
            parts.append([value])
    if len(parts) > 6:
        return f"from {parts[0][0]} to {parts[-1][-1]}"
    return ", ".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else str(part[0]) for part in parts)


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
    return "; ".join(filter(None, [words, run_facts.in_words(result)])) + "."


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


def summary(results: Path) -> str:
    """Return the table `summary`: figures chosen from several tables, with their number of trials and the paper's.

    A row of a table that was made before the freeze says so, with its commit.
    """
    rows = []
    for figure in SUMMARY:
        result = json.loads((results / f"{figure.table}.json").read_text())
        (row,) = (each for each in result["rows"] if figure.row.items() <= each.items())
        columns = [*result["columns"], *([result["across"]] if result["across"] else [])]
        (column,) = (each for each in columns if each["heading"] == figure.heading)
        older = "" if result.get("frozen") else f" (before the freeze, {result['made']})"
        what, ours, n = figure.what.format(**row) + older, fill(column["cell"], row), figure.n.format(**row)
        rows.append([what, ours, n, *published(column, row, result)])
    return "\n" + as_table(["what", "simulated", "n", "paper", "compared"], rows) + "\n"


def fill_page(page: str, results: Path) -> str:
    """Return the page with every table in it made anew from its file in `results`."""

    def replace(match: re.Match[str]) -> str:
        if match["kind"] == MEASURED:
            stored = json.loads((results / MEASURED / f"{match['name']}.json").read_text())
            return f"{match['begin']}\n{measured_text(stored)}\n{match['end']}"
        if match["name"] == "summary":
            return f"{match['begin']}{summary(results)}\n{match['end']}"
        if match["name"] == FREEZE:
            freeze = frozen.read()
            return f"{match['begin']}\n{frozen.in_words(freeze, frozen.changed(freeze))}\n\n{match['end']}"
        if match["name"] in LIKENESS:
            return f"{match['begin']}\n{likeness_tables.as_pages(results, as_table)[match['name']]}\n{match['end']}"
        if match["name"] in OF_SCRIPTS:
            return f"{match['begin']}\n{OF_SCRIPTS[match['name']](results, as_table)}\n{match['end']}"
        result = json.loads((results / f"{match['name']}.json").read_text())
        return f"{match['begin']}\n{text(result)}\n{match['end']}"

    pattern = (
        r"(?P<begin><!-- (?P<kind>table|measured) (?P<name>[\w-]+) -->\n)(?:.*?)(?P<end><!-- end of (?P=name) -->)"
    )
    return re.sub(pattern, replace, page, flags=re.DOTALL)


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


def main() -> None:
    """Write the tables into the pages given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", type=Path, default=PAGES)
    parser.add_argument("--results", type=Path, default=ROOT / "docs" / "results")
    parser.add_argument("--show", metavar="TABLE", help="print one table as Markdown, and write nothing")
    chosen = parser.parse_args()
    if chosen.show:
        print(text(json.loads((chosen.results / f"{chosen.show}.json").read_text())))
        return
    for page in chosen.pages:
        page.write_text(fill_page(page.read_text(), chosen.results))


if __name__ == "__main__":
    main()
