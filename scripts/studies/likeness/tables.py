"""The tables of docs/evidence/likeness.md: every public fact, with evetac's figures before and after a change.

The facts come from evetac_cli/data/likeness.toml. evetac's figures come from docs/results/likeness/before.json and
after.json, which run.py writes; after.json may be missing. Each comparison is computed when the tables are made, so it
always agrees with the facts shown.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from evetac_cli.evaluate.likeness.facts import NEAR, OFF, WITHIN, Fact, Within, as_text, facts
from evetac_cli.jobs import Row

FOLDER = "likeness"  # in docs/results
WHEN = ("before", "after")

# Reasons that have changed since data/likeness.toml was written, whose bytes are part of a recipe.
MISSES = {
    "force-by-papers-tracker": (
        "a dot moves only when more than 10 events of one millisecond pull it, and a slow shear makes fewer"
    ),
}

Measured = Mapping[str, Any]


def read(results: Path) -> dict[str, Measured]:
    """Return the measurements before and after, without those that have no file."""
    paths = {when: results / FOLDER / f"{when}.json" for when in WHEN}
    known = {when: json.loads(path.read_text()) for when, path in paths.items() if path.is_file()}
    before, after = (known.get(when) for when in WHEN)
    if before is not None and after is not None:
        first = {row["name"]: row for row in before["rows"]}
        known["after"] = {**after, "rows": [as_of_now(row, first.get(row["name"], {})) for row in after["rows"]]}
    return known


def as_of_now(row: Row, first: Row) -> Row:
    """Return a row of `after`, without its figures if they come from the same table of docs/results as `before`."""
    source = row.get("from") or ""
    if not (row.get("values") and source.startswith("docs/results") and source == first.get("from")):
        return row
    return {**row, "values": None, "not_measured": f"not repeated since ({source})"}


def row_of(fact: Fact, measured: Measured) -> Row:
    """Return the measured row of a fact, or an empty row if there is none."""
    return next((row for row in measured["rows"] if row["name"] == fact.name), {})


def compared(fact: Fact, measured: Measured) -> Within | None:
    """Return how the simulated figures compare with the public fact, or None if there are none."""
    return fact.compare(tuple(row_of(fact, measured).get("values") or ()))


def ours(fact: Fact, measured: Measured) -> str:
    """Return a cell with evetac's figures, comparison, number of trials and origin, or the reason for no figures."""
    row = row_of(fact, measured)
    if not row.get("values"):
        return f"not measured: {why}" if (why := row.get("not_measured")) else "not measured"
    how = [compared(fact, measured), f"n {row['n']}" if row.get("n") else None, row.get("from")]
    return f"{as_text(row['values'])} {fact.unit}".strip() + f" ({'; '.join(one for one in how if one)})"


def table(of: Iterable[Fact], known: Mapping[str, Measured]) -> list[list[str]]:
    """Return the headings, then a row for each fact, as text."""
    heads = ["fact", "public (source)", "class", *known, "command"]
    rows = []
    for fact in of:
        number = f"{fact.counts}. " if fact.counts else ""
        kind = fact.kind + (f": {fact.fits}" if fact.fits else "")
        cells = [ours(fact, measured) for measured in known.values()]
        public = f"{fact.public} ({fact.source})"
        rows.append([f"{number}`{fact.name}`: {fact.fact}", public, kind, *cells, as_code(fact.command)])
    return [heads, *rows]


def as_code(command: str) -> str:
    """Return a command as Markdown code, followed by its remark in brackets; other text is returned unchanged."""
    line, space, about = command.partition(" (")
    return f"`{line}`{space}{about}" if line.startswith(("evetac", "make")) else command


def counts(of: Iterable[Fact], measured: Measured) -> dict[str, int]:
    """Count the facts measured, those within the published spread and those between half and twice the figure."""
    found = [compared(fact, measured) for fact in of]
    known = sum(one is not None for one in found)
    return {"facts": len(found), "known": known, WITHIN: found.count(WITHIN), NEAR: found.count(NEAR)}


def said(of: list[Fact], known: Mapping[str, Measured]) -> list[str]:
    """Return a sentence on how many facts are reproduced, before and after."""
    lines = []
    for when, measured in known.items():
        found = counts(of, measured)
        lines.append(
            f"{when.capitalize()}: {found['known']} of these {found['facts']} facts are measured; {found[WITHIN]} are"
            f" within the published spread, {found[NEAR]} more are between half and twice the public figure."
        )
    return lines


def misses(of: Iterable[Fact], known: Mapping[str, Measured]) -> list[str]:
    """Return a line for each fact that the latest figures miss, with the reason if it has been investigated."""
    *_, latest = known.values()
    off = [fact for fact in of if compared(fact, latest) == OFF]
    return [f"- `{fact.name}`: {MISSES.get(fact.name) or fact.miss or 'not investigated'}." for fact in off]


def answer(results: Path) -> str:
    """Return the sentence on how many of the counted facts are reproduced now."""
    known = read(results)
    *_, latest = known.values()
    counted = [fact for fact in facts() if fact.counts]
    found = counts(counted, latest)
    off = sum(compared(fact, latest) == OFF for fact in counted)
    rest = found["facts"] - found[WITHIN] - found[NEAR] - off
    unknown = f" The other {rest} have no figure on the current simulator." if rest else ""
    return (
        f"Simulated: {found[WITHIN]} of these {found['facts']} facts are within the published spread,"
        f" {found[NEAR]} more between half and twice the public figure, and {off} are off.{unknown}"
    )


# Topics of the page: the tables of docs/results whose facts they are.
TOPICS = {
    "forces": ("force",),
    "grasps": ("grasps", "grasps-by-object", "grasp-robustness"),
    "vibration": ("vibration",),
}


def topics(results: Path) -> str:
    """Return a list with the facts on forces, grasps and vibration, and how each compares now."""
    *_, latest = read(results).values()
    lines = []
    for topic, tables in TOPICS.items():
        of = [fact for fact in facts() if fact.table in tables]
        words = [f"`{fact.name}` {compared(fact, latest) or 'no figure'}" for fact in of]
        lines.append(f"- {topic.capitalize()}: {', '.join(words)}.")
    return "\n".join(lines)


def how_made(when: str, measured: Measured) -> str:
    """Return a sentence with the commit, commands and seeds of the measurements."""
    commands = ", ".join(f"`{command}`" for command in measured["commands"])
    seeds = ", ".join(map(str, measured["sizes"]["recording_seeds"]))
    return f"{when.capitalize()}: {measured['made']}, made by {commands}; seeds of recordings {seeds}."


def as_pages(results: Path, as_table: Callable[[list[str], list[list[str]]], str]) -> dict[str, str]:
    """Return the text of the two tables by name. `as_table` makes Markdown from headings and rows."""
    known = read(results)
    listed = facts()
    counted = sorted((fact for fact in listed if fact.counts), key=lambda fact: fact.counts or 0)
    others = [fact for fact in listed if not fact.counts]
    texts = {}
    for name, of in (("likeness-counted", counted), ("likeness-others", others)):
        heads, *rows = table(of, known)
        parts = ["Simulated, except the public facts:", as_table(heads, rows)]
        if of is counted:
            parts += [*said(counted, known), "Off, and why:", "\n".join(misses(counted, known))]
            parts += [how_made(when, measured) for when, measured in known.items()]
        texts[name] = "\n\n".join(parts) + "\n"
    return texts
