"""trim: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class Trim:
    """Cut a range of slices out of a recording, as a recording of its own."""

    from_ms: int = parameter(0, "First slice of the piece.", unit="ms", low=0)
    to_ms: int | None = parameter(None, "Slice after its last; default: the end.", unit="ms", low=1)


COMMAND = Command(
    "trim",
    Trim,
    "stages.trim",
    "Recordings.",
    examples=("evetac trim long.recording.h5 --from-ms 500 --to-ms 1500 -o piece.recording.h5",),
)
