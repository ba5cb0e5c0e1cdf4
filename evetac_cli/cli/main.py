"""The command line: choose a command, read its flags, run its jobs, print the result or the error.

A stage is imported only when it is chosen: `evetac --help` loads none of numpy, h5py, torch, cv2, scipy, numba. The
flags of a command are also built only when it is chosen. Those of all commands are built only for `--help` and for an
unknown command name.
"""

import importlib
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from evetac_cli import commands, console, interrupts
from evetac_cli.cli import config, execution, exit_codes, flags, workers
from evetac_cli.cli.exit_codes import CommandExit, Commands
from evetac_cli.cli.flags import Running
from evetac_cli.commands.parameter import Command
from evetac_cli.errors import DeviceError, EvetacError, InputError, UnavailableError
from evetac_cli.jobs import Outcome
from evetac_cli.names import __version__

OF_FOLDERS = ("repair",)  # inspectors that take folders themselves, not the files in them
DOCTOR_PARTS = {"print_udev": "", "compile": ".compile_kernels", "speed": ".speed", "hardware": ".hardware_check"}
AsJson = Annotated[bool, flags.looking("as_json")]
Legend = Annotated[bool, flags.looking("legend")]
Quiet = Annotated[bool, flags.looking("quiet")]
Verbose = Annotated[bool, flags.looking("verbose")]


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"evetac {__version__}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Event-based tactile sensing with an Evetac: record, label, track, featurize, train, evaluate and grasp."""


def _add(
    group: typer.Typer,
    command: Command,
    title: str,
    panel: str,
    act: Callable[[Command, str, dict[str, Any]], None] | None = None,
    running: dict[str, tuple[Any, Any, str, str]] = flags.OF_STAGES,
) -> None:
    """Register a command, with a signature made from its parameters."""

    def call(**flag_values: Any) -> None:
        (act or execution.execute)(command, title, flag_values)

    signature = flags.signature(command, running)
    call.__signature__ = signature  # type: ignore[attr-defined]
    call.__annotations__ = {name: entry.annotation for name, entry in signature.parameters.items()}
    call.__doc__ = flags.help_text(command)
    group.command(command.name, rich_help_panel=panel, cls=flags.CommandOfFlags)(call)


def _write_for_others(command: Command, title: str, flag_values: dict[str, Any]) -> None:
    """Run a command whose output is not a stage file (a page, an export), and print the path of the output."""
    running = Running.take(flag_values, flags.OF_VIEW)
    paths = flag_values.pop("files")
    with CommandExit(title, running):
        params = config.resolve(command.params, title, flag_values, None)
        files = execution.with_folders(paths, command.kind) if command.kind else paths
        module = importlib.import_module(f"evetac_cli.{command.module}")
        with console.progress_bar(title, command.unit, quiet=running.quiet) as progress:
            result: Outcome = module.run(files, params, running.out, force=running.force, progress=progress)
        if not running.quiet or running.as_json:
            how = {"as_json": running.as_json, "verbose": running.verbose}
            console.show(title, result.rows, result.summary, simulated=result.simulated, **how)
            if not running.as_json:
                written = [row.get("output") or row.get("page") for row in result.rows]
                console.print_result([], [Path(path) for path in written if path])


