"""The command line: pick a command, read its flags, run its jobs, print the result or the error.

Flags are made from the dataclasses in params/, so a parameter is written down once. A stage is imported only when it
is chosen: `evetac --help` loads none of numpy, h5py, torch, cv2, scipy, numba.
"""

import importlib
import inspect
import itertools
import os
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from evetac_cli import __version__, console, resources
from evetac_cli.cli import compiling, config, engines, exit_codes, workers
from evetac_cli.cli.commands import DOCTOR, EVALUATE, EXPORT, PIPELINE, VIEW, Command
from evetac_cli.cli.exit_codes import CommandExit, Commands
from evetac_cli.errors import DeviceError, EvetacError, InputError
from evetac_cli.jobs import Job, Outcome, require_possible_name
from evetac_cli.params.parameter import flag_of

MOST_ROWS = 100  # of one table on a terminal

app = typer.Typer(
    cls=Commands,
    help="Event-based touch with an Evetac: record, label, track, featurize, train, evaluate, grasp.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
evaluate = typer.Typer(help="Measure results: figures, tables, a report file.", no_args_is_help=True)


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


# How to run, the same for every command that makes files; none of it changes the numbers.
_RUNNING: dict[str, tuple[Any, Any, str, str]] = {
    "out": (Path | None, None, "-o/--out", "Output file (ends in .h5) or folder; default: beside the input."),
    "force": (bool, False, "-f/--force", "Replace an output that was made by another recipe."),
    "number_of_jobs": (int, 1, "-j/--jobs", "Files worked on at the same time."),
    "engine": (
        str,
        engines.LOCAL,
        "--engine",
        "Where files are worked on; local: processes of this computer; dask: a Dask cluster of --jobs processes;"
        " dask:tcp://ADDRESS: one that runs, see docs/cluster.md.",
    ),
    "config": (Path | None, None, "--config", "TOML file with parameters, one table a command."),
    "as_json": (bool, False, "--json", "Print one JSON object instead of a table."),
    "quiet": (bool, False, "-q/--quiet", "No progress and no messages."),
    "verbose": (bool, False, "-v/--verbose", "Print the traceback of an error."),
}
# view makes one page, whose parameters are in no recipe: no use for several jobs, nor for a config file.
_VIEWING = {name: entry for name, entry in _RUNNING.items() if name not in ("number_of_jobs", "engine", "config")} | {
    "out": (Path | None, None, "-o/--out", "Page (ends in .html) or folder; default: beside the file."),
    "force": (bool, False, "-f/--force", "Replace a page or animation that exists."),
}
_EXPORTING = _VIEWING | {
    "out": (Path | None, None, "-o/--out", "File or folder; default: beside the recording."),
    "force": (bool, False, "-f/--force", "Replace a file that exists."),
}
_EXAMINING = {name: _RUNNING[name] for name in ("as_json", "verbose")} | {
    "out": (Path | None, None, "-o/--out", "--hardware: report file; default: evetac-hardware-DATE.json here."),
}


def _add(
    group: typer.Typer,
    command: Command,
    title: str,
    panel: str,
    act: Callable[[Command, str, dict[str, Any]], None] | None = None,
    running: dict[str, tuple[Any, Any, str, str]] = _RUNNING,
) -> None:
    """Register a command whose signature is made from its parameters."""

    def call(**given: Any) -> None:
        (act or _execute)(command, title, given)

    keyword = inspect.Parameter.KEYWORD_ONLY
    signature = []
    if command.files:
        files = Annotated[list[Path], typer.Argument(help=command.files, show_default=False)]
        needed: Any = inspect.Parameter.empty if command.files_needed else []
        signature.append(inspect.Parameter("files", keyword, default=needed, annotation=files))
    hints = get_type_hints(command.params)
    for item in fields(command.params):
        unit = f" \\[{item.metadata['unit']}]" if item.metadata["unit"] else ""
        choices = f" ({', '.join(item.metadata['choices'])})" if len(item.metadata["choices"]) > 1 else ""
        flag = flag_of(item)
        has_default = item.default is not None and item.default is not False and item.default != ""
        default = f" \\[default: {item.default}]" if has_default else ""
        text = item.metadata["help"].replace("[", "\\[")  # text, not markup
        help_ = text + choices + unit + default
        option: Any  # typer's own types of arguments and options
        if flag.startswith("--"):
            option = typer.Option(flag if hints[item.name] is not bool else f"{flag}/--no-{flag[2:]}", help=help_)
        else:
            option = typer.Argument(metavar=flag, help=help_, show_default=False)
        # Every flag defaults to None, so that a config file can tell what was not given. What is named by its place
        # comes before the files, which take all the rest.
        entry = inspect.Parameter(
            item.name, keyword, default=None, annotation=Annotated[hints[item.name] | None, option]
        )
        signature.insert(len(signature) if flag.startswith("--") else 0, entry)
    for name, (kind, default, flags, help_) in running.items():
        shown = default in (1, engines.LOCAL)
        option = typer.Option(*flags.split("/"), help=help_, rich_help_panel="Running", show_default=shown)
        signature.append(inspect.Parameter(name, keyword, default=default, annotation=Annotated[kind, option]))
    call.__signature__ = inspect.Signature(signature)  # type: ignore[attr-defined]
    call.__annotations__ = {entry.name: entry.annotation for entry in signature}
    call.__doc__ = command.params.__doc__
    group.command(command.name, rich_help_panel=panel)(call)


def _execute(command: Command, title: str, given: dict[str, Any]) -> None:
    """Run all jobs of a command and print what came out of them."""
    running = {name: given.pop(name) for name in _RUNNING}
    files = given.pop("files", [])
    with CommandExit(title, running) as run:
        chosen = config.resolve(command.params, title, given, running["config"])
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
        started = time.monotonic()
        _run(command, jobs, chosen, running, run.results)
        run.results = {job.output: run.results[job.output] for job in jobs}
        outcomes, errors = run.outcomes(), run.errors()
        if outcomes and not (errors and running["as_json"]):
            summary = outcomes[0].summary if len(outcomes) == 1 and outcomes[0].summary else console.count(outcomes)
            simulated = any(outcome.simulated for outcome in outcomes)
            rows = [row for outcome in outcomes for row in outcome.rows]
            if running["as_json"]:
                console.show(title, rows, summary, simulated=simulated, as_json=True)
            elif not running["quiet"]:
                console.show(title, _first(rows), summary, simulated=simulated, as_json=False)
        if not running["quiet"] and outcomes and not any(outcome.made for outcome in outcomes):
            console.say(f"{title}: up to date, nothing to do")
        elif not running["quiet"] and outcomes:
            console.say(f"{title}: {time.monotonic() - started:.1f} s")
        if errors:
            for error in errors[1:]:
                console.say(f"error: {error}")
            raise errors[0]


def _write_for_others(command: Command, title: str, given: dict[str, Any]) -> None:
    """Run a command whose output is no stage file (a page, an export), and print where it was written."""
    running = {name: given.pop(name) for name in _VIEWING}
    files = given.pop("files")
    with CommandExit(title, running):
        chosen = config.resolve(command.params, title, given, None)
        module = importlib.import_module(f"evetac_cli.{command.module}")
        with console.progress_bar(title, command.unit, quiet=running["quiet"]) as progress:
            result: Outcome = module.run(files, chosen, running["out"], force=running["force"], progress=progress)
        if not running["quiet"] or running["as_json"]:
            console.show(title, result.rows, result.summary, simulated=result.simulated, as_json=running["as_json"])


def _doctor(command: Command, title: str, given: dict[str, Any]) -> None:
    """Examine cameras and grippers; exit code 3 if something is wrong with one of them."""
    running = {name: given.pop(name) for name in _EXAMINING}
    with CommandExit(title, running):
        chosen = config.resolve(command.params, title, given, None)
        module = importlib.import_module(f"evetac_cli.{command.module}")
        if not chosen.hardware and (chosen.camera or chosen.arm or chosen.yes or running["out"]):
            raise InputError("has no effect without --hardware", where="--camera, --arm, --yes or -o")
        if chosen.speed and (chosen.hardware or chosen.gripper or chosen.print_udev):
            raise InputError("have no effect with --speed", where="--hardware, --gripper or --print-udev")
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
    shown = any(getattr(chosen, name, False) for name in ("live", "preview"))  # a view, with its own lines
    quiet, force = running["quiet"] or shown, running["force"]
    engine = engines.Engine.parse(running["engine"])
    exclusive = shown or any(job.exclusive for job in jobs)
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
        with console.progress_bar(command.name, "files", quiet=quiet) as progress:
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
            name = f"{command.name} {job.output.name}" + (f" ({number + 1} of {len(jobs)})" if len(jobs) > 1 else "")
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
            result: Outcome = module.run(files)
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


@app.command("info", rich_help_panel="Inspect")
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
    if len(files) != 1 or not files[0].is_dir():
        with CommandExit("info", {"as_json": as_json, "verbose": verbose}):
            folders = [path for path in files if path.is_dir()]
            if where:
                named = ", ".join(map(str, files))
                raise InputError("finds files of a folder", where="--where", expected="one folder", found=named)
            if folders:
                raise InputError("a folder is looked at by itself", where=str(folders[0]), found=f"{len(files)} names")
        _inspector("info", "")(files, as_json, verbose)
        return
    with CommandExit("info", {"as_json": as_json, "verbose": verbose}):
        index = importlib.import_module("evetac_cli.inspect.index")
        result: Outcome = index.answer(files[0], where or ())
        rows = result.rows if as_json else _first(index.for_people(result.rows))
        console.show("info", rows, result.summary, simulated=result.simulated, as_json=as_json)


app.command("index", rich_help_panel="Inspect")(
    _inspector(
        "index", "Make the index of a data set, or bring it up to date; `evetac info FOLDER` asks it.", "Folders."
    )
)
_add(app, VIEW, VIEW.name, "Inspect", _write_for_others, _VIEWING)
_add(app, EXPORT, EXPORT.name, "Inspect", _write_for_others, _EXPORTING)
app.command("validate", rich_help_panel="Inspect")(
    _inspector("validate", "Check stage files against their schema, their own numbers and their recipe id.")
)


app.command("repair", rich_help_panel="Inspect")(
    _inspector(
        "repair",
        "Make valid recordings of what broke off: folders NAME.recording.part, or folders that hold some. "
        "Prints what was kept.",
        "Folders.",
    )
)
_add(app, DOCTOR, DOCTOR.name, "Inspect", _doctor, _EXAMINING)


def main() -> None:
    """Entry point of the command `evetac`."""
    folder = resources.kernel_cache()
    if folder is not None:
        os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))  # of this process and of those that it starts
    workers.catch_interrupts()
    exit_codes.run(app)
