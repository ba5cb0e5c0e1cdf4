"""Jobs and what comes of them: a job makes one output file, an outcome holds its rows, progress says how far it is."""

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from evetac_cli.errors import InputError

MOST_NAME_BYTES = 255  # of a file, on nearly every file system
APPENDED_BYTES = 48  # to a name while the file is written (store/hdf5/disk.py), beside the name of this machine
P = TypeVar("P")  # parameters of a command


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

    @property
    def outputs(self) -> tuple[Path, ...]:
        """All files that it makes: of most jobs `output` alone, which stands for them."""
        return (self.output,)


@dataclass(frozen=True)
class Outcome:
    """What a job reports: flat rows for the table and --json (units end the names), figures over all rows."""

    rows: list[dict[str, Any]]
    simulated: bool
    summary: dict[str, Any] = field(default_factory=dict)
    made: bool = True


Row = dict[str, Any]
Rows = list[Row]


def no_cautions(jobs: Sequence[Any], params: Any) -> list[str]:
    """Nothing has to be known before the work begins."""
    return []


def no_parts(job: Any, params: Any) -> Sequence[Job]:
    """A job is made in one piece."""
    return ()


def no_warnings(rows: Rows) -> list[str]:
    """Nothing is wrong with what came out."""
    return []


def all_rows(rows: Rows, params: Any) -> tuple[Rows, list[str]]:
    """A terminal shows every row, and no sentence."""
    return rows, []


@dataclass(frozen=True)
class Stage(Generic[P]):
    """What a command that makes files asks of its stage, which defines it as STAGE.

    jobs: what has to be made from files and parameters, and where; run: make one job, (job, params, *, force, progress)
    -> Outcome. cautions: what to know before long work begins. parts: of a job, what can be made at the same time
    before it. for_people: the rows that a terminal shows, and what they amount to. warnings: what to know of all rows
    together, said once on stderr. dry_run: what would be made and what that costs, (jobs, params, *, force, progress)
    -> Outcome; dry_run_for_people: what of it fits a screen. recipe: that of a job's output, as far as indexes know its
    inputs, (job, params, store.index.known.Known) -> Recipe or None.
    """

    jobs: Callable[[list[Path], P, Path | None], Sequence[Job]]
    run: Callable[..., Outcome]
    cautions: Callable[[Sequence[Any], P], list[str]] = no_cautions
    parts: Callable[[Any, P], Sequence[Job]] = no_parts
    for_people: Callable[[Rows, P], tuple[Rows, list[str]]] = all_rows
    warnings: Callable[[Rows], list[str]] = no_warnings
    dry_run: Callable[..., Outcome] | None = None
    dry_run_for_people: Callable[[Outcome], tuple[Rows, list[str]]] = lambda shown: (shown.rows, [])
    recipe: Callable[[Any, P, Any], Any] | None = None


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
