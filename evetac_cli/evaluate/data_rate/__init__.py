"""evaluate data-rate: bytes of events against those of an RGB sensor."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.common.marks import Conditions, Key, Paper, PaperColumn, PaperFigure, Row, Source, scenes
from evetac_cli.evaluate.subject import THE_PAPER, Subject, SubjectTable, having

COLUMNS = 540  # of the frame, without the window, that the paper counts for both sensors
SCENE = "data-rate"  # grasp, hold, push, let slip: the motions of the paper's figures


def _figures() -> Iterator[tuple[Key, PaperFigure]]:
    where = "Data Rate Experiments, table"
    for interval, mean, sd in (("whole", 0.017, 0.004), ("contact", 0.028, 0.008), ("slip", 0.119, 0.006)):
        conditions = Conditions("bytes a second", SCENE, (5,), f"{COLUMNS} columns")
        fitted_in = SCENE if interval == "slip" else ""  # by the object's mass, which the paper does not state
        figure = PaperFigure(mean, "share of the RGB sensor's", where, conditions, fitted_in, trials=5, sd=sd)
        yield ("data rate", interval), figure
        yield ("data rate, sd", interval), replace(figure, value=sd, trials=0, sd=None)


def _of_interval(quantity: str) -> PaperColumn:
    def ours(row: Row, source: Source) -> Conditions:
        return Conditions("bytes a second", scenes(source), (row["trajectories"],), f"{row['columns']} columns")

    return PaperColumn(lambda row: (quantity, row["interval"]), ours, ("interval", "trajectories", "columns"))


PAPER = Paper(
    dict(_figures()),
    {"paper_share_mean": _of_interval("data rate"), "paper_share_sd": _of_interval("data rate, sd")},
)


@dataclass(frozen=True)
class EvaluateDataRate:
    """Compare the data rate of events with that of an RGB sensor: overall, in contact, and around slip onset.

    As in the paper, only events in the first 540 columns are counted; those of the window are reported separately.
    """

    around_s: float = parameter(
        0.5, "Length of the interval that counts as around slip, centred on the onset.", unit="s", low=0.002
    )


SUBJECT = Subject(
    "data-rate",
    EvaluateDataRate,
    "evaluate.data_rate.measure",
    "Recordings.",
    examples=("evetac evaluate data-rate data",),
    panel=THE_PAPER,
    title="Data rate",
    about=(
        f"Bytes per second of {COLUMNS} columns as a share of an RGB sensor's, as in the paper; next to it the"
        " share of the columns beyond, where a cut gel has its window."
    ),
    tables=(SubjectTable("Share of an RGB sensor's bytes", having("interval", "share_mean")),),
    paper=PAPER,
)
