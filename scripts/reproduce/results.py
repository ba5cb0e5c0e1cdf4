"""Write the tables of docs/results/ as Markdown into the README and the pages of docs/.

    python scripts/reproduce/results.py [--results docs/results] [README.md docs/...]
    python scripts/reproduce/results.py --show slip-by-object     # prints one table, also one that no page has

Two comments in a page mark the position of a table: `<!-- table NAME -->` and `<!-- end of NAME -->`. The text made
from docs/results/NAME.json is written between them; pages have only some of the tables. scripts/paper/page.py makes
those of docs/evidence/paper.md and README's, studies/likeness/tables.py those of docs/evidence/likeness.md. Tables of
run times, in measured/, have their own mark, `<!-- measured NAME -->`. `freeze` marks the sentences on the frozen
commit, with the number of frozen files that have changed since.
"""

import argparse
import json
import re
from pathlib import Path

from scripts.paper.page import PAGES as OF_PAPER
from scripts.paper.rows import read as paper_rows
from scripts.reproduce import frozen
from scripts.reproduce.facts import RESULTS, ROOT, made_on
from scripts.reproduce.plan import EXPERIMENTS, STUDIES
from scripts.reproduce.table_text import Result, measured_text, text

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted((DOCS / "evidence").glob("*.md"))]
MEASURED = "measured"  # folder of the tables of run times, and the word of their marks
FREEZE = "freeze"  # the sentences on the frozen commit, which are no table
# Tables of pages that are made from rows of another form, in docs/results/likeness or scripts/paper/rows.json.
OF_ROWS = {**OF_PAPER, **{name: made for study in STUDIES for name, made in study.pages.items()}}


def made_from(name: str, results: Path, *, measured: bool = False) -> tuple[str, list[Result]]:
    """Return the Markdown of a mark, and the tables whose figures it shows."""

    def read(path: str) -> Result:
        table: Result = json.loads((results / f"{path}.json").read_text())
        return table

    if measured:
        table = read(f"{MEASURED}/{name}")
        return measured_text(table), [table]
    if name == FREEZE:
        freeze = frozen.read()
        return f"{frozen.in_words(freeze, frozen.changed(freeze))}\n\n{made_with(freeze, results)}\n", []
    if name in OF_ROWS:
        if name in OF_PAPER:
            tables = sorted({row["table"] for row in paper_rows()["rows"] if "table" in row})
            return OF_PAPER[name](results), [read(table) for table in tables if (results / f"{table}.json").exists()]
        own = name.replace("-", "/", 1)  # likeness-grid is made from likeness/grid
        return OF_ROWS[name](results), [read(own if (results / f"{own}.json").exists() else "likeness/after")]
    table = read(name)
    return text(table), [table]


def made_with(freeze: frozen.Freeze, results: Path) -> str:
    """Return, in words, the tables that were made with frozen methods, with core hours, and those of before."""
    made, before = {}, []
    for experiment in EXPERIMENTS:
        for table in experiment.tables if experiment.published else ():
            path = results / f"{table.name}.json"
            stored = json.loads(path.read_text()) if path.exists() else {}
            if stored.get("frozen") == freeze.commit[:8]:
                made[experiment.name] = stored["hours"]
            elif stored:
                before.append(f"`{table.name}`")
    each = ", ".join(f"`{name}` {hours:.3g}" for name, hours in made.items())
    hours = f"Core hours of the experiments made with them: {each}; together {sum(made.values()):.3g}."
    return f"{hours} Tables of experiments that were made before the freeze, on other seeds: {', '.join(before)}."


def fill_page(page: str, results: Path) -> str:
    """Return the page with every table in it made anew from its file in `results`."""

    def replace(match: re.Match[str]) -> str:
        made, tables = made_from(match["name"], results, measured=match["kind"] == MEASURED)
        if line := made_on(tables):
            made = f"{made}\n{line}\n".lstrip("\n")
        return f"{match['begin']}\n{made}\n{match['end']}"

    pattern = (
        r"(?P<begin><!-- (?P<kind>table|measured) (?P<name>[\w-]+) -->\n)(?:.*?)(?P<end><!-- end of (?P=name) -->)"
    )
    return re.sub(pattern, replace, page, flags=re.DOTALL)


def main() -> None:
    """Write the tables into the pages given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", type=Path, default=PAGES)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--show", metavar="TABLE", help="print one table as Markdown, and write nothing")
    chosen = parser.parse_args()
    if chosen.show:
        print(text(json.loads((chosen.results / f"{chosen.show}.json").read_text())))
        return
    for page in chosen.pages:
        page.write_text(fill_page(page.read_text(), chosen.results))


if __name__ == "__main__":
    main()
