"""evaluate tracking: tracked dots against where they began and where they truly were."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.common.marks import Conditions, Key, Paper, PaperColumn, PaperFigure, Row, Source, scenes
from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable, having


def _figures() -> Iterator[tuple[Key, PaperFigure]]:
    where = "Effectiveness of Regularization in Dot Tracking, table"
    for preset, share, lost in (("unregularised", 0.2, 9.5), ("paper", 0.8, 1.5)):
        conditions, fitted_in = Conditions(preset, "edge", (10,)), "edge" if preset == "paper" else ""
        yield ("consistent", preset), PaperFigure(share, "share", where, conditions, fitted_in, trials=10)
        yield ("dots lost", preset), PaperFigure(lost, "dots", where, conditions)


def _of_preset(quantity: str) -> PaperColumn:
    def ours(row: Row, source: Source) -> Conditions:
        return Conditions(row["preset"], scenes(source), (row["trajectories"],))

    return PaperColumn(lambda row: (quantity, row["preset"]), ours, ("preset", "trajectories"))


PAPER = Paper(
    dict(_figures()),
    {"paper_consistent_share": _of_preset("consistent"), "paper_dots_lost_mean": _of_preset("dots lost")},
)


@dataclass(frozen=True)
class EvaluateTracking:
    """Measure whether tracked dots return to where they started, and their error (simulated recordings)."""

    recordings: Path | None = parameter(
        None,
        "Folder of the recordings. Default: the tracks' folder, the one above and its sub-folders.",
        recipe=False,
    )


SUBJECT = Subject(
    "tracking",
    EvaluateTracking,
    "evaluate.tracking.measure",
    "Tracks made with one or more presets.",
    kind="tracks",
    examples=("evetac evaluate tracking data", "evetac evaluate tracking stable paper --recordings data"),
    panel=OWN_DATA,
    title="Dot tracking",
    about=(
        "Whether every dot ends where it began, and its distance from the truth. The first is unknown for a simulated"
        " trajectory that ends with the gel sheared, so n is smaller."
    ),
    tables=(
        SubjectTable(
            "Presets",
            having("preset", "consistent_share"),
            (
                *("preset", "trajectories", "decided", "consistent_share", "dots_lost_counted", "dots_lost_mean"),
                *("with_truth", "error_px_rms", "error_px_worst", "still_px_rms"),
            ),
        ),
    ),
    paper=PAPER,
)
