"""evaluate likeness: recordings against published facts about the sensor."""

from dataclasses import dataclass

from evetac_cli.evaluate.subject import SIMULATOR, Subject, SubjectTable


@dataclass(frozen=True)
class EvaluateLikeness:
    """Compare recordings, simulated or real, with published facts about the sensor, and list facts without figures."""


SUBJECT = Subject(
    "likeness",
    EvaluateLikeness,
    "evaluate.likeness.command",
    "Recordings at rest, of presses or of slips, as available.",
    examples=(
        "evetac evaluate likeness slip rest.recording.h5",
        "evetac evaluate likeness real.recording.h5 --json",
    ),
    panel=SIMULATOR,
    title="Public facts about the sensor",
    about="Publicly known facts about the real sensor, compared with recordings"
    " and with evetac's trainings and grasps.",
    tables=(
        SubjectTable(
            "Facts with figures",
            lambda rows, summary: [row for row in rows if "public" in row and not row.get("not_measured")],
            ("counts", "fact", "public", "simulated", "simulated_from", "compared", "real", "unit", "class"),
        ),
    ),
)
