"""A command: its flags, which files it takes, and the stage that it runs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """A command that makes files: its parameters, its module, its input files, and what its progress counts."""

    name: str
    params: type
    module: str
    files: str  # what the file arguments are; empty if the command takes none
    kind: str = "recording"  # of the files that are taken from a folder; empty: the command sees to folders itself
    suffix: str = ".h5"  # of a file that -o names
    unit: str = "slices"
    files_needed: bool = True
    examples: tuple[str, ...] = ()  # of command lines, as --help shows them
