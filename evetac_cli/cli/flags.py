"""Flags and help of a command, made from its parameters: each is written down once, in commands/.

Flags that most people need come first, then how to run, then the others in panels of their own: the first two fit on a
screen.
"""

import inspect
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from evetac_cli.cli import engines
from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import RUNNING, flag_of

UNREAD = object()
WHOLE = re.compile("-?(0|[1-9][0-9]{0,17})")
DECIMAL = re.compile("-?(0|[1-9][0-9]{0,17})([.][0-9]{1,17})?")
# How to run, the same for every command that makes files; none of it changes the numbers. Of each flag: the type, the
# default, the names, the help.
OF_STAGES: dict[str, tuple[Any, Any, str, str]] = {
    "out": (Path | None, None, "-o/--out", "Output file (NAME.h5) or folder; default: beside the input."),
    "force": (bool, False, "-f/--force", "Replace an output of another recipe."),
    "number_of_jobs": (int, 1, "-j/--jobs", "Files worked on at the same time."),
    "engine": (
        str,
        engines.LOCAL,
        "--engine",
        "local; dask: a Dask cluster of --jobs processes, or dask:tls://ADDRESS (docs/cluster.md).",
    ),
    "config": (Path | None, None, "--config", "TOML file with parameters, one table a command; --no-FLAG unsets one."),
    "as_json": (bool, False, "--json", "Print one JSON object instead of a table."),
    "quiet": (bool, False, "-q/--quiet", "No progress and no messages."),
    "verbose": (bool, False, "-v/--verbose", "Print every column and row of a table, and the traceback of an error."),
}
# view makes one page, whose parameters are in no recipe: no use for several jobs, nor for a config file.
OF_VIEW = {name: entry for name, entry in OF_STAGES.items() if name not in ("number_of_jobs", "engine", "config")} | {
    "out": (
        Path | None,
        None,
        "-o/--out",
        "Output file or folder; default: beside the file.",
    ),
    "force": (bool, False, "-f/--force", "Replace a page or animation that exists."),
}
OF_REPORT = OF_VIEW | {
    "out": (
        Path | None,
        None,
        "-o/--out",
        "Output file or folder; default: report.html in the folder, or A-B.report.html here.",
    ),
    "force": (bool, False, "-f/--force", "Replace a page that exists."),
}
OF_EXPORT = OF_VIEW | {
    "out": (Path | None, None, "-o/--out", "File or folder; default: beside the recording."),
    "force": (bool, False, "-f/--force", "Replace a file that exists."),
}
OF_SHARE = OF_VIEW | {
    "out": (Path | None, None, "-o/--out", "Folder; default: NAME-hub beside it."),
    "force": (bool, False, "-f/--force", "Replace a folder that share made."),
}
OF_LOOKING = {name: OF_STAGES[name] for name in ("as_json", "quiet", "verbose")}  # of commands that make nothing
OF_DOCTOR = OF_LOOKING | {
    "out": (Path | None, None, "-o/--out", "--hardware: report file; default: evetac-hardware-DATE.json here."),
}


@dataclass(frozen=True)
class Running:
    """How a command is run, as its flags say; a command that lacks one of them has its default."""

    out: Path | None = None
    force: bool = False
    number_of_jobs: int = 1
    engine: str = engines.LOCAL
    config: Path | None = None
    as_json: bool = False
    quiet: bool = False
    verbose: bool = False

    @classmethod
    def take(cls, given: dict[str, Any], names: Iterable[str]) -> "Running":
        """Take these flags out of all that were given."""
        return cls(**{name: given.pop(name) for name in names})


class PlainFlags:
    """Of a command or group: switches are shown without a type, for they take no value; plain values are read here."""

    def get_params(self, ctx: Any) -> list[Any]:
        """All flags, `--help` among them."""
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for flag in params:
            if getattr(flag, "is_flag", False):
                flag.metavar = ""
            if not isinstance(flag.process_value, partial):
                flag.process_value = partial(_processed, flag, flag.process_value)
        return params


def _processed(flag: Any, usual: Callable[[Any, Any], Any], ctx: Any, given: Any) -> Any:
    """The value of a flag: here where it is plain, else as typer reads and refuses it.

    Why so: typer has pydantic read every value. To load it takes a fifth of a command that has nothing to do.
    """
    described = getattr(flag, "type_descriptor", None)
    kind = getattr(described, "annotation", None)
    if kind is None or flag.value_is_missing(given) and flag.required:
        return usual(ctx, given)
    several = flag.multiple or flag.nargs == -1
    if given is None:
        value: Any = () if several else None
    elif not several:
        value = plain_value(kind, given)
    elif get_origin(kind) is list:
        value = [plain_value(get_args(kind)[0], item) for item in given]
    else:
        value = UNREAD
    if value is UNREAD or several and UNREAD in value:
        return usual(ctx, given)
    return value if flag.callback is None else flag.callback(ctx, flag, value)


