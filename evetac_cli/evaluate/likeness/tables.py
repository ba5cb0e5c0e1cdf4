"""Figures for the public facts from the tables of docs/results, which needed trainings, grasps or many trials."""

import hashlib
import itertools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli import resources
from evetac_cli.errors import InputError
from evetac_cli.evaluate.likeness.facts import Fact, Values
from evetac_cli.jobs import Row, Rows
from evetac_cli.text_files import MOST_JSON_BYTES, parse_json, read_text

IN_A_CLONE = resources.PACKAGE.parent / "docs" / "results"
ORDER = ("fast-slow", "hist20", "hist10", "no-hist")  # of the paper's networks, the best first
LIFTED = tuple(range(10, 19))  # objects that the paper's controller lifts with its default gain
SIZES = ("trials", "trajectories", "windows", "recordings")  # columns and sizes with the number of trials


@dataclass(frozen=True)
class Ours:
    """Figures of evetac for a fact, their number of trials and origin, or the reason why there are none."""

    values: Values = ()
    n: int | None = None
    origin: str = ""
    untold: str = ""


class ResultTables:
    """The tables of a folder, read when needed; without a folder there are none."""

    def __init__(self, folder: Path | None) -> None:
        """Raise InputError if `folder` does not exist.

        None means the folder of the clone from which the package runs.
        """
        if folder is not None and not folder.is_dir():
            raise InputError("no such folder", where="--results", expected="docs/results of a clone", found=str(folder))
        self.folder = folder or (IN_A_CLONE if IN_A_CLONE.is_dir() else None)
        self._read: dict[str, Mapping[str, Any] | None] = {}

    def table(self, name: str) -> Mapping[str, Any] | None:
        """Return a table by name, None if the folder lacks it; raise InputError for a file that is not a table."""
        if name not in self._read:
            path = None if self.folder is None else self.folder / f"{name}.json"
            found = _parsed(path) if path is not None and path.is_file() else None
            rows = found.get("rows") if isinstance(found, dict) else None
            if found is not None and not (isinstance(rows, list) and all(isinstance(row, dict) for row in rows)):
                raise InputError(
                    "not a table of results",
                    where=str(path),
                    expected="a JSON object with rows, as for scripts/results.py",
                )
            self._read[name] = found
        return self._read[name]

    def digests(self, names: list[str]) -> dict[str, str]:
        """Return the SHA-256 of each existing table, for a recipe."""
        tables = {name: self.table(name) for name in sorted(set(names))}
        texts = {name: json.dumps(one, sort_keys=True) for name, one in tables.items() if one is not None}
        return {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}

    def ours(self, fact: Fact) -> Ours:
        """Return the figures of a fact that refers to a table."""
        if self.folder is None:
            return Ours(untold="docs/results is not part of this installation: give its path with --results")
        table = self.table(fact.table)
        if table is None:
            return Ours(untold=f"docs/results has no table {fact.table}")
        rows: Rows = table["rows"]
        selected_rows = [row for row in rows if fact.row is not None and fact.row.items() <= row.items()]
        origin = f"docs/results/{fact.table}.json, {table.get('made')}"
        if fact.row is not None and not selected_rows:
            return Ours(origin=origin, untold=f"the table {fact.table} has no row {json.dumps(dict(fact.row))}")
        (key, *more) = fact.value_of
        if not more and key in DERIVED:
            values = DERIVED[key](selected_rows or rows)
        else:
            values = tuple(selected_rows[0].get(column) for column in fact.value_of)
        if not values or all(value is None for value in values):
            return Ours(origin=origin, untold=f"the table {fact.table} does not have it")
        return Ours(values, _trials(selected_rows, table), origin)


def _parsed(path: Path) -> Any:
    try:
        return parse_json(read_text(path, MOST_JSON_BYTES))
    except ValueError as error:
        raise InputError(f"not valid JSON: {error}", where=str(path)) from None


def _trials(selected_rows: Rows, table: Mapping[str, Any]) -> int | None:
    """Return the number of trials behind a row, or behind the table as a whole."""
    (row, *_) = [*selected_rows, {}]
    places = (row, table.get("sizes") or {})
    return next((int(place[key]) for place in places for key in SIZES if isinstance(place.get(key), int)), None)


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


def _errors(rows: Rows, **traits: Any) -> tuple[float | None, float | None]:
    # The paper tracked dots in events with its own tracker; older tables of force do not name theirs.
    paper = _of(rows, sensor_name="evetac", **{"tracker": "paper", **traits})
    row = paper or _of(rows, sensor_name="evetac", **traits) or {}
    return row.get("mae_n_x"), row.get("mae_n_y")


def _force_by_papers_tracker(rows: Rows) -> Values:
    models = ("regression", "network")
    return tuple(one for model in models for one in _errors(rows, sensor="events", model=model, tracker="paper"))


def _ratio(first: Values, second: Values) -> Values:
    pairs = zip(first, second, strict=True)
    return tuple(None if one is None or other is None else one / other for one, other in pairs)


def _rgb_over_events(rows: Rows) -> Values:
    regression = (_errors(rows, sensor=sensor, model="regression") for sensor in ("frames", "events"))
    return _ratio(*regression)


def _network_over_regression(rows: Rows) -> Values:
    return _ratio(*(_errors(rows, sensor="events", model=model) for model in ("network", "regression")))


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
    "vibration_200": lambda rows: _windows(rows, expected_hz=200.0),
    "vibration_all": _windows,
}
