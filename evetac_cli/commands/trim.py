"""trim: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class Trim:
    """Cut a range of slices out of a recording, or its noise, as a recording of its own."""

    from_ms: int = parameter(0, "First slice of the piece.", unit="ms", low=0)
    to_ms: int | None = parameter(None, "Slice after its last; default: the end.", unit="ms", low=1)
    denoise: bool = parameter(
        False,
        "Leave out noise: the events of hot pixels that the recording's calibration names, and then those with no event"
        " at the 8 pixels around within --support-ms before, as dv-processing's filter of background activity does.",
    )
    support_ms: float | None = parameter(
        None,
        "How long before an event another beside it may be; default: 2. The authors' readout has 100.",
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
