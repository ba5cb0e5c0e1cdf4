"""trim: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import Command, parameter


@dataclass(frozen=True)
class Trim:
    """Cut a recording to a range of slices, remove its noise, or both, and write a new recording."""

    from_ms: int = parameter(0, "First slice to keep.", unit="ms", low=0)
    to_ms: int | None = parameter(
        None, "Slice before which the new recording ends; default: the end.", unit="ms", low=1
    )
    denoise: bool = parameter(
        False,
        "Remove noise: first the events of hot pixels listed in the recording's calibration, then events without an"
        " event at one of the 8 neighbouring pixels in the --support-ms before, as in dv-processing's background"
        " activity filter.",
    )
    support_ms: float | None = parameter(
        None,
        "Keep an event if one of its 8 neighbouring pixels had an event less than this long before; default: 2. The"
        " authors' readout uses 100.",
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