def _doctor(command: Command, title: str, flag_values: dict[str, Any]) -> None:
    """Examine cameras and grippers; the exit code is 3 if something is wrong with one of them."""
    running = Running.take(flag_values, flags.OF_DOCTOR)
    with CommandExit(title, running):
        params = config.resolve(command.params, title, flag_values, None)
        apart = [flag for flag in DOCTOR_PARTS if getattr(params, flag)]
        names = ", ".join(f"--{flag.replace('_', '-')}" for flag in apart)
        of_hardware = params.camera or params.arm or params.yes or running.out
        for refused, message, where in (
            (of_hardware and not params.hardware, "has no effect without --hardware", "--camera, --arm, --yes or -o"),
            (len(apart) > 1, "cannot be combined", names),
            (params.hardware and running.quiet, "has no effect with --hardware, which announces every step", "--quiet"),
            (params.gripper and apart and not params.hardware, f"has no effect with {names}", "--gripper"),
        ):
            if refused:
                raise InputError(message, where=where)
        module = importlib.import_module(f"evetac_cli.{command.module}{DOCTOR_PARTS[apart[0]] if apart else ''}")
        result: Outcome
        if params.print_udev:
            if running.as_json:
                console.show(title, [], {"udev": module.udev_rules()}, simulated=False, as_json=True)
            else:
                print(module.udev_rules())
            return
        if params.hardware:
            result = module.run(params, running.out)
        elif params.compile or params.speed:
            with console.progress_bar(f"{title} {names}", "parts", quiet=running.quiet) as progress:
                if params.compile:
                    result = module.run(progress, say=(lambda line: None) if running.quiet else console.say)
                else:
                    result = module.run(params, progress=progress)
        else:
            result = module.run(params)
        _show(title, module, result, running)
        if result.summary.get("wrong"):
            raise typer.Exit(DeviceError.exit_code)


def _show(title: str, module: Any, result: Outcome, running: Running) -> None:
    """Print a result as one JSON object, or in the form of its module; print nothing with --quiet."""
    if running.as_json:
        console.show(title, result.rows, result.summary, simulated=result.simulated, as_json=True)
    elif not running.quiet:
        module.show(result)


def _inspector(name: str, help_: str, files_help: str, unit: str = "files") -> Callable[..., None]:
    """Return a command of inspect/, which reads files and prints a table or JSON."""

    def call(
        files: Annotated[list[Path], typer.Argument(help=files_help, show_default=False)],
        as_json: AsJson = False,
        legend: Legend = False,
        quiet: Quiet = False,
        verbose: Verbose = False,
    ) -> None:
        running = Running(as_json=as_json, quiet=quiet, verbose=verbose)
        with CommandExit(name, running):
            module = importlib.import_module(f"evetac_cli.inspect.{name}")
            with console.progress_bar(name, unit, quiet=quiet) as progress:
                result: Outcome = module.run(files if name in OF_FOLDERS else execution.with_folders(files), progress)
            _show(name, module, result, running)
            if result.summary.get("invalid"):
                raise typer.Exit(InputError.exit_code)
            if result.summary.get("not_checked"):
                raise typer.Exit(UnavailableError.exit_code)

    call.__doc__ = help_
    return call


