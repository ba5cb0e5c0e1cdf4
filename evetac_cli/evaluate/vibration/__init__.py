"""evaluate vibration: the frequency at which the gel vibrates."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable, grouped, having
from evetac_cli.evaluate.vibration.paper import PAPER
from evetac_cli.jobs import Row, Rows


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


def _windows(rows: Rows, summary: Row) -> Rows:
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
