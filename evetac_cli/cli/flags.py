"""Flags and help of a command, made from its parameters, which are declared once, in commands/.

Flags that most people need come first, then those for how to run, then the others in separate panels. The first two
groups fit on one screen.
"""

import inspect
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from evetac_cli import console
from evetac_cli.commands.parameter import EXPERTS, RUNNING, STAGE, Command, flag_of
from evetac_cli.errors import InputError

LOCAL = "local"  # jobs run on this computer (workers.py), and not on a Dask cluster (dask_engine.py)
UNREAD = object()
WHOLE = re.compile("-?(0|[1-9][0-9]{0,17})")
DECIMAL = re.compile("-?(0|[1-9][0-9]{0,17})([.][0-9]{1,17})?")
# How to run; the same for every command that writes files. None of these flags changes the numbers. For each flag: its
# type, default, names and help.
OF_STAGES: dict[str, tuple[Any, Any, str, str]] = {
    "out": (Path | None, None, "-o/--out", "Output file or folder; else next to the input."),
    "force": (bool, False, "-f/--force", "Replace an output made with another recipe."),
    "number_of_jobs": (int, 1, "-j/--jobs", "Files processed at the same time."),
    "engine": (
        str,
        LOCAL,
        "--engine",
        "local, or dask:tls://ADDRESS: the workers of a Dask cluster (docs/cluster.md).",
    ),
    "config": (
        Path | None,
        None,
        "--config",
        "TOML file of parameters; --no-FLAG unsets one.",
    ),
    "as_json": (bool, False, "--json", "Print one JSON object instead of a table."),
    "legend": (bool, False, "--legend", "Only print what the columns mean."),
    "quiet": (bool, False, "-q/--quiet", "Print no progress and no messages."),
    "verbose": (bool, False, "-v/--verbose", "Print whole tables, and tracebacks of errors."),
}


def running(command: Command) -> dict[str, tuple[Any, Any, str, str]]:
    """Return how to run a command: its flags of OF_STAGES, with the help of its own -o and -f.

    Several jobs and a config file are only for parameters that are part of a recipe.
    """
    if command.does == STAGE:
        return OF_STAGES
    own = {name: about for name, about in (("out", command.out), ("force", command.force)) if about}
    chosen = {name: OF_STAGES[name] for name in (*own, "as_json", "legend", "quiet", "verbose")}
    return {name: (*entry[:3], own.get(name, entry[3])) for name, entry in chosen.items()}


def scheduler_of(engine: str) -> str:
    """Return the address in `dask:ADDRESS`, or "" for `local`; InputError for another value of `--engine`."""
    if engine != LOCAL and not engine.startswith(("dask:tls://", "dask:tcp://")):
        expected = "local, dask:tls://ADDRESS:PORT or dask:tcp://ADDRESS:PORT"
        raise InputError("unknown engine", where="--engine", expected=expected, found=engine)
    return "" if engine == LOCAL else engine.removeprefix("dask:")


@dataclass(frozen=True)
class Running:
    """How a command is run, from its flags. If a command lacks one of these flags, the default applies."""

    out: Path | None = None
    force: bool = False
    number_of_jobs: int = 1
    engine: str = LOCAL
    config: Path | None = None
    as_json: bool = False
    legend: bool = False  # printed before a command begins
    quiet: bool = False
    verbose: bool = False

    @classmethod
    def take(cls, flag_values: dict[str, Any], names: Iterable[str]) -> "Running":
        """Remove these flags from `flag_values` and return them as a Running."""
        return cls(**{name: flag_values.pop(name) for name in names})


HELP_ALL = "evetac.help_all"  # key of a context's meta data


class PlainFlags:
    """Base of commands and groups: shows switches without a type, since they take no value, and reads plain values."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return all flags, including `--help`."""
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for flag in params:
            if getattr(flag, "is_flag", False):
                flag.metavar = ""
            if not isinstance(flag.process_value, partial):
                flag.process_value = partial(_processed, flag, flag.process_value)
        return params


def _processed(flag: Any, usual: Callable[[Any, Any], Any], ctx: Any, raw_value: Any) -> Any:
    """Return the value of a flag. Plain values are read here, all others by typer, which also raises the errors.

    Typer reads every value with pydantic, and loading pydantic takes a fifth of the time of a command that has nothing
    to do.
    """
    described = getattr(flag, "type_descriptor", None)
    kind = getattr(described, "annotation", None)
    if kind is None or flag.value_is_missing(raw_value) and flag.required:
        return usual(ctx, raw_value)
    several = flag.multiple or flag.nargs == -1
    if raw_value is None:
        value: Any = () if several else None
    elif not several:
        value = plain_value(kind, raw_value)
    elif get_origin(kind) is list:
        value = [plain_value(get_args(kind)[0], item) for item in raw_value]
    else:
        value = UNREAD
    if value is UNREAD or several and UNREAD in value:
        return usual(ctx, raw_value)
    return value if flag.callback is None else flag.callback(ctx, flag, value)


def plain_value(kind: Any, raw_value: Any) -> Any:
    """Return a text or a default as a value of type `kind`, or UNREAD if typer has to read it."""
    if type(raw_value) is kind:
        return raw_value
    if isinstance(raw_value, str):
        if kind is int and WHOLE.fullmatch(raw_value):
            return int(raw_value)
        if kind is float and DECIMAL.fullmatch(raw_value):
            return float(raw_value)
        if kind is Path and (not os.path.exists(raw_value) or os.access(raw_value, os.R_OK)):
            return Path(raw_value)
    return UNREAD


class Group(PlainFlags, TyperGroup):
    """A group of commands."""


