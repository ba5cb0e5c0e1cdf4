"""validate: its flags, its examples, and the module that answers it."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import LOOK, Command, parameter


@dataclass(frozen=True)
class Validate:
    """Check stage files: their schema, the consistency of their numbers, and their recipe id."""

    repair: bool = parameter(
        False,
        "Make valid recordings from interrupted ones (folders NAME.recording.part, or folders with some), and report"
        " how much was recovered.",
        recipe=False,
    )


COMMAND = Command(
    "validate",
    Validate,
    "inspect.validate",
    "Stage files. For a folder, all stage files in it are checked.",
    kind="",
    unit="files",
    examples=("evetac validate data", "evetac validate --repair data"),
    does=LOOK,
)
