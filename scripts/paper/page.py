"""Write the tables of docs/evidence/paper.md from the rows of rows.py."""

from collections.abc import Callable, Iterable
from pathlib import Path

from evetac_cli.jobs import Row
from scripts.paper.rows import DIRECTION, INSIDE, MISSED, NOT_APPLICABLE, NOT_YET, counts, filled, read

AsTable = Callable[[list[str], Iterable[list[str]]], str]


def as_answer(results: Path, as_table: AsTable) -> str:
    """Return the sentences that answer how much of the paper is reproduced."""
    entries = filled(read(), results)["rows"]
    of_figures = counts([entry for entry in entries if entry["kind"] == "figure"])
    of_methods = counts([entry for entry in entries if entry["kind"] == "method"])
    others = sum(entry["kind"] == NOT_APPLICABLE for entry in entries)
    total = sum(of_figures.values())
    figures = ", ".join(f"{count} {name}" for name, count in of_figures.items())
    methods = ", ".join(f"{count} {name}" for name, count in of_methods.items())
    inside, direction, missed = (of_figures.get(name, 0) for name in (INSIDE, DIRECTION, MISSED))
    return (
        f"**Of {total} figures and comparisons of the paper, {inside} are inside their spread in the simulation,"
        f" {direction} more have the right direction, and {missed} are not reproduced.** In detail: {figures}. Of"
        f" {sum(of_methods.values())} methods: {methods}. {others} rows are not applicable.\n"
    )


def as_missed(results: Path, as_table: AsTable) -> str:
    """Return the table of what is not reproduced, with reasons, and of what was not tried."""
    content = filled(read(), results)
    missed = [entry for entry in content["rows"] if entry["computed"]["verdict"] == MISSED]
    lines = [[_number(entry), entry["what"], _paper(entry), _ours(entry), entry["why"]] for entry in missed]
    parts = ["Simulated, except the paper's figures:", as_table(["row", "what", "paper", "evetac", "reason"], lines)]
    tried = [entry for entry in content["rows"] if entry["kind"] == NOT_APPLICABLE]
    parts += [
        "Not applicable, or not tried:",
        "\n".join(f"- {one['number']}, {one['what']}: {one['why']}." for one in tried),
    ]
    return "\n\n".join(parts) + "\n"


def as_rows(results: Path, as_table: AsTable) -> str:
    """Return the tables of all figures and all methods."""
    entries = filled(read(), results)["rows"]
    figures = [
        [
            _number(one),
            one["what"],
            _paper(one),
            _ours(one),
            one["computed"].get("mark") or "",
            one["computed"]["verdict"],
        ]
        for one in entries
        if one["kind"] == "figure"
    ]
    methods = [
        [_number(one), one["what"], f"`{one['module']}`", f"`{one['test'].partition('::')[2]}`", _method(one)]
        for one in entries
        if one["kind"] == "method"
    ]
    heads = ["row", "what", "paper", "evetac, simulated", "mark", "verdict"]
    parts = ["### Figures", as_table(heads, figures), "### Methods"]
    parts += [as_table(["row", "the paper's method", "module", "test", "verdict"], methods)]
    return "\n\n".join(parts) + "\n"


def _method(entry: Row) -> str:
    differs = entry.get("differs")
    return f"{entry['computed']['verdict']}: {differs}" if differs else str(entry["computed"]["verdict"])


def _number(entry: Row) -> str:
    return str(entry["number"])


def _paper(entry: Row) -> str:
    found = entry["computed"]
    if "paper" not in found:
        return str(entry.get("statement", ""))
    spread = found.get("spread")
    return f"{found['paper']:g} {found['unit']}" + (f" ({spread[0]:.3g} to {spread[1]:.3g})" if spread else "")


def _ours(entry: Row) -> str:
    found = entry["computed"]
    if "ours" not in found:
        return NOT_YET
    ends = found.get("interval")
    origin = f", {entry['table']}" if "table" in entry else ""
    return f"{found['ours']:.3g}" + (f" ({ends[0]:.3g} to {ends[1]:.3g})" if ends else "") + origin


AS_PAGES = {
    "paper-answer": as_answer,
    "paper-not-reproduced": as_missed,
    "paper-rows": as_rows,
}
