"""Write the tables of docs/evidence/paper.md from the rows of rows.py."""

import string
from pathlib import Path

from evetac_cli.jobs import Row, Rows
from scripts.paper.rows import (
    ERROR,
    NOT_APPLICABLE,
    NOT_YET,
    STILL,
    by_number,
    counts,
    filled,
    is_informative,
    ours,
    read,
    row_of,
)
from scripts.paper.ten import TEN, by_own_method, counted
from scripts.paper.verdicts import DIFFERENT, UNDECIDED, VERDICTS
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
VERBS = "agree", "are compatible", "are undecided", "differ"


def as_answer(results: Path) -> str:
    """Return the sentences that answer how much of the paper is reproduced."""
    entries = filled(read(), results)["rows"]
    figures = [entry for entry in entries if entry["kind"] == "figure"]
    informative = [entry for entry in figures if is_informative(entry)]
    chosen = [entry for entry in figures if entry["role"] != "prediction"]
    ends = len(figures) - len(informative) - len(chosen)
    of_methods = counts([entry for entry in entries if entry["kind"] == "method"])
    others = sum(entry["kind"] == NOT_APPLICABLE for entry in entries)
    methods = ", ".join(f"{count} {name}" for name, count in of_methods.items())
    return (
        f"**Of {len(informative)} informative predictions of the paper's figures, {_by_verdict(informative)}.**"
        f" {ends} more predictions are not informative, because a share is 0 or 1 in the paper or here. {len(chosen)}"
        f" figures were fitted, may be, or were looked at while constants were chosen: {_by_verdict(chosen)}. Of"
        f" {sum(of_methods.values())} methods: {methods}. {others} rows are not applicable.\n"
    )


def _by_verdict(entries: Rows) -> str:
    """Return the number of entries for each verdict in words."""
    found = counts(entries)
    return ", ".join(f"{found.get(name, 0)} {verb}" for name, verb in zip(VERDICTS, VERBS, strict=True))


def as_ten(results: Path) -> str:
    """Return the ten rows: the paper's figure, evetac's by the same method and by its own."""
    entries = by_number(filled(read(), results)["rows"])
    lines = []
    for row in TEN:
        one = entries[row.number]
        found = one["computed"]
        paper = _figure(found["paper"], found["spread"]) if "paper" in found else ""
        shown = [row.what + _older(one, results), paper, NOT_YET]
        if "ours" in found:  # which is rounded
            shown[-1] = _figure(ours(one, entries, results, need_interval=False).value, found["interval"])
        known = found["verdict"] != NOT_YET
        about = [counted(row, one, results), by_own_method(row, one, results)] if known else ["", ""]
        lines.append([*shown, about[0], found.get("mark") or "", found["verdict"], about[1]])
    heading = ["what", "paper", "evetac by the paper's method", "n", "mark", "verdict", "evetac's own method"]
    return as_table(heading, lines) + "\n"


def _older(entry: Row, results: Path) -> str:
    """Return the commit of a table that was made before the freeze, in words; empty for a frozen one."""
    table, _ = row_of(results, entry["table"], entry["row"])
    return "" if table.get("frozen") else f" (before the freeze, {table['made']})"


def as_topics(results: Path) -> str:
    """Return the number of informative predictions by verdict for each topic of the paper."""
    figures = [one for one in filled(read(), results)["rows"] if one["kind"] == "figure" and is_informative(one)]
    lines = []
    for first, topic in TOPICS.items():
        of_topic = counts([entry for entry in figures if max(one for one in TOPICS if one <= _row(entry)) == first])
        lines.append([topic, str(sum(of_topic.values())), *(str(of_topic.get(name, 0)) for name in VERDICTS)])
    return as_table(["of the paper", "informative predictions", *VERDICTS], lines) + "\n"


def as_missed(results: Path) -> str:
    """Return the reasons why figures differ or are undecided, each with its rows, and what was not tried."""
    rows = filled(read(), results)["rows"]
    reasons: dict[str, list[str]] = {}
    for entry in rows:
        if entry["computed"]["verdict"] in (DIFFERENT, UNDECIDED, NOT_APPLICABLE) and "why" in entry:
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


def _figure(value: float, ends: list[float] | None) -> str:
    """Return a figure with its interval, which a run time and a figure without trials do not have."""
    return f"{value:.3g}" + (f" ({ends[0]:.2g} to {ends[1]:.2g})" if ends and ends[0] < ends[1] else "")


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
    "paper-ten": as_ten,
    "paper-topics": as_topics,
    "paper-differs": as_missed,
    "paper-figures": as_figures,
    "paper-methods": as_methods,
}
