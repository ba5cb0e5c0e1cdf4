"""evaluate data-rate: bytes of events against those of an RGB sensor."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.data_rate.paper import COLUMNS, PAPER
from evetac_cli.evaluate.subject import THE_PAPER, Subject, SubjectTable, having


@dataclass(frozen=True)
class EvaluateDataRate:
    """Compare the data rate of events with that of an RGB sensor: overall, in contact, and around slip onset.

    As in the paper, only events in the first 540 columns are counted; those of the window are reported separately.
    """

    event_bytes: int = parameter(5, "Size of an event: x, y and polarity.", unit="bytes", low=1, high=64)
    rgb_frame: str = parameter("540x480x3", "Frame of the RGB sensor: width, height and bytes per pixel.")
    rgb_hz: float = parameter(25.0, "Frame rate of the RGB sensor.", unit="Hz", low=0.001, high=1e6)
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
