"""track-rgb: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import Command, parameter


@dataclass(frozen=True)
class TrackRgb:
    """Track the dots by optical flow in simulated 25 Hz RGB frames, for comparison (simulated recordings)."""

    seed: int = parameter(0, "Seed of the frames' noise.", low=0, high=2**31 - 1)


COMMAND = Command(
    "track-rgb",
    TrackRgb,
    "stages.track_rgb",
    "Simulated recordings.",
    unit="frames",
    examples=("evetac track-rgb data -o rgb",),
)
