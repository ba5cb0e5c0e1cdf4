"""Build the reference page of each command from Typer: purpose, examples, options by panel, values and defaults."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

import typer

from evetac_cli import commands
from evetac_cli.cli.config import with_config
from evetac_cli.cli.main import app
from evetac_cli.commands.columns import columns_of
from evetac_cli.errors import DeviceError, EvetacError, InputError
from scripts.docs.page_text import bounds, code, fenced, prose, sentence, table

FOLDER = "commands"
UNNAMED_PANEL = "Options"
PICTURES = Path(__file__).resolve().parents[2] / "docs" / "pictures"
ENDS = (
    (0, "the command succeeded, or had nothing to do"),
    (EvetacError.exit_code, "the command failed"),
    (InputError.exit_code, "a flag, a file or a value is invalid"),
    (DeviceError.exit_code, "a camera or a gripper failed, or `doctor` found a problem"),
    (130, "stopped by Ctrl-C: finished files are complete, those in progress were discarded"),
)


def every_command() -> dict[str, Any]:
    """Return all commands by their full names, such as `evaluate slip`, in the order of `evetac --help`."""
    return dict(_walk(typer.main.get_command(app), ()))


def _walk(command: Any, names: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    if names and (not hasattr(command, "commands") or command.invoke_without_command):
        yield " ".join(names), command
    for name, inner in getattr(command, "commands", {}).items():
        yield from _walk(inner, (*names, name))


def page_name(command: str) -> str:
    """Return the file name of a command's page."""
    return f"{command.replace(' ', '-')}.md"


def pages() -> dict[str, str]:
    """Return the text of every page by its path: one page per command, and the list of all commands."""
    every = every_command()
    page_of = {f"{FOLDER}/{page_name(name)}": _page(name, command) for name, command in every.items()}
    return {f"{FOLDER}/index.md": _list(every), **page_of}


def _list(every: Mapping[str, Any]) -> str:
    parts = [
        "# Commands\n",
        "Each command reads files and writes its results next to them. `evetac COMMAND --help` prints the same"
        " information as the command's page.\n",
    ]
    panels: dict[str, list[tuple[str, str]]] = {}
    for name, command in every.items():
        panel = "Evaluate" if name.startswith("evaluate ") else command.rich_help_panel or "Other"
        link = f"[{code(f'evetac {name}')}]({page_name(name)})"
        panels.setdefault(str(panel), []).append((link, prose(_help(command)[0][0])))
    for panel in sorted(panels, key=lambda name: name == "Inspect"):
        parts += [f"## {panel}\n", table(("command", "what it does"), panels[panel])]
    parts += ["## Exit codes\n", table(("code", "meaning"), [(str(number), meaning) for number, meaning in ENDS])]
    parts.append(
        "With `--json` a command always prints exactly one JSON object on stdout, with the keys `command`, `simulated`,"
        " `rows` and `summary`, and `error` if the command failed. Progress and messages go to stderr.\n"
    )
    return "\n".join(parts)


def _page(name: str, command: Any) -> str:
    (purpose, *more), examples = _help(command)
    arguments = [param for param in command.params if param.param_type_name == "argument"]
    options = [param for param in command.params if param.param_type_name == "option" and not param.hidden]
    placed = " ".join(_argument(param) for param in arguments)
    parts = [f"# evetac {name}\n", sentence(prose(purpose)) + "\n"]
    parts += [prose(part) + "\n" for part in more]
    parts.append(fenced(f"evetac {name} {placed} [OPTIONS]".replace("  ", " "), "text"))
    if examples:
        parts += ["## Examples\n", fenced("\n".join(examples), "console")]
    picture = f"{name.replace(' ', '-')}.webp"
    if (PICTURES / picture).exists():
        parts.append(f"![What `evetac {name}` shows (simulated)](../../pictures/{picture})\n")
    if arguments:
        rows = [(code(_argument(param)), prose(param.help or "")) for param in arguments]
        parts += ["## Arguments\n", table(("argument", "meaning"), rows)]
    known = _parameters(name)
    panels: dict[str, list[tuple[str, str, str, str]]] = {}
    for param in options:
        panel = str(getattr(param, "rich_help_panel", None) or UNNAMED_PANEL)
        panels.setdefault(panel, []).append(_option(param, known.get(param.name)))
    for panel, rows in panels.items():
        parts += [f"## {panel}\n", table(("option", "what it does", "values", "default"), rows)]
    if columns := columns_of(name):
        cells = [(code(one.name), one.unit, prose(one.meaning)) for one in columns.values()]
        parts += ["## Columns\n", table(("column", "unit", "meaning"), cells)]
    if name in with_config():
        parts.append(_in_a_file(name))
    return "\n".join(parts)


def _in_a_file(name: str) -> str:
    """Explain how to write the options in a file for --config."""
    table_of = code(f"[{name.replace(' ', '.')}]")
    return f"In a `--config` file, write these options in the table {table_of}, with `_` instead of `-`.\n"


def _argument(param: Any) -> str:
    shown = str(param.metavar or param.name.upper())
    shown += "..." if param.nargs == -1 else ""
    return shown if param.required else f"[{shown}]"


def _help(command: Any) -> tuple[list[str], list[str]]:
    """Split a command's help into paragraphs and examples; examples are lines that begin with `evetac `."""
    paragraphs, examples = [], []
    for part in (command.help or "").replace("\b", "").split("\n\n"):
        lines = [line.strip() for line in part.strip().splitlines()]
        if lines and all(line.startswith("evetac ") for line in lines):
            examples += lines
        else:
            paragraphs.append(" ".join(lines))
    return paragraphs, examples


def _parameters(name: str) -> dict[str, Field[Any]]:
    """Return the parameters of a command by name, if the command is made from a dataclass."""
    command = commands.every().get(name) or with_config()[name]
    return {item.name: item for item in fields(command.params)}


def _option(param: Any, known: Field[Any] | None) -> tuple[str, str, str, str]:
    """Return the table row of an option; values, unit and default come from its parameter, if it has one."""
    flags = ", ".join(code(flag) for flag in param.opts)
    if known is None:
        shown = "" if param.default is None or param.default is False else code(param.default)
        return flags, prose(re.sub(r"\s*\\?\[default: [^\]]*\]", "", param.help or "")), "", shown
    about = known.metadata
    values = ", ".join(map(code, about["choices"])) or bounds(about["low"], about["high"])
    if about["unit"]:
        values = f"{values} {about['unit']}" if values and not about["choices"] else values or about["unit"]
    default = "" if known.default is None or known.default is False or known.default == "" else code(known.default)
    return flags, prose(about["help"]), values, default
