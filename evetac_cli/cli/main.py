"""The command line: pick a command, read its flags, run its jobs, print the result or the error.

A stage is imported only when it is chosen: `evetac --help` loads none of numpy, h5py, torch, cv2, scipy, numba.
"""

import importlib
import itertools
import os
import re
import shlex
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from evetac_cli import __version__, console, resources
from evetac_cli.cli import compiling, config, engines, exit_codes, flags, workers
from evetac_cli.cli.commands import DOCTOR, EVALUATE, EXPORT, PIPELINE, VIEW, Command
from evetac_cli.cli.exit_codes import CommandExit, Commands
from evetac_cli.errors import DeviceError, EvetacError, InputError
from evetac_cli.jobs import Job, Outcome, require_possible_name

MOST_ROWS = 100  # of one table on a terminal
OF_FOLDERS = ("index", "repair")  # commands that are about folders, not about the files in them

app = typer.Typer(
    cls=Commands,
    help="Event-based touch with an Evetac: record, label, track, featurize, train, evaluate, grasp.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
evaluate = typer.Typer(cls=flags.Group, help="Measure results: figures, tables, a report file.", no_args_is_help=True)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"evetac {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Event-based touch with an Evetac: record, label, track, featurize, train, evaluate, grasp."""


def _add(
    group: typer.Typer,
    command: Command,
    title: str,
    panel: str,
    act: Callable[[Command, str, dict[str, Any]], None] | None = None,
    running: dict[str, tuple[Any, Any, str, str]] = flags.OF_STAGES,
) -> None:
    """Register a command whose signature is made from its parameters."""

    def call(**given: Any) -> None:
        (act or _execute)(command, title, given)

    made = flags.signature(command, running)
    call.__signature__ = made  # type: ignore[attr-defined]
    call.__annotations__ = {name: entry.annotation for name, entry in made.parameters.items()}
    call.__doc__ = flags.help_text(command)
    group.command(command.name, rich_help_panel=panel, cls=flags.CommandOfFlags)(call)


def _execute(command: Command, title: str, given: dict[str, Any]) -> None:
    """Run all jobs of a command and print what came out of them."""
    running = {name: given.pop(name) for name in flags.OF_STAGES}
    named = given.pop("files", [])
    with CommandExit(title, running) as run:
        chosen = config.resolve(command.params, title, given, running["config"])
        files = _with_folders(named, command.kind)
        _check_out(running["out"], command.suffix)
        stage = importlib.import_module(f"evetac_cli.{command.module}")
        jobs: list[Job] = stage.jobs(files, chosen, running["out"])
        _check_outputs(jobs, files, chosen, force=running["force"])
        if running["number_of_jobs"] < 1:
            raise InputError(
                "out of range", where="--jobs", expected="at least 1", found=str(running["number_of_jobs"])
            )
        if getattr(chosen, "dry_run", False):
            # A scene is run to measure what it costs: some seconds, up to a minute where it has to be compiled first.
            quiet = running["quiet"]
            with (
                console.progress_bar(f"{title} --dry-run", "runs", quiet=quiet) as progress,
                compiling.announced(quiet=quiet),
            ):
                shown: Outcome = stage.dry_run(jobs, chosen, force=running["force"], progress=progress)
            as_json, simulated = running["as_json"], shown.simulated
            console.show(f"{title} --dry-run", shown.rows, shown.summary, simulated=simulated, as_json=as_json)
            return
        for line in stage.cautions(jobs, chosen) if hasattr(stage, "cautions") and not running["quiet"] else ():
            console.say(f"note: {line}")
        started = time.monotonic()
        _run(command, jobs, chosen, running, run.results)
        run.results = {job.output: run.results[job.output] for job in jobs}
        outcomes, errors = run.outcomes(), run.errors()
        if not running["quiet"] and outcomes:
            made = any(outcome.made for outcome in outcomes)
            took = f"{time.monotonic() - started:.1f} s" if made else "up to date, nothing to do"
            console.say(f"{title}: {took}")
        if outcomes and not (errors and running["as_json"]):
            summary = outcomes[0].summary if len(outcomes) == 1 and outcomes[0].summary else console.count(outcomes)
            simulated = any(outcome.simulated for outcome in outcomes)
            rows = [row for outcome in outcomes for row in outcome.rows]
            if running["as_json"]:
                console.show(title, rows, summary, simulated=simulated, as_json=True)
            elif not running["quiet"]:
                # A stage may say which of its rows people want to see, and what they amount to.
                for_people = getattr(stage, "for_people", None)
                shown_rows, verdict = for_people(rows, chosen) if for_people else (rows, [])
                console.show(title, _first(shown_rows), summary, simulated=simulated, as_json=False)
                console.print_result(verdict, [path for job in jobs for path in getattr(job, "outputs", [job.output])])
        if errors:
            for error in errors[1:]:
                console.say(f"error: {error}")
            raise errors[0]


def _write_for_others(command: Command, title: str, given: dict[str, Any]) -> None:
    """Run a command whose output is no stage file (a page, an export), and print where it was written."""
    running = {name: given.pop(name) for name in flags.OF_VIEW}
    named = given.pop("files")
    with CommandExit(title, running):
        chosen = config.resolve(command.params, title, given, None)
        files = _with_folders(named, command.kind)
        module = importlib.import_module(f"evetac_cli.{command.module}")
        with console.progress_bar(title, command.unit, quiet=running["quiet"]) as progress:
            result: Outcome = module.run(files, chosen, running["out"], force=running["force"], progress=progress)
        if not running["quiet"] or running["as_json"]:
            console.show(title, result.rows, result.summary, simulated=result.simulated, as_json=running["as_json"])
            if not running["as_json"]:
                written = [row.get("output") or row.get("page") for row in result.rows]
                console.print_result([], [Path(path) for path in written if path])


def _doctor(command: Command, title: str, given: dict[str, Any]) -> None:
    """Examine cameras and grippers; exit code 3 if something is wrong with one of them."""
    running = {name: given.pop(name) for name in flags.OF_DOCTOR}
    with CommandExit(title, running):
        chosen = config.resolve(command.params, title, given, None)
        module = importlib.import_module(f"evetac_cli.{command.module}")
        if not chosen.hardware and (chosen.camera or chosen.arm or chosen.yes or running["out"]):
            raise InputError("has no effect without --hardware", where="--camera, --arm, --yes or -o")
        apart = [flag for flag in ("print_udev", "compile", "speed", "hardware") if getattr(chosen, flag)]
        if len(apart) > 1:
            names = ", ".join(f"--{flag.replace('_', '-')}" for flag in apart)
            raise InputError("each does something else", where=names, expected="one of them at a time")
        if chosen.gripper and apart and not chosen.hardware:
            raise InputError(f"has no effect with --{apart[0].replace('_', '-')}", where="--gripper")
        if chosen.print_udev:
            if running["as_json"]:
                console.show(title, [], {"udev": module.udev_rules()}, simulated=False, as_json=True)
            else:
                print(module.udev_rules())
            return
        result: Outcome
        if chosen.compile:
            module = importlib.import_module("evetac_cli.inspect.compile_kernels")
            console.say("compiling, once after installing: a minute or so")
            with console.progress_bar("compiling", "commands", quiet=False) as progress:
                result = module.run(progress)
            console.show(title, result.rows, result.summary, simulated=False, as_json=running["as_json"])
            return
        if chosen.hardware:
            module = importlib.import_module("evetac_cli.inspect.hardware_check")
            result = module.run(chosen, running["out"])
        elif chosen.speed:
            module = importlib.import_module("evetac_cli.inspect.speed")
            result = module.run(chosen)
        else:
            result = module.run(chosen)
        if running["as_json"]:
            console.show(title, result.rows, result.summary, simulated=result.simulated, as_json=True)
        else:
            module.show(result)
        if result.summary["wrong"]:
            raise typer.Exit(DeviceError.exit_code)


def _with_folders(named: list[Path], kind: str = "*") -> list[Path]:
    """The files that are named, with the files of a kind in place of each folder; InputError for one without any."""
    files: list[Path] = []
    for path in named:
        if not path.is_dir():
            files.append(path)
            continue
        found = sorted(entry for entry in path.glob(f"*.{kind}.h5") if entry.is_file())
        if not found:
            below = next(iter(sorted(path.glob(f"*/*.{kind}.h5"))), None)
            raise InputError(
                "no such file in this folder",
                where=str(path),
                expected=f"*.{kind}.h5",
                hint=f"name the folder in which they lie: {below.parent}" if below else "",
            )
        files += found
    return files


def _check_out(out: Path | None, suffix: str) -> None:
    """InputError for `-o NAME.txt`, which would become a folder of this name."""
    if out is not None and re.fullmatch(r"\.[A-Za-z]\w{0,6}", out.suffix) and out.suffix != suffix and not out.is_dir():
        raise InputError(
            "looks like a file of another kind",
            where="--out",
            expected=f"a name that ends in {suffix}, or a folder",
            found=str(out),
            hint=f"for a folder of this name: mkdir {shlex.quote(str(out))} first",
        )


def _check_outputs(jobs: list[Job], files: list[Path], chosen: Any, *, force: bool) -> None:
    """Refuse outputs that would replace each other, or (with --force) what they are made from."""
    for job in jobs:
        require_possible_name(job.output)
    times = Counter(job.output for job in jobs)
    clash = sorted(output for output, count in times.items() if count > 1)
    if clash:
        raise InputError("several inputs would write the same output", found=", ".join(map(str, clash)))
    named = (value for value in vars(chosen).values() if isinstance(value, Path))
    inputs = {path.resolve() for path in (*files, *named, *(path for job in jobs for path in job.inputs))}
    lost = sorted(output for output in times if output.resolve() in inputs) if force else []
    if lost:
        raise InputError("the output would replace an input", found=", ".join(map(str, lost)))


def _first(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first MOST_ROWS rows of each table, for a terminal; how many more there are is printed."""
    shown = []
    for _, group in itertools.groupby(rows, key=tuple):
        table = list(group)
        shown += table[:MOST_ROWS]
        if len(table) > MOST_ROWS:
            console.say(f"{len(table) - MOST_ROWS:,} more rows with {next(iter(table[0]))}; --json prints all")
    return shown


def _run(
    command: Command, jobs: list[Job], chosen: Any, running: dict[str, Any], results: dict[Path, Outcome | EvetacError]
) -> None:
    """Run the jobs, several at a time if asked, and fill in the results; an error in one does not stop the others."""
    quiet, force = running["quiet"] or getattr(chosen, "live", False), running["force"]  # --live has its own lines
    engine = engines.Engine.parse(running["engine"])
    exclusive = any(job.exclusive for job in jobs)
    if exclusive and engine.name != engines.LOCAL:
        raise InputError("devices belong to this computer", where="--engine", expected="local", found=running["engine"])
    if engine.address and running["number_of_jobs"] > 1:
        hint = "leave it out: a cluster that runs has as many workers as it has"
        raise InputError("has no effect", where="--jobs", found=f"--engine {running['engine']}", hint=hint)
    # An output that exists is either up to date or refused: that is quick, and worth no worker process.
    waiting = [job for job in jobs if force or not job.output.exists()]

    def run_several(some: list[Job], into: dict[Path, Outcome | EvetacError]) -> None:
        at_once = 1 if exclusive else min(running["number_of_jobs"], len(some))
        if not some or (engine.name == engines.LOCAL and at_once < 2):
            return
        how = (command.module, engines.largest_first(some), chosen, force, at_once)
        with console.progress_bar(f"{command.name} {len(some)} files", "files", quiet=quiet) as progress:
            if engine.name == engines.DASK:
                engines.run_on_dask(engine, *how, progress, into)
            else:
                workers.run_parallel(*how, progress, into, quiet=quiet)

    if engine.name == engines.DASK or running["number_of_jobs"] > 1:
        # Of some stages a job has parts that can be made at the same time, before it.
        parts_of = getattr(importlib.import_module(f"evetac_cli.{command.module}"), "parts", None)
        parts: dict[Path, list[Job]] = {job.output: parts_of(job, chosen) for job in waiting if parts_of is not None}
        made: dict[Path, Outcome | EvetacError] = {}
        run_several([part for some in parts.values() for part in some], made)
        for output, some in parts.items():
            failed = (result for part in some if isinstance(result := made.get(part.output), EvetacError))
            if (error := next(failed, None)) is not None:
                results[output] = error
        run_several([job for job in waiting if job.output not in results], results)
    for number, job in enumerate(jobs):
        if job.output not in results:
            which = f" {number + 1} of {len(jobs)}:" if len(jobs) > 1 else ""
            name = f"{command.name}{which} {job.output.name}"
            with console.progress_bar(name, command.unit, quiet=quiet) as progress, compiling.announced(quiet=quiet):
                results[job.output] = workers.run_one(command.module, job, chosen, force, progress)


def _inspector(name: str, help_: str, files_help: str = "Stage files.") -> Callable[..., None]:
    """A command of inspect/: files in, a table or JSON out."""

    def call(
        files: Annotated[list[Path], typer.Argument(help=files_help, show_default=False)],
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
        verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Print the traceback of an error.")] = False,
    ) -> None:
        with CommandExit(name, {"as_json": as_json, "verbose": verbose}):
            module = importlib.import_module(f"evetac_cli.inspect.{name}")
            result: Outcome = module.run(files if name in OF_FOLDERS else _with_folders(files))
            if as_json:
                console.show(name, result.rows, result.summary, simulated=result.simulated, as_json=True)
            else:
                module.show(result)
            if result.summary.get("invalid"):
                raise typer.Exit(InputError.exit_code)

    call.__doc__ = help_
    return call


for _command in PIPELINE[:-1]:
    _add(app, _command, _command.name, "Pipeline")
for _command in EVALUATE:
    _add(evaluate, _command, f"evaluate {_command.name}", "Subjects")
app.add_typer(evaluate, name="evaluate", rich_help_panel="Pipeline")
_add(app, PIPELINE[-1], PIPELINE[-1].name, "Pipeline")


@app.command("info", rich_help_panel="Inspect", cls=flags.CommandOfFlags)
def _info(
    files: Annotated[list[Path], typer.Argument(help="Stage files, or a folder of them.", show_default=False)],
    where: Annotated[
        list[str] | None,
        typer.Option(
            help="Of a folder: the files for which this holds, as in object=3, seed=10-19, kind=labels,features;"
            " several conditions have to hold all."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Print the traceback of an error.")] = False,
) -> None:
    """What stage files hold: kind, duration, events, rates, history; of a folder, which files it has, by its index."""
    with CommandExit("info", {"as_json": as_json, "verbose": verbose}) as looked:
        if len(files) != 1 or not files[0].is_dir():
            if where:
                named = ", ".join(map(str, files))
                raise InputError("finds files of a folder", where="--where", expected="one folder", found=named)
            _describe(_with_folders(files), looked)
            return
        index = importlib.import_module("evetac_cli.inspect.index")
        result: Outcome = index.answer(files[0], where or ())
        rows = result.rows if as_json else _first(index.for_people(result.rows))
        console.show("info", rows, result.summary, simulated=result.simulated, as_json=as_json)


def _describe(files: list[Path], looked: CommandExit) -> None:
    """Show what each file holds; those that cannot be read are errors at the end, and do not hide the others."""
    info = importlib.import_module("evetac_cli.inspect.info")
    for number, path in enumerate(files):
        try:
            looked.results[Path(f"{number}")] = info.run([path])
        except EvetacError as error:
            looked.results[Path(f"{number}")] = error
    rows = [row for outcome in looked.outcomes() for row in outcome.rows]
    simulated = any(outcome.simulated for outcome in looked.outcomes())
    errors = looked.errors()
    if looked.as_json and not errors:
        console.show("info", rows, {"files": len(rows)}, simulated=simulated, as_json=True)
    elif not looked.as_json:
        info.show(Outcome(rows, simulated, {"files": len(rows)}))
    if errors:
        for error in errors[1:]:
            console.say(f"error: {error}")
        raise errors[0]


app.command("index", rich_help_panel="Inspect", cls=flags.CommandOfFlags)(
    _inspector(
        "index", "Make the index of a data set, or bring it up to date; `evetac info FOLDER` asks it.", "Folders."
    )
)
_add(app, VIEW, VIEW.name, "Inspect", _write_for_others, flags.OF_VIEW)
_add(app, EXPORT, EXPORT.name, "Inspect", _write_for_others, flags.OF_EXPORT)
app.command("validate", rich_help_panel="Inspect", cls=flags.CommandOfFlags)(
    _inspector("validate", "Check stage files against their schema, their own numbers and their recipe id.")
)


app.command("repair", rich_help_panel="Inspect", cls=flags.CommandOfFlags)(
    _inspector(
        "repair",
        "Make valid recordings of what broke off: folders NAME.recording.part, or folders that hold some. "
        "Prints what was kept.",
        "Folders.",
    )
)
_add(app, DOCTOR, DOCTOR.name, "Inspect", _doctor, flags.OF_DOCTOR)


def main() -> None:
    """Entry point of the command `evetac`."""
    folder = resources.kernel_cache()
    if folder is not None:
        os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))  # of this process and of those that it starts
    workers.catch_interrupts()
    exit_codes.run(app)
