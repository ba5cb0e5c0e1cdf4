"""The paper's figures on the data rate, and the rows that they belong to."""

from collections.abc import Iterator

from evetac_cli.evaluate.common.marks import Conditions, Key, Paper, PaperColumn, PaperFigure, scenes
from evetac_cli.evaluate.common.source import Row, Source

COLUMNS = 540  # of the frame, without the window, that the paper counts for both sensors
SCENE = "data-rate"  # grasp, hold, push, let slip: the motions of the paper's figures


def _figures() -> Iterator[tuple[Key, PaperFigure]]:
    where = "Data Rate Experiments, table"
    for interval, mean, sd in (("whole", 0.017, 0.004), ("contact", 0.028, 0.008), ("slip", 0.119, 0.006)):
        conditions = Conditions("bytes a second", SCENE, (5,), f"{COLUMNS} columns")
        fitted_in = SCENE if interval == "slip" else ""  # by the object's mass, which the paper does not state
        for key, value in (("data rate", mean), ("data rate, sd", sd)):
            limits = (round(mean - sd, 4), round(mean + sd, 4)) if value == mean else None
            figure = PaperFigure(value, "share of the RGB sensor's", where, conditions, fitted_in, limits)
            yield (key, interval), figure


def _of_interval(quantity: str) -> PaperColumn:
    def ours(row: Row, source: Source) -> Conditions:
        return Conditions("bytes a second", scenes(source), (row["trajectories"],), f"{row['columns']} columns")

    return PaperColumn(lambda row: (quantity, row["interval"]), ours, ("interval", "trajectories", "columns"))


PAPER = Paper(
    dict(_figures()),
    {"paper_share_mean": _of_interval("data rate"), "paper_share_sd": _of_interval("data rate, sd")},
)
