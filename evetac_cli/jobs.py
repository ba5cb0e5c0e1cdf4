"""Jobs and what comes of them: a job makes one output file, an outcome holds its rows, progress says how far it is."""

import os
import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

from evetac_cli.errors import InputError

MOST_NAME_BYTES = 255  # of a file, on nearly every file system
APPENDED_BYTES = 48  # to a name while the file is written (store/disk.py), beside the name of this machine


class Progress(Protocol):
    """How far a job is: `done` of `total`, where a total of 0 is not known yet.

    doing: what is done or counted, where it is not what the command counts, as in `files read`.
    """

    def __call__(self, done: float, total: float, doing: str = "") -> None:
        """Report it; whoever listens may leave some reports out."""


def silent(done: float, total: float, doing: str = "") -> None:
    """Report no progress."""


@dataclass(frozen=True)
class Job:
    """One output to make from its inputs; a stage that has to know more of it adds fields in a class of its own."""

    exclusive: ClassVar[bool] = False  # uses devices, of which there is one each: never beside another job
    inputs: tuple[Path, ...]
    output: Path


@dataclass(frozen=True)
class Outcome:
    """What a job reports: flat rows for the table and --json (units end the names), figures over all rows."""

    rows: list[dict[str, Any]]
    simulated: bool
    summary: dict[str, Any] = field(default_factory=dict)
    made: bool = True


def require_possible_name(output: Path) -> None:
    """InputError, before any work, if no file of this name could be written."""
    most = MOST_NAME_BYTES - APPENDED_BYTES - len(platform.node().encode())
    length = len(os.fsencode(output.name))
    if length > most:
        raise InputError(
            "the name is too long", where=str(output), expected=f"at most {most} bytes", found=f"{length} bytes"
        )


def outcome(job: Job, *, made: bool, simulated: bool, **figures: Any) -> Outcome:
    """The row of a job that makes one file."""
    row = {"output": str(job.output), "status": "made" if made else "up to date", **figures}
    return Outcome([row], simulated, made=made)
