"""info: its flags, its examples, and the module that answers it."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import LOOK, Command, parameter


@dataclass(frozen=True)
class Info:
    """Show the contents of stage files: kind, duration, events, rates, history. For a folder, count its files."""

    where: list[str] | None = parameter(
        None,
        "For a folder: show only files that satisfy this condition, e.g. object=3, seed=10-19 or kind=labels,features."
        " Repeat the flag for more conditions; all must be satisfied.",
        recipe=False,
    )


COMMAND = Command(
    "info",
    Info,
    "inspect.info",
    "Stage files, or a folder of them.",
    kind="",
    unit="files",
    examples=("evetac info a.recording.h5", "evetac info data", "evetac info data --where object=3"),
    does=LOOK,
)
