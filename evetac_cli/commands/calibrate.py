"""calibrate: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.parameter import Command, parameter

FOUND = "dots that are searched (no --refine, no sensor file)"
OF_SENSOR = "a sensor file (--import)"


@dataclass(frozen=True)
class Calibrate:
    """Find the dot grid of a gel in a press recording, or import one, and write it as JSON for --calibration."""

    refine: Path | None = parameter(
        None, "Start from this default grid (JSON); dots that were not pressed keep their positions.", recipe=False
    )
    source: Path | None = parameter(
        None,
        "Import the grid from this file: JSON, a pickle of the official software (read without executing it), or a"
        " sensor's TOML file written by identify. The latter adds the contrast, threshold and stiffness for slip"
        " detectors.",
        flag="--import",
        recipe=False,
    )
    gel: str | None = parameter(
        None,
        "Type of gel; a cut gel has a window next to its dots. Default: that of the recording or the default grid, or"
        " closed if the dots leave no space for a window.",
        choices=("cut", "closed"),
        needs=(FOUND, OF_SENSOR),
    )
    rows: int | None = parameter(
        None,
        "Rows of dots, together with --columns, if they differ from an Evetac's 7 x 9 (cut gel: 7 x 8).",
        low=2,
        high=128,
        needs=(FOUND,),
    )
    columns: int | None = parameter(None, "Columns of dots, together with --rows.", low=2, high=128, needs=(FOUND,))
    irregular: bool = parameter(
        False,
        "Accept all dots that are found, for dots that form no grid (staggered rows, random positions).",
        needs=(FOUND,),
    )


COMMAND = Command(
    "calibrate",
    Calibrate,
    "stages.calibrate",
    "Recordings of presses; not used with --import.",
    suffix=".json",
    files_needed=False,
    examples=(
        "evetac calibrate press.recording.h5 --gel cut -o gel.json",
        "evetac calibrate press.recording.h5 --rows 6 --columns 10 -o gel.json",
        "evetac calibrate --import official.pkl",
    ),
)
