"""How evetac's figures compare with the paper's: conditions of a figure, and the rule for marks.

The figures of the paper are stored once, in `PAPER` of their subject. Tables, reports and plots take them only from
there. A row of a report has the paper's figure in a column of its own, `paper_...`. `Paper.beside` returns this figure
for a row, with a mark that depends on the row and on the headers behind it. Of the marks that apply, the first of these
is used:

- fitted: evetac's scene was adjusted until it gave this figure, so the agreement proves nothing;
- other method: another tracker, training, detector or grip controller than the paper's, or other inputs;
- other scene: objects, motions or surroundings that are not modelled on the paper's, or are unknown;
- other size: another number of trials, trajectories, objects, windows or trainings, or another duration;
- same method: all of these match the paper, although evetac's data may be simulated.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from evetac_cli.store.layout.ancestry import scene_words, trajectories

Row = Mapping[str, Any]
LABELS, TRUTH = "labels", "truth of the simulation"  # by which onsets `evaluate slip` judges trials


@dataclass(frozen=True)
class Source:
    """Origin of the rows of a report, according to the headers of its files."""

    simulated: bool = False
    scenes: tuple[str, ...] = ()
    trackers: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()
    detectors: tuple[str, ...] = ()  # used in grasps
    grasp_s: tuple[float, ...] = ()  # durations of lifting and balancing with a detector
    training_recordings: int = 0

    @classmethod
    def of(cls, headers: Iterable[Row]) -> "Source":
        """Return the source of the headers of a report, or of the files it was made from."""
        every: dict[str, Row] = {}
        for header in headers:
            every |= {**header["history"], header["id"]: header}
        of_kind: dict[str, dict[str, Row]] = defaultdict(dict)
        for id_, one in every.items():
            of_kind[one["kind"]][id_] = one
        detectors, recordings = of_kind["model"], of_kind["recording"].values()
        grasps = [one for one in recordings if not detectors.keys().isdisjoint(one["parents"])]
        rows = trajectories(every.values())
        used = {id_ for one in grasps for id_ in one["parents"]} & detectors.keys()
        trackers = {one["parameters"].get("preset") for one in of_kind["tracks"].values()}
        trackers |= {row["tracker"] for row in rows}
        labels = [one["parameters"].get("method", "farneback") for one in of_kind["labels"].values()]
        durations = {tuple(float(one["parameters"].get(name, 0)) for name in ("lift_s", "balance_s")) for one in grasps}
        return cls(
            simulated=any(one.get("simulated", False) for one in every.values()),
            scenes=_texts([*(_scene(one["parameters"]) for one in recordings), *(row["scene"] for row in rows)]),
            trackers=_texts(
                [*trackers - {"rgb"}, *((one["parameters"].get("tracker") or {}).get("preset") for one in grasps)]
            ),
            labels=_texts([*labels, *(row["labels"] for row in rows)]),
            detectors=_texts(_detector(detectors[id_]["parameters"]) for id_ in used),
            grasp_s=tuple(second for pair in sorted(durations) for second in pair),
            training_recordings=len({row["recording"] for row in rows} - {None}),
        )

    @property
    def detector(self) -> str:
        """The detectors of grasps in words."""
        return " + ".join(self.detectors)

    @classmethod
    def from_json(cls, stored: Row) -> "Source":
        """Restore a source that was stored as JSON from dataclasses.asdict."""
        entries: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one for name, one in stored.items()}
        entries.pop("networks", None)  # in tables of earlier versions
        return cls(**entries)


def _texts(values: Iterable[Any]) -> tuple[str, ...]:
    return tuple(sorted({str(one) for one in values if one is not None}))


def _scene(parameters: Row) -> str | None:
    scene = parameters.get("scene")
    return scene if isinstance(scene, str) else scene_words(parameters, "name")


def _detector(parameters: Row) -> str:
    horizon_ms = parameters.get("horizon_ms")
    predicting = f" {horizon_ms} ms ahead" if horizon_ms else ""
    return f"{parameters.get('model')}{predicting} by {parameters.get('preset')}"


SAME, METHOD, SIZE, SCENE, FITTED = "same method", "other method", "other size", "other scene", "fitted"
MARKS = (FITTED, METHOD, SCENE, SIZE, SAME)  # in order of precedence

Key = tuple[str | float, ...]  # the quantity, then its subject (object, model, ...)


@dataclass(frozen=True)
class Conditions:
    """The conditions under which a figure was obtained, the paper's or evetac's, in evetac's names."""

    method: str  # network with its training, tracker preset, grip controller
    scene: str
    size: tuple[float, ...]  # numbers of trials, objects, trainings and the like, and durations in s
    inputs: str = ""  # inputs of the method, where they may differ


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper."""

    value: float
    unit: str
    where: str  # section or table of the paper
    conditions: Conditions
    fitted_in: str = ""  # the scene of evetac that was adjusted until it gave this figure
    limits: tuple[float, float] | None = None  # what a sentence allows
    trials: int = 0  # of which the figure is a share or a mean
    sd: float | None = None  # of a mean, over its trials

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval: Wilson's of a share, Student's of a mean with its sd; None without trials."""
        if not self.trials:
            return None
        from evetac_cli.kernels import estimates  # here, as subjects are listed without numpy

        if self.sd is not None:
            return estimates.mean(self.value, self.sd, self.trials)[1:]
        return estimates.share(round(self.value * self.trials), self.trials)[1:]