class CommandOfFlags(PlainFlags, TyperCommand):
    """A command that refuses a repeated flag, explains its columns, and hides `--no-` forms and EXPERTS in help."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the flags. A repeated flag is an error; otherwise all but its last value would be lost silently."""
        values, _, order = self.make_parser(ctx).parse_args(list(args))
        if values.get("legend") and not ctx.resilient_parsing:
            group = f"{ctx.parent.info_name} " if ctx.parent and ctx.parent.parent else ""
            print_legend(f"{group}{self.name}", as_json=bool(values.get("as_json")))
            ctx.exit()
        times = Counter(flag.opts[-1] for flag in order if not getattr(flag, "is_flag", True) and not flag.multiple)
        twice = next((name for name, count in times.items() if count > 1), None)
        if twice is not None and not ctx.resilient_parsing:
            more = ": several models of `evaluate slip` are given with commas" if twice == "--model" else ""
            ctx.fail(f"{twice} is given {times[twice]} times but takes one value{more}.")
        return list(super().parse_args(ctx, args))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the usual help without the `--no-` forms, which are useful only together with a config file."""
        whole = self.params
        self.params = [copy(flag) for flag in whole if ctx.meta.get(HELP_ALL) or not is_for_experts(flag)]
        for flag in self.params:
            flag.secondary_opts = []
        try:
            super().format_help(ctx, formatter)
        finally:
            self.params = whole


def print_legend(title: str, *, as_json: bool) -> None:
    """Print what the columns of a command mean, such as `label` or `evaluate slip`."""
    from evetac_cli.commands.columns import columns_of  # loaded only for this

    columns = columns_of(title).values()
    rows = [{"column": one.name, "unit": one.unit or None, "meaning": one.meaning} for one in columns]
    if not as_json:
        rows = [{"column": one.name, "meaning": one.in_words} for one in columns]
    console.show(f"{title} --legend", rows, {}, simulated=False, as_json=as_json)


def is_for_experts(flag: Any) -> bool:
    """Whether only --help-all shows a flag."""
    return getattr(flag, "rich_help_panel", None) == EXPERTS


def _print_all_help(ctx: typer.Context, wanted: bool) -> None:
    if wanted:
        ctx.meta[HELP_ALL] = True
        typer.echo(ctx.get_help())
        raise typer.Exit


ALL_HELP = typer.Option(
    "--help-all", callback=_print_all_help, is_eager=True, rich_help_panel=RUNNING,
    help="Also show the flags for precision and experts.",
)  # fmt: skip


def signature(command: Command) -> inspect.Signature:
    """Return the parameters of a command for typer: files, flags without a panel, how to run, flags in panels,
    those for experts last.

    Every flag defaults to None, so that flags that were not given can be taken from a config file. Positional
    parameters come before the files, which take all remaining arguments.
    """
    hints = get_type_hints(command.params)
    keyword = inspect.Parameter.KEYWORD_ONLY
    places: list[inspect.Parameter] = []
    first: list[inspect.Parameter] = []
    in_panels: list[inspect.Parameter] = []
    experts: list[inspect.Parameter] = []
    for item in fields(command.params):
        flag, kind, panel = flag_of(item), hints[item.name], item.metadata["panel"]
        option: Any  # typer's own types of arguments and options
        if not flag.startswith("--"):
            option = typer.Argument(metavar=flag, help=_help(item), show_default=False)
        elif kind is bool:
            is_in_files = command.does == STAGE and not item.metadata["consent"]  # no config file can set consent
            names = f"{flag}/--no-{flag[2:]}" if is_in_files else flag
            option = typer.Option(names, help=_help(item), rich_help_panel=panel or None)
        else:
            option = typer.Option(flag, help=_help(item), rich_help_panel=panel or None)
        entry = inspect.Parameter(item.name, keyword, default=None, annotation=Annotated[kind | None, option])
        others = experts if panel == EXPERTS else in_panels if panel else first
        (others if flag.startswith("--") else places).append(entry)
    how: list[inspect.Parameter] = []
    for name, (kind, default, names, help_) in running(command).items():
        panel = EXPERTS if name == "engine" else RUNNING
        shown = default in (1, LOCAL)
        option = typer.Option(*names.split("/"), help=help_, rich_help_panel=panel, show_default=shown)
        entry = inspect.Parameter(name, keyword, default=default, annotation=Annotated[kind, option])
        (experts if panel == EXPERTS else how).append(entry)
    if experts:
        how.append(inspect.Parameter("help_all", keyword, default=False, annotation=Annotated[bool, ALL_HELP]))
    if command.files:
        help_ = command.files + (f" For a folder, all {command.kind} files in it are used." if command.kind else "")
        files = Annotated[list[Path], typer.Argument(metavar="FILES", help=help_, show_default=False)]
        needed: Any = inspect.Parameter.empty if command.files_needed else []
        places.append(inspect.Parameter("files", keyword, default=needed, annotation=files))
    context = inspect.Parameter("ctx", keyword, annotation=typer.Context)
    return inspect.Signature([context, *places, *first, *how, *in_panels, *experts])


def _help(item: Any) -> str:
    """Return the help of a flag: its text, choices, unit and default."""
    about = item.metadata
    text = about["help"].replace("[", "\\[")  # text, not markup
    choices = f" ({', '.join(about['choices'])})" if len(about["choices"]) > 1 else ""
    unit = f" \\[{about['unit']}]" if about["unit"] else ""
    has_default = item.default is not None and item.default is not False and item.default != ""
    default = f" \\[default: {item.default}]" if has_default else ""
    return f"{text}{choices}{unit}{default}"


def help_text(command: Command) -> str:
    """Return the description of a command, followed by its examples."""
    paragraphs = [" ".join(paragraph.split()) for paragraph in (command.params.__doc__ or "").split("\n\n")]
    return "\n\n".join([*paragraphs, "\n".join(command.examples)])
