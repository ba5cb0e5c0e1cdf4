"""Jobs and their results: a job makes one output file, an outcome holds its rows, progress reports how far it is."""

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

from evetac_cli.errors import EvetacError, InputError

MOST_NAME_BYTES = 255  # longest file name on nearly every file system
APPENDED_BYTES = 48  # added to a name while the file is written (store/hdf5/disk.py), plus the name of this machine
P = TypeVar("P")  # parameters of a command


class Progress(Protocol):
    """A callback for the progress of a job: `done` of `total`; a total of 0 means that it is not known yet.

    doing: the current activity or unit, if it differs from the command's unit, for example `files read`.
    """

    def __call__(self, done: float, total: float, doing: str = "") -> None:
        """Report progress; the receiver may ignore some reports."""


def silent(done: float, total: float, doing: str = "") -> None:
    """Report no progress."""


@dataclass(frozen=True)
class Job:
    """One output to make from its inputs; a stage that needs more information defines a subclass."""

    exclusive: ClassVar[bool] = False  # whether it uses devices, so that no other job may run at the same time
    inputs: tuple[Path, ...]
    output: Path

    @property
    def outputs(self) -> tuple[Path, ...]:
        """All files that the job makes; for most jobs only `output`, which identifies the job."""
        return (self.output,)


@dataclass(frozen=True)
class Outcome:
    """The result of a job: flat rows for the table and --json (names end in units), and figures over all rows."""

    rows: list[dict[str, Any]]
    simulated: bool
    summary: dict[str, Any] = field(default_factory=dict)
    made: bool = True


Row = dict[str, Any]
Rows = list[Row]


class LookCall(NamedTuple):
    """A call of a command that prints: its module has `look(LookCall) -> Outcome` and `show(Outcome, verbose)`.

    paths: as typed; files: returns them with each folder replaced by its stage files; errors: takes those of single
    files, which hide no other.
    """

    paths: list[Path]
    files: Callable[[], list[Path]]
    params: Any
    out: Path | None
    quiet: bool
    progress: Progress
    errors: list[EvetacError]


@dataclass(frozen=True)
class Stage(Generic[P]):
    """The functions that a command which writes files needs from its stage; the stage defines them as STAGE.

    - jobs: return the jobs for some files and parameters, with their outputs.
    - run: run one job, (job, params, *, force, progress) -> Outcome.
    - cautions: return notes to print before long work begins.
    - parts: return parts of a job that can be made at the same time, before the job itself.
    - for_people: return the rows for a terminal, and a verdict in sentences.
    - details: columns of these rows that a terminal shows only with -v.
    - details_of_many: ... only with -v if there are too many rows to list the columns of each below each other.
    - warnings: return warnings on all rows together, which are printed once on stderr.
    - dry_run: return what would be made and its cost, (jobs, params, *, force, progress) -> Outcome.
    - dry_run_for_people: return the part of this that fits a screen.
    """

    jobs: Callable[[list[Path], P, Path | None], Sequence[Job]]
    run: Callable[..., Outcome]
    cautions: Callable[[Sequence[Any], P], list[str]] = lambda jobs, params: []
    parts: Callable[[Any, P], Sequence[Job]] = lambda job, params: ()
    for_people: Callable[[Rows, P], tuple[Rows, list[str]]] = lambda rows, params: (rows, [])
    details: frozenset[str] = frozenset()
    details_of_many: frozenset[str] = frozenset()
    warnings: Callable[[Rows], list[str]] = lambda rows: []
    dry_run: Callable[..., Outcome] | None = None
    dry_run_for_people: Callable[[Outcome], tuple[Rows, list[str]]] = lambda shown: (shown.rows, [])


def require_possible_name(output: Path) -> None:
    """Raise InputError, before any work, if the name is too long for a file."""
    most = MOST_NAME_BYTES - APPENDED_BYTES - len(platform.node().encode())
    length = len(os.fsencode(output.name))
    if length > most:
        raise InputError(
            "the name is too long", where=str(output), expected=f"at most {most} bytes", found=f"{length} bytes"
        )


def outcome(job: Job, *, made: bool, simulated: bool, **figures: Any) -> Outcome:
    """Return the outcome, with one row, of a job that makes one file."""
    row = {"output": str(job.output), "status": "made" if made else "up to date", **figures}
    return Outcome([row], simulated, made=made)
