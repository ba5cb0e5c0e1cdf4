"""The paper's figures on dot tracking, and the rows that they belong to."""

from collections.abc import Iterator

from evetac_cli.evaluate.common.marks import Conditions, Key, Paper, PaperColumn, PaperFigure, scenes
from evetac_cli.evaluate.common.source import Row, Source


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
