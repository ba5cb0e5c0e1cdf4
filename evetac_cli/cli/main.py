"""The command line: choose a command, read its flags, run its jobs, print the result or the error.

A stage is imported only when it is chosen: `evetac --help` loads none of numpy, h5py, torch, cv2, scipy, numba. The
flags of a command are also built only when it is chosen. Those of all commands are built only for `--help` and for an
unknown command name.
"""

import importlib
import os
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import typer

from evetac_cli import commands, console, interrupts
from evetac_cli.cli import config, execution, exit_codes, flags, workers
from evetac_cli.cli.exit_codes import CommandExit, Commands
from evetac_cli.cli.flags import Running
from evetac_cli.commands.parameter import LOOK, PAGE, STAGE, Command
from evetac_cli.errors import DeviceError, EvetacError, InputError, UnavailableError
from evetac_cli.jobs import LookCall, Outcome
from evetac_cli.names import __version__

HELP_OF_GROUPS = {"evaluate": "Evaluate results: numbers, tables, plots and a report file."}


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


def _write_page(command: Command, title: str, flag_values: dict[str, Any]) -> None:
    """Run a command whose output is not a stage file (a page, an export), and print the path of the output."""
    running = Running.take(flag_values, flags.running(command))
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


def _look(command: Command, title: str, flag_values: dict[str, Any]) -> None:
    """Run a command that prints a result; its exit code is that of invalid files, or of faults of devices."""
    running = Running.take(flag_values, flags.running(command))
    paths = flag_values.pop("files", [])
    with CommandExit(title, running) as looked:
        params = config.resolve(command.params, title, flag_values, None)
        module = importlib.import_module(f"evetac_cli.{command.module}")
        errors: list[EvetacError] = []
        with console.progress_bar(title, command.unit, quiet=running.quiet or not command.unit) as progress:
            files = partial(execution.with_folders, paths)
            result: Outcome = module.look(LookCall(paths, files, params, running.out, running.quiet, progress, errors))
        looked.results |= {Path(): result, **{Path(f"{number}"): error for number, error in enumerate(errors)}}
        if running.as_json and not errors:
            console.show(title, result.rows, result.summary, simulated=result.simulated, as_json=True)
        elif not running.as_json and not running.quiet:
            module.show(result, verbose=running.verbose)
        for error in errors[1:]:
            console.say(f"error: {error}")
        if errors:
            raise errors[0]
        for found, kind in (("invalid", InputError), ("not_checked", UnavailableError), ("wrong", DeviceError)):
            if result.summary.get(found):
                raise typer.Exit(kind.exit_code)


ACTS = {STAGE: execution.execute, PAGE: _write_page, LOOK: _look}


def _function(command: Command, title: str) -> Callable[..., None]:
    """Return the function that typer calls for a command, with a signature made from its parameters."""

    def call(ctx: Any, **flag_values: Any) -> None:
        flag_values.pop("help_all", None)  # its callback has acted on it
        if flag_values.get("legend"):
            flags.print_legend(title, as_json=flag_values["as_json"])
        elif ctx.invoked_subcommand is None:
            ACTS[command.does](command, title, flag_values)
        elif any(flag_values.values()):
            ctx.fail(f"Flags of `{ctx.invoked_subcommand}` follow its name.")

    signature = flags.signature(command)
    call.__signature__ = signature  # type: ignore[attr-defined]
    call.__annotations__ = {name: entry.annotation for name, entry in signature.parameters.items()}
    call.__doc__ = flags.help_text(command)
    return call


def _parts(group: str) -> tuple[Command, ...]:
    """Return the commands of a group, by the headings of its help."""
    if group != "evaluate":
        return commands.parts(group)
    from evetac_cli.evaluate import SUBJECTS
    from evetac_cli.evaluate.subject import PANELS  # here, as all subjects are imported for it

    return tuple(sorted(SUBJECTS, key=lambda subject: PANELS.index(subject.panel)))


def _add(app: typer.Typer, name: str, panel: str) -> None:
    """Register a command, or a group with its commands and, where it has one, that of the group alone."""
    if name not in commands.GROUPS:
        app.command(name, rich_help_panel=panel, cls=flags.CommandOfFlags)(_function(commands.find(name), name))
        return
    alone = commands.find(name) if name not in HELP_OF_GROUPS else None
    group = typer.Typer(
        cls=flags.Group,
        help=HELP_OF_GROUPS[name] if alone is None else flags.help_text(alone),
        no_args_is_help=alone is None,
        invoke_without_command=alone is not None,
    )
    if alone is not None:
        group.callback()(_function(alone, name))
    for command in _parts(name):
        part = _function(command, f"{name} {command.name}")
        group.command(command.name, rich_help_panel=command.panel or None, cls=flags.CommandOfFlags)(part)
    app.add_typer(group, name=name, rich_help_panel=panel)


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
    panels = {name: panel for panel, names in commands.PANELS.items() for name in names}
    for name in (first,) if first in panels else () if first == "--version" else panels:
        _add(app, name, panels[name])
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
