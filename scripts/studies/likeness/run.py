"""Measure how well the simulator reproduces published facts, and write the figures for docs/evidence/likeness.md.

    python scripts/studies/likeness/run.py before|after [--seed 4000] [--each 1] [--rates 3] [--edges 5] [--jobs 2]
    python scripts/studies/likeness/run.py after --tables-alone  # in a second: from docs/results, no recordings

Records slips of many objects, the data-rate scene, rubs, a rest, a press and a shear. `evetac evaluate likeness`
measures these recordings. The result is docs/results/likeness/before.json or after.json. It has evetac's figures, the
number of recordings behind each, their origin, the commands, seeds, method versions and the commit. Figures that
require training or grasps are taken from the tables of docs/results. Recordings are stored in --folder (default:
likeness/), and an interrupted run continues where it stopped. `make results` writes the figures into the page.

With --tables-alone, figures from these recordings stay as they are in the result file, and all others are taken from
the tables in docs/results, each with its commit.
"""

import argparse
import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli import resources
from evetac_cli.evaluate.likeness.command import HERE
from evetac_cli.evaluate.likeness.facts import Fact, Ours, Values
from evetac_cli.evaluate.likeness.facts import facts as public_facts
from evetac_cli.jobs import Row, Rows
from scripts.reproduce.facts import RESULTS, Refusal, commit_facts, facts, methods, report_header
from scripts.reproduce.perform import run_command

FOLDER = "likeness"  # in docs/results
OBJECTS = tuple(range(1, 21))  # the default grid resolves the slip of all
RATE_OBJECT = 1  # the scene replaces its weight by a fitted one, see data-rate-slip
SIZES = ("trials", "trajectories", "windows", "recordings")  # columns and sizes with the number of trials
ORDER = ("fast-slow", "hist20", "hist10", "no-hist")  # of the paper's networks, the best first
LIFTED = tuple(range(10, 19))  # objects that the paper's controller lifts with its default gain
# Facts for which data/likeness.toml names no table, because there was none when it was written.
OF_LATER_TABLES: dict[str, Row] = {"tone-among-three": {"table": "vibration", "value_of": ("tone_among_three",)}}


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
    header = report_header(chosen.folder / "all.report.h5")
    return {
        "name": f"{FOLDER}-{when}",
        "simulated": True,
        **commit_facts(),
        "commands": [" ".join(command) for command in commands(chosen)],
        "methods": methods([header]),
        "sizes": facts([header]),
        "rows": [figures(row) for row in rows if "fact" in row],
    }


def figures(row: Row) -> Row:
    """Return the stored row of a fact, from the row that `evetac evaluate likeness` printed."""
    found = {"n": row["simulated_n"], "from": row["simulated_from"], "not_measured": row["not_measured"]}
    return {"name": row["name"], "values": json.loads(row["simulated_values"]), **found}


def from_tables(stored: Row, results: Path = RESULTS) -> Row:
    """Return a result file with the figures that come from docs/results taken anew."""
    known = {fact.name: fact for fact in public_facts()}
    return {**stored, "rows": [_of_now(row, known[row["name"]], results) for row in stored["rows"]]}


def _of_now(row: Row, fact: Fact, results: Path) -> Row:
    if row["from"] == HERE:
        return row
    fact = replace(fact, **OF_LATER_TABLES.get(fact.name, {}))
    if not fact.table:
        return row
    found = of_table(fact, results)
    if not found.values and fact.name in OF_LATER_TABLES:
        return row
    figures = {"values": [*found.values], "n": found.n, "from": found.origin}
    return {**row, **figures, "not_measured": found.not_measured or None}


def of_table(fact: Fact, results: Path) -> Ours:
    """Return the figures of a fact that names a table of docs/results, or why there are none."""
    path = results / f"{fact.table}.json"
    if not path.is_file():
        return Ours(not_measured=f"docs/results has no table {fact.table}")
    table = json.loads(path.read_text())
    rows: Rows = table["rows"]
    selected_rows = [row for row in rows if fact.row is not None and fact.row.items() <= row.items()]
    origin = f"docs/results/{fact.table}.json, {table.get('made')}"
    if fact.row is not None and not selected_rows:
        return Ours(origin=origin, not_measured=f"the table {fact.table} has no row {json.dumps(dict(fact.row))}")
    derived = DERIVED.get(fact.value_of[0])
    values = derived(selected_rows or rows) if derived else tuple(map(selected_rows[0].get, fact.value_of))
    if all(value is None for value in values):
        return Ours(origin=origin, not_measured=f"the table {fact.table} does not have it")
    places = (*selected_rows[:1], table.get("sizes") or {})
    trials = (int(place[key]) for place in places for key in SIZES if isinstance(place.get(key), int))
    return Ours(values, next(trials, None), origin)


def _of(rows: Rows, **traits: Any) -> Row | None:
    """Return the first row with these values; None if there is none."""
    return next((row for row in rows if traits.items() <= row.items()), None)


