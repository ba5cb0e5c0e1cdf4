"""Measure how well the simulator reproduces published facts, and write the figures for docs/likeness.md.

    python scripts/likeness.py before|after [--seed 4000] [--each 1] [--rates 3] [--edges 5] [--jobs 2] [--folder NAME]
    python scripts/likeness.py after --tables-alone      # in a second: figures from docs/results anew, no recordings

Records slips of many objects, the data-rate scene, rubs, a rest, a press and a shear. `evetac evaluate likeness`
measures these recordings. The result is docs/results/likeness/before.json or after.json. It has evetac's figures, the
number of recordings behind each, their origin, the commands, seeds, method versions and the commit. Figures that
require training or grasps are taken from docs/results as they are. Recordings are stored in --folder (default:
likeness/), and an interrupted run continues where it stopped. `make results` writes the figures into the page.

With --tables-alone, figures from these recordings stay as they are in the result file, and all others are taken from
the tables in docs/results, each with its commit.
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

from likeness_tables import FOLDER, WHEN
from made_tables import Refusal, commit
from report_facts import facts, methods, report_header
from reproduce import RESULTS
from run_command import run_command

from evetac_cli.evaluate.likeness.facts import Fact, Ours, ResultTables
from evetac_cli.evaluate.likeness.facts import facts as public_facts
from evetac_cli.jobs import Row, Rows

OBJECTS = (
    1,
    3,
    4,
    7,
    8,
    9,
    10,
    11,
    12,
    13,
    15,
    16,
    17,
    18,
    19,
)  # the objects that the default grid resolves, and object 18
RATE_OBJECT = 1  # the scene replaces its weight by a fitted one, see data-rate-slip
# Figures that are in no table of docs/results but in the text of a page or study, with their source.
SAID: dict[str, dict[str, tuple[list[float | None], str]]] = {
    "before": {
        "force-by-papers-tracker": ([4.2, 2.1, None, None], "docs/results.md, in words: a smaller run, the regression"),
    },
    "after": {},
}  # fmt: skip


def commands(chosen: argparse.Namespace) -> list[list[str]]:
    """Return the commands that record, then the command that measures."""
    record = ["evetac", "record", "--seed", str(chosen.seed), "--jobs", str(chosen.jobs), "--scene"]
    objects = ",".join(map(str, OBJECTS))
    return [
        [*record, "slip", "--object", objects, "--count", str(chosen.each), "--out", "slip"],
        [*record, "data-rate", "--object", str(RATE_OBJECT), "--count", str(chosen.rates), "--out", "data-rate"],
        [*record, "edge", "--count", str(chosen.edges), "--out", "edge"],
        *([*record, scene, "--count", "1", "--out", scene] for scene in ("rest", "press", "shear")),
        ["evetac", "evaluate", "likeness", "slip", "data-rate", "edge", "rest", "press", "shear"],
    ]


def kept(when: str, rows: list[Row], chosen: argparse.Namespace) -> Row:
    """Return the content of the result file, from the rows that `evetac evaluate likeness` printed."""
    head, changed = commit()
    header = report_header(chosen.folder / "all.report.h5")
    return {
        "name": f"{FOLDER}-{when}",
        "simulated": True,
        "made": f"commit {head}" + (", with uncommitted changes" if changed else ""),
        "commit": head,
        "uncommitted_changes": changed,
        "commands": [" ".join(command) for command in commands(chosen)],
        "methods": methods([header]),
        "sizes": facts([header]),
        "rows": [figures(row, SAID[when]) for row in rows if "fact" in row],
    }


def figures(row: Row, said: Mapping[str, tuple[list[float | None], str]]) -> Row:
    """Return the stored row of a fact: figures measured, or taken from `said`, or the reason that there are none."""
    values = json.loads(row["simulated_values"])
    if not values and row["name"] in said:
        values, origin = said[row["name"]]
        return {"name": row["name"], "values": values, "n": None, "from": origin, "not_told": None}
    told = {"n": row["simulated_n"], "from": row["simulated_from"], "not_told": row["not_told"]}
    return {"name": row["name"], "values": values, **told}


HERE = "these recordings"  # origin of a figure that the recordings have


def _among_three(rows: Rows) -> float | None:
    """Return the share of windows of 1 s whose tone is among the three strongest, over all tones."""
    own = {"method": "paper", "window_s": 1.0, "expected_hz": None}
    return next((row.get("among_three_share") for row in rows if own.items() <= row.items()), None)


# Facts for which data/likeness.toml names no table, because there was none when it was written.
OF_LATER_TABLES = {"tone-among-three": ("vibration", _among_three)}


def from_tables(stored: Row, results: Path = RESULTS) -> Row:
    """Return a result file with the figures that come from docs/results taken anew."""
    tables, known = ResultTables(results), {fact.name: fact for fact in public_facts()}
    return {**stored, "rows": [_of_now(row, known[row["name"]], tables) for row in stored["rows"]]}


def _of_now(row: Row, fact: Fact, tables: ResultTables) -> Row:
    if row["from"] == HERE:
        return row
    if fact.table:
        found = tables.ours(fact)
    elif fact.name in OF_LATER_TABLES and (table := tables.table(OF_LATER_TABLES[fact.name][0])):
        name, value_of = OF_LATER_TABLES[fact.name]
        value = value_of(table["rows"])
        origin = f"docs/results/{name}.json, {table['made']}"
        found = Ours() if value is None else Ours((value,), (table.get("sizes") or {}).get("recordings"), origin)
    else:
        return row
    if not found.values and fact.name in OF_LATER_TABLES:
        return row
    values = [*found.values]
    return {**row, "values": values, "n": found.n, "from": found.origin, "not_told": found.untold or None}


def main() -> None:
    """Record, measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("when", choices=WHEN)
    for name, usual in (("seed", 4000), ("each", 1), ("rates", 3), ("edges", 5), ("jobs", 2)):
        parser.add_argument(f"--{name}", type=int, default=usual)
    parser.add_argument("--folder", type=Path, default=Path("likeness"))
    parser.add_argument(
        "--tables-alone", action="store_true", help="take figures from docs/results anew; no recordings"
    )
    chosen = parser.parse_args()
    if chosen.tables_alone:
        path = RESULTS / FOLDER / f"{chosen.when}.json"
        path.write_text(json.dumps(from_tables(json.loads(path.read_text())), indent=1) + "\n")
        return
    chosen.folder.mkdir(parents=True, exist_ok=True)
    *records, measure = commands(chosen)
    for command in records:
        code, _ = run_command(command, chosen.folder)
        if code:
            raise Refusal(f"{' '.join(command)} ended with exit code {code}")
    code, printed = run_command([*measure, "--out", "all.report.h5", "--json", "--force"], chosen.folder)
    if code:
        raise Refusal(f"{' '.join(measure)} ended with exit code {code}")
    (RESULTS / FOLDER).mkdir(exist_ok=True)
    found = kept(chosen.when, json.loads(printed)["rows"], chosen)
    (RESULTS / FOLDER / f"{chosen.when}.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
