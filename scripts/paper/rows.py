"""The rows of the paper, each with evetac's figure or method beside it; page.py writes the page about them.

    python scripts/paper/rows.py            # computes what scripts/paper/rows.json has as `computed`, and `awaiting`
    python scripts/reproduce/results.py               # writes the tables of docs/evidence/paper.md

`scripts/paper/rows.json` has a row for every statement of the paper. A figure names the table of docs/results, the row
and the field with evetac's figure; a method names the module and the test that show it. What can be computed is
computed here from the tables and from evetac_cli/evaluate, and a test compares it with what is written.

A figure that the paper prints has a verdict of verdicts.py, by the interval of the difference of the two figures and
the margin of its unit. The paper's interval is Wilson's for a share of trials, and Student's for a mean with its sd and
n; sds of single errors, as in the paper's table of forces, give none. What a sentence of the paper allows,
such as "less than 10 mm in most trials", is a range. A comparison that the paper draws has a verdict by the interval of
the difference of evetac's two figures; of several comparisons the worst verdict counts. A figure of evetac without an
interval decides nothing.

A count of dots that end where they began, and an error beside that of another tracker, can be right with dots that
never move. Such entries name their row of `tracking-distance` (`tracks`): they are `undecided` unless the tracker is
nearer to the true dots than dots that never move.

`not applicable` has a reason, too. Methods have the verdict `same method`, or `other method` with what differs.
"""

import json
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.common import marks
from evetac_cli.evaluate.common.marks import Source
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels import estimates
from evetac_cli.kernels.estimates import Estimate
from scripts.paper import verdicts
from scripts.paper.verdicts import DIFFERENT, UNDECIDED

ROOT = Path(__file__).resolve().parents[2]
ROWS = Path(__file__).with_name("rows.json")
RESULTS = ROOT / "docs" / "results"
NOT_APPLICABLE = "not applicable"
SAME, OTHER = marks.SAME, marks.METHOD
VERDICTS = (*verdicts.VERDICTS, SAME, OTHER, NOT_APPLICABLE)
NOT_YET = "no table yet"
SHARES = ("share", "share (most)", "F1")  # units in which 0 and 1 are the ends
# Field of a table: the figures of its row for each unit that is resampled, an object or a trajectory. Trajectories of
# one object are named OBJECT/TRAJECTORY, and resampled with their object.
BY_UNIT = "by_unit"
DISTANCE, ERROR, STILL = "tracking-distance", "error_px_rms", "still_px_rms"


class Ours(NamedTuple):
    """A figure of evetac with the ends of its 95 % interval, if it has one, and its mark beside the paper's."""

    value: float
    low: float | None = None
    high: float | None = None
    mark: str | None = None

    @property
    def estimate(self) -> Estimate | None:
        """The figure with its interval; None without one."""
        return None if self.low is None or self.high is None else Estimate(self.value, self.low, self.high)


class Awaited(Exception):
    """A figure that cannot be shown yet: its table, row, field or interval is missing. The message names which."""


@cache
def _table(results: Path, name: str) -> Row | None:
    path = results / f"{name}.json"
    return json.loads(path.read_text()) if path.is_file() else None


def row_of(results: Path, table: str, select: Mapping[str, Any]) -> tuple[Row, Row]:
    """Return a table and its one row with these values; raise Awaited if there is none, ValueError for several."""
    found = _table(results, table)
    if found is None:
        raise Awaited(f"{table}: no such table")
    rows = [row for row in found["rows"] if select.items() <= row.items()]
    if not rows:
        raise Awaited(f"{table}: no row {json.dumps(dict(select))}")
    if len(rows) > 1:
        raise ValueError(f"{table}: {len(rows)} rows {json.dumps(dict(select))}, expected one")
    return found, rows[0]


def published(entry: Row, results: Path = RESULTS) -> marks.PaperFigure | None:
    """Return the paper's figure of an entry, by its key or by the column next to evetac's figure.

    None for a statement without a figure.
    """
    if "figure" in entry:
        return PAPER.figures[tuple(entry["figure"])]
    if "column" not in entry:
        return None
    _, row = row_of(results, entry["table"], entry["row"])
    missing = [name for name in PAPER.columns[entry["column"]].needs if name not in row]
    if missing:
        raise Awaited(f"{entry['table']}: no field {', '.join(missing)}")
    return PAPER.figures[PAPER.columns[entry["column"]].key(row)]


