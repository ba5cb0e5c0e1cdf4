"""The public facts about the real sensor: their sources, and the figures of evetac to compare.

They are listed only in data/likeness.toml. docs/evidence/likeness.md, `evetac evaluate likeness` and the comments
`fitted to NAME` next to constants refer to them by name. Figures of the paper come from the other subjects.

Every fact has a class, because a fact by which a constant was chosen confirms nothing when it agrees. The classes are
`used to fit`, `kept as a prediction`, and `cannot be told`: public sources contradict each other or do not state what
was done.

Facts whose figure needs trainings, grasps or many trials name a table of docs/results, which
scripts/studies/likeness/run.py reads.
"""

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from evetac_cli import resources
from evetac_cli.evaluate import PAPER
from evetac_cli.kernels import estimates
from evetac_cli.sim.setup import scene_file, sensor_file

FIT, PREDICTION, UNTOLD = "used to fit", "kept as a prediction", "cannot be told"
EVERY = "*"  # in a path: all entries of a table; the smallest and largest values are taken

Within = Literal["within", "half to twice", "off"]
WITHIN: Within = "within"
NEAR: Within = "half to twice"
OFF: Within = "off"
Values = tuple[float | None, ...]


@dataclass(frozen=True)
class Fact:
    """A public fact: `fact` and its `public` figure in words, its source, class and command.

    - paper, value: the public figures, by their keys in `PAPER` or as numbers;
    - sd, trials, low and high: their spread, one per figure: the paper's standard deviation, the 95 % interval (Wilson)
      of a share of this many trials, or the ends;
    - measures: of recordings; in `NAME@SCENE`, simulations count only if they are of this scene;
    - table: a file of docs/results, with its `row` and `value_of`: a column, columns, or a function of
      scripts/studies/likeness/run.py;
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
        arguments["value"] = tuple(PAPER.figures[tuple(key)].value for key in keys)
    if sds:
        spread = [PAPER.figures[tuple(key)].value for key in sds]
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
        found: Any = asdict(scene_file.load(name))  # also what the scene leaves to its default
    else:
        found = sensor_file.rows() if kind == "sensors" else resources.table(kind)
    if rest[0] == EVERY:
        values = [row[rest[1]] for row in found.values()]
        return float(min(values)), float(max(values))
    for key in rest:
        found = found[key]
    return tuple(map(float, found)) if isinstance(found, (list, tuple)) else (float(found),)


@dataclass(frozen=True)
class Ours:
    """Figures of evetac for a fact, their number of trials and origin, or the reason why there are none."""

    values: Values = ()
    n: int | None = None
    origin: str = ""
    not_measured: str = ""
