"""How commands use the indexes of data sets: to find outputs that are up to date, and to add new files after a run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evetac_cli import console
from evetac_cli.cli import workers
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent

if TYPE_CHECKING:  # `evetac --help` loads none of it
    from evetac_cli.store.index import Describe, IndexRow, Seen

COMPILES = False  # describing files needs no kernel
MOST_OF_A_JOB = 64  # files per job: sending a job takes as long as reading some files
JOBS_A_WORKER = 4  # at least, so that no worker waits long for the others at the end
FEW = 20  # reading fewer files takes less time than starting a process
Results = dict[Path, Outcome | EvetacError]


@dataclass(frozen=True)
class Described(Job):
    """A job that describes files of a folder, given with their file status; `output` only identifies the job."""

    files: tuple[tuple[str, "Seen"], ...] = ()


def run(job: Described, folder: Path, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Describe some files of a folder, in a worker, and return the rows for the index."""
    from evetac_cli.store.index import describe

    rows = []
    for number, (name, seen) in enumerate(job.files):
        progress(number, len(job.files))
        rows.append(describe(folder, name, *seen)._asdict())
    return Outcome(rows, simulated=False)


def describer(at_once: int) -> "Describe":
    """Return a function that describes files in this process, or in `at_once` processes."""
    from evetac_cli.store.index import one_by_one

    return one_by_one if at_once < 2 else partial(_in_workers, at_once)


def _in_workers(
    at_once: int,
    folder: Path,
    files: "Mapping[str, Seen]",
    progress: Callable[[int, int], None],
    take: "Callable[[Sequence[IndexRow]], None]",
) -> None:
    """Describe files in several processes. If a file crashes its process, only this file is lost."""
    from evetac_cli.store.index import IndexRow, one_by_one

    if len(files) < FEW:
        one_by_one(folder, files, progress, take)
        return
    results: Results = {}
    taken: set[Path] = set()
    described = 0

    def take_new() -> None:
        nonlocal described
        for output in [output for output in results if output not in taken]:
            taken.add(output)
            result = results[output]
            if isinstance(result, Outcome):
                described += len(result.rows)
                take([IndexRow(**row) for row in result.rows])

    def report(done: float, total: float, doing: str = "") -> None:
        take_new()
        progress(described, len(files))

    def work_off(jobs: Sequence[Described]) -> list[Described]:
        """Run the jobs and return those during which a process died."""
        try:
            workers.run_parallel("cli.indexing", list(jobs), folder, False, at_once, report, results)
        finally:
            take_new()
        return [job for job in jobs if isinstance(results.get(job.output), EvetacError)]

    size = max(1, min(MOST_OF_A_JOB, len(files) // (at_once * JOBS_A_WORKER)))
    names = sorted(files)
    jobs = [_job(folder, files, names[first : first + size]) for first in range(0, len(names), size)]
    again = [_job(folder, files, [name]) for job in work_off(jobs) for name, _ in job.files]
    for job in work_off(again) if again else ():
        ((name, seen),) = job.files
        error = results[job.output]
        assert isinstance(error, EvetacError)
        take([IndexRow(name, *seen, error=f"{error.message}: {error.found}")])


def _job(folder: Path, files: "Mapping[str, Seen]", names: Sequence[str]) -> Described:
    """Return a job for files; that of a single file differs from that of several files which it leads."""
    alone = "" if len(names) > 1 else "/alone"
    return Described((), Path(f"{folder / names[0]}{alone}"), tuple((name, files[name]) for name in names))


def up_to_date(stage: Stage[Any], jobs: Sequence[Job], params: Any) -> dict[Path, Outcome]:
    """Return the outcomes of jobs whose outputs are up to date by the indexes next to them; no output is opened."""
    from evetac_cli.store.index.known import Known

    known_outcomes: dict[Path, Outcome] = {}
    if stage.recipe is None:
        return known_outcomes
    with Known() as indexes:
        for job in jobs:
            if indexes.place(job.output.parent) is None:
                continue
            try:
                recipe = stage.recipe(job, params, indexes)
            except EvetacError:  # the job will report it
                continue
            if recipe is not None and indexes.is_up_to_date(job.output, recipe):
                known_outcomes[job.output] = outcome(job, made=False, simulated=recipe.simulated)
    return known_outcomes


def learn(jobs: Sequence[Job], at_once: int, quiet: bool) -> None:
    """Update existing indexes with the files that jobs read and wrote; no index is created."""
    from evetac_cli.store.index import table
    from evetac_cli.store.index.known import Known

    with Known() as indexes:
        unknown = indexes.unknown(path for job in jobs for path in (*job.inputs, *job.outputs))
    for folder, files in unknown.items():
        rows: list[IndexRow] = []
        with console.progress_bar(f"index {folder}", "files", quiet=quiet) as progress:
            describer(at_once)(folder, files, progress, rows.extend)
        table.add(folder / table.NAME, rows)
