"""track: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.parameter import Command, parameter


@dataclass(frozen=True)
class Track:
    """Track the dots of the gel through all slices of a recording."""

    preset: str = parameter(
        "stable",
        f"Preset of the tracker; {names.words(names.TRACKERS)}.",
        choices=tuple(names.TRACKERS),
    )
    step_size: float | None = parameter(None, "Gradient step size alpha; overrides the preset.", low=0.0)
    regulariser: float | None = parameter(None, "Weight of the distance regulariser; overrides the preset.", low=0.0)
    min_events: int | None = parameter(
        None,
        "A dot is moved only by more events than this in a slice; overrides the preset.",
        unit="events",
        low=0,
    )
    calibration: Path | None = parameter(
        None, "Dot grid (JSON) to use instead of the one in the recording.", recipe=False
    )


COMMAND = Command(
    "track",
    Track,
    "stages.track",
    "Recordings.",
    examples=("evetac track data --jobs 2", "evetac track a.recording.h5 --preset paper -o paper"),
)
