"""evaluate vibration: the frequency at which the gel vibrates."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.common.marks import Conditions, Key, Paper, PaperColumn, PaperFigure, Row, Source, scenes
from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable, grouped, having
from evetac_cli.jobs import Rows

WINDOWS_S = (10.0, 2.0, 1.0)  # lengths of windows
WHOLE_S = 100.0  # recorded per tone


def _figures() -> Iterator[tuple[Key, PaperFigure]]:
    where = "Sensing Vibrations, table of windows"
    for tone, shares in (
        ("100", (1.00, 0.98, 0.96)), ("200", (1.00, 0.92, 0.69)), ("300", (1.00, 1.00, 0.99)),
        ("400", (1.00, 1.00, 0.98)), ("498", (1.00, 1.00, 1.00)), ("all", (1.00, 0.98, 0.924)),
    ):  # fmt: skip
        for length_s, share in zip(WINDOWS_S, shares, strict=True):
            windows = WHOLE_S / length_s * (5 if tone == "all" else 1)
            conditions = Conditions("paper", "vibration", (windows,))
            figure = PaperFigure(share, "share", where, conditions, fitted_in="vibration", trials=round(windows))
            yield ("vibration", tone, length_s), figure
            if tone == "all":
                among = replace(
                    figure, value=1.0, where="Sensing Vibrations", fitted_in="", trials=0, limits=(1.0, 1.0)
                )
                yield ("among three", tone, length_s), among
                if length_s == WINDOWS_S[1]:  # 5 of 250
                    yield ("half tone", tone, length_s), replace(figure, value=0.02, where="Sensing Vibrations")


def _of_tone(quantity: str) -> PaperColumn:
    """Return a column of windows; a row over all tones has none as its tone."""

    def key(row: Row) -> Key:
        tone_hz = row.get("expected_hz")
        return (quantity, "all" if tone_hz is None else f"{tone_hz:g}", row["window_s"])

    def ours(row: Row, source: Source) -> Conditions:
        return Conditions(row["method"], scenes(source), (row["windows"],))

    return PaperColumn(key, ours, ("method", "window_s", "windows"), ("expected_hz",))


PAPER = Paper(
    dict(_figures()),
    {
        "paper_share": _of_tone("vibration"),
        "paper_among_three_share": _of_tone("among three"),
        "paper_half_tone_share": _of_tone("half tone"),
    },
)


@dataclass(frozen=True)
class EvaluateVibration:
    """Estimate the frequency at which the gel vibrates, and how often windows of each length estimate it correctly."""

    preset: str = parameter(
        "default",
        "default: the amplitude of the gel's motion at each frequency, together with the paper's method. paper: only"
        " the strongest line in the spectrum of events per slice.",
        choices=("default", "paper"),
    )
    windows: str = parameter("10,2,1", "Lengths of the windows, from 0.1 to 10.", unit="s")
    true_hz: float | None = parameter(
        None, "Tone that was played; default: the ground truth of a simulation.", unit="Hz", low=0.1, high=1e6
    )
    tolerance_hz: float = parameter(
        1.0,
        "An estimate this close to the tone counts as correct; at least 0.5 divided by the window's length is allowed,"
        " e.g. 2 Hz for 0.25 s.",
        unit="Hz",
        low=0.0,
        high=1e3,
    )
    lowest_hz: float = parameter(25.0, "Lowest frequency that is considered.", unit="Hz", low=1.0, high=1e4)
    rate: int = parameter(
        1000,
        "Sampling rate of the event counts; frequencies up to half of it are considered.",
        unit="Hz",
        low=100,
        high=20000,
    )
    false_alarms: float = parameter(
        0.01, "Probability that noise alone is reported as a vibration; for preset default.", low=1e-9, high=0.5
    )


def _windows(rows: Rows, summary: dict[str, Any]) -> Rows:
    """Return shares over all recordings of a tone."""
    windows = having("window_s", "correct", "expected_hz")(rows, summary)
    tones = []
    for members in grouped(windows, ("method", "expected_hz", "window_s")):
        correct, count = (sum(row[key] for row in members) for key in ("correct", "windows"))
        recordings = {"recordings": len(members), "correct": correct, "windows": count, "share": correct / count}
        tones.append({**members[0], **recordings})
    return tones


SUBJECT = Subject(
    "vibration",
    EvaluateVibration,
    "evaluate.vibration.measure",
    "Recordings.",
    unit="ms",
    examples=("evetac evaluate vibration tones", "evetac evaluate vibration own.recording.h5 --true-hz 300"),
    panel=OWN_DATA,
    title="Vibration",
    about="Windows in which the frequency of the tone is detected, in recordings with a known tone that are"
    " long enough.",
    tables=(
        SubjectTable(
            "Windows with the correct tone",
            _windows,
            ("method", "expected_hz", "window_s", "recordings", "windows", "share"),
        ),
        SubjectTable(
            "Recordings",
            having("file", "method", "seconds"),
            ("file", "method", "seconds", "frequency_hz", "uncertainty_hz", "expected_hz"),
        ),
    ),
    paper=PAPER,
)
