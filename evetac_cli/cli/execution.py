"""Run a command that writes files: from files and flags to jobs, and from jobs to a table, a verdict and the outputs.

jobs.Stage documents what a stage may define in addition to `jobs` and `run`.
"""

import importlib
import re
import shlex
import time
from collections import Counter
from pathlib import Path
from typing import Any

from evetac_cli import console
from evetac_cli.cli import config, flags, workers
from evetac_cli.cli.exit_codes import CommandExit
from evetac_cli.cli.flags import Running
from evetac_cli.commands.parameter import Command
from evetac_cli.errors import MADE_BY, EvetacError, InputError, made_by
from evetac_cli.interrupts import interrupt_received
from evetac_cli.jobs import Job, Outcome, Stage, require_possible_name


def execute(command: Command, title: str, flag_values: dict[str, Any]) -> None:
    """Run all jobs of a command and print their results."""
    running = Running.take(flag_values, flags.OF_STAGES)
    paths = flag_values.pop("files", [])
    with CommandExit(title, running) as run:
        params = config.resolve(command.params, title, flag_values, running.config)
        files = with_folders(paths, command.kind) if command.kind else list(paths)
        _check_out(running.out, command.suffix)
        stage: Stage[Any] = importlib.import_module(f"evetac_cli.{command.module}").STAGE
        jobs = list(stage.jobs(files, params, running.out))
        _check_outputs(jobs, files, params, force=running.force)
        require_jobs(running)
        if stage.dry_run is not None and params.dry_run:
            _dry_run(f"{title} --dry-run", stage, jobs, params, running)
            return
        for line in stage.cautions(jobs, params) if not running.quiet else ():
            console.say(f"note: {line}")
        started = time.monotonic()
        previews = getattr(params, "preview", False)
        run_jobs(command, stage, jobs, params, running, run.results)
        run.results = {job.output: run.results[job.output] for job in jobs}
        outcomes, errors = run.outcomes(), run.errors()
        if not running.quiet and outcomes:
            any_new = any(outcome.made for outcome in outcomes)
            took = f"{time.monotonic() - started:.1f} s" if any_new else "up to date, nothing to do"
            console.say(f"{title}: {took}")
        if outcomes and not (errors and running.as_json):
            own = outcomes[0].summary if len(outcomes) == 1 else {}
            simulated = any(outcome.simulated for outcome in outcomes)
            rows = [row for outcome in outcomes for row in outcome.rows]
            for line in stage.warnings(rows) if not running.quiet else ():
                console.say(f"warning: {line}")
            if running.as_json:
                console.show(title, rows, own or console.count(outcomes), simulated=simulated, as_json=True)
            elif not running.quiet:
                # A stage may select the rows that people want to see, and add a verdict.
                shown_rows, verdict = stage.for_people(rows, params)
                verbose = running.verbose
                if not verbose:
                    many = stage.details_of_many if len(shown_rows) > console.FEW_ROWS else frozenset()
                    if any(many & row.keys() for row in shown_rows):
                        console.say("-v and --json print all columns")
                    details = stage.details | many
                    short = [{name: row[name] for name in row if name not in details} for row in shown_rows]
                    shown_rows = console.first_rows(short)
                console.print_table(title, shown_rows, own, simulated=simulated, verbose=verbose)
                if not own:
                    console.print_text(console.counted(outcomes))
                done = [job for job in jobs if isinstance(run.results[job.output], Outcome)]
                written = [path for job in done for path in job.outputs]
                console.print_result(verdict, [] if previews else written)
        if errors:
            for error in errors[1:]:
                console.say(f"error: {error}")
            raise errors[0]


def require_jobs(running: Running) -> None:
    """Raise InputError if the number of jobs is below 1."""
    if running.number_of_jobs < 1:
        raise InputError("out of range", where="--jobs", expected="at least 1", found=str(running.number_of_jobs))


def _dry_run(title: str, stage: Stage[Any], jobs: list[Job], params: Any, running: Running) -> None:
    """Print what would be made: what fits a screen, or with -v or --json everything.

    A scene is run to measure its cost: some seconds, up to a minute if it has to be compiled first.
    """
    assert stage.dry_run is not None
    with (
        console.progress_bar(title, "runs", quiet=running.quiet) as progress,
        workers.announced(quiet=running.quiet, interrupted=interrupt_received),
    ):
        shown = stage.dry_run(jobs, params, force=running.force, progress=progress)
    if running.as_json or running.verbose:
        how = {"as_json": running.as_json, "verbose": running.verbose}
        console.show(title, shown.rows, shown.summary, simulated=shown.simulated, **how)
        return
    rows, lines = stage.dry_run_for_people(shown)
    console.print_table(title, rows, {}, simulated=shown.simulated)
    console.print_result(lines, [])


def with_folders(paths: list[Path], kind: str = "*") -> list[Path]:
    """Return the named files, with each folder replaced by its files of a kind; InputError for a folder without any."""
    files: list[Path] = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        inside = sorted(entry for entry in path.glob(f"*.{kind}.h5") if entry.is_file())
        if kind == "*":
            inside = _without_foreign(path, inside)
        if not inside:
            below = next(iter(sorted(path.glob(f"*/*.{kind}.h5"))), None)
            hint = made_by(kind) if kind in MADE_BY else ""
            if below:
                hint = f"name the folder that contains them: {below.parent}"
            raise InputError(
                "no such file in this folder",
                where=str(path),
                expected=f"*.{kind}.h5",
                hint=hint,
            )
        files += inside
    return files


