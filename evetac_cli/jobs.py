"""Jobs and what comes of them: a job makes one output file, an outcome holds its rows, progress is (done, total)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

Progress = Callable[[int, int], None]  # (done, total)


def silent(done: int, total: int) -> None:
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


def outcome(job: Job, *, made: bool, simulated: bool, **figures: Any) -> Outcome:
    """The row of a job that makes one file."""
    row = {"output": str(job.output), "status": "made" if made else "up to date", **figures}
    return Outcome([row], simulated, made=made)