def _info(
    files: Annotated[list[Path], typer.Argument(help="Stage files, or a folder of them.", show_default=False)],
    where: Annotated[
        list[str] | None,
        typer.Option(
            help="For a folder: show only files that satisfy this condition, e.g. object=3, seed=10-19 or"
            " kind=labels,features. Repeat the flag for more conditions; all must be satisfied."
        ),
    ] = None,
    as_json: AsJson = False,
    legend: Legend = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Show the contents of stage files: kind, duration, events, rates, history. For a folder, list its files.

    The list of a folder's files is kept in an index, so that only changed files are read again.
    """
    with CommandExit("info", Running(as_json=as_json, verbose=verbose)) as looked:
        if len(files) != 1 or not files[0].is_dir():
            if where:
                file_names = ", ".join(map(str, files))
                raise InputError(
                    "searches the files of a folder", where="--where", expected="one folder", found=file_names
                )
            _describe(execution.with_folders(files), looked, quiet=quiet)
            return
        index = importlib.import_module("evetac_cli.inspect.index")
        with console.progress_bar(f"index {files[0]}", "files", quiet=quiet) as progress:
            result: Outcome = index.answer(files[0], where or (), progress)
        if as_json or not quiet:
            rows = result.rows if as_json else index.for_people(result.rows)
            rows = rows if as_json or verbose else execution.first_rows(rows)
            simulated = result.simulated
            console.show("info", rows, result.summary, simulated=simulated, as_json=as_json, verbose=verbose)


def _describe(files: list[Path], looked: CommandExit, *, quiet: bool) -> None:
    """Show the contents of each file; errors of unreadable files are printed at the end and do not hide the others."""
    info = importlib.import_module("evetac_cli.inspect.info")
    for number, path in enumerate(files):
        try:
            looked.results[Path(f"{number}")] = info.run([path])
        except EvetacError as fault:
            looked.results[Path(f"{number}")] = fault
    rows = [row for outcome in looked.outcomes() for row in outcome.rows]
    simulated = any(outcome.simulated for outcome in looked.outcomes())
    errors = looked.errors()
    if looked.as_json and not errors:
        console.show("info", rows, {"files": len(rows)}, simulated=simulated, as_json=True)
    elif not looked.as_json and not quiet:
        info.show(Outcome(rows, simulated, {"files": len(rows)}))
    if errors:
        for error in errors[1:]:
            console.say(f"error: {error}")
        raise errors[0]


def _add_evaluate(app: typer.Typer) -> None:
    judging = typer.Typer(
        cls=flags.Group, help="Evaluate results: numbers, tables, plots and a report file.", no_args_is_help=True
    )
    from evetac_cli.evaluate.subject import PANELS  # here, as all subjects are imported for it
    from evetac_cli.evaluate.subjects import SUBJECTS

    for panel in PANELS:
        for subject in SUBJECTS:
            if subject.panel == panel:
                _add(judging, subject, f"evaluate {subject.name}", panel)
    app.add_typer(judging, name="evaluate", rich_help_panel="Pipeline")


def _adding(
    name: str,
    panel: str,
    act: Callable[[Command, str, dict[str, Any]], None] | None = None,
    running: dict[str, tuple[Any, Any, str, str]] = flags.OF_STAGES,
) -> Callable[[typer.Typer], None]:
    return lambda app: _add(app, commands.find(name), name, panel, act, running)


def _inspecting(name: str, call: Callable[..., None]) -> Callable[[typer.Typer], None]:
    def add(app: typer.Typer) -> None:
        app.command(name, rich_help_panel="Inspect", cls=flags.CommandOfFlags)(call)

    return add


# Functions that add each command, in the order of `--help`.
ADDED: dict[str, Callable[[typer.Typer], None]] = {
    **{name: _adding(name, "Pipeline") for name in commands.OF_PIPELINE},
    "evaluate": _add_evaluate,
    "info": _inspecting("info", _info),
    "view": _adding("view", "Inspect", _write_for_others, flags.OF_VIEW),
    "report": _adding("report", "Inspect", _write_for_others, flags.OF_REPORT),
    "export": _adding("export", "Inspect", _write_for_others, flags.OF_EXPORT),
    "share": _adding("share", "Inspect", _write_for_others, flags.OF_SHARE),
    "validate": _inspecting(
        "validate",
        _inspector(
            "validate",
            "Check stage files: their schema, the consistency of their numbers, and their recipe id.",
            "Stage files. For a folder, all stage files in it are checked.",
        ),
    ),
    "repair": _inspecting(
        "repair",
        _inspector(
            "repair",
            "Make valid recordings from interrupted ones, and report how much was recovered.",
            "Folders NAME.recording.part, or folders that contain some.",
            "folders",
        ),
    ),
    "doctor": _adding("doctor", "Inspect", _doctor, flags.OF_DOCTOR),
}


def command_line(first: str = "") -> typer.Typer:
    """Return the app that reads the command line: with a single command if `first` names one, otherwise with all.

    first: first word of the command line.
    """
    app = typer.Typer(
        cls=Commands,
        help="Event-based tactile sensing with an Evetac: record, label, track, featurize, train, evaluate and grasp.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_root)
    for name in (first,) if first in ADDED else () if first == "--version" else ADDED:
        ADDED[name](app)
    return app


@cache
def _whole() -> typer.Typer:
    return command_line()


def __getattr__(name: str) -> typer.Typer:
    """Return `app`, with all commands, for programs that call them from Python."""
    if name == "app":
        return _whole()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def main() -> None:
    """Entry point of the command `evetac`."""
    interrupts.catch_interrupts()
    exit_codes.run(_program)


def _program() -> None:
    workers.compute_on_one_thread()
    os.environ.setdefault("PYTHONSAFEPATH", "1")  # child processes load no `json.py` from the working folder
    command_line(*sys.argv[1:2])()