def _without_foreign(folder: Path, inside: list[Path]) -> list[Path]:
    """Return the files of a folder without those in other formats, such as exports; their number is printed."""
    from evetac_cli.store.files import is_foreign

    foreign = set(filter(is_foreign, inside))
    if foreign:
        which = f"{len(foreign):,} HDF5 file{'s' if len(foreign) > 1 else ''} of other programs ({min(foreign).name})"
        console.say(f"{folder}: skipped: {which}")
    return [path for path in inside if path not in foreign]


def _check_out(out: Path | None, suffix: str) -> None:
    """Raise InputError for `-o NAME.txt`, which would become a folder of this name."""
    if out is not None and re.fullmatch(r"\.[A-Za-z]\w{0,6}", out.suffix) and out.suffix != suffix and not out.is_dir():
        raise InputError(
            "looks like a file of another kind",
            where="--out",
            expected=f"a name that ends in {suffix}, or a folder",
            found=str(out),
            hint=f"for a folder of this name, run mkdir {shlex.quote(str(out))} first",
        )


def _check_outputs(jobs: list[Job], files: list[Path], params: Any, *, force: bool) -> None:
    """Refuse outputs that would replace each other, or (with --force) their own inputs."""
    for job in jobs:
        require_possible_name(job.output)
    times = Counter(path for job in jobs for path in job.outputs)
    clash = sorted(output for output, count in times.items() if count > 1)
    if clash:
        expected, found = "a folder, and inputs of different names", ", ".join(map(str, clash))
        raise InputError("one output file cannot hold several results", where="--out", expected=expected, found=found)
    path_values = (value for value in vars(params).values() if isinstance(value, Path))
    inputs = {path.resolve() for path in (*files, *path_values, *(path for job in jobs for path in job.inputs))}
    lost = sorted(output for output in times if output.resolve() in inputs) if force else []
    if lost:
        raise InputError("the output would replace an input", found=", ".join(map(str, lost)))


def run_jobs(
    command: Command,
    stage: Stage[Any],
    jobs: list[Job],
    params: Any,
    running: Running,
    results: dict[Path, Outcome | EvetacError],
) -> None:
    """Run the jobs, several at a time if requested, and fill in the results; one failure does not stop the others."""
    shown = getattr(params, "shown", False)  # a live view prints its own lines
    quiet, force = running.quiet or shown or getattr(params, "listen", False), running.force
    scheduler = flags.scheduler_of(running.engine)
    exclusive = shown or any(job.exclusive for job in jobs)
    if exclusive and scheduler:
        raise InputError("devices work only on this computer", where="--engine", expected="local", found=running.engine)
    if scheduler and running.number_of_jobs > 1:
        hint = "leave out --jobs: the number of workers is that of the running cluster"
        raise InputError("has no effect", where="--jobs", found=f"--engine {running.engine}", hint=hint)
    # An existing output is either up to date or refused. This is quick and needs no worker process.
    waiting = [job for job in jobs if force or not job.output.exists()]

    def run_several(some: list[Job], into: dict[Path, Outcome | EvetacError]) -> None:
        at_once = 1 if exclusive else min(running.number_of_jobs, len(some))
        if not some or (not scheduler and at_once < 2):
            return
        how = (command.module, largest_first(some), params, force)
        with console.progress_bar(f"{command.name} {len(some)} files", "files", quiet=quiet) as progress:
            if scheduler:
                from evetac_cli.cli import dask_engine  # loaded only for a cluster

                dask_engine.run_on_dask(scheduler, *how, progress, into)
            else:
                workers.run_parallel(*how, at_once, progress, into, quiet=quiet)

    if scheduler or running.number_of_jobs > 1:
        parts = {job.output: stage.parts(job, params) for job in waiting}
        part_results: dict[Path, Outcome | EvetacError] = {}
        run_several([part for some in parts.values() for part in some], part_results)
        for output, some in parts.items():
            failed = (result for part in some if isinstance(result := part_results.get(part.output), EvetacError))
            if (error := next(failed, None)) is not None:
                results[output] = error
        run_several([job for job in waiting if job.output not in results], results)
    for number, job in enumerate(jobs):
        if job.output not in results:
            which = f" {number + 1} of {len(jobs)}:" if len(jobs) > 1 else ""
            name = f"{command.name}{which} {job.output.name}"
            with (
                console.progress_bar(name, command.unit, quiet=quiet) as progress,
                workers.announced(quiet=quiet, interrupted=interrupt_received),
            ):
                results[job.output] = workers.run_one(command.module, job, params, force, progress)


def largest_first(jobs: list[Job]) -> list[Job]:
    """Return the jobs sorted by the bytes of their inputs, largest first, so that short jobs end last; stable."""

    def size(job: Job) -> int:
        return sum(path.stat().st_size for path in job.inputs if path.is_file())

    return sorted(jobs, key=size, reverse=True)