def ours(entry: Row, rows: Mapping[str, Row], results: Path = RESULTS, *, need_interval: bool = True) -> Ours:
    """Return evetac's figure of an entry, of a row by itself or derived from those of other entries.

    Raises Awaited if it is missing, or if the entry names an interval that is missing and `need_interval` is set.
    """
    if "derived" in entry:
        ((how, (above, below)),) = entry["derived"].items()
        first, second = (ours(rows[number], rows, results, need_interval=False) for number in (above, below))
        both = [one.mark for one in (first, second) if one.mark is not None]
        mark = min(both, key=marks.MARKS.index, default=None)
        units = [_by_unit(rows[number], results) for number in (above, below)]
        ratio = Ours(first.value / second.value)
        if units[0] and units[0].keys() == units[1].keys():
            found = verdicts.paired_ratio(*units)
            ratio = Ours(ratio.value, found.low, found.high)
        if how == "ratio" or ratio.low is None or ratio.high is None:
            return ratio._replace(mark=mark, value=ratio.value if how == "ratio" else 1 - ratio.value)
        return Ours(1 - ratio.value, 1 - ratio.high, 1 - ratio.low, mark)
    result, row = row_of(results, entry["table"], entry["row"])
    if row.get(entry["field"]) is None:
        raise Awaited(f"{entry['table']}: no field {entry['field']}")
    low, high = _interval(entry, row, need_interval=need_interval)
    return Ours(float(row[entry["field"]]), low, high, _mark(entry, row, result))


def _mark(entry: Row, row: Row, result: Row) -> str | None:
    """Return the mark of `PAPER` for an entry's row; None if the paper has no figure."""
    if "column" not in entry:
        return None
    source = Source.from_json(result.get("sources", {}).get(row.get("evaluation")) or result.get("source", {}))
    column = PAPER.columns[entry["column"]]
    if any(name not in row for name in column.needs):
        return None
    figure = PAPER.figures[column.key(row)]
    return marks.mark(figure, column.ours(row, source), simulated=source.simulated)


def _interval(entry: Row, row: Row, *, need_interval: bool) -> tuple[float | None, float | None]:
    """Return the ends of an interval.

    They are two fields, those of a share of a number of trials (Wilson), of a mean with its sd (Student), or of the
    "mean", "rms" or "median" of units that are resampled. "exact" is a run time, which is that of one computer.
    """
    how = entry.get("interval")
    if how is None:
        return None, None
    if how == "exact":
        return 2 * (float(row[entry["field"]]),)
    if isinstance(how, str):
        units = {name: one[entry["field"]] for name, one in row.get(BY_UNIT, {}).items()}
        if not units and need_interval:
            raise Awaited(f"{entry['table']}: no field {BY_UNIT}")
        return verdicts.of_units(units, how)[1:] if units else (None, None)
    fields = how if isinstance(how, list) else list(how.values())
    if missing := [name for name in fields if row.get(name) is None]:
        if need_interval:
            raise Awaited(f"{entry['table']}: no field {', '.join(missing)}")
        return None, None
    if isinstance(how, list):
        return float(row[how[0]]), float(row[how[1]])
    if "share_of" in how:
        count = int(row[how["share_of"]])
        return estimates.share(round(row[entry["field"]] * count), count)[1:]
    return estimates.mean(row[entry["field"]], row[how["sd"]], int(row[how["n"]]))[1:]


def compared(claim: Row, entry: Row, rows: Mapping[str, Row], results: Path = RESULTS) -> str:
    """Return the verdict on a comparison that the paper draws, from evetac's figures.

    A claim is that a figure is `above` or `below` another one: that of another entry (`row`), of another row of its
    table (`select`), or of another field (`field`), or so many `times` it. With `than` it is compared with a number
    that the paper states. Figures that their tables also have by unit, for the same units, are compared in pairs.
    """
    sign, times = 1 if claim["is"] == "above" else -1, claim.get("times", 1.0)
    mine = ours(entry, rows, results, need_interval=False).estimate
    if "than" in claim:
        other: Estimate | None = Estimate(*3 * (claim["than"],))
    else:
        against = rows[claim["row"]] if "row" in claim else _changed(entry, claim)
        first, second = _by_unit(entry, results), _by_unit(against, results)
        if first and first.keys() == second.keys():
            scaled = {name: times * figure for name, figure in second.items()}
            return verdicts.of_comparison(verdicts.paired(first, scaled), sign)
        other = ours(against, rows, results, need_interval=False).estimate
    if mine is None or other is None:
        return UNDECIDED
    return verdicts.of_comparison(verdicts.difference(mine, Estimate(*(times * end for end in other))), sign)


def _changed(entry: Row, claim: Row) -> Row:
    """Return the entry of the figure that a claim compares with, in the same table."""
    own = ("column", "interval") if "field" in claim else ("column",)  # what does not hold for the other figure
    other = {key: value for key, value in entry.items() if key not in own}
    return {**other, "row": entry["row"] | claim.get("select", {}), "field": claim.get("field", entry["field"])}


def _by_unit(entry: Row, results: Path) -> dict[str, float]:
    """Return an entry's figure by unit; empty where its table does not have it, or has a unit without it."""
    if "table" not in entry:
        return {}
    _, row = row_of(results, entry["table"], entry["row"])
    found = {name: figures.get(entry["field"]) for name, figures in row.get(BY_UNIT, {}).items()}
    return {} if None in found.values() else found


