"""evaluate tracking: tracked dots against where they began and where they truly were."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable, having
from evetac_cli.evaluate.tracking.paper import PAPER


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
