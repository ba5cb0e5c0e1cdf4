"""calibrate: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class Calibrate:
    """Find the dot grid of a gel in a press recording, or import it, and write it as JSON for --calibration."""

    refine: Path | None = parameter(
        None, "Start from this default grid (JSON); dots that were not pressed keep its places.", recipe=False
    )
    source: Path | None = parameter(
        None,
        "Import this instead: the official software's pickle, which is not executed, JSON, or a sensor's TOML file as"
        " identify writes it, with the contrast, threshold and stiffness that slip detectors ask for.",
        flag="--import",
        recipe=False,
    )
    gel: str | None = parameter(
        None,
        "Kind of gel; a cut one has a window beside its dots. Default: as the recording or the default grid says,"
        " or closed where the dots leave no room for a window.",
        choices=("cut", "closed"),
    )
    rows: int | None = parameter(
        None, "Rows of dots, with --columns, of a gel other than an Evetac's 7 x 9 (cut: 7 x 8).", low=2, high=128
    )
    columns: int | None = parameter(None, "Columns of dots, with --rows.", low=2, high=128)
    irregular: bool = parameter(False, "The dots are in no grid (staggered rows, at random): take all that are found.")


COMMAND = Command(
    "calibrate",
    Calibrate,
    "stages.calibrate",
    "Press recordings; none with --import.",
    suffix=".json",
    files_needed=False,
    examples=(
        "evetac calibrate press.recording.h5 --gel cut -o gel.json",
        "evetac calibrate press.recording.h5 --rows 6 --columns 10 -o gel.json",
        "evetac calibrate --import official.pkl",
    ),
)