def _by_network(rows: Rows, column: str) -> dict[str, float]:
    """Return a column of the networks trained as in the paper, predicting zero time ahead."""
    own = [row for row in rows if row.get("preset") == "paper" and row.get("horizon_ms") == 0]
    return {row["model"]: row[column] for row in own if row.get(column) is not None}


def _order_of_networks(rows: Rows) -> Values:
    pairs: list[bool] = []
    for column in ("slip_correct", "f1"):
        by_network = _by_network(rows, column)
        if not set(ORDER) <= set(by_network):
            return (None,)
        pairs += [by_network[better] > by_network[worse] for better, worse in itertools.combinations(ORDER, 2)]
    return (float(np.mean(pairs)),)


def _difference(better: str, worse: str, columns: tuple[str, ...] = ("slip_correct",)) -> Callable[[Rows], Values]:
    def less(rows: Rows) -> Values:
        by_network = [_by_network(rows, column) for column in columns]
        return tuple(one[better] - one[worse] if {better, worse} <= set(one) else None for one in by_network)

    return less


def _hist20_loses_ahead(rows: Rows) -> Values:
    found = [_of(rows, model="hist20", preset="paper", horizon_ms=ahead_ms) for ahead_ms in (0, 20)]
    at, ahead = (None if row is None else row.get("slip_correct") for row in found)
    return (None if at is None or ahead is None else at - ahead,)


def _official_over_still(rows: Rows) -> Values:
    found = [_of(rows, preset="official", scene=scene, gel="cut") for scene in ("slip", "edge")]
    return tuple(None if row is None else row["error_px_rms"] / row["still_px_rms"] for row in found)


def _consistent_share(rows: Rows) -> Values:
    return (rows[0]["consistent"] / rows[0]["trajectories"],)


def _errors(rows: Rows, sensor: str, model: str) -> Values:
    tracker = "paper" if sensor == "events" else "rgb"  # as in the paper
    row = _of(rows, sensor_name="evetac", sensor=sensor, model=model, tracker=tracker) or {}
    return row.get("mae_n_x"), row.get("mae_n_y")


def _force_by_papers_tracker(rows: Rows) -> Values:
    return (*_errors(rows, "events", "regression"), *_errors(rows, "events", "network"))


def _ratio(first: Values, second: Values) -> Values:
    pairs = zip(first, second, strict=True)
    return tuple(None if one is None or other is None else one / other for one, other in pairs)


def _rgb_over_events(rows: Rows) -> Values:
    return _ratio(*(_errors(rows, sensor, "regression") for sensor in ("frames", "events")))


def _network_over_regression(rows: Rows) -> Values:
    return _ratio(*(_errors(rows, "events", model) for model in ("network", "regression")))


def _force_follows_mass(rows: Rows) -> Values:
    from scipy import stats

    masses = resources.table("objects")
    of_object = [_of(rows, object=number, setting="paper") for number in LIFTED]
    pairs = [(masses[str(row["object"])]["mass_g"], row["force_end_n"]) for row in of_object if row is not None]
    return (float(stats.spearmanr(*zip(*pairs, strict=True)).statistic),) if len(pairs) > 2 else (None,)


def _ticks_closed(rows: Rows) -> Values:
    found = [_of(rows, object=number, setting="paper") for number in (17, 18)]
    return tuple(None if row is None else row["opening_after_balance_ticks"] for row in found)


def _windows(rows: Rows, **traits: Any) -> Values:
    own = [row for row in rows if {"method": "paper", "window_s": 1.0, **traits}.items() <= row.items()]
    windows = sum(row["windows"] for row in own)
    return (sum(row["correct"] for row in own) / windows if windows else None,)


def _among_three(rows: Rows) -> Values:
    row = _of(rows, method="paper", window_s=1.0, expected_hz=None) or {}
    return (row.get("among_three_share"),)


# Figures that follow from several rows or columns of a table; `value_of` refers to them by name.
DERIVED: dict[str, Callable[[Rows], Values]] = {
    "consistent_share": _consistent_share,
    "events_less_displacement": _difference("events-only", "disp-only", ("slip_correct", "f1")),
    "force_by_papers_tracker": _force_by_papers_tracker,
    "force_follows_mass": _force_follows_mass,
    "hist20_less_down5": _difference("hist20", "down5"),
    "hist20_loses_ahead": _hist20_loses_ahead,
    "network_over_regression": _network_over_regression,
    "official_over_still": _official_over_still,
    "order_of_networks": _order_of_networks,
    "rgb_over_events": _rgb_over_events,
    "ticks_closed": _ticks_closed,
    "tone_among_three": _among_three,
    "vibration_200": lambda rows: _windows(rows, expected_hz=200.0),
    "vibration_all": _windows,
}


def main() -> None:
    """Record, measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("when", choices=("before", "after"))
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
    found = from_tables(kept(chosen.when, json.loads(printed)["rows"], chosen))
    (RESULTS / FOLDER / f"{chosen.when}.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
