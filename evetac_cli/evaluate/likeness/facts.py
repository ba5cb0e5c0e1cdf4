"""The public facts about the real sensor: their sources, and the figures of evetac to compare.

They are listed only in data/likeness.toml. docs/likeness.md, `evetac evaluate likeness` and the comments `fitted to
NAME` next to constants refer to them by name. Figures of the paper come from paper.py.

Every fact has a class, because a fact by which a constant was chosen confirms nothing when it agrees. The classes are
`used to fit`, `kept as a prediction`, and `cannot be told`: public sources contradict each other or do not state what
was done.

Figures that needed trainings, grasps or many trials come from the tables of docs/results.
"""

import functools
import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evetac_cli import resources
from evetac_cli.errors import InputError
from evetac_cli.evaluate import paper
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels import estimates
from evetac_cli.text_files import MOST_JSON_BYTES, parse_json, read_text, read_toml

FIT, PREDICTION, UNTOLD = "used to fit", "kept as a prediction", "cannot be told"
EVERY = "*"  # in a path: all entries of a table; the smallest and largest values are taken

Within = Literal["within", "half to twice", "off"]
WITHIN: Within = "within"
NEAR: Within = "half to twice"
OFF: Within = "off"
Values = tuple[float | None, ...]
IN_A_CLONE = resources.PACKAGE.parent / "docs" / "results"
ORDER = ("fast-slow", "hist20", "hist10", "no-hist")  # of the paper's networks, the best first
LIFTED = tuple(range(10, 19))  # objects that the paper's controller lifts with its default gain
SIZES = ("trials", "trajectories", "windows", "recordings")  # columns and sizes with the number of trials


@dataclass(frozen=True)
class Fact:
    """A public fact: `fact` and its `public` figure in words, its source, class and command.

    - paper, value: the public figures, by their keys in paper.py or as numbers;
    - sd, trials, low and high: their spread, one per figure: the paper's standard deviation, the 95 % interval (Wilson)
      of a share of this many trials, or the ends;
    - measures: of recordings; in `NAME@SCENE`, simulations count only if they are of this scene;
    - table: a file of docs/results, with its `row` and `value_of` (a column, columns, or a function of tables.py);
    - constant: a constant of data/*.toml;
    - counts: its number among the counted facts;
    - fits: what was chosen by it;
    - needs: what a figure requires, if a recording is not enough;
    - miss: why evetac's figure is off, as far as is known.

    One of measures, table and constant provides evetac's figure.
    """

    name: str
    fact: str
    public: str
    source: str
    kind: str
    command: str
    counts: int | None = None
    unit: str = ""
    value: tuple[float, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    measures: tuple[str, ...] = ()
    table: str = ""
    row: Mapping[str, Any] | None = None
    value_of: tuple[str, ...] = ()
    constant: tuple[str, ...] = ()
    needs: str = ""
    fits: str = ""
    miss: str = ""

    @property
    def published(self) -> str:
        """The public figures and the ends of their spread, if there are any, with their unit."""
        ends = "; ".join(f"{_shown(low)} to {_shown(high)}" for low, high in zip(self.low, self.high, strict=True))
        figures = as_text(self.value)
        both = f"{figures} ({ends})" if figures and ends else figures or ends
        return f"{both} {self.unit}".strip() if both else "in words alone"

    def compare(self, ours: Values) -> Within | None:
        """Compare evetac's figures with the public ones; None if all are missing, or some are and no other is off.

        within: all in the published spread; half to twice: all of the same sign and between half and twice the public
        figures; off: neither. If no spread is published, no figure is within it.
        """
        known_figures = [(place, one) for place, one in enumerate(ours) if one is not None]
        if not known_figures or not (self.value or self.low):
            return None
        within = all(_between(one, _at(self.low, place), _at(self.high, place)) for place, one in known_figures)
        near = all(_near(one, _at(self.value, place)) for place, one in known_figures)
        if not within and not near:
            return OFF
        if len(known_figures) < len(ours):
            return None
        return WITHIN if within else NEAR


def _at(values: tuple[float, ...], place: int) -> float | None:
    """Return the value for one of evetac's figures: its own, or the last one, which applies to all."""
    return values[min(place, len(values) - 1)] if values else None


def _between(ours: float, low: float | None, high: float | None) -> bool:
    return low is not None and high is not None and low <= ours <= high


def _near(ours: float, public: float | None) -> bool:
    return bool(public) and public is not None and 0.5 <= ours / public <= 2.0


@functools.cache
def facts() -> tuple[Fact, ...]:
    """Return all facts in the order of the list."""
    return tuple(_fact(entry) for entry in resources.table("likeness")["fact"])


def named_tables() -> list[str]:
    """Return the names of the tables of docs/results to which facts refer."""
    return sorted({entry["table"] for entry in resources.table("likeness")["fact"] if "table" in entry})


def by_name(name: str) -> Fact:
    """Return the fact with a name; raise KeyError if there is none."""
    return {one.name: one for one in facts()}[name]


def _fact(entry: Mapping[str, Any]) -> Fact:
    """Return a fact from its entry with figures and spreads of the paper filled in."""
    arguments: dict[str, Any] = {key: tuple(one) if isinstance(one, list) else one for key, one in entry.items()}
    keys, sds, trials = arguments.pop("paper", ()), arguments.pop("sd", ()), arguments.pop("trials", None)
    arguments["kind"] = arguments.pop("class")
    if isinstance(arguments.get("value_of"), str):
        arguments["value_of"] = (arguments["value_of"],)
    if keys:
        arguments["value"] = tuple(paper.FIGURES[tuple(key)].value for key in keys)
    if sds:
        spread = [paper.FIGURES[tuple(key)].value for key in sds]
        arguments["low"] = tuple(mean - sd for mean, sd in zip(arguments["value"], spread, strict=True))
        arguments["high"] = tuple(mean + sd for mean, sd in zip(arguments["value"], spread, strict=True))
    if trials is not None:
        ends = [estimates.share(round(share * trials), trials)[1:] for share in arguments["value"]]
        arguments["low"], arguments["high"] = (tuple(float(end[side]) for end in ends) for side in (0, 1))
    return Fact(**arguments)


def as_text(values: Iterable[float | None]) -> str:
    """Return figures as text: three digits each, `unknown` for a missing one; empty if all are missing."""
    figures = list(values)
    if all(value is None for value in figures):
        return ""
    return "; ".join("unknown" if value is None else _shown(value) for value in figures)


def _shown(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def constant_of(path: Sequence[str]) -> Values:
    """Return the value, or the two ends, of a constant by its path, such as sensors, evetac, threshold.

    The first part is sensors, objects, scenes (followed by the scene's name) or gripper. Raises KeyError if there is
    none.
    """
    kind, *rest = path
    if kind == "gripper":
        from evetac_cli.sim.gripper import Drive  # late: loads compiled code

        return (float(getattr(Drive(), rest[0])),)
    if kind == "scenes":
        name, *rest = rest
        found: Any = read_toml(resources.SCENES / f"{name}.toml")
    else:
        found = resources.table(kind)
    if rest[0] == EVERY:
        values = [row[rest[1]] for row in found.values()]
        return float(min(values)), float(max(values))
    for key in rest:
        found = found[key]
    return tuple(float(one) for one in found) if isinstance(found, list) else (float(found),)


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
                raise InputError("not a table of results", where=str(path), expected="a JSON object with rows")
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