def plain_value(kind: Any, given: Any) -> Any:
    """What is given, a text or a default, as a value of its type; UNREAD where typer has to say what it is."""
    if type(given) is kind:
        return given
    if isinstance(given, str):
        if kind is int and WHOLE.fullmatch(given):
            return int(given)
        if kind is float and DECIMAL.fullmatch(given):
            return float(given)
        if kind is Path and (not os.path.exists(given) or os.access(given, os.R_OK)):
            return Path(given)
    return UNREAD


class Group(PlainFlags, TyperGroup):
    """A group of commands."""


class CommandOfFlags(PlainFlags, TyperCommand):
    """A command that refuses a flag that is given twice, whose help leaves out the `--no-` of switches."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the flags; of one that stands there twice, all but the last would be lost without a word."""
        _, _, order = self.make_parser(ctx).parse_args(list(args))
        times = Counter(flag.opts[-1] for flag in order if not getattr(flag, "is_flag", True) and not flag.multiple)
        twice = next((name for name, count in times.items() if count > 1), None)
        if twice is not None and not ctx.resilient_parsing:
            more = ": name the others among the files, or all by a glob" if twice == "--model" else ""
            ctx.fail(f"{twice} is given {times[twice]} times, and takes one value{more}.")
        return list(super().parse_args(ctx, args))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """As always, but without `--no-`, which only a config file makes useful."""
        switches = [(flag, flag.secondary_opts) for flag in self.params if flag.secondary_opts]
        for flag, _ in switches:
            flag.secondary_opts = []
        try:
            super().format_help(ctx, formatter)
        finally:
            for flag, names in switches:
                flag.secondary_opts = names


def signature(command: Command, running: dict[str, tuple[Any, Any, str, str]]) -> inspect.Signature:
    """The parameters of a command as typer reads them: files, flags without a panel, how to run, flags in panels.

    Every flag defaults to None, so that a config file can tell what was not given. What is named by its place comes
    before the files, which take all the rest.
    """
    hints = get_type_hints(command.params)
    keyword = inspect.Parameter.KEYWORD_ONLY
    places: list[inspect.Parameter] = []
    first: list[inspect.Parameter] = []
    in_panels: list[inspect.Parameter] = []
    for item in fields(command.params):
        flag, kind, panel = flag_of(item), hints[item.name], item.metadata["panel"]
        option: Any  # typer's own types of arguments and options
        if not flag.startswith("--"):
            option = typer.Argument(metavar=flag, help=_help(item), show_default=False)
        elif kind is bool:
            names = flag if item.metadata["consent"] else f"{flag}/--no-{flag[2:]}"  # no file sets it, so none is unset
            option = typer.Option(names, help=_help(item), rich_help_panel=panel or None)
        else:
            option = typer.Option(flag, help=_help(item), rich_help_panel=panel or None)
        entry = inspect.Parameter(item.name, keyword, default=None, annotation=Annotated[kind | None, option])
        (places if not flag.startswith("--") else in_panels if panel else first).append(entry)
    how = []
    for name, (kind, default, names, help_) in running.items():
        option = typer.Option(
            *names.split("/"),
            help=help_,
            rich_help_panel=RUNNING,
            show_default=default in (1, engines.LOCAL),
        )
        how.append(inspect.Parameter(name, keyword, default=default, annotation=Annotated[kind, option]))
    if command.files:
        help_ = command.files + (f" A folder stands for the {command.kind} files in it." if command.kind else "")
        files = Annotated[list[Path], typer.Argument(metavar="FILES", help=help_, show_default=False)]
        needed: Any = inspect.Parameter.empty if command.files_needed else []
        places.append(inspect.Parameter("files", keyword, default=needed, annotation=files))
    return inspect.Signature([*places, *first, *how, *in_panels])


def looking(name: str) -> Any:
    """The option of one of OF_STAGES, as typer reads it from the signature of a function."""
    _, _, names, help_ = OF_STAGES[name]
    return typer.Option(*names.split("/"), help=help_)


def _help(item: Any) -> str:
    """What is said of a flag: its help, the values that it takes, its unit, its default."""
    about = item.metadata
    text = about["help"].replace("[", "\\[")  # text, not markup
    choices = f" ({', '.join(about['choices'])})" if len(about["choices"]) > 1 else ""
    unit = f" \\[{about['unit']}]" if about["unit"] else ""
    has_default = item.default is not None and item.default is not False and item.default != ""
    default = f" \\[default: {item.default}]" if has_default else ""
    return f"{text}{choices}{unit}{default}"


def help_text(command: Command) -> str:
    """What a command does, and examples of it."""
    said = [" ".join(paragraph.split()) for paragraph in (command.params.__doc__ or "").split("\n\n")]
    return "\n\n".join([*said, "\n".join(command.examples)])
