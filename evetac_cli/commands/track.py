"""track: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.parameter import EXPERTS, Command, parameter

EVENTS, RGB = ("the tracking of events (no --rgb)",), ("--rgb",)


@dataclass(frozen=True)
class Track:
    """Track the dots of the gel through all slices of a recording.

    With --rgb the dots are tracked by optical flow in simulated 25 Hz frames of an RGB sensor behind the same gel.
    """

    preset: str = parameter(
        "stable",
        f"Preset of the tracker; {names.words(names.TRACKERS)}.",
        choices=tuple(names.TRACKERS),
        needs=EVENTS,
    )
    step_size: float | None = parameter(None, "Gradient step size alpha; overrides the preset.", low=0.0, needs=EVENTS)
    regulariser: float | None = parameter(
        None, "Weight of the distance regulariser; overrides the preset.", low=0.0, needs=EVENTS
    )
    min_events: int | None = parameter(
        None,
        "A dot is moved only by more events than this in a slice; overrides the preset.",
        unit="events",
        low=0,
        needs=EVENTS,
    )
    calibration: Path | None = parameter(
        None, "Dot grid (JSON) to use instead of the one in the recording.", recipe=False, needs=EVENTS
    )
    rgb: bool = parameter(
        False,
        "Track simulated RGB frames instead of events, for comparison (simulated recordings). Default of -o: the folder"
        " rgb next to the recording.",
        recipe=False,
    )
    seed: int = parameter(0, "Seed of the frames' noise.", low=0, high=2**31 - 1, panel=EXPERTS, needs=RGB)


COMMAND = Command(
    "track",
    Track,
    "stages.track",
    "Recordings.",
    examples=("evetac track data --jobs 2", "evetac track a.recording.h5 --preset paper", "evetac track data --rgb"),
)