def computed(entry: Row, rows: Mapping[str, Row], results: Path = RESULTS) -> Row:
    """Return what follows from the tables and the paper for an entry: figures, spread, mark and verdict."""
    if entry["kind"] == NOT_APPLICABLE:
        return {"verdict": NOT_APPLICABLE}
    if entry["kind"] == "method":
        return {"verdict": OTHER if entry.get("differs") else SAME}
    try:
        mine, figure = ours(entry, rows, results, need_interval=False), published(entry, results)
        found: Row = {}
        if figure is not None:
            ends = figure.interval or figure.limits
            found = {"paper": figure.value, "unit": figure.unit, "where": figure.where}
            found["spread"] = ends and [_rounded(end) for end in ends]
        found["ours"] = _rounded(mine.value)
        verdict = _verdict(entry, mine, figure, rows, results)
        if "tracks" in entry:
            _, row = row_of(results, DISTANCE, entry["tracks"])
            found |= {name: _rounded(row[name]) for name in (ERROR, STILL)}
            verdict = verdict if row[ERROR] < row[STILL] else UNDECIDED
    except Awaited:
        return {"verdict": NOT_YET}
    interval = None if mine.estimate is None else [_rounded(end) for end in mine.estimate[1:]]
    return {**found, "interval": interval, "mark": mine.mark, "verdict": verdict}


def _verdict(entry: Row, mine: Ours, figure: marks.PaperFigure | None, rows: Mapping[str, Row], results: Path) -> str:
    if figure is None:
        found = [compared(claim, entry, rows, results) for claim in entry["direction"]]
        return max(found, key=verdicts.VERDICTS.index)
    if mine.estimate is None:
        return UNDECIDED
    if figure.limits is not None:
        return verdicts.of_range(mine.estimate, *figure.limits)
    paper = Estimate(figure.value, *(figure.interval or 2 * (figure.value,)))
    return verdicts.of_figures(verdicts.difference(mine.estimate, paper), margin(figure.unit, figure.value))


def margin(unit: str, value: float) -> verdicts.Margin:
    """Return how far a figure may be from the paper's to be called equal, by its unit; set before measuring."""
    ((how, most),) = read()["margins"][unit].items()
    return (-most, most) if how == "difference" else tuple(sorted((value / most - value, value * most - value)))


def _rounded(value: float | None) -> float | None:
    """Return a figure with four significant digits: more would differ between computers."""
    return None if value is None else float(f"{value:.4g}")


def awaiting(entries: Rows, results: Path = RESULTS) -> list[str]:
    """Return, for each figure whose table, row, field or interval is missing, its number and what is missing."""
    rows = by_number(entries)
    missing = []
    for entry in entries:
        try:
            if entry["kind"] == "figure":
                ours(entry, rows, results)
                published(entry, results)
                for claim in entry.get("direction", []):
                    compared(claim, entry, rows, results)
        except Awaited as error:
            missing.append(f"{entry['number']}: {error}")
    return missing


def by_number(entries: Rows) -> dict[str, Row]:
    """Return entries by number, such as 19a."""
    return {entry["number"]: entry for entry in entries}


def needed(table: str) -> set[str]:
    """Return the fields of a table that entries need, which are therefore stored with it."""
    fields: set[str] = set()
    for entry in read()["rows"]:
        if entry.get("table") != table:
            continue
        how = entry.get("interval") or []
        named = how.values() if isinstance(how, dict) else how if isinstance(how, list) else ()
        fields |= {entry["field"], BY_UNIT, *entry["row"], *named}
        for claim in entry.get("direction", []):
            fields |= {*claim.get("select", {}), *([claim["field"]] if "field" in claim else [])}
        if "column" in entry:
            column = PAPER.columns[entry["column"]]
            fields |= {*column.needs, *column.may_need}
    return fields


def read(path: Path = ROWS) -> Row:
    """Return the file of rows."""
    content: Row = json.loads(path.read_text())
    return content


def filled(content: Row, results: Path = RESULTS) -> Row:
    """Return the file's content with everything computed anew."""
    rows = by_number(content["rows"])
    entries = [{**entry, "computed": computed(entry, rows, results)} for entry in content["rows"]]
    return {**content, "awaiting": awaiting(entries, results), "rows": entries}


def counts(entries: Rows) -> dict[str, int]:
    """Return the number of entries by verdict, in the order of VERDICTS."""
    found = [entry["computed"]["verdict"] for entry in entries]
    return {name: found.count(name) for name in (*VERDICTS, NOT_YET) if name in found}


def is_informative(entry: Row) -> bool:
    """Whether a figure could show something: nothing was fitted to it or near it, and neither is a share of 0 or 1."""
    found = entry["computed"]
    ends = {found.get("paper"), found.get("ours")} if found.get("unit") in SHARES else set()
    return bool(entry["role"] == "prediction" and not ends & {0.0, 1.0})


def main() -> None:
    """Compute what follows from the tables, write it into the file, and print the counts."""
    content = filled(read())
    ROWS.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    for kind in ("figure", "method", NOT_APPLICABLE):
        print(kind, counts([entry for entry in content["rows"] if entry["kind"] == kind]))
    if content["awaiting"]:
        print("awaiting:", *content["awaiting"], sep="\n  ")
    unexplained = [
        entry["number"]
        for entry in content["rows"]
        if entry["computed"]["verdict"] == DIFFERENT and not entry.get("why")
    ]
    if unexplained:
        sys.exit(f"different, without a reason (why): {', '.join(unexplained)}")


if __name__ == "__main__":
    main()
