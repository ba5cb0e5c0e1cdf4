"""One module per command.

A stage module has INPUTS and OUTPUT (kinds of file), METHOD (raised when its numbers change) and two functions:
`jobs(files, params, out)` says which outputs will be made from which inputs, `run(job, params, ...)` makes one of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import InputError

Progress = Callable[[int, int], None]  # (done, total)


def silent(done: int, total: int) -> None:
    """Report no progress."""


class Job(NamedTuple):
    """One output to make: its inputs, where it goes, and what else tells it from its siblings."""

    inputs: tuple[Path, ...]
    output: Path
    choice: dict[str, Any] = {}


@dataclass(frozen=True)
class Outcome:
    """What a job has to say: flat rows for the table and --json (units end the names), figures over all rows."""

    rows: list[dict[str, Any]]
    simulated: bool
    summary: dict[str, Any] = field(default_factory=dict)
    made: bool = True


def outcome(job: Job, *, made: bool, simulated: bool, **figures: Any) -> Outcome:
    """The row of a job that makes one file."""
    row = {"output": str(job.output), "status": "made" if made else "up to date", **figures}
    return Outcome([row], simulated, made=made)


def per_file(files: list[Path], kind: str, out: Path | None) -> list[Job]:
    """One output of a kind for every input file: beside it, in the folder `out`, or (one input) the file `out`."""
    from evetac_cli.store.files import output_path

    one_file(files, out)
    return [Job((file,), output_path(file, kind, out)) for file in files]


def one_file(outputs: Sequence[Any], out: Path | None) -> None:
    """Refuse `-o NAME.h5` where there are several outputs."""
    if out is not None and out.suffix == ".h5" and len(outputs) > 1:
        raise InputError(
            "one output file cannot hold several results",
            where="--out",
            expected=f"a folder for {len(outputs)} files",
            found=str(out),
        )
