"""trim: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class Trim:
    """Make a recording from a range of slices of another, or from all of them without noise."""

    from_ms: int = parameter(0, "First slice of the piece.", unit="ms", low=0)
    to_ms: int | None = parameter(None, "Slice after its last; default: the end.", unit="ms", low=1)
    denoise: bool = parameter(
        False,
        "Leave out noise: the events of hot pixels that the recording's calibration names, and then those with no event"
        " at the 8 pixels around within --support-ms before, as dv-processing's filter of background activity does.",
    )
    support_ms: float | None = parameter(
        None,
        "Keep an event if one of the 8 pixels around had an event less than this long before; default: 2. The authors'"
        " readout uses 100.",
        unit="ms",
        low=0.001,
        high=10_000.0,
    )


COMMAND = Command(
    "trim",
    Trim,
    "stages.trim",
    "Recordings.",
    examples=(
        "evetac trim long.recording.h5 --from-ms 500 --to-ms 1500 -o piece.recording.h5",
        "evetac trim noisy.recording.h5 --denoise -o clean.recording.h5",
    ),
)