class PaperColumn(NamedTuple):
    """A column `paper_...`: the key of a row's figure, the row's own conditions, and the columns that both read."""

    key: Callable[[Row], Key]
    ours: Callable[[Row, Source], Conditions]
    needs: tuple[str, ...]
    may_need: tuple[str, ...] = ()  # read if the row has them


class Beside(NamedTuple):
    """The paper's value and its mark, for display next to a figure of evetac."""

    value: float
    mark: str


def mark(figure: PaperFigure, ours: Conditions, *, simulated: bool) -> str:
    """Return how evetac's figure compares with one of the paper: the first of MARKS that applies."""
    paper = figure.conditions
    if simulated and figure.fitted_in and (ours.method, ours.scene) == (paper.method, figure.fitted_in):
        return FITTED
    if (ours.method, ours.inputs) != (paper.method, paper.inputs):
        return METHOD
    if ours.scene != paper.scene:
        return SCENE
    return SAME if ours.size == paper.size else SIZE


@dataclass(frozen=True)
class Paper:
    """The paper's figures on a subject, and the columns `paper_...` in which rows show them."""

    figures: MutableMapping[Key, PaperFigure] = field(default_factory=dict)
    columns: MutableMapping[str, PaperColumn] = field(default_factory=dict)

    def value(self, *key: str | float) -> float | None:
        """Return a figure of the paper by its key; None if the paper has none."""
        figure = self.figures.get(key)
        return None if figure is None else figure.value

    def value_of(self, column: str, row: Row) -> float | None:
        """Return the paper's figure of a column `paper_...` for a row; None if the paper has none."""
        return self.value(*self.columns[column].key(row))

    def beside(self, column: str, row: Row, source: Source) -> Beside | None:
        """Return the paper's figure and its mark for a row; None without one, or without the needed columns."""
        paper_column = self.columns[column]
        if row.get(column) is None or any(row.get(name) is None for name in paper_column.needs):
            return None
        figure = self.figures.get(paper_column.key(row))
        if figure is None:
            return None
        return Beside(figure.value, mark(figure, paper_column.ours(row, source), simulated=source.simulated))


def scenes(source: Source) -> str:
    """Return the scenes of a source as one text."""
    return " + ".join(source.scenes)


def by(what: str, names: Iterable[str]) -> str:
    """Return what inputs were made by, for example `dots by paper`."""
    return f"{what} by {' + '.join(names)}"


def dots(row: Row, source: Source) -> str:
    """Return the tracker of a row, or of its source."""
    return by("dots", [row["tracker"]] if row.get("tracker") else source.trackers)
