"""Write the tables of docs/evidence/paper.md from the rows of rows.py."""

import string
from pathlib import Path

from evetac_cli.jobs import Row
from scripts.paper.rows import DIRECTION, ERROR, INSIDE, MISSED, NOT_APPLICABLE, NOT_YET, STILL, counts, filled, read
from scripts.reproduce.table_text import as_table

# The topics of the paper, by the number of their first row.
TOPICS = {
    19: "Tracking of dots",
    29: "Vibration",
    36: "Data rate",
    41: "Shear force",
    69: "Slip detection",
    91: "Grasps",
}


def as_answer(results: Path) -> str:
    """Return the sentences that answer how much of the paper is reproduced."""
    entries = filled(read(), results)["rows"]
    of_figures = counts([entry for entry in entries if entry["kind"] == "figure"])
    of_methods = counts([entry for entry in entries if entry["kind"] == "method"])
    others = sum(entry["kind"] == NOT_APPLICABLE for entry in entries)
    total = sum(of_figures.values())
    predicted = [entry for entry in entries if entry.get("role") == "prediction"]
    agree = counts(predicted)
    methods = ", ".join(f"{count} {name}" for name, count in of_methods.items())
    inside, direction, missed = (of_figures.get(name, 0) for name in (INSIDE, DIRECTION, MISSED))
    return (
        f"**Of {total} figures and comparisons of the paper, {inside} are inside their spread in the simulation,"
        f" {direction} more have the right direction, and {missed} are not reproduced.** {len(predicted)} are"
        f" predictions: {agree.get(INSIDE, 0)} inside their spread, {agree.get(DIRECTION, 0)} in the right direction,"
        f" {agree.get(MISSED, 0)} not reproduced. The other {total - len(predicted)} are fitted, may be fitted, or were"
        " looked at while constants were chosen. Of"
        f" {sum(of_methods.values())} methods: {methods}. {others} rows are not applicable.\n"
    )


def as_topics(results: Path) -> str:
    """Return the number of figures by verdict for each topic of the paper."""
    figures = [entry for entry in filled(read(), results)["rows"] if entry["kind"] == "figure"]
    lines = []
    for first, topic in TOPICS.items():
        of_topic = counts([entry for entry in figures if max(one for one in TOPICS if one <= _row(entry)) == first])
        found = [str(of_topic.get(name, 0)) for name in (INSIDE, DIRECTION, MISSED)]
        lines.append([topic, str(sum(of_topic.values())), *found])
    return as_table(["of the paper", "figures", INSIDE, DIRECTION, MISSED], lines) + "\n"


def as_missed(results: Path) -> str:
    """Return the reasons why figures are not reproduced, each with its rows, and what was not tried."""
    rows = filled(read(), results)["rows"]
    reasons: dict[str, list[str]] = {}
    for entry in rows:
        if entry["computed"]["verdict"] in (MISSED, NOT_APPLICABLE):
            reasons.setdefault(entry["why"], []).append(entry["number"])
    return "\n".join(f"- **{', '.join(numbers)}**: {why}." for why, numbers in reasons.items()) + "\n"


def as_figures(results: Path) -> str:
    """Return the table of all figures."""
    figures = [
        [
            _number(one), one["what"], _paper(one), _ours(one), one["role"], one["computed"].get("mark") or "",
            one["computed"]["verdict"],
        ]
        for one in filled(read(), results)["rows"]
        if one["kind"] == "figure"
    ]  # fmt: skip
    return as_table(["row", "what", "paper", "evetac, simulated", "role", "mark", "verdict"], figures) + "\n"


def as_methods(results: Path) -> str:
    """Return the table of the methods that differ from the paper's."""
    methods = [
        [_number(one), one["what"], f"`{one['module']}`", one["differs"]]
        for one in read()["rows"]
        if one.get("differs")
    ]
    return as_table(["row", "the paper's method", "module", "what differs"], methods) + "\n"


def _row(entry: Row) -> int:
    return int(entry["number"].rstrip(string.ascii_lowercase))


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
    off = f"; off the true dots {found[ERROR]:.3g} px rms, standing still {found[STILL]:.3g}" if ERROR in found else ""
    return f"{found['ours']:.3g}" + (f" ({ends[0]:.3g} to {ends[1]:.3g})" if ends else "") + off


PAGES = {
    "paper-answer": as_answer,
    "paper-topics": as_topics,
    "paper-not-reproduced": as_missed,
    "paper-figures": as_figures,
    "paper-methods": as_methods,
}
