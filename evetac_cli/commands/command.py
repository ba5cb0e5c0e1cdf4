"""A command: its flags, its input files, and the stage that it runs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """A command that writes files: its parameters, its module, its input files, and the unit of its progress bar."""

    name: str
    params: type
    module: str
    files: str  # help text of the file arguments; empty if the command takes none
    kind: str = "recording"  # kind of the files taken from a folder; empty: the command handles folders itself
    suffix: str = ".h5"  # of an output file named by -o
    unit: str = "slices"
    files_needed: bool = True
    examples: tuple[str, ...] = ()  # command lines shown by --help
